"""Reads the state of a robot from data with the fields of a message of ROS or MoveIt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
import pydantic

from vkc_pin.utils.arguments import check_mapping
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.documents import Document, parse_document
from vkc_pin.world.files.fields import Number, make_validation_error
from vkc_pin.world.files.srdf import format_names

_NORM_TOLERANCE = 1e-3  # of lengths of quaternions
_MAX_TILT = 0.02  # [rad] of a planar base that a localisation may report
_MAX_HEIGHT = 1e-3  # [m] above which its height is noted


class _Part(pydantic.BaseModel):
    """A part of a message; its other fields are not used."""

    model_config = pydantic.ConfigDict(extra="ignore", frozen=True)


class JointStateSchema(_Part):
    """`sensor_msgs/JointState`: names of joints, and their positions [rad] or [m]."""

    name: tuple[str, ...] = ()
    position: tuple[Number, ...] = ()

    @pydantic.model_validator(mode="after")
    def _check_names(self) -> JointStateSchema:
        if len(self.name) != len(self.position):
            raise make_validation_error("wrong number", f"{len(self.name)} positions")
        if len(set(self.name)) != len(self.name):
            raise make_validation_error("a joint is named twice", "each joint once")
        return self

    @property
    def positions(self) -> dict[str, float]:
        """Joint → position."""
        return dict(zip(self.name, self.position, strict=True))


class _Vector(_Part):
    x: Number
    y: Number
    z: Number = 0.0


class _Rotation(_Part):
    x: Number
    y: Number
    z: Number
    w: Number


class _Transform(_Part):
    translation: _Vector
    rotation: _Rotation


class _MultiDofSchema(_Part):
    joint_names: tuple[str, ...] = ()
    transforms: tuple[_Transform, ...] = ()

    @pydantic.model_validator(mode="after")
    def _check_names(self) -> _MultiDofSchema:
        if len(self.joint_names) != len(self.transforms):
            raise make_validation_error("wrong number", f"{len(self.joint_names)} transforms")
        return self


class _RobotStateSchema(_Part):
    """`moveit_msgs/RobotState`."""

    joint_state: JointStateSchema = JointStateSchema()
    multi_dof_joint_state: _MultiDofSchema = _MultiDofSchema()
    attached_collision_objects: tuple[Any, ...] = ()


@dataclass(frozen=True, eq=False)
class JointState:
    """A state of a robot.

    Attributes:
        positions: Joint → position, [rad] or [m].
        base: x, y [m] and yaw [rad] of the base, shape (3,), if the message states it.
        notes: Further contents of the message, which are left out.
    """

    positions: Mapping[str, float]
    base: Floats | None = None
    notes: tuple[str, ...] = ()


def parse_joint_state(message: Any) -> JointState:
    """Return the state in a message.

    Args:
        message: Mapping with the fields of `sensor_msgs/JointState` (`name`, `position`) or of
            `moveit_msgs/RobotState` (`joint_state`, `multi_dof_joint_state`).

    Raises:
        InputError: A field is missing or invalid, or the base is tilted.
    """
    data = check_mapping(message, "message")
    document = Document(dict(data))
    if "name" in data:
        return JointState(parse_document(document, JointStateSchema).positions)
    if "joint_state" not in data and "multi_dof_joint_state" not in data:
        raise document.make_error(
            (),
            "the message has no joints",
            expected="name and position, or joint_state",
            got=list(data),
        )
    state = parse_document(document, _RobotStateSchema)
    notes = list[str]()
    if state.attached_collision_objects:
        notes.append("attached_collision_objects are left out: use Scene.with_held")
    base = None
    joints = state.multi_dof_joint_state.joint_names
    if joints:
        path = ("multi_dof_joint_state", "joint_names")
        if len(joints) > 1:
            raise document.make_error(
                path, "several joints of many degrees of freedom", expected="one", got=list(joints)
            )
        (transform,) = state.multi_dof_joint_state.transforms
        base = _find_base(document, transform)
        if abs(transform.translation.z) > _MAX_HEIGHT:
            notes.append(f"the height of {joints[0]} is left out: the scene states it")
    return JointState(state.joint_state.positions, base, tuple(notes))


def _find_base(document: Document, transform: _Transform) -> Floats:
    """Return x, y [m] and yaw [rad] of a transform, shape (3,)."""
    turn = transform.rotation
    path = ("multi_dof_joint_state", "transforms", 0, "rotation")
    numbers = np.array([turn.x, turn.y, turn.z, turn.w])
    norm = float(np.linalg.norm(numbers))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise document.make_error(
            path, "not a rotation", expected="a quaternion of length 1", got=numbers.tolist()
        )
    rotation = pin.Quaternion(numbers / norm).matrix()
    tilt = float(np.arccos(np.clip(rotation[2, 2], -1.0, 1.0)))
    if tilt > _MAX_TILT:
        raise document.make_error(
            path, "the base is tilted", expected="a rotation about z", got=f"{tilt:.3g} rad"
        )
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return np.array([transform.translation.x, transform.translation.y, yaw])


def note_other_joints(positions: Mapping[str, float], planned: tuple[str, ...]) -> list[str]:
    """Return a note about the joints that are not planned, if there are any."""
    others = [name for name in positions if name not in planned]
    return [f"joints that are not planned are left out: {format_names(others)}"] if others else []
