"""Retimes waypoints, and refines the curve where validation finds violations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.validation.report import Report
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["MAX_REPAIRS", "retime_validated"]

MAX_REPAIRS = 3
"""Largest number of refinements; each brings the curve four times as close to the segments."""


def retime_validated(
    scene: Scene,
    waypoints: Trajectory,
    check: Callable[[Trajectory], Report],
    *,
    repairs: int = MAX_REPAIRS,
    jerk_time: float = 0.0,
) -> tuple[Trajectory, Report]:
    """Return a trajectory through waypoints and its report; the last one if none is valid.

    Around a violation the curve is made to pass through the middles of the straight segments too,
    which the program has checked. Violated torque limits depend on no curve and are left alone.
    `check` validates a trajectory, and `repairs` is the largest number of refinements.
    """
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
