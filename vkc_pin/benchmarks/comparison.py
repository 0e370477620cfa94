"""Compares planning base and arm together (VKC) with planning them apart (B1, B2).

All methods get the same tasks, random starts, limits and validation.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from tqdm import tqdm

from vkc_pin.baselines.attempt import FINER
from vkc_pin.baselines.separate import BASELINES, RETRIES, plan_separately
from vkc_pin.benchmarks.comparison_tables import WAYPOINTS, format_results
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.charts import motions_chart
from vkc_pin.benchmarks.harness.limits import LIMITS, MAX_EVALUATIONS
from vkc_pin.benchmarks.harness.record import Record, Solve, compute_peaks, trial
from vkc_pin.benchmarks.harness.runner import Execution
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, plan
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Place, Step

__all__ = ["COLD", "COMPARED_PLANNERS", "METHODS", "Assignment", "Comparison"]

COMPARED_PLANNERS = (*BASELINES, "VKC")
METHODS = (*COMPARED_PLANNERS[:-1], *WAYPOINTS, "VKC")  # in the order of the tables
COLD = 5
"""Number of trials of a task and method that are planned twice, cold and warm."""

Draw = Callable[[Sequence[Record], Path, Mapping[str, str], Sequence[str]], list[str]]
"""Draws the charts of records, in a folder, for tasks (name → description) and methods."""


@dataclass(frozen=True)
class Assignment:
    """A task of an experiment.

    Attributes:
        scene: Name of the scene.
        steps: Steps to plan.
        name: Description.
        scatter: Samples poses of objects, by name, (x, y, z, roll, pitch, yaw) [m, rad] each.
            Default: all objects stay as in the scene.
    """

    scene: str
    steps: tuple[Step, ...]
    name: str
    scatter: Callable[[Scene, np.random.Generator], dict[str, list[float]]] | None = None


@dataclass(frozen=True)
class Comparison:
    """An experiment that compares `COMPARED_PLANNERS`.

    Attributes:
        benchmark: Name on the command line.
        title: Title of the tables.
        tasks: Name → task.
        draw: Draws the charts.
        load: Loads a scene by name.
    """

    benchmark: str
    title: str
    tasks: Mapping[str, Assignment]
    draw: Draw
    load: Callable[[str], Scene] = load_scene

    def plan_trial(self, scene: Scene, spec: Mapping[str, Any]) -> Plan:
        """Plan a trial with its task (`scene`), `method`, `seed` and other settings."""
        steps = self.tasks[spec["scene"]].steps
        how: dict[str, Any] = {
            **LIMITS,
            **{key: spec[key] for key in ("max_evaluations", "planner") if key in spec},
            "seed": spec["seed"],
        }
        if spec["method"] == "VKC":
            return plan(scene, steps, **how)
        method, finer = WAYPOINTS.get(spec["method"], (spec["method"], FINER))
        return plan_separately(scene, steps, method=method, finer=finer, **how)

    def specify(
        self,
        *,
        trials: int,
        seed: int,
        tasks: Sequence[str],
        methods: Sequence[str],
        max_evaluations: int = MAX_EVALUATIONS,
    ) -> list[dict[str, Any]]:
        """Return the trials, ordered by task, method and start.

        Starts and poses of objects depend on seed and task alone. Start i is planned with the
        random seed `seed` + i.
        """
        specs = []
        for name in tasks:
            task = self.tasks[name]
            rng = np.random.default_rng([seed, list(self.tasks).index(name)])
            scene = _load_scene_once(self.load, task.scene)
            starts: list[dict[str, Any]] = []
            for _ in range(trials):
                more = {"placed": task.scatter(scene, rng)} if task.scatter else {}
                base = place_objects(scene, more).sample_start(rng).start[:3].tolist()
                starts.append({"base": base, **more})
            for method in methods:
                for number, start in enumerate(starts):
                    own = {"scene": name, "method": method, "number": number, **start}
                    key = f"{name}/{number:04d}/{method}"
                    specs.append(
                        {
                            "key": key,
                            **own,
                            "seed": seed + number,
                            "max_evaluations": max_evaluations,
                        }
                    )
        return specs

    def run(
        self,
        *,
        trials: int,
        seed: int,
        out: str | Path,
        solve: Solve | None = None,
        tasks: Sequence[str] | None = None,
        methods: Sequence[str] = COMPARED_PLANNERS,
        max_evaluations: int = MAX_EVALUATIONS,
        save_failures: bool = False,
        **execution: Unpack[Execution],
    ) -> dict[str, Any]:
        """Run the experiment in the folder `out`; see `runner.run`.

        Args:
            out: Folder.
            trials: Number of random starts per task, at least 1.
            seed: Random seed of starts and planning.
            solve: Plans a trial. Default: `plan_trial`.
            tasks: Names of tasks. Default: all.
            methods: Some of `METHODS`.
            max_evaluations: Limit of evaluations of each trial.
            save_failures: Whether to save the plan of every failure; failures that were run
                without it are planned again.

        Returns:
            See `runner.run`; the `scene` of a trial is the name of its task.
        """
        tasks = runner.select_names("task", self.tasks if tasks is None else tasks, self.tasks)
        methods = runner.select_names("method", methods, METHODS)
        runner.check_positive(trials=trials)
        out, progress = Path(out), execution.get("progress", True)
        specs = self.specify(
            trials=trials, seed=seed, tasks=tasks, methods=methods, max_evaluations=max_evaluations
        )
        settings = {
            "benchmark": self.benchmark,
            "seed": seed,
            "starts": trials,
            "tasks": tasks,
            "methods": methods,
            "scenes": {name: self.tasks[name].scene for name in tasks},
            "goals": {name: list_goals(self.tasks[name].steps) for name in tasks},
            **{**LIMITS, "max_evaluations": max_evaluations, "retries": RETRIES},
        }
        trials_of = _Trials(self, out, solve or self.plan_trial, timed=solve is None)
        record = functools.partial(trials_of.record, save_failures=save_failures)
        result = runner.run(specs, record, out, settings=settings, **execution)
        saved = trials_of.list_saved_plans(
            result["trials"], specs, again=save_failures, show=progress
        )
        names = {name: self.tasks[name].name for name in tasks}
        pictures = self.draw(result["trials"], out, names, methods)
        pictures += trials_of.draw_motions(result["trials"], specs)
        text = self.format_results(result, saved=saved, pictures=pictures)
        write_atomically(out / "table.md", text.encode())
        return result

    def format_results(
        self,
        result: Mapping[str, Any],
        *,
        saved: Mapping[str, str] | None = None,
        pictures: Sequence[str] = (),
    ) -> str:
        """Return the tables of a result in Markdown; see `comparison_tables.format_results`."""
        names = {name: self.tasks[name].name for name in result["meta"]["tasks"]}
        return format_results(result, names, title=self.title, saved=saved, pictures=pictures)


def place_objects(scene: Scene, spec: Mapping[str, Any]) -> Scene:
    """Return a scene with its objects at the poses of a trial."""
    for name, pose in spec.get("placed", {}).items():
        scene = scene.with_placement(name, as_placement(pose))
    return scene


def list_goals(steps: Sequence[Step]) -> dict[str, Any]:
    """Return the goals of steps: "<object>.<joint>" → value, object or "base" → pose."""
    found: dict[str, Any] = {}
    for step in steps:
        if isinstance(step, Actuate):
            found |= {f"{step.object}.{joint}": value for joint, value in step.joints.items()}
        elif isinstance(step, Place):
            found[step.object] = np.asarray(step.pose, float).tolist()
        elif isinstance(step, GoTo):
            found["base"] = [step.x, step.y] if step.yaw is None else [step.x, step.y, step.yaw]
    return found


@dataclass(frozen=True)
class _Trials:
    """Runs the trials of an experiment and keeps their plans in a folder."""

    experiment: Comparison
    out: Path
    solve: Solve
    timed: bool = False

    def record(self, spec: dict[str, Any], *, save_failures: bool) -> dict[str, Any]:
        """Run a trial and return its record."""
        import pink  # noqa: F401 - planners import it at their first call, which is no planning time

        found, times = self._plan_timed(spec)
        if save_failures and not found.success and found.status != "interrupted":
            found.save(self._file(spec, "failures"))
        own = {"duration": found.metrics["duration"], **compute_peaks(found.trajectory), **times}
        own |= {key: spec[key] for key in ("scene", "number", "placed") if key in spec}
        return trial(found, method=spec["method"], seed=spec["seed"], **own)

    def list_saved_plans(
        self,
        records: Sequence[Record],
        specs: Sequence[Mapping[str, Any]],
        *,
        again: bool,
        show: bool,
    ) -> dict[str, str]:
        """Return key → file of saved failures; with `again`, plan those that are not saved."""
        failed = {r["key"] for r in records if not r["success"] and r["status"] != "error"}
        specs = [spec for spec in specs if spec["key"] in failed]
        files = {spec["key"]: self._file(spec, "failures") for spec in specs}
        lost = [spec for spec in specs if again and not files[spec["key"]].is_file()]
        for spec in tqdm(lost, desc="failures", unit="plan", disable=not (show and lost)):
            found = self._plan_uninterrupted(spec)
            if not found.success:
                found.save(files[spec["key"]])
        return {
            key: path.relative_to(self.out).as_posix()
            for key, path in files.items()
            if path.is_file()
        }

    def draw_motions(
        self, records: Sequence[Record], specs: Sequence[Mapping[str, Any]]
    ) -> list[str]:
        """Draw the motions of one trial of each task that any method solves."""
        methods, pictures = tuple(dict.fromkeys(spec["method"] for spec in specs)), []
        for task in dict.fromkeys(spec["scene"] for spec in specs):
            name = self.experiment.tasks[task].name
            number = choose_shown_trial(
                [record for record in records if record["scene"] == task], methods
            )
            if number is None:
                continue
            chosen = [s for s in specs if (s["scene"], s["number"]) == (task, number)]
            plans = {spec["method"]: self._plan_shown(spec) for spec in chosen}
            title = f"{name.capitalize()}, trial {number}"
            motions_chart(plans, self.out / f"{task}_joints.png", title=title)
            pictures.append(f"![Motions of trial {number}: {name}]({task}_joints.png)")
        return pictures

    def _plan_shown(self, spec: Mapping[str, Any]) -> Plan:
        """Load the plan of a trial from the folder, or plan it again and save it there."""
        path = self._file(spec, "shown")
        if path.is_file():
            return Plan.load(path)
        found = self._plan_uninterrupted(spec)
        found.save(path)
        return found

    def _plan_uninterrupted(self, spec: Mapping[str, Any]) -> Plan:
        if (found := self._plan(spec)).status == "interrupted":
            raise KeyboardInterrupt("all trials are done, but not all of their plans are saved")
        return found

    def _plan_timed(self, spec: Mapping[str, Any]) -> tuple[Plan, dict[str, float]]:
        """Return a plan and wall times; the first trials are planned cold, then warm."""
        if not self.timed:
            return self._plan(spec), {}
        times, new = dict[str, float](), {"planner": Planner()} if spec["number"] < COLD else {}
        for name in ("cold_time", "warm_time") if new else ("wall_time",):
            began, found = time.perf_counter(), self._plan({**spec, **new})
            times[name] = time.perf_counter() - began
            if found.status == "interrupted":
                break
        return found, {"wall_time": times.get("warm_time", 0.0), **times}

    def _plan(self, spec: Mapping[str, Any]) -> Plan:
        name = self.experiment.tasks[spec["scene"]].scene
        scene = place_objects(_load_scene_once(self.experiment.load, name), spec)
        return self.solve(scene.with_start(base=spec["base"]), spec)

    def _file(self, spec: Mapping[str, Any], folder: str) -> Path:
        return self.out / folder / f"{spec['scene']}_{spec['number']:04d}_{spec['method']}.npz"


@functools.cache
def _load_scene_once(load: Callable[[str], Scene], name: str) -> Scene:
    return load(name)


def choose_shown_trial(records: Sequence[Record], methods: Sequence[str]) -> int | None:
    """Return the trial with most successes, if possible one of VKC; None without any success."""
    good: dict[int, set[str]] = {}
    for record in records:
        if record["success"]:
            good.setdefault(int(record["number"]), set()).add(str(record["method"]))
    return max(
        sorted(good),
        key=lambda k: (len(good[k]) == len(methods), "VKC" in good[k], len(good[k])),
        default=None,
    )
