"""Retimes waypoints and pulls the path towards straight lines where a check rejects it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np

from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["retime_and_repair"]

# Maximum number of repairs; each one reduces the deviation from the straight line to a quarter.
_MAX_REPAIRS = 3


class _ViolationLike(Protocol):
    """A violation at a waypoint, or between it and the next one."""

    @property
    def constraint(self) -> str: ...

    @property
    def waypoint(self) -> int: ...


class _ReportLike(Protocol):
    """The result of a check."""

    @property
    def ok(self) -> bool: ...

    @property
    def violations(self) -> Sequence[_ViolationLike]: ...


ReportT = TypeVar("ReportT", bound=_ReportLike)


def retime_and_repair(
    scene: Scene,
    waypoints: Trajectory,
    check: Callable[[Trajectory], ReportT],
    *,
    repairs: int = _MAX_REPAIRS,
    jerk_time: float = 0.0,
) -> tuple[Trajectory, ReportT]:
    """Return a trajectory through waypoints and the report of its check, accepted or not.

    Where the check finds a violation, the path additionally passes through the midpoints of the
    straight lines between waypoints, which the optimisation has checked for collision. See
    `retime_trajectory`.

    Args:
        scene: Robot and objects.
        waypoints: Trajectory whose waypoints are kept; its times do not matter.
        check: Function that checks a trajectory.
        repairs: Maximum number of repairs.
        jerk_time: See `Options.jerk_time`.

    Returns:
        The last trajectory and its report.
    """
    parts = np.ones(len(waypoints.times) - 1, int)
    trajectory = retime_trajectory(scene, waypoints, jerk_time=jerk_time)
    report = check(trajectory)
    for _ in range(repairs):
        nearby_steps = {
            violation.waypoint + k
            for violation in report.violations
            for k in (-1, 0, 1)
            if violation.constraint != "torque"
        }
        if not nearby_steps:  # no violation, or only torques, which no other path would reduce
            break
        parts[[k for k in nearby_steps if 0 <= k < len(parts)]] *= 2
        trajectory = retime_trajectory(scene, waypoints, parts, jerk_time=jerk_time)
        report = check(trajectory)
    return trajectory, report
