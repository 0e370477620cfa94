"""Plans steps one by one, each from the end of the previous motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vkc_pin.experiments.harness.record import trial
from vkc_pin.experiments.harness.runner import LIMITS
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step


def plan_step_by_step(
    scene: Scene, steps: Sequence[Step], *, options: Options, seed: int
) -> list[Plan]:
    """Return the plans of steps up to the first failure."""
    plans: list[Plan] = []
    for step in steps:
        plans.append(plan(scene, [step], options=options, seed=seed, **LIMITS))
        if not plans[-1].success:
            break
        scene = plans[-1].end_scene()
    return plans


def combine_records(
    plans: Sequence[Plan], of: int, *, method: str, seed: int, **more: Any
) -> dict[str, Any]:
    """Return one record of the plans of the first of `of` steps."""
    records = [
        trial(one, method=method, seed=seed, duration=one.trajectory.metrics()["duration"])
        for one in plans
    ]
    sums = (
        "planning_time",
        "base_path_length",
        "base_path_length_l1",
        "arm_path_length",
        "duration",
        "build_time",
    )
    counts = ("iterations", "rounds", "evaluations", "waypoints")
    times = [key for key in records[0] if key.startswith("time_")]
    clearances = [record["clearance"] for record in records if record["clearance"] is not None]
    good = sum(record["success"] for record in records)
    failed = records[-1]["failed_constraint"]
    return {
        **records[-1],
        **{field: sum(record[field] for record in records) for field in (*sums, *counts, *times)},
        "start": records[0]["start"],
        "success": good == of,
        "clearance": min(clearances, default=None),
        "closure_error": max(record["closure_error"] for record in records),
        "initialization": "; ".join(dict.fromkeys(record["initialization"] for record in records)),
        "failed_constraint": failed
        and f"{failed} at steps[{len(plans) - 1}], {plans[-1].steps[0]}",
        "steps_done": good,
        **more,
    }
