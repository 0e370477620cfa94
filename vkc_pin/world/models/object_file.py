"""Loads articulated objects and defines the schema of their description files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pinocchio as pin
from pydantic import Field, model_validator

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_mapping
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.files.documents import Document, parse_document, read_yaml
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
)
from vkc_pin.world.files.resources import check_path, find_file
from vkc_pin.world.files.urdf import load_urdf
from vkc_pin.world.models.articulated_object import (
    DEFAULT_ACCELERATION,
    DEFAULT_VELOCITY,
    ArticulatedObject,
    Attachment,
    Freedom,
    Latch,
)
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.dynamics import ObjectJointSchema, read_resistances, set_mass
from vkc_pin.world.models.grafting import round_placement

_contains_zero = require(
    lambda value: value[0] <= 0.0 <= value[1],
    "the limits do not contain 0",
    "limits [lower <= 0, upper >= 0]",
)
_is_nonzero = require(
    lambda value: np.linalg.norm(value) >= 1e-6,
    "a direction cannot be zero",
    "a nonzero vector",
)
_MAX_COSINE = 1e-9  # of the angle between the directions of approach and closing
Limits = Annotated[tuple[Number, Number], require_length(2), _contains_zero]
Direction = Annotated[Vector3, _is_nonzero]


class FreedomSchema(Schema):
    """A degree of freedom of the hand in a grasp; see `articulated_object.Freedom`."""

    name: Name
    slide: Direction | None = None
    turn: Direction | None = None
    through: Vector3 | None = None
    limits: Limits

    @model_validator(mode="after")
    def _check_consistency(self) -> FreedomSchema:
        if (self.slide is None) == (self.turn is None):
            raise make_validation_error("a freedom needs one axis", "either slide or turn")
        if self.slide is not None and self.through is not None:
            raise make_validation_error(
                "`through` has no meaning for a slide", "through with turn only"
            )
        return self


class AttachmentSchema(Schema):
    """A grasp of a link; see `articulated_object.Attachment`."""

    name: Name
    link: str
    position: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 | None = None
    quaternion: Quaternion | None = None
    approach: Direction | None = None
    closing: Direction | None = None
    joint: Literal["fixed", "revolute", "prismatic", "cylindrical", "spherical"] = "fixed"
    axis: Direction | None = None
    limits: Limits | None = None
    turn: Limits | None = None
    standoff: NonNegative = 0.0
    freedoms: tuple[FreedomSchema, ...] = ()
    firm: bool | None = None  # default: whether the object is free
    clearance: NonNegative | None = None
    opening: NonNegative | None = None
    contact: Literal["grasp", "push", "touch"] = "grasp"

    @model_validator(mode="after")
    def _check_consistency(self) -> AttachmentSchema:
        self._check_orientation()
        self._check_joint()
        self._check_freedoms()
        return self

    def _check_orientation(self) -> None:
        orientations = (self.rpy, self.quaternion, self.approach)
        stated = [orientation for orientation in orientations if orientation is not None]
        is_incomplete = (self.approach is None) != (self.closing is None)
        if is_incomplete or len(stated) > 1:
            raise make_validation_error(
                "the tool's orientation is ambiguous",
                "one of rpy, quaternion, or approach and closing",
            )
        if self.approach is not None and self.closing is not None:
            cosine = np.dot(self.approach, self.closing)
            if abs(cosine) > _MAX_COSINE:
                raise make_validation_error(
                    "approach and closing are not perpendicular", "two perpendicular directions"
                )

    def _check_joint(self) -> None:
        has_axis = self.joint in ("revolute", "prismatic", "cylindrical")
        if has_axis != (self.axis is not None):
            raise make_validation_error(
                "axis and joint do not match",
                "an axis with joint revolute, prismatic or cylindrical, and only there",
            )
        if has_axis and self.limits is None:
            raise make_validation_error(
                "limits missing", "limits [lower, upper] of the grasp's joint"
            )
        if self.joint == "fixed" and self.limits is not None:
            raise make_validation_error(
                "a fixed grasp has no limits", "no limits, or another joint"
            )
        is_cylindrical = self.joint == "cylindrical"
        if is_cylindrical != (self.turn is not None):
            raise make_validation_error(
                "turn and joint do not match",
                "turn [lower, upper] with joint cylindrical, and only there",
            )

    def _check_freedoms(self) -> None:
        names = [freedom.name for freedom in self.freedoms]
        if names and self.joint != "fixed":
            raise make_validation_error("`freedoms` and `joint` exclude each other", "one of them")
        if self.contact == "push" and self.firm:
            raise make_validation_error(
                "a hand that pushes does not clamp", "firm: false, or contact: grasp"
            )
        if len(names) > 6:
            raise make_validation_error("too many freedoms", "at most 6")
        if len(set(names)) < len(names):
            raise make_validation_error("two freedoms share a name", "different names")


class LatchSchema(Schema):
    """A latch; see `articulated_object.Latch`."""

    joint: str
    held_at: Number = 0.0
    released_by: str
    threshold: Number
    engaged_within: Positive


class ObjectSchema(Schema):
    """Description of an articulated object; `urdf` is the path or the text of a URDF."""

    urdf: str
    free: bool = False
    mass: NonNegative | None = None
    joints: Mapping[str, ObjectJointSchema] = Field(default_factory=dict)
    attachments: tuple[AttachmentSchema, ...]  # may be empty, for objects that are obstacles only
    latches: tuple[LatchSchema, ...] = ()
    own_collisions: tuple[Annotated[tuple[str, ...], require_length(2)], ...] = ()


def load_object(
    name_or_path: str | Path | Mapping[str, Any], *, folder: str | Path = "."
) -> ArticulatedObject:
    """Load an articulated object.

    Args:
        name_or_path: Name of a description in `scenes/objects`, path of a description (.yaml), or
            the description itself.
        folder: Folder to which paths in a description given as a mapping are relative.

    Raises:
        UnknownNameError: The object does not exist, or its description names a field, link or joint
            that does not exist.
        InputError: The description or its URDF is invalid.
    """
    if isinstance(name_or_path, Mapping):
        document = Document(check_mapping(name_or_path, "description"))
        return build_object(document, check_path(folder, "folder"))
    file = find_file(name_or_path, "scenes", "objects/*.yaml", noun="object")
    return build_object(read_yaml(file), file.parent, file.stem)


def build_object(document: Document, folder: Path, name: str | None = None) -> ArticulatedObject:
    """Build an object from its description.

    Args:
        document: The description.
        folder: Base of relative paths.
        name: Name of the object. Default: the robot name in the URDF.
    """
    schema = parse_document(document, ObjectSchema)
    if schema.urdf.lstrip().startswith("<"):
        text = schema.urdf
        urdf = Path(f"{document.file or folder / 'description'}: urdf")
    else:
        text = None
        urdf = folder / schema.urdf
    with document.annotate_errors(("urdf",)):
        model, collision, visual = load_urdf(urdf, text=text)
        coordinates = Coordinates(model)
    names = coordinates.names
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    velocity, acceleration = _read_rate_limits(document, schema, coordinates)
    if not (velocity > 0.0).all():
        slowest = names[int(np.argmin(velocity))]
        raise InputError(
            "the velocity limit must be positive",
            file=urdf,
            field=f"{slowest}.limit.velocity",
            expected="> 0",
            got=velocity.min(),
        )
    if schema.mass is not None:
        if not schema.free:
            problem = "`mass` applies to free objects only"
            expected = "masses of links in its URDF, or free: true"
            raise document.make_error(("mass",), problem, expected=expected, got=schema.mass)
        set_mass(model, collision, schema.mass)
    attachments = _build_attachments(document, schema, links)
    return ArticulatedObject(
        name=name or str(model.name),
        urdf=urdf if text is None else None,
        model=model,
        collision=collision,
        visual=visual,
        coordinates=coordinates,
        lower=coordinates.lower,
        upper=coordinates.upper,
        velocity=velocity,
        acceleration=acceleration,
        attachments=freeze(attachments),
        latches=_build_latches(document, schema, coordinates),
        base_link=links[0],
        free=schema.free,
        own_pairs=_read_own_pairs(document, schema, links),
        resistance=freeze(read_resistances(document, schema.joints, urdf, text, names)),
    )


def _read_rate_limits(
    document: Document, schema: ObjectSchema, coordinates: Coordinates
) -> tuple[Floats, Floats]:
    """Return velocity and acceleration limits: those of the description, or else of the URDF."""
    velocity = coordinates.velocity.copy()
    velocity[np.isinf(velocity)] = DEFAULT_VELOCITY
    acceleration = np.full(coordinates.size, DEFAULT_ACCELERATION)
    for joint, limits in schema.joints.items():
        if joint not in coordinates.names:
            raise document.make_unknown_name_error(
                ("joints", joint), "joint", joint, coordinates.names
            )
        index = coordinates.index(joint)
        velocity[index] = limits.velocity or velocity[index]
        acceleration[index] = limits.acceleration or acceleration[index]
    return velocity, acceleration


def _build_attachments(
    document: Document, schema: ObjectSchema, links: Sequence[str]
) -> dict[str, Attachment]:
    """Build the attachments of a description, by name."""
    attachments = dict[str, Attachment]()
    coordinates = set[str]()
    for index, item in enumerate(schema.attachments):
        if item.link not in links:
            raise document.make_unknown_name_error(
                ("attachments", index, "link"), "link", item.link, links
            )
        if item.name in attachments:
            raise document.make_error(
                ("attachments", index, "name"),
                "this attachment name is already used",
                expected="a new name",
                got=item.name,
            )
        if schema.free and item.contact == "push":
            raise document.make_error(
                ("attachments", index, "contact"),
                "free objects cannot be pushed, since no joint guides them",
                expected="grasp",
                got=item.contact,
            )
        attachment = _build_attachment(item, firm=schema.free)
        # For example, "grip_slide" is a coordinate of a "grip" that slides.
        duplicates = coordinates.intersection(attachment.coordinates)
        if duplicates:
            raise document.make_error(
                ("attachments", index, "name"),
                "its coordinate's name is already used",
                expected="a new name",
                got=", ".join(duplicates),
            )
        attachments[item.name] = attachment
        coordinates.update(attachment.coordinates)
    return attachments


def _build_attachment(item: AttachmentSchema, *, firm: bool) -> Attachment:
    """Build an attachment; `firm` is the default where the description has none."""
    if item.approach is not None and item.closing is not None:
        z = np.array(item.approach) / np.linalg.norm(item.approach)
        x = np.array(item.closing) / np.linalg.norm(item.closing)
        rotation = np.column_stack([x, np.cross(z, x), z])
    elif item.quaternion is not None:
        rotation = pin.Quaternion(np.array(item.quaternion)).matrix()
    else:
        rotation = pin.rpy.rpyToMatrix(*(item.rpy or (0.0, 0.0, 0.0)))
    return Attachment(
        name=item.name,
        link=item.link,
        placement=round_placement(pin.SE3(rotation, np.array(item.position))),
        joint="listed" if item.freedoms else item.joint,
        freedoms=_build_freedoms(item),
        standoff=item.standoff,
        firm=firm if item.firm is None else item.firm,
        clearance=item.clearance,
        opening=item.opening,
        contact=item.contact,
    )


def _build_freedoms(item: AttachmentSchema) -> tuple[Freedom, ...]:
    if item.freedoms:
        return tuple(_build_freedom(freedom) for freedom in item.freedoms)
    if item.joint == "spherical":
        lower, upper = item.limits or (-np.pi, np.pi)
        x_axis, y_axis, z_axis = np.eye(3)
        return (
            Freedom("_x", "revolute", x_axis, lower, upper),
            Freedom("_y", "revolute", y_axis, lower, upper),
            Freedom("_z", "revolute", z_axis, lower, upper),
        )
    # By the schema, only a fixed grasp has no axis and no limits.
    if item.axis is None or item.limits is None:
        return ()
    axis = np.array(item.axis) / np.linalg.norm(item.axis)
    lower, upper = item.limits
    if item.turn is None:
        return (Freedom("", item.joint, axis, lower, upper),)
    turn_lower, turn_upper = item.turn
    return (
        Freedom("_slide", "prismatic", axis, lower, upper),
        Freedom("_turn", "revolute", axis, turn_lower, turn_upper),
    )


def _build_freedom(item: FreedomSchema) -> Freedom:
    if item.slide is None:
        kind = "revolute"
        axis = np.array(item.turn, float)
    else:
        kind = "prismatic"
        axis = np.array(item.slide, float)
    lower, upper = item.limits
    through = np.array(item.through or (0.0, 0.0, 0.0))
    return Freedom(f"_{item.name}", kind, axis / np.linalg.norm(axis), lower, upper, through)


def _read_own_pairs(
    document: Document, schema: ObjectSchema, links: Sequence[str]
) -> frozenset[frozenset[str]]:
    for number, pair in enumerate(schema.own_collisions):
        for place, link in enumerate(pair):
            if link not in links:
                raise document.make_unknown_name_error(
                    ("own_collisions", number, place), "link", link, links
                )
        if pair[0] == pair[1]:
            raise document.make_error(
                ("own_collisions", number),
                "a link cannot collide with itself",
                expected="two links",
                got=pair[0],
            )
    return frozenset(map(frozenset, schema.own_collisions))


def _build_latches(
    document: Document, schema: ObjectSchema, coordinates: Coordinates
) -> tuple[Latch, ...]:
    latches = []
    for number, item in enumerate(schema.latches):
        field = ("latches", number)
        for joint_key, joint, position_key, position in (
            ("joint", item.joint, "held_at", item.held_at),
            ("released_by", item.released_by, "threshold", item.threshold),
        ):
            if joint not in coordinates.names:
                raise document.make_unknown_name_error(
                    (*field, joint_key), "joint", joint, coordinates.names
                )
            index = coordinates.index(joint)
            lower = coordinates.lower[index]
            upper = coordinates.upper[index]
            if not lower <= position <= upper:
                raise document.make_error(
                    (*field, position_key),
                    f"outside the limits of {joint}",
                    expected=f"{lower:g} to {upper:g}",
                    got=position,
                )
        if item.joint == item.released_by:
            raise document.make_error(
                (*field, "released_by"),
                "a joint cannot release itself",
                expected="another joint",
                got=item.released_by,
            )
        latch = Latch(
            joint=item.joint,
            held_at=item.held_at,
            released_by=item.released_by,
            threshold=item.threshold,
            engaged_within=item.engaged_within,
        )
        latches.append(latch)
    return tuple(latches)
