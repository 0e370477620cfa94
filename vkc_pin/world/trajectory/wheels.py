"""How a base on wheels moves in a step: along, not aside, and turning no tighter than it steers.

A step goes from one pose of the base to the next, (x, y, yaw), all three linear in time. With the
heading θ̄ at its middle it goes c = cos θ̄·δx + sin θ̄·δy along and −sin θ̄·δx + cos θ̄·δy aside,
and turns by δθ. An arc of a circle is such a step: its chord points where the base heads at its
middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot

__all__ = ["OMNIDIRECTIONAL", "RollingLimits", "make_rolling_limits", "rotate_into_base_frame"]

_STANDS = 1e-4  # [m] along, up to which a step goes neither ahead nor back


@dataclass(frozen=True)
class RollingLimits:
    """The limits of a base.

    Attributes:
        aside: Whether it moves aside as well, or not at all: then there are no others.
        radius: The least radius of a turn [m]; 0: it turns in place.
        track: How far its left wheels are from its right ones, as far as turning is concerned [m].
        rim: How fast they are at most [m/s].
    """

    is_omnidirectional: bool = False
    turning_radius: float = 0.0
    track: float = 0.0
    wheel_speed: float = np.inf

    @property
    def has_wheel_limit(self) -> bool:
        """Whether its wheels have a limit of their own."""
        return bool(np.isfinite(self.wheel_speed))

    @staticmethod
    def compute_steps(path: Floats) -> tuple[Floats, Floats, Floats]:
        """Return how far steps of z_0..z_N, shape (N + 1, ≥ 3), go along and aside [m], and turn [rad], shape (N,) each."""
        dx, dy, turn = np.diff(path[:, :3], axis=0).T
        return *rotate_into_base_frame(dx, dy, path[:-1, 2] + turn / 2), turn

    def compute_error(self, path: Floats) -> float:
        """Return how far it goes aside in the worst step, or how much too short a step is for its turn [m]."""
        if self.is_omnidirectional:
            return 0.0
        along, aside, turn = self.compute_steps(path)
        return float(
            max(np.abs(aside).max(), (self.turning_radius * np.abs(turn) - np.abs(along)).max())
        )

    def compute_gears(self, path: Floats) -> Floats:
        """Return 1 for steps ahead and -1 for those back, shape (N,); where it stands, the gear of the step before, or after."""
        if self.is_omnidirectional:
            return np.ones(len(path) - 1)
        along, _, _ = self.compute_steps(path)
        gear = np.where(np.abs(along) > _STANDS, np.sign(along), 0.0)
        known = np.flatnonzero(gear)
        if not len(known):
            return np.ones(len(gear))
        return np.asarray(
            gear[
                known[np.maximum(np.searchsorted(known, np.arange(len(gear)), side="right") - 1, 0)]
            ]
        )

    def compute_min_times(self, path: Floats) -> Floats:
        """Return how long each step takes its wheels at least, shape (N,) [s]."""
        if not self.has_wheel_limit:
            return np.zeros(len(path) - 1)
        along, _, turn = self.compute_steps(path)
        return np.asarray((np.abs(along) + self.track / 2 * np.abs(turn)) / self.wheel_speed)


def rotate_into_base_frame(x: Floats, y: Floats, yaws: Floats) -> tuple[Floats, Floats]:
    """Return vectors (x, y), shape (K,) each, as a base with these headings sees them: along and aside, shape (K,) each."""
    cos, sin = np.cos(yaws), np.sin(yaws)
    return cos * x + sin * y, cos * y - sin * x


OMNIDIRECTIONAL = RollingLimits(is_omnidirectional=True)
"""Of a base that goes in any direction, or stands."""


def make_rolling_limits(robot: Robot) -> RollingLimits:
    """Return the limits of a robot's base."""
    if robot.base not in ("differential", "ackermann"):
        return OMNIDIRECTIONAL
    if robot.wheels is None:
        return RollingLimits(turning_radius=robot.turning_radius)
    return RollingLimits(
        turning_radius=robot.turning_radius,
        track=robot.wheels.track,
        wheel_speed=robot.wheels.rim_speed,
    )
