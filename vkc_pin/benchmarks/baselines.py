"""Base and arm planned together (VKC) against planners of base and arm apart (B1, B2): push a door open, pull a drawer open.

The same random starts, scenes, limits and validation for all.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from vkc_pin import baselines
from vkc_pin.benchmarks import experiment
from vkc_pin.benchmarks.baselines_report import report
from vkc_pin.benchmarks.charts import criteria_chart, motions_chart
from vkc_pin.benchmarks.record import trial
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.plan import Plan, write_atomically
from vkc_pin.planner import plan
from vkc_pin.scene import Scene, load_scene
from vkc_pin.steps import Actuate
from vkc_pin.trajectory import Trajectory

__all__ = ["METHODS", "TASKS", "Task", "peaks", "plan_trial", "run", "specify"]


@dataclass(frozen=True)
class Task:
    """What is to be done.

    Attributes:
        scene: The scene's name.
        object: What is moved in it.
        goal: Its joints' values in the end [rad] or [m].
        name: To show.
    """

    scene: str
    object: str
    goal: Mapping[str, float]
    name: str


TASKS = {
    "door": Task("corridor_door", "door", {"hinge": 1.5}, "push a door open"),
    "drawer": Task("aisle_drawer", "drawer", {"slide": 0.6}, "pull a drawer open"),
}
METHODS = (*baselines.METHODS, "VKC")
TIME_LIMIT = 20.0  # [s] of planning

Solve = Callable[[Scene, Mapping[str, Any]], Plan]


def plan_trial(scene: Scene, spec: Mapping[str, Any]) -> Plan:
    """Plan the task of one trial: `scene` (the task's name), `method` and `seed` say how."""
    task = TASKS[spec["scene"]]
    steps = [Actuate(task.object, dict(task.goal))]
    if spec["method"] == "VKC":
        return plan(scene, steps, time_limit=TIME_LIMIT, seed=spec["seed"])
    return baselines.plan_separately(scene, steps, method=spec["method"], time_limit=TIME_LIMIT, seed=spec["seed"])


def specify(*, trials: int, seed: int, tasks: Sequence[str], methods: Sequence[str]) -> list[dict[str, Any]]:
    """Return the trials: every task, method and start, in this order, in which a process can keep what it has built.

    A task's starts depend on the seed and the task alone; start i is planned from with the random seed `seed` + i.
    """
    specs = []
    for task in tasks:
        rng, scene = np.random.default_rng([seed, list(TASKS).index(task)]), load_scene(TASKS[task].scene)
        bases = [scene.sample_start(rng).start[:3].tolist() for _ in range(trials)]
        for method in methods:
            for number, base in enumerate(bases):
                key = f"{task}/{number:04d}/{method}"
                specs.append({"key": key, "scene": task, "method": method, "number": number, "base": base, "seed": seed + number})
    return specs


def run(
    *,
    trials: int,
    seed: int,
    out: str | Path,
    jobs: int = 1,
    tasks: Sequence[str] = tuple(TASKS),
    methods: Sequence[str] = METHODS,
    save_failures: bool = False,
    progress: bool = True,
    solve: Solve = plan_trial,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write its results, table and pictures to `out`.

    They are results.json, results.csv and table.md; for every task <task>.png (the criteria as bars) and <task>_joints.png (the
    motions of one trial over time); the plans of that trial in shown/, and those of failures in failures/ if asked for.

    Args:
        trials: Number of random starts per task, at least 1.
        seed: Of the starts and of planning.
        out: The folder; if it has trials of the same settings already, they are not run again.
        jobs: Number of processes.
        tasks: Some of `TASKS`.
        methods: Some of `METHODS`.
        save_failures: Save the plan of every failure; those that ran before without this are planned once more.
        progress: Whether to show progress bars.
        solve: What plans a trial.

    Returns:
        {"meta": ..., "trials": [...]}; see `experiment.run`. A trial's `scene` is its task's name.

    Raises:
        UnknownNameError: There is no such task or method.
        InputError: No trials, tasks or methods, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    tasks, methods = _chosen("task", tasks, list(TASKS)), _chosen("method", methods, METHODS)
    if trials < 1:
        raise InputError("out of range", field="trials", expected="at least 1", got=trials)
    specs, out = specify(trials=trials, seed=seed, tasks=tasks, methods=methods), Path(out)
    settings = {
        "benchmark": "baselines",
        "seed": seed,
        "starts": trials,
        "tasks": tasks,
        "methods": methods,
        "scenes": {task: TASKS[task].scene for task in tasks},
        "goals": {task: {f"{TASKS[task].object}.{joint}": at for joint, at in TASKS[task].goal.items()} for task in tasks},
        "time_limit": TIME_LIMIT,
        "retries": baselines.RETRIES,
    }
    function = functools.partial(_record, solve=solve, out=out if save_failures else None)
    result = experiment.run(specs, function, out, settings=settings, jobs=jobs, progress=progress)
    saved = _saved(result["trials"], specs, out, solve if save_failures else None, progress=progress)
    shown = _pictures(result["trials"], specs, out, solve)
    names = {task: TASKS[task].name for task in tasks}
    write_atomically(out / "table.md", report(result, names, saved=saved, shown=shown).encode())
    return result


def peaks(trajectory: Trajectory) -> dict[str, float]:
    """Return the largest velocity [rad/s] and acceleration [rad/s²] of an arm joint: peak_velocity, peak_acceleration."""
    arm = slice(3, trajectory.robot_size)
    rates = {"peak_velocity": trajectory.velocities(), "peak_acceleration": trajectory.accelerations()}
    return {name: float(np.abs(rate[:, arm]).max(initial=0.0)) for name, rate in rates.items()}


def _record(spec: dict[str, Any], solve: Solve, out: Path | None) -> dict[str, Any]:
    """Run one trial and return its record; a failure's plan is saved in `out`."""
    _ready()
    found = _plan(spec, solve)
    if out is not None and not found.success and found.status != "interrupted":
        found.save(_file(spec, out, "failures"))
    own = {"scene": spec["scene"], "number": spec["number"], "duration": found.metrics["duration"], **peaks(found.trajectory)}
    return trial(found, method=spec["method"], seed=spec["seed"], **own)


def _saved(
    records: Sequence[Mapping[str, Any]], specs: Sequence[Mapping[str, Any]], out: Path, solve: Solve | None, *, progress: bool
) -> dict[str, str]:
    """Return key → file in `out` of the failures whose plans are saved; with `solve`, those that are not are planned again."""
    failed = {record["key"] for record in records if not record["success"] and record["status"] != "error"}
    files = {spec["key"]: _file(spec, out, "failures") for spec in specs if spec["key"] in failed}
    lost = [spec for spec in specs if spec["key"] in failed and not files[spec["key"]].is_file()] if solve else []
    for spec in tqdm(lost, desc="failures", unit="plan", disable=not (progress and lost)):
        assert solve is not None
        found = _uninterrupted(spec, solve)
        if not found.success:
            found.save(files[spec["key"]])
    return {key: path.relative_to(out).as_posix() for key, path in files.items() if path.is_file()}


def _pictures(
    records: Sequence[Mapping[str, Any]], specs: Sequence[Mapping[str, Any]], out: Path, solve: Solve
) -> dict[str, int]:
    """Draw the charts of every task; return the trial whose motions are shown, for tasks where there is one."""
    methods, shown = tuple(dict.fromkeys(spec["method"] for spec in specs)), {}
    for task in dict.fromkeys(spec["scene"] for spec in specs):
        own, name = [record for record in records if record["scene"] == task], TASKS[task].name.capitalize()
        starts = len({record["number"] for record in own})
        criteria_chart(own, out / f"{task}.png", methods, title=f"{name}, {starts} random start{'s' * (starts != 1)}")
        number = _shown(own, methods)
        if number is not None:
            shown[task] = number
            plans = {s["method"]: _kept(s, out, solve) for s in specs if (s["scene"], s["number"]) == (task, number)}
            motions_chart(plans, out / f"{task}_joints.png", title=f"{name}, trial {number}")
    return shown


def _shown(records: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> int | None:
    """Return the first trial in which all methods succeed, or else VKC and most others, or else most; None: none ever does."""
    good: dict[int, set[str]] = {}
    for record in records:
        if record["success"]:
            good.setdefault(int(record["number"]), set()).add(str(record["method"]))
    return max(sorted(good), key=lambda k: (len(good[k]) == len(methods), "VKC" in good[k], len(good[k])), default=None)


def _kept(spec: Mapping[str, Any], out: Path, solve: Solve) -> Plan:
    """Return the plan of a trial that is shown: from its file, or else planned again and saved there."""
    path = _file(spec, out, "shown")
    if path.is_file():
        return Plan.load(path)
    found = _uninterrupted(spec, solve)
    found.save(path)
    return found


def _uninterrupted(spec: Mapping[str, Any], solve: Solve) -> Plan:
    found = _plan(spec, solve)
    if found.status == "interrupted":
        raise KeyboardInterrupt("all trials are done, but not all of their plans are saved")
    return found


def _plan(spec: Mapping[str, Any], solve: Solve) -> Plan:
    return solve(_scene(TASKS[spec["scene"]].scene).with_start(base=spec["base"]), spec)


def _file(spec: Mapping[str, Any], out: Path, folder: str) -> Path:
    return out / folder / f"{spec['scene']}_{spec['number']:04d}_{spec['method']}.npz"


def _chosen(kind: str, names: Sequence[str], choices: Sequence[str]) -> tuple[str, ...]:
    """Return names without repetition, in the order of the choices; raise an error if one is none of them."""
    for name in names:
        if name not in choices:
            raise UnknownNameError(kind, name, choices, field=f"{kind}s")
    if not names:
        raise InputError("nothing to compare", field=f"{kind}s", expected="at least one")
    return tuple(choice for choice in choices if choice in names)


@functools.cache
def _scene(name: str) -> Scene:
    """Return a scene, loaded once per process."""
    return load_scene(name)


@functools.cache
def _ready() -> None:
    """Import what planners import when they are first called, which is no part of planning."""
    import pink  # noqa: F401
