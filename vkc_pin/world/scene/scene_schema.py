"""Defines the fields of scene files: lengths [m], angles [rad], z up, the floor at z = 0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.fields import (
    Name,
    NonNegative,
    Number,
    Positive,
    Quaternion,
    Schema,
    Vector3,
    make_validation_error,
    require,
    require_length,
    wrap_text,
)
from vkc_pin.world.files.points import MAX_POINTS, decode_points
from vkc_pin.world.models.robot import Base

_MAX_OBSTACLES = 10_000  # they take some seconds to load

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


def _parse_colour(value: Any) -> Any:
    if isinstance(value, str):
        if value not in COLOURS:
            raise make_validation_error(
                f"unknown colour '{value}'",
                f"one of {', '.join(COLOURS)}, or [red, green, blue] from 0 to 1",
            )
        return (*COLOURS[value], 1.0)
    if isinstance(value, list | tuple) and len(value) == 3:
        return (*value, 1.0)
    return value


def _parse_scale(value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return (value, value, value) if is_number else value


def _parse_arm(value: Any) -> Any:
    expected = "home, a list of joint values [rad], or a mapping from joint to value"
    if isinstance(value, str) and value != "home":
        raise make_validation_error(f"unknown arm configuration '{value}'", expected)
    if not isinstance(value, str | list | tuple | Mapping):
        raise make_validation_error("wrong value", expected)
    return None if value == "home" else value


def _parse_heading(value: Any) -> Any:
    if isinstance(value, str) and value != "any":
        raise make_validation_error(f"unknown heading '{value}'", "any, or [lowest, highest]")
    return None if value == "any" else value


def _parse_measured(value: Any) -> Any:
    if value != "derive" and not isinstance(value, dict | PoseSchema):
        raise make_validation_error(
            "wrong value", "derive, or a pose such as {position: [0, 0, 0]}"
        )
    return value


Count = Annotated[int, Field(ge=0)]
Fraction = Annotated[Number, Field(ge=0.0, le=1.0)]
Size = Annotated[tuple[Positive, Positive, Positive], require_length(3)]
Colour = Annotated[
    tuple[Fraction, Fraction, Fraction, Fraction], require_length(4), BeforeValidator(_parse_colour)
]
Interval = Annotated[
    tuple[Number, Number],
    require_length(2),
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
Scale = Annotated[Size, BeforeValidator(_parse_scale)]


class PoseSchema(Schema):
    """A pose: position [m] and at most one orientation.

    The orientation is given as roll, pitch, yaw [rad], as yaw alone, or as quaternion [x, y, z, w].
    """

    position: Vector3
    rpy: Vector3 | None = None
    yaw: Number | None = None
    quaternion: Quaternion | None = None

    @model_validator(mode="after")
    def _check_orientation(self) -> PoseSchema:
        orientations = (self.rpy, self.yaw, self.quaternion)
        stated = [orientation for orientation in orientations if orientation is not None]
        if len(stated) > 1:
            raise make_validation_error(
                "more than one orientation", "one of rpy, yaw and quaternion"
            )
        return self


class ShapeSchema(PoseSchema):
    """Fields of all obstacles."""

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
    """A capsule; `position` is its centre, `length` that of its cylindrical part, along z."""

    type: Literal["capsule"]
    radius: Positive
    length: Positive


class MeshSchema(ShapeSchema):
    """A mesh file, whose convex hull is used for collisions; `position` is the mesh's origin."""

    type: Literal["mesh"]
    file: str
    scale: Scale = (1.0, 1.0, 1.0)


class UrdfSchema(PoseSchema):
    """A URDF with all joints at their neutral position; `colour`, if given, overrides its own."""

    name: Name
    colour: Colour | None = None
    type: Literal["urdf"]
    file: str


def _check_encoded_points(value: str) -> bool:
    try:
        points = decode_points(value)
    except ValueError:
        return False
    return bool(0 < len(points) <= MAX_POINTS and np.isfinite(points).all())


_Removal = Literal["robot", "objects", "floor", "not_finite"]


class PointsSchema(ShapeSchema):
    """Measured points of one radius, from a file or, as saved scenes have them, as `data`.

    `position` and orientation are those of the frame of the points. Of the points of a file, those
    of the robot at its start, of objects and of the floor are `removed`, with their numbers.
    """

    type: Literal["points"]
    position: Vector3 = (0.0, 0.0, 0.0)
    radius: Positive | None = None
    file: str | None = None
    data: (
        Annotated[
            str,
            require(
                _check_encoded_points, "no points", "base64 of n × 3 finite little-endian floats"
            ),
        ]
        | None
    ) = None
    removed: Mapping[_Removal, Count] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_file_or_data(self) -> PointsSchema:
        if (self.file is None) == (self.data is None):
            raise make_validation_error("neither a file nor data", "one of file and data")
        if self.data is not None and self.radius is None:
            raise make_validation_error("data without a radius", "radius, such as 0.01")
        return self


ObstacleSchema = Annotated[
    BoxSchema
    | SphereSchema
    | CylinderSchema
    | CapsuleSchema
    | MeshSchema
    | UrdfSchema
    | PointsSchema,
    Field(discriminator="type"),
]


class MeasuredJointSchema(Schema):
    """A joint that was measured elsewhere than described; see `MeasuredJoint`.

    `placement` is that of its frame in the frame of its parent link, `link` that of its own link in
    its moving frame.
    """

    placement: PoseSchema
    link: PoseSchema


class PlacedObjectSchema(PoseSchema):
    """An articulated object: `type` is its name, file or description, `state` its joint values.

    Joints that `state` leaves out are at 0, joints in `measured` are elsewhere than described.
    Attachments that are `reversed` are approached from the
    side opposite to their description; None: those whose approach would take the hand through the
    object or the floor.
    """

    name: Name
    type: Description
    state: Mapping[str, Number] = Field(default_factory=dict)
    reversed: tuple[str, ...] | None = None
    measured: Mapping[str, MeasuredJointSchema] = Field(default_factory=dict)


class SceneRobotSchema(Schema):
    """A robot by its name, or by the path of its URDF."""

    name: str
    base: Base = "omni"
    turning_radius: Positive | None = None
    tool_frame: str | None = None


_Measured = Annotated[
    Annotated[PoseSchema, Tag("pose")] | Annotated[Literal["derive"], Tag("derive")],
    Discriminator(lambda value: "derive" if value == "derive" else "pose"),
]


class HeldSchema(Schema):
    """A hold: attachment, frame that grasps, and values of the attachment's freedoms.

    `measured` is the measured pose of the attachment's frame in the grasping frame, or "derive":
    that of robot and object as the scene places them.
    """

    attachment: str
    by: str | None = None
    at: tuple[Number, ...] | None = None
    measured: Annotated[_Measured, BeforeValidator(_parse_measured)] | None = None


class StartSchema(Schema):
    """The start: base [x, y, yaw], arm joints [rad], and object → attachment or hold.

    Arm joints that a mapping does not name are as in the robot's home configuration. `velocity`
    maps coordinates of the robot to their velocities [m/s], [rad/s]; the others are at rest.
    `z` is the constant height of the robot's root link [m]; default: the robot's own. `opening` is
    the gripper opening [m]; default: that of the robot's rest configuration.
    """

    base: Vector3
    z: Number | None = None
    opening: NonNegative | None = None
    arm: Annotated[
        tuple[Number, ...] | Mapping[str, Number] | None, BeforeValidator(_parse_arm)
    ] = None
    velocity: Mapping[str, Number] = Field(default_factory=dict)
    held: Mapping[str, Annotated[HeldSchema, wrap_text("attachment")]] = Field(default_factory=dict)


class ArenaSchema(Schema):
    """The part of the floor that belongs to the scene: intervals of x and y."""

    x: Interval = (-5.0, 5.0)
    y: Interval = (-5.0, 5.0)


class MapSchema(Schema):
    """An occupancy map: the file of a `map.yaml`, and the height of obstacles on its cells [m].

    `unknown` says whether cells that are neither occupied nor free are obstacles, too.
    """

    file: str
    height: Positive = 2.0
    unknown: Literal["blocked", "free"] = "blocked"


class RegionSchema(Schema):
    """The region of random starts: intervals of x, y [m] and heading [rad] (None: any)."""

    x: Interval
    y: Interval
    yaw: Annotated[Interval | None, BeforeValidator(_parse_heading)] = None

    def sample_poses(self, rng: np.random.Generator) -> Iterator[Floats]:
        """Yield base poses x, y [m] and yaw [rad], shape (3,), uniform in the region, endlessly."""
        low, high = zip(self.x, self.y, self.yaw or (-np.pi, np.pi), strict=True)
        while True:
            yield rng.uniform(low, high)


def _parse_allow(value: Any) -> Any:
    if isinstance(value, str):
        return {"srdf": value}
    return {"pair": value} if isinstance(value, list | tuple) else value


class AllowSchema(Schema):
    """A pair of links, objects or obstacles that may be close, or an SRDF file with such pairs.

    `margin` is the clearance that the pair keeps [m]; None: none.
    """

    pair: Annotated[tuple[str, str], require_length(2)] | None = None
    srdf: str | None = None
    margin: Number | None = None

    @model_validator(mode="after")
    def _check_pair_or_srdf(self) -> AllowSchema:
        has_one = (self.pair is None) != (self.srdf is None)
        has_margin_of_srdf = self.srdf is not None and self.margin is not None
        if not has_one or has_margin_of_srdf:
            raise make_validation_error(
                "neither a pair nor an SRDF file",
                "[one, other], {pair: [one, other], margin: 0.005}, or the name of an SRDF file",
            )
        return self


class SceneSchema(Schema):
    """A scene file.

    Without an arena, it is the bounding box of the map, or `ArenaSchema`'s default.
    """

    name: Name | None = None
    robot: Annotated[SceneRobotSchema, wrap_text("name")]
    start: StartSchema
    arena: ArenaSchema | None = None
    start_region: RegionSchema | None = None
    floor: bool = True
    map: Annotated[MapSchema | None, wrap_text("file")] = None
    obstacles: Annotated[tuple[ObstacleSchema, ...], Field(max_length=_MAX_OBSTACLES)] = ()
    objects: tuple[PlacedObjectSchema, ...] = ()
    allow: tuple[Annotated[AllowSchema, BeforeValidator(_parse_allow)], ...] = ()
