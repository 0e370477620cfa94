"""Computes the motion of a wheeled base between waypoints, and the limits of its wheels.

A segment leads from one base pose (x, y, yaw) to the next, all three linear in time. With the mean
heading θ̄, its longitudinal motion is c = cos θ̄·δx + sin θ̄·δy, its lateral motion
−sin θ̄·δx + cos θ̄·δy, and its rotation δθ. A circular arc has no lateral motion, since its chord is
parallel to its mean heading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot

_REST_TOLERANCE = 1e-4  # smaller longitudinal motions have no direction [m]


@dataclass(frozen=True)
class RollingLimits:
    """The motion limits of a base.

    Attributes:
        is_omnidirectional: Whether the base can move sideways; then it has no other limits.
        turning_radius: Smallest turning radius [m]; 0 if the base turns in place.
        track: Effective distance between left and right wheels [m].
        wheel_speed: Largest rim speed of the wheels [m/s].
    """

    is_omnidirectional: bool = False
    turning_radius: float = 0.0
    track: float = 0.0
    wheel_speed: float = np.inf

    @property
    def has_wheel_limit(self) -> bool:
        """Whether the speed of the wheels is limited."""
        return bool(np.isfinite(self.wheel_speed))

    @staticmethod
    def compute_steps(path: Floats) -> tuple[Floats, Floats, Floats]:
        """Return longitudinal, lateral [m], angular motion [rad] of N segments, shape (N,) each."""
        dx, dy, turn = np.diff(path[:, :3], axis=0).T
        mean_heading = path[:-1, 2] + turn / 2
        along, aside = rotate_into_base_frame(dx, dy, mean_heading)
        return along, aside, turn

    def compute_error(self, path: Floats) -> float:
        """Return the largest lateral motion, or shortfall of the turning radius [m]."""
        if self.is_omnidirectional:
            return 0.0
        along, aside, turn = self.compute_steps(path)
        shortfall = self.turning_radius * np.abs(turn) - np.abs(along)
        return float(max(np.abs(aside).max(), shortfall.max()))

    def compute_gears(self, path: Floats) -> Floats:
        """Return 1 for forward, -1 for backward segments, shape (N,); rests keep the last gear."""
        if self.is_omnidirectional:
            return np.ones(len(path) - 1)
        along, _, _ = self.compute_steps(path)
        gear = np.where(np.abs(along) > _REST_TOLERANCE, np.sign(along), 0.0)
        known = np.flatnonzero(gear)
        if not len(known):
            return np.ones(len(gear))
        # Segments before the first known gear have that one.
        last = np.searchsorted(known, np.arange(len(gear)), side="right") - 1
        last_known = known[np.maximum(last, 0)]
        return np.asarray(gear[last_known])

    def compute_min_times(self, path: Floats) -> Floats:
        """Return the shortest durations of segments at the wheels' speed limit, shape (N,) [s]."""
        if not self.has_wheel_limit:
            return np.zeros(len(path) - 1)
        along, _, turn = self.compute_steps(path)
        # The outer wheel rolls |c| + |δθ| times half of the track.
        rolled = np.abs(along) + self.track / 2 * np.abs(turn)
        return np.asarray(rolled / self.wheel_speed)


def rotate_into_base_frame(x: Floats, y: Floats, yaws: Floats | float) -> tuple[Floats, Floats]:
    """Rotate world vectors (x, y) into base frames with these yaw angles, shape (K,) each."""
    cos = np.cos(yaws)
    sin = np.sin(yaws)
    return cos * x + sin * y, cos * y - sin * x


OMNIDIRECTIONAL = RollingLimits(is_omnidirectional=True)
"""Limits of an omnidirectional or fixed base."""


def make_rolling_limits(robot: Robot) -> RollingLimits:
    """Make the motion limits of a robot's base."""
    if robot.base not in ("differential", "ackermann"):
        return OMNIDIRECTIONAL
    if robot.wheels is None:
        return RollingLimits(turning_radius=robot.turning_radius)
    return RollingLimits(
        turning_radius=robot.turning_radius,
        track=robot.wheels.track,
        wheel_speed=robot.wheels.rim_speed,
    )
