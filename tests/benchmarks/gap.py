"""Plans reaches over a table beyond a gap of 0.85 m."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import JUDGED, format_table, join_sections
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Reach

from .problems.ablation import SUMMARIZED, SUMMARY, summary, tabulate_trials
from .problems.poses import sample_random_start
from .problems.trials import run_trial

SCENE = "gap_table"
POSE = (2.5, 0.5, 0.95, np.pi, 0.0, 0.0)
"""Tool pose (x, y, z, roll, pitch, yaw) [m, rad] in the world frame, 0.2 m above the table."""


def make_start(seed: int, number: int) -> Scene:
    """Return the scene with start `number` of a random seed."""
    return sample_random_start(load_scene(SCENE), np.random.default_rng([seed, number]))


def run(
    *,
    out: str | Path,
    trials: int = 50,
    seed: int = 0,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        trials: Number of random starts of base and arm, at least 1.
        seed: Random seed of starts and planning.
    """
    runner.check_positive(trials=trials)
    settings = {"benchmark": "gap", "seed": seed, "starts": trials, "pose": POSE, **LIMITS}
    specs = [{"key": f"{number:04d}", "number": number, "seed": seed} for number in range(trials)]
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    return join_sections(
        about,
        "# Through a gap to a table",
        f"{about['starts']} random starts of base and arm, seed {about['seed']}, "
        f"{describe_limit(about)} each. {JUDGED} {SUMMARIZED}",
        format_table(["scene", *SUMMARY], [[SCENE, *summary(records)]]),
        "## Every trial",
        tabulate_trials(records),
    )


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    number = spec["number"]
    seed = spec["seed"]
    return run_trial(
        make_start(seed, number),
        (Reach(POSE),),
        seed=seed,
        number=number,
        problem=f"{SCENE} {number}",
    )
