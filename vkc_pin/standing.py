"""The plan of a robot that stays where it is: what is left if planning is stopped before there is any motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.interrupt import interruptible
from vkc_pin.options import Options
from vkc_pin.plan import Plan
from vkc_pin.scene import Scene
from vkc_pin.steps import Step
from vkc_pin.terms import Term, traced
from vkc_pin.trajectory import PhaseSpan, Trajectory
from vkc_pin.validation import validate

__all__ = ["TIMES", "standing"]

TIMES = ("initialization", "coal", "casadi", "ipopt", "validation")
"""What planning spends its time on."""


def standing(
    scene: Scene, steps: Sequence[Step], options: Options, *, seed: int = 0, spent: float = 0.0, terms: Sequence[Term] = ()
) -> Plan:
    """Return a plan with status "interrupted" in which nothing moves; what it says of `steps` is the validation's.

    Args:
        scene: Where the robot stands.
        steps: What was asked for.
        options: How it was to be planned.
        seed: Of the random numbers.
        spent: Time spent on planning [s].
        terms: Own constraints and costs that were asked for.
    """
    values = dict(zip(scene.robot.coordinates.names, scene.start.tolist(), strict=True))
    for name, placed in scene.objects.items():
        joints = zip(placed.object.coordinates.names, placed.state.tolist(), strict=True)
        values |= {f"{name}.{joint}": value for joint, value in joints}
    for hold in scene.holds:
        names = scene.objects[hold.object].object.attachment(hold.attachment).coordinates
        at = scene.held_at.get(hold.object, (0.0,) * len(names))
        values |= {f"{hold.object}.{name}": value for name, value in zip(names, at, strict=True)}
    row = list(values.values())
    phase = PhaseSpan("stand", 0, 1, dict(scene.held), dict(scene.held_by))
    trajectory = Trajectory(tuple(values), np.array([0.0, options.dt]), np.array([row, row]), (phase,), len(scene.start))
    with interruptible():
        report = validate(scene, steps, trajectory, options, terms)
    metrics = {
        "planning_time": spent,
        "build_time": 0.0,
        **trajectory.metrics(),
        "clearance": report.clearance,
        "closure_error": report.closure_error,
        "iterations": 0.0,
        "rounds": 0.0,
        **{f"time_{key}": 0.0 for key in TIMES},
    }
    return Plan(
        scene, tuple(steps), options, trajectory, report, "interrupted", metrics, seed, "none", terms=traced(scene, terms)
    )
