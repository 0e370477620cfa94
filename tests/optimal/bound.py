"""Computes the least duration of a motion along its own path, between the same rests."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vkc_pin.planning.retiming import retime
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["FINE", "compute_bound"]

FINE = 60
"""Grid points on each cubic of a path; the package uses at most three."""
_TOLERANCE = 1e-6  # [s] difference of durations after retiming


def compute_bound(scene: Scene, motion: Trajectory, points: int = FINE) -> tuple[float, int]:
    """Return the least duration [s] under all limits, and the number of paths bound by torques.

    The motion is retimed, which must reproduce its duration. TOPP-RA then solves every path of this
    retiming again, on a finer grid. Stops and rests are those of the motion.
    """
    paths = dict[int, tuple[Any, ...]]()
    rest_times = list[float]()
    compute_speeds = retime.compute_speeds
    stop_at_waypoints = retime._stop_at_waypoints

    def record_path(path: Any, places: Any, *limits: Any) -> Any:
        # The last call includes torque limits if they bind.
        paths[id(path)] = (path, *limits)
        return compute_speeds(path, places, *limits)

    def record_rest(*arguments: Any) -> Any:
        curve, knots = stop_at_waypoints(*arguments)
        rest_times.append(float(curve.times[-1]))
        return curve, knots

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(retime, "compute_speeds", record_path)
        patch.setattr(retime, "_stop_at_waypoints", record_rest)
        retimed = retime.retime_trajectory(scene, motion, _count_parts(motion))
    assert abs(retimed.times[-1] - motion.times[-1]) <= _TOLERANCE, (
        "the retimed motion is another one"
    )
    least = sum(rest_times)
    for path, *limits in paths.values():
        fractions = np.arange(points) / points
        places = np.append(
            (path.x[:-1, None] + np.diff(path.x)[:, None] * fractions).ravel(), path.x[-1]
        )
        speeds = compute_speeds(path, places, *limits)
        assert speeds is not None
        least += float((2.0 * np.diff(places) / (speeds[1:] + speeds[:-1])).sum())
    return least, sum(len(limits) > 2 for _, *limits in paths.values())


def _count_parts(motion: Trajectory) -> np.ndarray:
    """Return the number of parts of each straight line, from its number of cubics."""
    assert motion.curve is not None
    cubics = np.diff(np.searchsorted(motion.curve.times, motion.times))
    return np.maximum(cubics // 3, 1)
