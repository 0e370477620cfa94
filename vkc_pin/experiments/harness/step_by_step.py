"""Plans steps one by one, each from the end of the previous motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vkc_pin.experiments.harness.record import trial
from vkc_pin.experiments.harness.runner import LIMITS
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step


def plan_step_by_step(
    scene: Scene, steps: Sequence[Step], *, options: Options, seed: int
) -> list[Plan]:
    """Return the plans of steps up to the first failure."""
    plans: list[Plan] = []
    for step in steps:
        found = plan(scene, [step], options=options, seed=seed, **LIMITS)
        plans.append(found)
        if not found.success:
            break
        scene = found.end_scene()
    return plans


def combine_records(
    plans: Sequence[Plan], of: int, *, method: str, seed: int, **more: Any
) -> dict[str, Any]:
    """Return one record of the plans of the first of `of` steps."""
    records = [
        trial(one, method=method, seed=seed, duration=one.trajectory.metrics()["duration"])
        for one in plans
    ]
    times = [key for key in records[0] if key.startswith("time_")]
    clearances = [record["clearance"] for record in records if record["clearance"] is not None]
    initializations = dict.fromkeys(record["initialization"] for record in records)
    success_count = sum(record["success"] for record in records)
    combined = dict(records[-1])
    for field in (*_SUMMED, *times):
        combined[field] = sum(record[field] for record in records)
    combined["start"] = records[0]["start"]
    combined["success"] = success_count == of
    combined["clearance"] = min(clearances, default=None)
    combined["closure_error"] = max(record["closure_error"] for record in records)
    combined["initialization"] = "; ".join(initializations)
    if combined["failed_constraint"]:
        where = f"steps[{len(plans) - 1}], {plans[-1].steps[0]}"
        combined["failed_constraint"] += f" at {where}"
    combined["steps_done"] = success_count
    combined.update(more)
    return combined


# Fields of records that are added up.
_SUMMED = (
    "planning_time",
    "base_path_length",
    "base_path_length_l1",
    "arm_path_length",
    "duration",
    "build_time",
    "iterations",
    "rounds",
    "evaluations",
    "waypoints",
)
