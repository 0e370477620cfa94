"""Smooth motions that a check accepts: closer to the straight lines between waypoints where it does not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np

from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["accepted"]

# how often a curve is drawn closer to the straight lines; each time it leaves them a quarter as far
_REPAIRS = 3


class _Found(Protocol):
    """What is wrong at a waypoint, or between it and the next."""

    @property
    def constraint(self) -> str: ...

    @property
    def waypoint(self) -> int: ...


class _Report(Protocol):
    """What a check finds."""

    @property
    def ok(self) -> bool: ...

    @property
    def violations(self) -> Sequence[_Found]: ...


R = TypeVar("R", bound=_Report)


def accepted(
    scene: Scene,
    waypoints: Trajectory,
    check: Callable[[Trajectory], R],
    *,
    repairs: int = _REPAIRS,
    jerk_time: float = 0.0,
) -> tuple[Trajectory, R]:
    """Return a motion through waypoints, see `retime_trajectory`, and what a check says of it; a last one, if none is accepted.

    Where something is wrong, the path passes the middles of the straight lines as well, which the
    program has looked along.

    Args:
        scene: Robot and objects.
        waypoints: The waypoints, with as much time as they please.
        check: Looks at a motion.
        repairs: How often it is drawn closer to the straight lines.
        jerk_time: See `Options.jerk_time`.
    """
    parts = np.ones(len(waypoints.times) - 1, int)
    trajectory = retime_trajectory(scene, waypoints, jerk_time=jerk_time)
    report = check(trajectory)
    for _ in range(repairs):
        near = {
            found.waypoint + k
            for found in report.violations
            for k in (-1, 0, 1)
            if found.constraint != "torque"
        }
        if not near:  # all is well, or too heavy on whatever curve
            break
        parts[[k for k in near if 0 <= k < len(parts)]] *= 2
        trajectory = retime_trajectory(scene, waypoints, parts, jerk_time=jerk_time)
        report = check(trajectory)
    return trajectory, report
