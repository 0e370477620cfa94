"""Where a robot may start in a scene, and random starts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.arrays import Floats

if TYPE_CHECKING:
    from vkc_pin.models.robot import Robot

__all__ = ["START_CLEARANCE", "StartRegion", "start_limits"]

START_CLEARANCE = 0.03
"""Random starts keep the robot at least this far from everything but the floor [m]."""


@dataclass(frozen=True)
class StartRegion:
    """Where random starts are drawn from: intervals of the base's x and y [m] and heading [rad] (None: any)."""

    x: tuple[float, float]
    y: tuple[float, float]
    yaw: tuple[float, float] | None = None

    def draws(self, rng: np.random.Generator) -> Iterator[Floats]:
        """Yield poses of the base, shape (3,): x, y [m] and yaw [rad], uniform in the region, without end."""
        low, high = self.yaw or (-np.pi, np.pi)
        while True:
            yield rng.uniform([self.x[0], self.y[0], low], [self.x[1], self.y[1], high])


def start_limits(robot: Robot) -> tuple[Floats, Floats]:
    """Return the limits of a start, shape (n,), [m] and [rad]: the robot's; a base that cannot move may stand anywhere."""
    lower, upper = robot.lower.copy(), robot.upper.copy()
    if robot.base == "fixed":
        lower[:3], upper[:3] = -np.inf, np.inf
    return lower, upper
