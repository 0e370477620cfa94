"""Retimes waypoints, and refines the curve where validation finds violations."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from vkc_pin.planning.plan import Plan
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.terms import Term, trace_terms
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["MAX_REPAIRS", "complete_draft", "retime_validated"]

MAX_REPAIRS = 3
"""Largest number of refinements; each brings the curve four times as close to the segments."""


def retime_validated(
    scene: Scene,
    waypoints: Trajectory,
    check: Callable[[Trajectory], Report],
    *,
    repairs: int = MAX_REPAIRS,
    jerk_time: float = 0.0,
    terms: Sequence[Term] = (),
) -> tuple[Trajectory, Report]:
    """Return a trajectory through waypoints and its report; the last one if none is valid.

    Around a violation the curve is made to pass through the middles of the straight segments too,
    which the program has checked. Violated torque limits depend on no curve and are left alone.
    `check` validates a trajectory, and `repairs` is the largest number of refinements. If one of
    the user's traced `terms` depends on velocities, the program's own times are kept.
    """
    if any(term.formula.uses_previous for term in terms):
        return waypoints, check(waypoints)
    parts = np.ones(len(waypoints.times) - 1, int)
    trajectory = retime_trajectory(scene, waypoints, jerk_time=jerk_time)
    report = check(trajectory)
    for _ in range(repairs):
        wrong = [found.waypoint for found in report.violations if found.constraint != "torque"]
        near = {waypoint + k for waypoint in wrong for k in (-1, 0, 1)}
        if not near:
            break
        parts[[k for k in near if 0 <= k < len(parts)]] *= 2
        trajectory = retime_trajectory(scene, waypoints, parts, jerk_time=jerk_time)
        report = check(trajectory)
    return trajectory, report


def complete_draft(plan: Plan) -> Plan:
    """Return a plan whose trajectory is retimed and validated, if it is not yet."""
    if plan.is_validated:
        return plan

    def check(trajectory: Trajectory) -> Report:
        return validate(plan.scene, plan.steps, trajectory, plan.options, plan.terms)

    trajectory, report = retime_validated(
        plan.scene,
        plan.trajectory,
        check,
        jerk_time=plan.options.jerk_time,
        terms=trace_terms(plan.scene, plan.terms),
    )
    status = plan.status if report.ok else "rejected"
    return dataclasses.replace(
        plan, trajectory=trajectory, report=report, status=status, is_validated=True
    )
