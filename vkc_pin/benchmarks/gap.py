"""Reach over a table beyond a gap of 0.85 m between a pillar and a wall, from random starts of base and arm."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS, allowed
from vkc_pin.benchmarks.harness.tables import foot, markdown
from vkc_pin.benchmarks.problems.ablation import SUMMARY, every_trial, summary
from vkc_pin.benchmarks.problems.poses import random_start
from vkc_pin.benchmarks.problems.trials import tried
from vkc_pin.errors import InputError
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Reach

__all__ = ["POSE", "SCENE", "report", "run", "started"]

SCENE = "gap_table"
POSE = (2.5, 0.5, 0.95, np.pi, 0.0, 0.0)
"""Of the tool: x, y, z [m], roll, pitch, yaw [rad] in the world frame; 0.2 m above the table, the fingers down."""


def started(seed: int, number: int) -> Scene:
    """Return the scene with a random start of base and arm.

    Args:
        seed: Of the random numbers.
        number: Which start; it does not depend on how many there are.
    """
    return random_start(load_scene(SCENE), np.random.default_rng([seed, number]))


def run(
    *,
    out: str | Path,
    trials: int = 50,
    seed: int = 0,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        trials: Number of random starts, at least 1.
        seed: Of the starts and of planning.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        InputError: No trials, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if trials < 1:
        raise InputError("out of range", field="trials", expected="at least 1", got=trials)
    settings = {"benchmark": "gap", "seed": seed, "starts": trials, "pose": POSE, **LIMITS}
    specs = [{"key": f"{number:04d}", "number": number, "seed": seed} for number in range(trials)]
    return runner.run(
        specs,
        _record,
        out,
        settings=settings,
        report=report,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
    )


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    parts = [
        "# Through a gap to a table",
        f"{about['starts']} random starts of base and arm, seed {about['seed']}, {allowed(about)} each. "
        "Success is the word of the independent validation; the first seed sufficed where the solver ran once. "
        "Times are those of all trials, CPU time with building symbolic programs. Rounds and iterations are means, efforts "
        "medians of successes.",
        markdown(["scene", *SUMMARY], [[SCENE, *summary(records)]]),
        "## Every trial",
        every_trial(records),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    number, seed = spec["number"], spec["seed"]
    return tried(
        started(seed, number), (Reach(POSE),), seed=seed, number=number, problem=f"{SCENE} {number}"
    )
