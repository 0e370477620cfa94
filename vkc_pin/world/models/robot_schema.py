"""What a robot.yaml may contain: what a URDF cannot say about a robot."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import quantity
from vkc_pin.world.files.documents import Document, check, read_yaml
from vkc_pin.world.files.fields import (
    JointSchema,
    NotNegative,
    Number,
    Positive,
    Schema,
    require,
    text_for,
)

__all__ = [
    "BaseSchema",
    "CouplingSchema",
    "FingerSchema",
    "RobotJointSchema",
    "RobotSchema",
    "Wheels",
    "find_python_packages",
    "read_robot",
    "read_wheels",
]


Limits = Annotated[
    tuple[Number, Number],
    require(
        lambda value: value[0] <= value[1], "lower limit above the upper one", "[lower, upper]"
    ),
]


class Wheels(Schema):
    """The driven wheels of a base, half of them left, half right.

    Attributes:
        track: How far left is from right, as far as turning is concerned [m]: where wheels skid in
            turns, more than it measures.
        radius: Of a wheel [m].
        speed: How fast one turns at most [rad/s].
    """

    track: Positive
    radius: Positive
    speed: Positive

    @property
    def rim_speed(self) -> float:
        """How fast a wheel goes over the floor at most [m/s]."""
        return self.radius * self.speed


class BaseSchema(Schema):
    """The planar base: x and y in [m], yaw in [rad]; velocities and accelerations per x, y, yaw; height of the root link [m].

    Of wheels, and of the least radius of a turn [m], nothing is assumed.
    """

    position: tuple[Limits, Limits] = ((-20.0, 20.0), (-20.0, 20.0))
    velocity: tuple[Positive, Positive, Positive] = (1.0, 1.0, 2.0)
    acceleration: tuple[Positive, Positive, Positive] = (3.0, 3.0, 6.0)
    height: Number = 0.0
    wheels: Wheels | None = None
    turning_radius: Positive | None = None


class RobotJointSchema(JointSchema):
    """What a URDF does not say about a joint of a robot, or says wrong; effort [N·m] or [N], 0: that is not known."""

    effort: NotNegative | None = None


class FingerSchema(Schema):
    """A joint of a finger: where it is when the gripper is closed, and when it is fully open, [m] or [rad]."""

    closed: Number
    open: Number


class CouplingSchema(Schema):
    """A joint that follows `joint`: it is at multiplier · position + offset, [m] or [rad], as <mimic> in a URDF says."""

    joint: str
    multiplier: Annotated[
        Number, require(bool, "a joint that stands still", "a number but 0, or `locked_joints`")
    ] = 1.0
    offset: Number = 0.0


class RobotSchema(Schema):
    """A robot.yaml beside a URDF; every field but `urdf` may be left out."""

    urdf: str
    srdf: str | None = None
    packages: tuple[str, ...] = ()
    tool_frame: str | None = None
    arm: str | None = None
    touch_links: tuple[str, ...] = ()
    base: BaseSchema = BaseSchema()
    home: dict[str, Number] = Field(default_factory=dict)
    locked_joints: dict[str, Number] = Field(default_factory=dict)
    gripper: dict[str, FingerSchema] = Field(default_factory=dict)
    couplings: dict[str, Annotated[CouplingSchema, text_for("joint")]] = Field(default_factory=dict)
    joints: dict[str, RobotJointSchema] = Field(default_factory=dict)


def read_robot(file: Path) -> tuple[RobotSchema, Document]:
    """Read a robot.yaml.

    Raises:
        InputError: It cannot be read, or a field of it is wrong; the error names file, line and
            field.
    """
    document = read_yaml(file)
    if not isinstance(document.data, dict):
        raise InputError(
            "not a robot",
            file=file,
            expected="fields (name: value)",
            got=type(document.data).__name__,
        )
    settings = check(document, RobotSchema)
    if settings.arm is not None and settings.tool_frame is not None:
        raise document.error(
            ("arm",), "tool_frame says what grasps, too", expected="one of them", got=settings.arm
        )
    return settings, document


def read_wheels(
    base: str, least: float | None, settings: RobotSchema, source: Path
) -> dict[str, Any]:
    """Return the fields of a `Robot` that its wheels are about.

    Args:
        base: How it moves.
        least: The least radius of a turn [m]; None: what robot.yaml says. Only "ackermann" has one.
        settings: What robot.yaml says.
        source: Where that is.

    Raises:
        InputError: The radius is none, the base has none, or it needs one and nobody says.
    """
    wheels = settings.base.wheels
    if base != "ackermann":
        if least is not None:
            expected = "none, unless the base is ackermann"
            raise InputError(
                f"a base that is {base} has no turning radius",
                field="turning_radius",
                expected=expected,
                got=least,
            )
        return {"wheels": wheels}
    radius = settings.base.turning_radius if least is None else quantity(least, "turning_radius")
    if radius is None:
        expected = "turning_radius [m], beside the base, or under `base` in its robot.yaml"
        raise InputError(
            "nothing says how tightly it turns",
            file=source,
            field="turning_radius",
            expected=expected,
            got="none",
        )
    if radius <= 0.0:
        raise InputError(
            "out of range", field="turning_radius", expected="a number > 0 [m]", got=radius
        )
    return {"wheels": wheels, "turning_radius": radius}


def find_python_packages(names: tuple[str, ...], document: Document) -> dict[str, Path]:
    """Return the folders of installed Python packages, without importing them.

    Raises:
        InputError: One is not installed.
    """
    folders = {}
    for index, name in enumerate(names):
        spec = importlib.util.find_spec(name) if name.isidentifier() else None
        if spec is None or not spec.submodule_search_locations:
            problem = "the Python package with the robot's meshes is not installed"
            raise document.error(
                ("packages", index), problem, expected=f"pip install {name.replace('_', '-')}"
            )
        folders[name] = Path(next(iter(spec.submodule_search_locations)))
    return folders
