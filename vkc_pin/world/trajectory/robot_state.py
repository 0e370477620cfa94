"""Defines the measured state of a robot."""

from __future__ import annotations

from dataclasses import dataclass

from vkc_pin.utils.arrays import Floats


@dataclass(frozen=True, eq=False)
class RobotState:
    """Measured state of a robot.

    Attributes:
        time: When it was measured, on the robot's clock [s].
        positions: Coordinates of the robot, shape (n,), [m] and [rad].
        velocities: Their velocities, shape (n,), [m/s] and [rad/s].
    """

    time: float
    positions: Floats
    velocities: Floats
