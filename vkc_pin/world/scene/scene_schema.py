"""What a scene file may contain. Lengths in metres, angles in radians, world frame with z up and the floor at z = 0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.fields import (
    Name,
    NotNegative,
    Number,
    Positive,
    Quaternion,
    Schema,
    Vector3,
    count,
    fail,
    require,
    text_for,
)
from vkc_pin.world.models.robot import Base

__all__ = [
    "COLOURS",
    "AllowSchema",
    "BoxSchema",
    "CapsuleSchema",
    "CylinderSchema",
    "HeldSchema",
    "MeshSchema",
    "ObstacleSchema",
    "PlacedObjectSchema",
    "RegionSchema",
    "SceneRobotSchema",
    "SceneSchema",
    "SphereSchema",
    "StartSchema",
    "UrdfSchema",
]

_MOST = 10_000  # obstacles; so many are loaded in some seconds

COLOURS: dict[str, tuple[float, float, float]] = {
    "black": (0.13, 0.13, 0.14),
    "blue": (0.27, 0.42, 0.60),
    "brown": (0.45, 0.31, 0.20),
    "concrete": (0.72, 0.71, 0.69),
    "cream": (0.93, 0.89, 0.80),
    "green": (0.29, 0.50, 0.29),
    "grey": (0.55, 0.56, 0.58),
    "oak": (0.76, 0.60, 0.42),
    "orange": (0.87, 0.53, 0.24),
    "red": (0.72, 0.25, 0.22),
    "steel": (0.66, 0.68, 0.71),
    "teal": (0.24, 0.52, 0.52),
    "terracotta": (0.74, 0.44, 0.32),
    "wall": (0.90, 0.89, 0.86),
    "walnut": (0.38, 0.26, 0.18),
    "white": (0.95, 0.95, 0.94),
    "yellow": (0.93, 0.79, 0.36),
}


def _colour(value: Any) -> Any:
    if isinstance(value, str):
        if value not in COLOURS:
            raise fail(
                f"unknown colour '{value}'",
                f"one of {', '.join(COLOURS)}, or [red, green, blue] from 0 to 1",
            )
        return (*COLOURS[value], 1.0)
    if isinstance(value, list | tuple) and len(value) == 3:
        return (*value, 1.0)
    return value


def _triple(value: Any) -> Any:
    return (
        (value, value, value)
        if isinstance(value, int | float) and not isinstance(value, bool)
        else value
    )


def _arm(value: Any) -> Any:
    if isinstance(value, str) and value != "home":
        raise fail(f"unknown arm configuration '{value}'", "home, or a list of joint values [rad]")
    if not isinstance(value, str | list | tuple):
        raise fail("wrong value", "home, or a list of joint values [rad]")
    return None if value == "home" else value


def _heading(value: Any) -> Any:
    if isinstance(value, str) and value != "any":
        raise fail(f"unknown heading '{value}'", "any, or [lowest, highest]")
    return None if value == "any" else value


Fraction = Annotated[Number, Field(ge=0.0, le=1.0)]
Size = Annotated[tuple[Positive, Positive, Positive], count(3)]
Colour = Annotated[
    tuple[Fraction, Fraction, Fraction, Fraction], count(4), BeforeValidator(_colour)
]
Interval = Annotated[
    tuple[Number, Number],
    count(2),
    require(lambda value: value[0] <= value[1], "the interval is empty", "[lowest, highest]"),
]
Description = Annotated[
    Any,
    require(
        lambda value: isinstance(value, str | dict),
        "wrong value",
        "the name or file of an object, or its description",
    ),
]
Scale = Annotated[Size, BeforeValidator(_triple)]


class PoseSchema(Schema):
    """Where something stands: position [m], and orientation as roll, pitch, yaw [rad], yaw alone, or quaternion [x, y, z, w]."""

    position: Vector3
    rpy: Vector3 | None = None
    yaw: Number | None = None
    quaternion: Quaternion | None = None

    @model_validator(mode="after")
    def _one_orientation(self) -> PoseSchema:
        if sum(given is not None for given in (self.rpy, self.yaw, self.quaternion)) > 1:
            raise fail("two orientations", "one of rpy, yaw and quaternion")
        return self


class ShapeSchema(PoseSchema):
    """What all obstacles have."""

    name: Name
    colour: Colour = (*COLOURS["grey"], 1.0)


class BoxSchema(ShapeSchema):
    """A box; `position` is its centre, `size` its edge lengths along its x, y, z axes."""

    type: Literal["box"]
    size: Size


class SphereSchema(ShapeSchema):
    """A sphere; `position` is its centre."""

    type: Literal["sphere"]
    radius: Positive


class CylinderSchema(ShapeSchema):
    """A cylinder along its z axis; `position` is its centre."""

    type: Literal["cylinder"]
    radius: Positive
    length: Positive


class CapsuleSchema(ShapeSchema):
    """A cylinder of `length` along its z axis with a half sphere at either end; `position` is its centre."""

    type: Literal["capsule"]
    radius: Positive
    length: Positive


class MeshSchema(ShapeSchema):
    """A mesh file, which collides as its convex hull; `position` is the origin of its coordinates."""

    type: Literal["mesh"]
    file: str
    scale: Scale = (1.0, 1.0, 1.0)


class UrdfSchema(PoseSchema):
    """A URDF whose joints stay at their neutral position; its own colours, unless `colour` replaces them."""

    name: Name
    colour: Colour | None = None
    type: Literal["urdf"]
    file: str


ObstacleSchema = Annotated[
    BoxSchema | SphereSchema | CylinderSchema | CapsuleSchema | MeshSchema | UrdfSchema,
    Field(discriminator="type"),
]


class PlacedObjectSchema(PoseSchema):
    """An articulated object: `type` names its description or its file, or is one; `state` its joint values (others are 0).

    Attachments that are `reversed` are approached from the other side than the object's description
    says; None: those whose hand would come out of the object or from below the floor.
    """

    name: Name
    type: Description
    state: Mapping[str, Number] = Field(default_factory=dict)
    reversed: tuple[str, ...] | None = None


class SceneRobotSchema(Schema):
    """A robot by its name, or by the path of its URDF."""

    name: str
    base: Base = "omni"
    turning_radius: Positive | None = None
    tool_frame: str | None = None


class HeldSchema(Schema):
    """How an object is held: at which attachment, through what, and at what values of the attachment's freedoms."""

    attachment: str
    by: str | None = None
    at: tuple[Number, ...] | None = None


class StartSchema(Schema):
    """Where the robot starts: base [x, y, yaw], arm joints [rad], and object → attachment (or more) of what it holds.

    `z` is the height of the robot's root link [m], all the time; the robot's own if it is left out.
    `opening` is how far its gripper is open [m]; as the robot rests if it is left out.
    """

    base: Vector3
    z: Number | None = None
    opening: NotNegative | None = None
    arm: Annotated[tuple[Number, ...] | None, BeforeValidator(_arm)] = None
    held: Mapping[str, Annotated[HeldSchema, text_for("attachment")]] = Field(default_factory=dict)


class ArenaSchema(Schema):
    """The floor that belongs to the scene, an interval in x and one in y."""

    x: Interval = (-5.0, 5.0)
    y: Interval = (-5.0, 5.0)


class RegionSchema(Schema):
    """Where random starts of the base are drawn from: intervals of x and y [m] and of the heading [rad] (None: any)."""

    x: Interval
    y: Interval
    yaw: Annotated[Interval | None, BeforeValidator(_heading)] = None

    def draws(self, rng: np.random.Generator) -> Iterator[Floats]:
        """Yield poses of the base, shape (3,): x, y [m] and yaw [rad], uniform in the region, without end."""
        low, high = zip(self.x, self.y, self.yaw or (-np.pi, np.pi), strict=True)
        while True:
            yield rng.uniform(low, high)


def _allow(value: Any) -> Any:
    if isinstance(value, str):
        return {"srdf": value}
    return {"pair": value} if isinstance(value, list | tuple) else value


class AllowSchema(Schema):
    """A pair of links, objects or obstacles that may be close, and the margin that it keeps (None: none), or an SRDF."""

    pair: Annotated[tuple[str, str], count(2)] | None = None
    srdf: str | None = None
    margin: Number | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> AllowSchema:
        if (self.pair is None) == (self.srdf is None) or (
            self.srdf is not None and self.margin is not None
        ):
            raise fail(
                "not what may be close",
                "[one, other], {pair: [one, other], margin: 0.005}, or the name of an SRDF file",
            )
        return self


class SceneSchema(Schema):
    """A scene file."""

    name: Name | None = None
    robot: Annotated[SceneRobotSchema, text_for("name")]
    start: StartSchema
    arena: ArenaSchema = ArenaSchema()
    start_region: RegionSchema | None = None
    floor: bool = True
    obstacles: Annotated[tuple[ObstacleSchema, ...], Field(max_length=_MOST)] = ()
    objects: tuple[PlacedObjectSchema, ...] = ()
    allow: tuple[Annotated[AllowSchema, BeforeValidator(_allow)], ...] = ()
