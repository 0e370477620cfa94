"""Defines the schema of robot.yaml, which holds the properties that a URDF lacks."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_coordinate
from vkc_pin.world.files.documents import Document, parse_document, read_yaml
from vkc_pin.world.files.fields import (
    JointSchema,
    NonNegative,
    Number,
    Positive,
    Schema,
    require,
    wrap_text,
)

Limits = Annotated[
    tuple[Number, Number],
    require(
        lambda value: value[0] <= value[1], "lower limit above the upper one", "[lower, upper]"
    ),
]


class Wheels(Schema):
    """Driven wheels of a base, half of them on each side.

    Attributes:
        track: Effective distance between left and right wheels in turns [m]; larger than the
            geometric one if wheels skid.
        radius: Wheel radius [m].
        speed: Maximum angular velocity of a wheel [rad/s].
    """

    track: Positive
    radius: Positive
    speed: Positive

    @property
    def rim_speed(self) -> float:
        """Maximum circumferential speed of a wheel [m/s]."""
        return self.radius * self.speed


class BaseSchema(Schema):
    """Properties of the planar base, ordered x [m], y [m], yaw [rad].

    `height` is that of the root link above the floor [m]. Wheels and minimum turning radius [m]
    have no default.
    """

    position: tuple[Limits, Limits] = ((-20.0, 20.0), (-20.0, 20.0))
    velocity: tuple[Positive, Positive, Positive] = (1.0, 1.0, 2.0)
    acceleration: tuple[Positive, Positive, Positive] = (3.0, 3.0, 6.0)
    height: Number = 0.0
    wheels: Wheels | None = None
    turning_radius: Positive | None = None


class RobotJointSchema(JointSchema):
    """Corrections to a robot's joint in the URDF; effort [N·m] or [N], where 0 means unknown."""

    effort: NonNegative | None = None


class FingerSchema(Schema):
    """Positions of a finger joint with the gripper closed and fully open, [m] or [rad]."""

    closed: Number
    open: Number


class CouplingSchema(Schema):
    """Coupling to `joint`: multiplier · position + offset, as <mimic> in a URDF."""

    joint: str
    multiplier: Annotated[
        Number, require(bool, "the multiplier must not be 0", "another number, or `locked_joints`")
    ] = 1.0
    offset: Number = 0.0


class RobotSchema(Schema):
    """Contents of a robot.yaml; all fields except `urdf` are optional.

    `payload` is the largest mass of grasped objects and of those on them [kg].
    """

    urdf: str
    srdf: str | None = None
    packages: tuple[str, ...] = ()
    tool_frame: str | None = None
    arm: str | None = None
    touch_links: tuple[str, ...] = ()
    base: BaseSchema = BaseSchema()
    payload: Positive | None = None
    home: dict[str, Number] = Field(default_factory=dict)
    locked_joints: dict[str, Number] = Field(default_factory=dict)
    gripper: dict[str, FingerSchema] = Field(default_factory=dict)
    couplings: dict[str, Annotated[CouplingSchema, wrap_text("joint")]] = Field(
        default_factory=dict
    )
    joints: dict[str, RobotJointSchema] = Field(default_factory=dict)


def read_robot(file: Path) -> tuple[RobotSchema, Document]:
    """Read a robot.yaml."""
    document = read_yaml(file)
    if not isinstance(document.data, dict):
        raise InputError(
            "this is not a robot description",
            file=file,
            expected="fields (name: value)",
            got=type(document.data).__name__,
        )
    settings = parse_document(document, RobotSchema)
    if settings.arm is not None and settings.tool_frame is not None:
        raise document.make_error(
            ("arm",),
            "`arm` and `tool_frame` exclude each other",
            expected="one of them",
            got=settings.arm,
        )
    return settings, document


def read_wheels(
    base: str, turning_radius: float | None, settings: RobotSchema, source: Path
) -> dict[str, Any]:
    """Return the arguments of `Robot` for wheels and turning radius.

    Args:
        base: Type of the base.
        turning_radius: Minimum turning radius of an "ackermann" base [m], or None.
        settings: Contents of the robot.yaml.
        source: Path of the robot.yaml or URDF, for messages.
    """
    wheels = settings.base.wheels
    if base != "ackermann":
        if turning_radius is not None:
            expected = "no value, or base='ackermann'"
            raise InputError(
                f"a base of type '{base}' has no turning radius",
                field="turning_radius",
                expected=expected,
                got=turning_radius,
            )
        return {"wheels": wheels}
    radius = settings.base.turning_radius
    if turning_radius is not None:
        radius = check_coordinate(turning_radius, "turning_radius")
    if radius is None:
        expected = "turning_radius [m] as an argument, or under `base` in robot.yaml"
        raise InputError(
            "an ackermann base needs a turning radius",
            file=source,
            field="turning_radius",
            expected=expected,
            got="none",
        )
    if radius <= 0.0:
        raise InputError(
            "the turning radius must be positive",
            field="turning_radius",
            expected="a number > 0 [m]",
            got=radius,
        )
    return {"wheels": wheels, "turning_radius": radius}


def find_python_packages(names: tuple[str, ...], document: Document) -> dict[str, Path]:
    """Return the folders of installed Python packages, without importing them."""
    folders = {}
    for index, name in enumerate(names):
        spec = importlib.util.find_spec(name) if name.isidentifier() else None
        if spec is None or not spec.submodule_search_locations:
            problem = "the Python package with the robot's meshes is not installed"
            raise document.make_error(
                ("packages", index), problem, expected=f"pip install {name.replace('_', '-')}"
            )
        folders[name] = Path(next(iter(spec.submodule_search_locations)))
    return folders
