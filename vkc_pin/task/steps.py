"""What a user asks for: steps, each a change in the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError

__all__ = [
    "STEPS",
    "Actuate",
    "GoTo",
    "Grasp",
    "Place",
    "Reach",
    "Release",
    "Step",
    "Touch",
    "as_list",
    "as_placement",
    "as_target",
    "step_from_dict",
    "step_to_dict",
]


def as_placement(pose: Any, *, name: str = "pose") -> pin.SE3:
    """Return `pose` as a `pinocchio.SE3`.

    Args:
        pose: An SE3, a 4 × 4 homogeneous matrix, or (x, y, z, roll, pitch, yaw) in [m] and [rad].
        name: The argument's name, for the message.

    Raises:
        InputError: It is none of these, not finite, or its rotation is no rotation.
    """
    expected = "a pinocchio.SE3, a 4 x 4 matrix or (x, y, z, roll, pitch, yaw)"
    try:
        array = np.asarray(pose.homogeneous if isinstance(pose, pin.SE3) else pose, float)
    except (TypeError, ValueError):
        raise InputError("not a pose", field=name, expected=expected, got=repr(pose)) from None
    if array.shape not in ((6,), (4, 4)):
        got = f"an array of shape {array.shape}" if array.ndim else repr(pose)
        raise InputError("not a pose", field=name, expected=expected, got=got)
    if not np.all(np.isfinite(array)):
        raise InputError("not finite", field=name, expected=expected, got=array.tolist())
    if array.shape == (6,):
        return pin.SE3(pin.rpy.rpyToMatrix(*array[3:]), array[:3])
    rotation = array[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
        raise InputError("its upper left 3 x 3 block is not a rotation", field=name, got=rotation.tolist())
    if np.abs(array[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise InputError("its last row is wrong", field=name, expected=[0, 0, 0, 1], got=array[3].tolist())
    return pin.SE3(rotation, array[:3, 3])


def as_target(target: Any, *, name: str) -> pin.SE3 | tuple[float, float, float]:
    """Return `target` as a point [m] if it is three numbers, otherwise as a placement; see `as_placement`.

    Raises:
        InputError: It is neither.
    """
    try:
        point = np.asarray(target, float) if not isinstance(target, pin.SE3) else None
    except (TypeError, ValueError):
        point = None
    if point is not None and point.ndim == 1 and point.shape not in ((3,), (6,)):
        expected = "a point (x, y, z), or a pose: a pinocchio.SE3, a 4 x 4 matrix or (x, y, z, roll, pitch, yaw)"
        raise InputError("not a pose or a point", field=name, expected=expected, got=repr(target))
    if point is None or point.shape != (3,):
        return as_placement(target, name=name)
    if not np.all(np.isfinite(point)):
        raise InputError("not finite", field=name, expected="a point (x, y, z)", got=point.tolist())
    return (float(point[0]), float(point[1]), float(point[2]))


def _finite(value: Any, field: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError("not a number", field=field, got=repr(value)) from None
    if not np.isfinite(number):
        raise InputError("not finite", field=field, got=value)
    return number


@dataclass(frozen=True)
class Reach:
    """Bring a frame of the robot to a pose.

    Attributes:
        pose: Where, expressed in the world frame; see `as_placement` for what is taken.
        frame: Which frame of the robot; None is its tool frame.
    """

    pose: Any
    frame: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", as_placement(self.pose, name="Reach.pose"))


@dataclass(frozen=True)
class Grasp:
    """Take hold of an object.

    Attributes:
        object: Its name in the scene.
        attachment: Where to grasp it; None is the object's first attachment.
        by: Through what: "<object>.<link>", a link of an object in the hand (a stick's tip), which takes the place of the
            tool frame; None is the hand itself.
    """

    object: str
    attachment: str | None = None
    by: str | None = None


@dataclass(frozen=True)
class Actuate:
    """Bring joints of an object to values; grasping it and releasing its latches is implied.

    Attributes:
        object: The object's name in the scene.
        joints: Joint name → value at the end, [rad] or [m].
        attachment: Where to grasp it if it is not held yet; None is the object's first attachment.
    """

    object: str
    joints: Mapping[str, float] = field(default_factory=dict)
    attachment: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.joints, Mapping) or not self.joints:
            expected = "a mapping such as {'hinge': 1.2}"
            raise InputError("nothing to actuate", field="Actuate.joints", expected=expected, got=repr(self.joints))
        joints = {str(name): _finite(value, f"Actuate.joints[{name!r}]") for name, value in self.joints.items()}
        object.__setattr__(self, "joints", joints)


@dataclass(frozen=True)
class Touch:
    """Bring a frame of what is held, or of the robot, to a point or a pose.

    Attributes:
        frame: "<object>.<link>", a link of a free object, which is grasped first unless it is held; or a frame of the robot.
        target: In the world frame: a point (x, y, z) [m], at any orientation, or a pose; see `as_placement`.
    """

    frame: str
    target: Any

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise InputError("not a frame", field="Touch.frame", expected="<object>.<link>, e.g. stick.tip", got=repr(self.frame))
        object.__setattr__(self, "target", as_target(self.target, name="Touch.target"))


@dataclass(frozen=True)
class Place:
    """Put a free object somewhere and let go of it; grasping it first is implied.

    Attributes:
        object: Its name in the scene.
        pose: Of its base link in the world frame: a pose (see `as_placement`), or a point (x, y, z) [m], where it then
            stands as upright as it does before the plan, at any heading; with its z axis up if it is in the hand then.
        attachment: Where to grasp it if it is not held yet; None is the object's first attachment.
    """

    object: str
    pose: Any
    attachment: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", as_target(self.pose, name="Place.pose"))


@dataclass(frozen=True)
class Release:
    """Let go.

    Attributes:
        object: Of what; None is everything in the hand.
    """

    object: str | None = None


@dataclass(frozen=True)
class GoTo:
    """Bring the base to a place on the floor, carrying along what can be carried and letting go of the rest.

    Attributes:
        x, y: Position of the base frame in the world, [m].
        yaw: Heading [rad]; None leaves it open.
    """

    x: float
    y: float
    yaw: float | None = None

    def __post_init__(self) -> None:
        for name in ("x", "y", "yaw"):
            if name != "yaw" or self.yaw is not None:
                object.__setattr__(self, name, _finite(getattr(self, name), f"GoTo.{name}"))


Step = Reach | Grasp | Actuate | GoTo | Touch | Place | Release
STEPS = (Reach, Grasp, Actuate, GoTo, Touch, Place, Release)
"""All kinds of steps."""
_KINDS: dict[str, Any] = {kind.__name__: kind for kind in STEPS}


def as_list(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Return steps as a tuple.

    Raises:
        InputError: They are no list, or an empty one.
    """
    if isinstance(steps, STEPS):
        raise InputError("one step alone", field="steps", expected="a list of steps", got=repr(steps))
    try:
        steps = tuple(steps)
    except TypeError:
        raise InputError("not steps", field="steps", expected="a list of steps", got=repr(steps)) from None
    if not steps:
        raise InputError("there is nothing to do", field="steps", expected="at least one step", got="an empty list")
    return steps


def step_to_dict(step: Step) -> dict[str, Any]:
    """Return `step` as plain data, e.g. for a saved plan."""
    data = {"step": type(step).__name__, **vars(step)}
    for name, value in data.items():
        if isinstance(value, pin.SE3):
            data[name] = value.homogeneous.tolist()
    return data


def step_from_dict(data: Mapping[str, Any]) -> Step:
    """Return the step that `step_to_dict` made `data` of.

    Raises:
        UnknownNameError: There is no such step, or it has no such field.
        InputError: A field is missing or wrong.
    """
    given = dict(data)
    kind = str(given.pop("step", ""))
    if kind not in _KINDS:
        raise UnknownNameError("step", kind, _KINDS, field="step")
    known = {item.name: item for item in fields(_KINDS[kind])}
    for name in given:
        if name not in known:
            raise UnknownNameError(f"field of {kind}", name, known, field=f"{kind}.{name}")
    for name, item in known.items():
        if name not in given and item.default is MISSING and item.default_factory is MISSING:
            raise InputError("this is missing", field=f"{kind}.{name}")
    step: Step = _KINDS[kind](**given)
    return step
