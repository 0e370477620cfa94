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

__all__ = ["ANYWHERE", "Rolling", "rolling_of", "seen"]

_STANDS = 1e-4  # [m] along, up to which a step goes neither ahead nor back


@dataclass(frozen=True)
class Rolling:
    """The limits of a base.

    Attributes:
        aside: Whether it moves aside as well, or not at all: then there are no others.
        radius: The least radius of a turn [m]; 0: it turns in place.
        track: How far its left wheels are from its right ones, as far as turning is concerned [m].
        rim: How fast they are at most [m/s].
    """

    aside: bool = False
    radius: float = 0.0
    track: float = 0.0
    rim: float = np.inf

    @property
    def timed(self) -> bool:
        """Whether its wheels have a limit of their own."""
        return bool(np.isfinite(self.rim))

    @staticmethod
    def steps(path: Floats) -> tuple[Floats, Floats, Floats]:
        """Return how far steps of z_0..z_N, shape (N + 1, ≥ 3), go along and aside [m], and turn [rad], shape (N,) each."""
        dx, dy, turn = np.diff(path[:, :3], axis=0).T
        return *seen(dx, dy, path[:-1, 2] + turn / 2), turn

    def error(self, path: Floats) -> float:
        """Return how far it goes aside in the worst step, or how much too short a step is for its turn [m]."""
        if self.aside:
            return 0.0
        along, aside, turn = self.steps(path)
        return float(max(np.abs(aside).max(), (self.radius * np.abs(turn) - np.abs(along)).max()))

    def gears(self, path: Floats) -> Floats:
        """Return 1 for steps ahead and -1 for those back, shape (N,); where it stands, the gear of the step before, or after."""
        if self.aside:
            return np.ones(len(path) - 1)
        along, _, _ = self.steps(path)
        gear = np.where(np.abs(along) > _STANDS, np.sign(along), 0.0)
        known = np.flatnonzero(gear)
        if not len(known):
            return np.ones(len(gear))
        return np.asarray(
            gear[
                known[np.maximum(np.searchsorted(known, np.arange(len(gear)), side="right") - 1, 0)]
            ]
        )

    def times(self, path: Floats) -> Floats:
        """Return how long each step takes its wheels at least, shape (N,) [s]."""
        if not self.timed:
            return np.zeros(len(path) - 1)
        along, _, turn = self.steps(path)
        return np.asarray((np.abs(along) + self.track / 2 * np.abs(turn)) / self.rim)


def seen(x: Floats, y: Floats, yaws: Floats) -> tuple[Floats, Floats]:
    """Return vectors (x, y), shape (K,) each, as a base with these headings sees them: along and aside, shape (K,) each."""
    cos, sin = np.cos(yaws), np.sin(yaws)
    return cos * x + sin * y, cos * y - sin * x


ANYWHERE = Rolling(aside=True)
"""Of a base that goes in any direction, or stands."""


def rolling_of(robot: Robot) -> Rolling:
    """Return the limits of a robot's base."""
    if robot.base not in ("differential", "ackermann"):
        return ANYWHERE
    if robot.wheels is None:
        return Rolling(radius=robot.turning_radius)
    return Rolling(radius=robot.turning_radius, track=robot.wheels.track, rim=robot.wheels.rim)
