"""First experiment: initialization methods at a task with a tool.

The robot takes a stick and touches a cube under a table with it, in three scenes of growing
difficulty. The same steps are also planned one after the other.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.charts import success_chart
from vkc_pin.experiments.harness.record import Solve, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    comparison_table,
    join_sections,
    methods_table,
)
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Grasp, Touch

SCENES = ("init_1", "init_2", "init_3")
COMPARED_INITIALIZATIONS = ("stationary", "interpolated", "astar", "rrt", "auto")
STEPWISE = "step after step"
"""The method that plans the steps one after the other, initialised as by "auto"."""
TARGET = (-1.0, 3.897, 0.1)
"""Goal of the stick's tip in the world frame [m], 3 mm before the cube's south face."""
PERTURBATION = 0.05
"""Of the initial guess, in all repeats but the first."""
_NAMES = {"init_1": "no obstacle", "init_2": "two small obstacles", "init_3": "one large obstacle"}


def plan_trial(scene: Scene, spec: Mapping[str, Any]) -> Plan:
    """Plan one trial, given by `method`, `perturbation` and `seed`."""
    is_stepwise = spec["method"] == STEPWISE
    return plan(
        scene,
        [Grasp("stick"), Touch("stick.tip", TARGET)],
        initialization="auto" if is_stepwise else spec["method"],
        simultaneous=not is_stepwise,
        perturbation=spec["perturbation"],
        seed=spec["seed"],
        **LIMITS,
    )


def specify(
    *, starts: int, repeats: int, seed: int, scenes: Sequence[str], methods: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the trials, ordered by scene, start, repeat and method.

    Starts, and random seeds of planning from each, depend on seed and scene alone. The first repeat
    has an unperturbed initial guess. With "auto", the steps are also planned one after the other,
    once per start.
    """
    trials: list[dict[str, Any]] = []
    for scene in scenes:
        number = SCENES.index(scene) + 1 if scene in SCENES else 0
        rng = np.random.default_rng([seed, number])
        loaded = load_scene(scene)
        for start in range(starts):
            base = loaded.sample_start(rng).start[:3].tolist()
            start_rng = np.random.default_rng([seed, number, start])
            start_seed = int(start_rng.integers(2**31))
            for repeat in range(repeats):
                compared = list(methods)
                if "auto" in methods and repeat == 0:
                    compared.append(STEPWISE)
                for method in compared:
                    trials.append(
                        {
                            "key": f"{scene}/{start:04d}/{repeat:03d}/{method}",
                            "scene": scene,
                            "method": method,
                            "number": start,
                            "repeat": repeat,
                            "base": base,
                            "seed": start_seed + repeat,
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
    scenes: Sequence[str] = SCENES,
    methods: Sequence[str] = COMPARED_INITIALIZATIONS,
    solve: Solve = plan_trial,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        starts: Number of random starts per scene.
        repeats: Number of trials per start; all but the first perturb the initial guess.
        seed: Random seed of starts and planning.
        scenes: Some of `SCENES`.
        methods: Some of `COMPARED_INITIALIZATIONS`.
        solve: Plans a trial; other tasks may use other scenes.
    """
    scenes = runner.select_names("scene", scenes, SCENES if solve is plan_trial else scenes)
    methods = runner.select_names("method", methods, COMPARED_INITIALIZATIONS)
    trials = specify(starts=starts, repeats=repeats, seed=seed, scenes=scenes, methods=methods)
    settings = {
        "benchmark": "initialization",
        "seed": seed,
        "starts": starts,
        "repeats": repeats,
        "scenes": scenes,
        "methods": methods,
        "target": TARGET,
        **LIMITS,
        "perturbation": PERTURBATION,
    }
    function = functools.partial(_record, solve=solve)
    result = runner.run(
        trials, function, out, settings=settings, format_results=format_results, **execution
    )
    title = f"Success by initialization, {starts} starts"
    if repeats > 1:
        title += f", {repeats} trials from each"
    success_chart(
        result["trials"], Path(out) / "success.png", _label_scenes(scenes), methods, title=title
    )
    return result


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    scenes = _label_scenes(about["scenes"])
    methods = about["methods"]
    repeats = ""
    if about["repeats"] > 1:
        repeats = f", {about['repeats']} trials from each, all but the first with a perturbed guess"
    parts = [
        "# Initializing the trajectory",
        f"{about['starts']} random starts per scene{repeats}; "
        f"seed {about['seed']}, {describe_limit(about)} per trial. {JUDGED} "
        "Planning times are those of all trials, path lengths those of successes (medians).",
        methods_table(records, scenes, [*methods, STEPWISE]),
        "![Success rates](success.png)",
    ]
    if "auto" in methods:
        parts += [
            "## Simultaneous and stepwise planning",
            "Path lengths from starts where both find a motion, both initialized by `auto`, "
            "without perturbation.",
            comparison_table(records, scenes, ("auto", STEPWISE), ("one problem", STEPWISE)),
        ]
    return join_sections(about, *parts)


def _record(spec: dict[str, Any], solve: Solve) -> dict[str, Any]:
    """Plan a trial and return its record."""
    scene = _load_scene(spec["scene"]).with_start(base=spec["base"])
    fields = {key: spec[key] for key in ("scene", "number", "repeat", "perturbation")}
    began = time.perf_counter()
    found = solve(scene, spec)
    if solve is plan_trial:
        fields["wall_time"] = time.perf_counter() - began
    return trial(found, method=spec["method"], seed=spec["seed"], **fields)


_load_scene = functools.cache(load_scene)  # once per process


def _label_scenes(scenes: Sequence[str]) -> dict[str, str]:
    """Return the displayed name of each scene."""
    labels: dict[str, str] = {}
    for scene in scenes:
        labels[scene] = f"{scene}: {_NAMES[scene]}" if scene in _NAMES else scene
    return labels
