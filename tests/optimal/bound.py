"""The least time that a motion can take along its own path, between the same rests."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vkc_pin.planning.retiming import retime
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["FINE", "compute_bound"]

FINE = 60
"""Places on each of a path's cubics; the package looks at three or less."""
_SAME = 1e-6  # [s] by which the motion, timed anew, may take another time


def compute_bound(scene: Scene, motion: Trajectory, fine: int = FINE) -> tuple[float, int]:
    """Return the least duration [s] under all limits, and the number of runs bound by torques.

    The motion is timed anew, which must come to the same. Whatever path TOPP-RA is asked about on
    the way, it is asked about again, at many more places. Stops and rests are those of the motion.
    """
    asked, rests, solve, rest = (
        dict[int, tuple[Any, ...]](),
        list[float](),
        retime.compute_speeds,
        retime._make_straight_curve,
    )

    def noted(path: Any, places: Any, *limits: Any) -> Any:
        asked[id(path)] = (
            path,
            *limits,
        )  # the last time, torques among the limits if they bound it
        return solve(path, places, *limits)

    def rested(*given: Any) -> Any:
        curve = rest(*given)
        rests.append(float(curve.times[-1]))
        return curve

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(retime, "compute_speeds", noted)
        patch.setattr(retime, "_make_straight_curve", rested)
        again = retime.retime_trajectory(scene, motion, _split(motion))
    assert abs(again.times[-1] - motion.times[-1]) <= _SAME, (
        "the motion that was timed anew is another one"
    )
    least = sum(rests)
    for path, *limits in asked.values():
        shares = np.arange(fine) / fine
        places = np.append(
            (path.x[:-1, None] + np.diff(path.x)[:, None] * shares).ravel(), path.x[-1]
        )
        speeds = solve(path, places, *limits)
        assert speeds is not None
        least += float((2.0 * np.diff(places) / (speeds[1:] + speeds[:-1])).sum())
    return least, sum(len(limits) > 2 for _, *limits in asked.values())


def _split(motion: Trajectory) -> np.ndarray:
    """Return into how many parts each straight line was cut, by how many cubics lead along it."""
    assert motion.curve is not None
    cubics = np.diff(np.searchsorted(motion.curve.times, motion.times))
    return np.maximum(cubics // 3, 1)
