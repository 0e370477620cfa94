"""What a user asks for: steps, each a change in the world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, shown
from vkc_pin.utils.arguments import items, known, mapping, quantity, text
from vkc_pin.world.scene.poses import as_placement, as_target

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
    "as_steps",
    "step_from_dict",
    "step_to_dict",
]


def _names(step: Any, **optional: bool) -> None:
    """Check that fields of a step are text, or None where that is optional."""
    for name, may_be_none in optional.items():
        value = getattr(step, name)
        if value is not None or not may_be_none:
            object.__setattr__(step, name, text(value, f"{type(step).__name__}.{name}", "a name"))


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
        _names(self, frame=True)


@dataclass(frozen=True)
class Grasp:
    """Take hold of an object.

    Attributes:
        object: Its name in the scene.
        attachment: Where to grasp it; None is the object's first attachment.
        by: Through what: "<object>.<link>", a link of an object in the hand (a stick's tip), which
            takes the place of the tool frame; None is the hand itself.
    """

    object: str
    attachment: str | None = None
    by: str | None = None

    def __post_init__(self) -> None:
        _names(self, object=False, attachment=True, by=True)


@dataclass(frozen=True)
class Actuate:
    """Bring joints of an object to values; grasping it and releasing its latches is implied.

    Attributes:
        object: The object's name in the scene.
        joints: Joint name → value at the end, [rad] or [m].
        attachment: Where to grasp it if it is not held there; None leaves that open: it is held on
            to if the joints move so, else taken by the object's first attachment that moves them,
            and where planning with that one fails, by the others that do.
    """

    object: str
    joints: Mapping[str, float] = field(default_factory=dict)
    attachment: str | None = None

    def __post_init__(self) -> None:
        _names(self, object=False, attachment=True)
        expected = "a mapping such as {'hinge': 1.2}"
        if not isinstance(self.joints, Mapping) or not self.joints:
            raise InputError(
                "nothing to actuate",
                field="Actuate.joints",
                expected=expected,
                got=shown(self.joints),
            )
        given = mapping(self.joints, "Actuate.joints", expected)
        joints = {
            name: quantity(value, f"Actuate.joints[{name!r}]") for name, value in given.items()
        }
        object.__setattr__(self, "joints", joints)


@dataclass(frozen=True)
class Touch:
    """Bring a frame of what is held, or of the robot, to a point or a pose.

    Attributes:
        frame: "<object>.<link>", a link of a free object, which is grasped first unless it is held;
            or a frame of the robot.
        target: In the world frame: a point (x, y, z) [m], at any orientation, or a pose; see
            `as_placement`.
    """

    frame: str
    target: Any

    def __post_init__(self) -> None:
        text(self.frame, "Touch.frame", "<object>.<link>, e.g. stick.tip, or a frame of the robot")
        object.__setattr__(self, "target", as_target(self.target, name="Touch.target"))


@dataclass(frozen=True)
class Place:
    """Put a free object somewhere and let go of it; grasping it first is implied.

    Attributes:
        object: Its name in the scene.
        pose: Of its base link in the world frame: a pose (see `as_placement`), or a point (x, y, z)
            [m], where it then stands as upright as it does before the plan, at any heading; with
            its z axis up if it is in the hand then.
        attachment: Where to grasp it if it is not held yet; None is the object's first attachment.
    """

    object: str
    pose: Any
    attachment: str | None = None

    def __post_init__(self) -> None:
        _names(self, object=False, attachment=True)
        object.__setattr__(self, "pose", as_target(self.pose, name="Place.pose"))


@dataclass(frozen=True)
class Release:
    """Let go.

    Attributes:
        object: Of what; None is everything in the hand.
    """

    object: str | None = None

    def __post_init__(self) -> None:
        _names(self, object=True)


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
                object.__setattr__(self, name, quantity(getattr(self, name), f"GoTo.{name}"))


Step = Reach | Grasp | Actuate | GoTo | Touch | Place | Release
STEPS = (Reach, Grasp, Actuate, GoTo, Touch, Place, Release)
"""All kinds of steps."""
_KINDS: dict[str, Any] = {kind.__name__: kind for kind in STEPS}


def as_steps(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Return steps as a tuple.

    Raises:
        InputError: They are no list, or an empty one.
    """
    if isinstance(steps, STEPS):
        raise InputError(
            "one step alone", field="steps", expected="a list of steps", got=shown(steps)
        )
    found: tuple[Step, ...] = items(steps, "steps", "a list of steps")
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
                "not a step", field=f"steps[{number}]", expected=expected, got=shown(step)
            )
    return found


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
    given = mapping(data, "step", "a step as data")
    kind = known(given.pop("step", ""), _KINDS, "step", "step")
    has = {item.name: item for item in fields(_KINDS[kind])}
    for name in given:
        if name not in has:
            raise UnknownNameError(f"field of {kind}", name, has, field=f"{kind}.{name}")
    for name, item in has.items():
        if name not in given and item.default is MISSING and item.default_factory is MISSING:
            raise InputError("this is missing", field=f"{kind}.{name}")
    step: Step = _KINDS[kind](**given)
    return step
