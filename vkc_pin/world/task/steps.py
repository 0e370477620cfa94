"""Defines the steps of a task: desired changes in the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arguments import (
    check_bool,
    check_choice,
    check_coordinate,
    check_list,
    check_mapping,
    check_number,
    check_text,
)
from vkc_pin.world.scene.poses import as_placement, as_target


def _check_names(step: Any, **optional: bool) -> None:
    """Check that fields of a step are strings, or None where that is allowed."""
    for name, may_be_none in optional.items():
        value = getattr(step, name)
        if value is not None or not may_be_none:
            checked = check_text(value, f"{type(step).__name__}.{name}", "a name")
            object.__setattr__(step, name, checked)


@dataclass(frozen=True)
class Reach:
    """Bring a frame of the robot to a pose. For a goal in joint space, see `Configure`.

    Attributes:
        pose: Goal pose in the world frame; see `as_placement` for its forms. A list or an array of
            as many numbers as the arm has joints, and within their limits, is refused, since it may
            be meant as joint values; a tuple is a pose.
        frame: Frame of the robot; None: the tool frame.
        numbers: The pose as given, if it was a list or an array of numbers.
    """

    pose: Any
    frame: str | None = None
    numbers: tuple[float, ...] | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if isinstance(self.pose, Mapping):
            expected = "a pose; Configure brings joints to values"
            got = format_value(self.pose)
            raise InputError("not a pose", field="Reach.pose", expected=expected, got=got)
        given = self.pose
        object.__setattr__(self, "pose", as_placement(given, name="Reach.pose"))
        if isinstance(given, list | np.ndarray) and np.ndim(given) == 1:
            object.__setattr__(self, "numbers", tuple(float(number) for number in given))
        _check_names(self, frame=True)


@dataclass(frozen=True)
class Grasp:
    """Grasp an object.

    Attributes:
        object: Its name in the scene.
        attachment: Attachment to grasp; None leaves it open: the first one that is meant for a hand
            (or for a tool), and if planning fails, the others.
        by: Link of a held object that grasps instead of the tool frame (a stick's tip),
            "<object>.<link>"; None: the hand.
    """

    object: str
    attachment: str | None = None
    by: str | None = None

    def __post_init__(self) -> None:
        _check_names(self, object=False, attachment=True, by=True)


@dataclass(frozen=True)
class Actuate:
    """Bring joints of an object to values; the object is grasped and unlatched first if necessary.

    Attributes:
        object: Name of the object in the scene.
        joints: Joint name → final value, [rad] or [m].
        attachment: Attachment to grasp if the object is not held there; None leaves it open: the
            present grasp is kept if it can move the joints, else the first attachment that moves
            them is used, and if planning fails, the others that do.
    """

    object: str
    joints: Mapping[str, float] = field(default_factory=dict)
    attachment: str | None = None

    def __post_init__(self) -> None:
        _check_names(self, object=False, attachment=True)
        expected = "a mapping such as {'hinge': 1.2}"
        if not isinstance(self.joints, Mapping) or not self.joints:
            raise InputError(
                "nothing to actuate",
                field="Actuate.joints",
                expected=expected,
                got=format_value(self.joints),
            )
        joints = dict[str, float]()
        for name, value in check_mapping(self.joints, "Actuate.joints", expected).items():
            joints[name] = check_coordinate(value, f"Actuate.joints[{name!r}]")
        object.__setattr__(self, "joints", joints)


@dataclass(frozen=True)
class Touch:
    """Bring a frame of a held object, or of the robot, to a point or a pose.

    Attributes:
        frame: "<object>.<link>", a link of a free object, which is grasped first unless it is held;
            or a frame of the robot.
        target: In the world frame: a point (x, y, z) [m] with any orientation, or a pose; see
            `as_placement`.
        attachment: Attachment to grasp if the object is not held yet; None leaves it open, as in
            `Grasp`.
    """

    frame: str
    target: Any
    attachment: str | None = None

    def __post_init__(self) -> None:
        _check_names(self, attachment=True)
        check_text(
            self.frame, "Touch.frame", "<object>.<link>, e.g. stick.tip, or a frame of the robot"
        )
        object.__setattr__(self, "target", as_target(self.target, name="Touch.target"))


@dataclass(frozen=True)
class Place:
    """Put a free object down and release it; it is grasped first if necessary.

    Attributes:
        object: Its name in the scene.
        pose: Goal of its base link in the world frame: a pose (see `as_placement`), or a point (x,
            y, z) [m], where it is as upright as before the plan, at any heading; if it is held at
            the start, with its z axis up.
        attachment: Attachment to grasp if it is not held yet; None leaves it open, as in `Grasp`.
        unsupported: Whether it may be released where it does not rest on anything and would fall or
            tip over; otherwise that is an error.
    """

    object: str
    pose: Any
    attachment: str | None = None
    unsupported: bool = False

    def __post_init__(self) -> None:
        _check_names(self, object=False, attachment=True)
        check_bool(self.unsupported, "Place.unsupported")
        object.__setattr__(self, "pose", as_target(self.pose, name="Place.pose"))


@dataclass(frozen=True)
class Release:
    """Release an object.

    Attributes:
        object: Its name; None: all held objects.
        unsupported: Whether it may be released where it does not rest on anything; see `Place`.
    """

    object: str | None = None
    unsupported: bool = False

    def __post_init__(self) -> None:
        _check_names(self, object=True)
        check_bool(self.unsupported, "Release.unsupported")


@dataclass(frozen=True)
class Configure:
    """Bring joints of the robot to values: a goal in joint space.

    Free held objects are carried along, fixed ones are released.

    Attributes:
        joints: Joint → final value, [rad] or [m], for all or some joints of the robot, and for its
            base: `base_x`, `base_y` [m] and `base_yaw` [rad]. Of a joint without limits and of the
            heading, values that differ by full turns are the same.
        tolerance: Largest accepted deviation from the values, [rad] or [m]: one for all joints, or
            joint → deviation; joints without one must be reached exactly.
        velocities: Joint → velocity with which the motion ends there, [rad/s] or [m/s], where it is
            not at rest. Only the last step may end in motion.
    """

    joints: Mapping[str, float]
    tolerance: float | Mapping[str, float] = 0.0
    velocities: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        field = "Configure.joints"
        expected = "a mapping such as {'elbow_joint': 1.2}"
        if not isinstance(self.joints, Mapping) or not self.joints:
            got = format_value(self.joints)
            raise InputError("nothing to configure", field=field, expected=expected, got=got)
        joints = dict[str, float]()
        for name, value in check_mapping(self.joints, field, expected).items():
            joints[name] = check_coordinate(value, f"{field}[{name!r}]")
        object.__setattr__(self, "joints", joints)
        object.__setattr__(self, "tolerance", self._check_tolerance())
        object.__setattr__(self, "velocities", self._check_velocities())

    def _check_tolerance(self) -> float | dict[str, float]:
        field = "Configure.tolerance"
        expected = "a finite number of at least 0"
        if not isinstance(self.tolerance, Mapping):
            return check_number(self.tolerance, field, expected, low=0.0)
        found = dict[str, float]()
        for name, value in check_mapping(self.tolerance, field).items():
            if name not in self.joints:
                raise UnknownNameError("joint of this step", name, self.joints, field=field)
            found[name] = check_number(value, f"{field}[{name!r}]", expected, low=0.0)
        return found

    def _check_velocities(self) -> dict[str, float]:
        field = "Configure.velocities"
        expected = "a mapping such as {'elbow_joint': 0.2}"
        found = dict[str, float]()
        for name, value in check_mapping(self.velocities, field, expected).items():
            if name not in self.joints:
                raise UnknownNameError("joint of this step", name, self.joints, field=field)
            found[name] = check_number(value, f"{field}[{name!r}]", "a velocity [m/s] or [rad/s]")
        return found

    def get_tolerance(self, joint: str) -> float:
        """Return the largest accepted deviation of a joint of this step, [rad] or [m]."""
        if isinstance(self.tolerance, Mapping):
            return self.tolerance.get(joint, 0.0)
        return self.tolerance


@dataclass(frozen=True)
class GoTo:
    """Bring the base to a position; free held objects are carried along, fixed ones are released.

    Attributes:
        x, y: Position of the base frame in the world [m].
        yaw: Heading [rad]; None: any.
    """

    x: float
    y: float
    yaw: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", check_coordinate(self.x, "GoTo.x"))
        object.__setattr__(self, "y", check_coordinate(self.y, "GoTo.y"))
        if self.yaw is not None:
            object.__setattr__(self, "yaw", check_coordinate(self.yaw, "GoTo.yaw"))


Step = Reach | Grasp | Actuate | GoTo | Touch | Place | Release | Configure
STEPS = (Reach, Grasp, Actuate, GoTo, Touch, Place, Release, Configure)
"""All step classes."""
_KINDS: dict[str, Any] = {kind.__name__: kind for kind in STEPS}


def as_steps(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Return steps as a tuple."""
    if isinstance(steps, STEPS):
        raise InputError(
            "a single step", field="steps", expected="a list of steps", got=format_value(steps)
        )
    found: tuple[Step, ...] = check_list(steps, "steps", "a list of steps")
    if not found:
        raise InputError(
            "there is nothing to do",
            field="steps",
            expected="at least one step",
            got="an empty list",
        )
    for number, step in enumerate(found):
        if not isinstance(step, STEPS):
            expected = ", ".join(kind.__name__ for kind in STEPS)
            raise InputError(
                "not a step", field=f"steps[{number}]", expected=expected, got=format_value(step)
            )
        is_last = number == len(found) - 1
        if isinstance(step, Configure) and any(step.velocities.values()) and not is_last:
            raise InputError(
                "only the last step may end in motion",
                field=f"steps[{number}].velocities",
                expected="velocities of 0, or no further steps",
                got=dict(step.velocities),
            )
    return found


def describe_step(step: Step) -> str:
    """Return kind and subject of a step, for example "Place of cup"."""
    subject = getattr(step, "object", None) or getattr(step, "frame", None)
    return f"{type(step).__name__} of {subject}" if subject else type(step).__name__


def step_to_dict(step: Step) -> dict[str, Any]:
    """Return `step` as plain data, e.g. for a saved plan."""
    data: dict[str, Any] = {"step": type(step).__name__}
    for item in fields(step):
        if item.init:
            value = getattr(step, item.name)
            data[item.name] = value.homogeneous.tolist() if isinstance(value, pin.SE3) else value
    return data


def step_from_dict(data: Mapping[str, Any]) -> Step:
    """Return the step that `step_to_dict` converted to `data`."""
    given = check_mapping(data, "step", "a step as data")
    kind = check_choice(given.pop("step", ""), _KINDS, "step", "step")
    known_fields = {item.name: item for item in fields(_KINDS[kind]) if item.init}
    for name in given:
        if name not in known_fields:
            raise UnknownNameError(f"field of {kind}", name, known_fields, field=f"{kind}.{name}")
    for name, item in known_fields.items():
        is_required = item.default is MISSING and item.default_factory is MISSING
        if is_required and name not in given:
            raise InputError("this is missing", field=f"{kind}.{name}")
    step: Step = _KINDS[kind](**given)
    return step
