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
        grasp_force: Force between hand and grasped object [N]; None: it is not measured.
        grasp_torque: Torque between them at the tool frame [N·m]; None: it is not measured.
    """

    time: float
    positions: Floats
    velocities: Floats
    grasp_force: float | None = None
    grasp_torque: float | None = None
