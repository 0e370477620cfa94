"""Cameras that are mounted on a robot: where, which way they look, how many pixels they have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot

__all__ = ["BASE", "HAND", "Camera", "check_frame", "frame_of"]

BASE, HAND = "base", "hand"
"""What every robot has: the frame that its base moves, and the one that grasps (z ahead, fingers close along x)."""
_ASTRAY = 1e-6  # sine of the angle between two directions that are the same


@dataclass(frozen=True)
class Camera:
    """A pinhole camera on a robot.

    Attributes:
        name: What it is called.
        frame: `BASE`, `HAND`, or a frame of the robot.
        position: Where it is in this frame [m].
        target: What is in the middle of the picture, in this frame [m].
        up: What is up in the picture, a direction in this frame.
        width, height: Of the picture [pixels].
        fov: Vertical field of view [deg].

    Raises:
        InputError: It looks at itself, or along what is up.
    """

    name: str
    frame: str
    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    width: int = 128
    height: int = 128
    fov: float = 60.0

    def __post_init__(self) -> None:
        ahead, up = np.subtract(self.target, self.position), np.array(self.up)
        lengths = np.linalg.norm(ahead) * np.linalg.norm(up)
        if np.linalg.norm(np.cross(ahead, up)) <= _ASTRAY * lengths:
            expected = "a target that is not at the camera's position, nor straight above or below it along `up`"
            raise InputError(
                "this camera has no direction",
                field="target",
                expected=expected,
                got=list(self.target),
            )

    @property
    def placement(self) -> pin.SE3:
        """Where it is in its frame; x is right in the picture, y up, and it looks along −z, as MuJoCo's and OpenGL's cameras."""
        back: Floats = np.subtract(self.position, self.target)
        back /= np.linalg.norm(back)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return pin.SE3(
            np.column_stack([right, np.cross(back, right), back]), np.array(self.position)
        )

    def on(self, robot: Robot) -> str:
        """Return the frame of a robot's model that it is mounted on.

        Raises:
            UnknownNameError: The robot has none of this name.
        """
        check_frame(robot, self.frame)
        return frame_of(robot, self.frame)


def frame_of(robot: Robot, frame: str) -> str:
    """Return the frame of a robot's model that is meant by `BASE`, `HAND`, or its own name."""
    if frame == BASE:
        return str(robot.model.names[1])
    return robot.tool_frame if frame == HAND else frame


def check_frame(robot: Robot, frame: str) -> None:
    """Refuse the name of a frame that a robot lacks.

    Raises:
        UnknownNameError: It has none of this name.
    """
    known = sorted(
        {
            BASE,
            HAND,
            *(str(one.name) for one in robot.model.frames if one.type == pin.FrameType.BODY),
        }
    )
    if frame not in known:
        raise UnknownNameError(f"frame of {robot.name}", frame, known)
