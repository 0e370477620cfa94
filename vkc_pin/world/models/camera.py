"""Describes cameras on a robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot

BASE = "base"
"""Frame of every robot: that of the mobile base."""
HAND = "hand"
"""Frame of every robot: the tool frame, whose z axis points ahead and along whose x axis the
fingers close."""
# sine of the angle up to which two directions are parallel
_PARALLEL = 1e-6


@dataclass(frozen=True)
class Camera:
    """A pinhole camera on a robot.

    Attributes:
        name: Camera name.
        frame: `BASE`, `HAND`, or a frame of the robot.
        position: Position in this frame [m].
        target: Point in the centre of the image, in this frame [m].
        up: Direction that is up in the image, in this frame.
        width, height: Image size [pixels].
        fov: Vertical field of view [deg].

    Raises:
        InputError: `target` equals `position`, or the viewing direction is parallel to `up`.
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
        ahead = np.subtract(self.target, self.position)
        up = np.array(self.up)
        lengths = np.linalg.norm(ahead) * np.linalg.norm(up)
        if np.linalg.norm(np.cross(ahead, up)) <= _PARALLEL * lengths:
            raise InputError(
                f"the orientation of camera '{self.name}' is undefined",
                field="target",
                expected="a target other than the camera's position, and not in the direction `up`",
                got=list(self.target),
            )

    @property
    def placement(self) -> pin.SE3:
        """Placement in its frame, looking along −z with x right and y up, as in OpenGL."""
        back: Floats = np.subtract(self.position, self.target)
        back /= np.linalg.norm(back)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        rotation = np.column_stack([right, np.cross(back, right), back])
        return pin.SE3(rotation, np.array(self.position))

    def find_frame(self, robot: Robot) -> str:
        """Return the frame of a robot's model on which the camera is mounted.

        Raises:
            UnknownNameError: The robot lacks the frame.
        """
        check_frame(robot, self.frame)
        return resolve_frame(robot, self.frame)


def resolve_frame(robot: Robot, frame: str) -> str:
    """Return the frame of a robot's model for `BASE`, `HAND`, or a frame name."""
    if frame == BASE:
        return str(robot.model.names[1])
    return robot.tool_frame if frame == HAND else frame


def check_frame(robot: Robot, frame: str) -> None:
    """Check that a robot has a frame."""
    bodies = {str(one.name) for one in robot.model.frames if one.type == pin.FrameType.BODY}
    known = {BASE, HAND} | bodies
    if frame not in known:
        raise UnknownNameError(f"frame of {robot.name}", frame, sorted(known))
