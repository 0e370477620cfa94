"""Methods of initialising the trajectory, compared at a task with a tool: take a stick and touch a cube under a table with it.

Three scenes of growing difficulty, the same random starts for every method. For comparison, the
same steps are planned one after the other instead of as one problem.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.charts import success_chart
from vkc_pin.benchmarks.harness.limits import LIMITS, allowed
from vkc_pin.benchmarks.harness.record import Solve, trial
from vkc_pin.benchmarks.harness.tables import comparison_table, foot, methods_table
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Grasp, Touch

__all__ = [
    "COMPARED_INITIALIZATIONS",
    "SCENES",
    "STEPWISE",
    "TARGET",
    "plan_trial",
    "report",
    "run",
    "specify",
]

SCENES = ("init_1", "init_2", "init_3")
COMPARED_INITIALIZATIONS = ("stationary", "interpolated", "astar", "rrt", "auto")
STEPWISE = "step after step"
"""The method that plans the steps one after the other, initialised as by "auto"."""
TARGET = (-1.0, 3.897, 0.1)
"""Where the stick's tip has to be, in the world frame [m]: 3 mm before the middle of the cube's south face."""
PERTURBATION = 0.05  # of the seed trajectory, in all repeats but the first
_NAMES = {"init_1": "no obstacle", "init_2": "two small obstacles", "init_3": "one large obstacle"}


def plan_trial(scene: Scene, spec: Mapping[str, Any]) -> Plan:
    """Plan the task of one trial: `method`, `perturbation` and `seed` say how."""
    how: dict[str, Any] = {
        "initialization": "auto" if spec["method"] == STEPWISE else spec["method"],
        "simultaneous": spec["method"] != STEPWISE,
        "perturbation": spec["perturbation"],
    }
    return plan(
        scene, [Grasp("stick"), Touch("stick.tip", TARGET)], seed=spec["seed"], **LIMITS, **how
    )


def specify(
    *, starts: int, repeats: int, seed: int, scenes: Sequence[str], methods: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the trials: every scene, start, repeat and method, in this order.

    A scene's starts depend on the seed and the scene alone. Repeat 0 starts from the seed
    trajectory as it is, the others from perturbed ones. With "auto", the steps are also planned one
    after the other, once per start.
    """
    trials = []
    for scene in scenes:
        number = SCENES.index(scene) + 1 if scene in SCENES else 0
        rng, loaded = np.random.default_rng([seed, number]), load_scene(scene)
        for start in range(starts):
            base = loaded.sample_start(rng).start[:3].tolist()
            for repeat in range(repeats):
                for method in (
                    *methods,
                    *([STEPWISE] if "auto" in methods and repeat == 0 else []),
                ):
                    key = f"{scene}/{start:04d}/{repeat:03d}/{method}"
                    spec = {
                        "key": key,
                        "scene": scene,
                        "method": method,
                        "number": start,
                        "repeat": repeat,
                        "base": base,
                    }
                    trials.append(
                        {
                            **spec,
                            "seed": seed + repeat,
                            "perturbation": PERTURBATION if repeat else 0.0,
                        }
                    )
    return trials


def run(
    *,
    starts: int,
    repeats: int,
    seed: int,
    out: str | Path,
    jobs: int = 1,
    scheduler: str | None = None,
    scenes: Sequence[str] = SCENES,
    methods: Sequence[str] = COMPARED_INITIALIZATIONS,
    progress: bool = True,
    solve: Solve = plan_trial,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv, table.md and success.png to `out`.

    Args:
        starts: Number of random starts per scene.
        repeats: How often each start is tried, at least 1; all but the first with a perturbed seed
            trajectory.
        seed: Of the starts and of planning.
        out: The folder; if it has trials of the same settings already, they are not run again.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        scenes: Some of `SCENES`.
        methods: Some of `COMPARED_INITIALIZATIONS`.
        progress: Whether to show a progress bar.
        solve: What plans a trial; another one may be given for other tasks, and then scenes may be
            any.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        UnknownNameError: There is no such scene or method.
        InputError: No scenes or methods, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    scenes = runner.chosen("scene", scenes, SCENES if solve is plan_trial else scenes)
    methods = runner.chosen("method", methods, COMPARED_INITIALIZATIONS)
    trials = specify(starts=starts, repeats=repeats, seed=seed, scenes=scenes, methods=methods)
    settings = {
        "benchmark": "initialization",
        "seed": seed,
        "starts": starts,
        "repeats": repeats,
        "scenes": scenes,
    }
    settings |= {"methods": methods, "target": TARGET, **LIMITS, "perturbation": PERTURBATION}
    function = functools.partial(_record, solve=solve)
    result = runner.run(
        trials, function, out, settings=settings, jobs=jobs, scheduler=scheduler, progress=progress
    )
    write_atomically(Path(out) / "table.md", report(result).encode())
    title = f"Success by initialisation, {starts} starts{f', {repeats} trials from each' if repeats > 1 else ''}"
    success_chart(result["trials"], Path(out) / "success.png", _shown(scenes), methods, title=title)
    return result


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    scenes, methods = _shown(about["scenes"]), about["methods"]
    several = (
        f", {about['repeats']} trials from each, all but the first with a perturbed seed trajectory"
    )
    parts = [
        "# Initialising the trajectory",
        f"{about['starts']} random starts per scene{several if about['repeats'] > 1 else ''}; seed {about['seed']}, "
        f"{allowed(about)} per trial. Success is the word of the independent validation. "
        "Planning times are those of all trials, efforts those of successes (medians).",
        methods_table(records, scenes, [*methods, STEPWISE]),
        "![Success rates](success.png)",
    ]
    if "auto" in methods:
        parts += [
            "## One problem against step after step",
            "Efforts from starts where both find a motion, both initialised by `auto`, no perturbation.",
            comparison_table(records, scenes, ("auto", STEPWISE), ("one problem", STEPWISE)),
        ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def _record(spec: dict[str, Any], solve: Solve) -> dict[str, Any]:
    scene = _scene(spec["scene"]).with_start(base=spec["base"])
    own = {key: spec[key] for key in ("scene", "number", "repeat", "perturbation")}
    began = time.perf_counter()
    found = solve(scene, spec)
    if solve is plan_trial:
        own["wall_time"] = time.perf_counter() - began
    return trial(found, method=spec["method"], seed=spec["seed"], **own)


_scene = functools.cache(load_scene)  # once per process


def _shown(scenes: Sequence[str]) -> dict[str, str]:
    return {scene: f"{scene}: {_NAMES[scene]}" if scene in _NAMES else scene for scene in scenes}
