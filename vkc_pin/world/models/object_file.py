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
    def _consistent(self) -> FreedomSchema:
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
    def _consistent(self) -> AttachmentSchema:
        given = sum(
            orientation is not None for orientation in (self.rpy, self.quaternion, self.approach)
        )
        is_ambiguous = (self.approach is None) != (self.closing is None) or given > 1
        is_oblique = (
            self.approach is not None
            and self.closing is not None
            and abs(np.dot(self.approach, self.closing)) > 1e-9
        )
        has_axis = self.joint in ("revolute", "prismatic", "cylindrical")
        axis = "joint revolute, prismatic or cylindrical"
        is_cylindrical = self.joint == "cylindrical"
        names = [freedom.name for freedom in self.freedoms]
        for is_invalid, problem, expected in (
            (
                is_ambiguous,
                "the tool's orientation is ambiguous",
                "one of rpy, quaternion, or approach and closing",
            ),
            (
                is_oblique,
                "approach and closing are not perpendicular",
                "two perpendicular directions",
            ),
            (
                has_axis != (self.axis is not None),
                "axis and joint do not match",
                f"an axis with {axis}, and only there",
            ),
            (
                has_axis and self.limits is None,
                "limits missing",
                "limits [lower, upper] of the grasp's joint",
            ),
            (
                self.joint == "fixed" and self.limits is not None,
                "a fixed grasp has no limits",
                "no limits, or another joint",
            ),
            (
                is_cylindrical != (self.turn is not None),
                "turn and joint do not match",
                "turn [lower, upper] with joint cylindrical, and only there",
            ),
            (
                names and self.joint != "fixed",
                "`freedoms` and `joint` exclude each other",
                "one of them",
            ),
            (
                self.contact == "push" and self.firm,
                "a hand that pushes does not clamp",
                "firm: false, or contact: grasp",
            ),
            (len(names) > 6, "too many freedoms", "at most 6"),
            (len(set(names)) < len(names), "two freedoms share a name", "different names"),
        ):
            if is_invalid:
                raise make_validation_error(problem, expected)
        return self


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
        return build_object(
            Document(check_mapping(name_or_path, "description")), check_path(folder, "folder")
        )
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
    text = schema.urdf if schema.urdf.lstrip().startswith("<") else None
    urdf = (
        folder / schema.urdf
        if text is None
        else Path(f"{document.file or folder / 'description'}: urdf")
    )
    with document.annotate_errors(("urdf",)):
        model, collision, visual = load_urdf(urdf, text=text)
        coordinates = Coordinates(model)
    names = coordinates.names
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    velocity = coordinates.velocity.copy()
    acceleration = np.full(coordinates.size, DEFAULT_ACCELERATION)
    velocity[np.isinf(velocity)] = DEFAULT_VELOCITY
    for joint, limits in schema.joints.items():
        if joint not in names:
            raise document.make_unknown_name_error(("joints", joint), "joint", joint, names)
        index = coordinates.index(joint)
        velocity[index] = limits.velocity or velocity[index]
        acceleration[index] = limits.acceleration or acceleration[index]
    if not (velocity > 0.0).all():
        slow = names[int(np.argmin(velocity))]
        problem, field = "the velocity limit must be positive", f"{slow}.limit.velocity"
        raise InputError(problem, file=urdf, field=field, expected="> 0", got=velocity.min())
    if schema.mass is not None:
        if not schema.free:
            problem = "`mass` applies to free objects only"
            expected = "masses of links in its URDF, or free: true"
            raise document.make_error(("mass",), problem, expected=expected, got=schema.mass)
        set_mass(model, collision, schema.mass)
    attachments: dict[str, Attachment] = {}
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
            problem = "free objects cannot be pushed, since no joint guides them"
            raise document.make_error(
                ("attachments", index, "contact"), problem, expected="grasp", got=item.contact
            )
        attachment = _build_attachment(item, firm=schema.free)
        duplicates = {
            name for other in attachments.values() for name in other.coordinates
        }.intersection(attachment.coordinates)
        if duplicates:  # "grip_slide" beside a "grip" that slides
            problem, got = "its coordinate's name is already used", ", ".join(duplicates)
            raise document.make_error(
                ("attachments", index, "name"), problem, expected="a new name", got=got
            )
        attachments[item.name] = attachment
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


def _build_attachment(item: AttachmentSchema, *, firm: bool) -> Attachment:
    """Build an attachment; `firm` is the default where the description has none."""
    if item.approach is not None and item.closing is not None:
        z, x = (np.array(v) / np.linalg.norm(v) for v in (item.approach, item.closing))
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
        limits = item.limits or (-np.pi, np.pi)
        return tuple(
            Freedom(f"_{name}", "revolute", axis, *limits)
            for name, axis in zip("xyz", np.eye(3), strict=True)
        )
    if item.axis is None or item.limits is None:  # a fixed grasp, guaranteed by the schema
        return ()
    axis = np.array(item.axis) / np.linalg.norm(item.axis)
    if item.turn is not None:
        return Freedom("_slide", "prismatic", axis, *item.limits), Freedom(
            "_turn", "revolute", axis, *item.turn
        )
    return (Freedom("", item.joint, axis, *item.limits),)


def _build_freedom(item: FreedomSchema) -> Freedom:
    kind, given = ("revolute", item.turn) if item.slide is None else ("prismatic", item.slide)
    axis = np.array(given, float)
    return Freedom(
        f"_{item.name}",
        kind,
        axis / np.linalg.norm(axis),
        *item.limits,
        np.array(item.through or (0.0, 0.0, 0.0)),
    )


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
        at = ("latches", number)
        for role, joint, value in (
            ("joint", item.joint, item.held_at),
            ("released_by", item.released_by, item.threshold),
        ):
            if joint not in coordinates.names:
                raise document.make_unknown_name_error(
                    (*at, role), "joint", joint, coordinates.names
                )
            index = coordinates.index(joint)
            lower, upper = coordinates.lower[index], coordinates.upper[index]
            if not lower <= value <= upper:
                key = "held_at" if role == "joint" else "threshold"
                raise document.make_error(
                    (*at, key),
                    f"outside the limits of {joint}",
                    expected=f"{lower:g} to {upper:g}",
                    got=value,
                )
        if item.joint == item.released_by:
            problem = "a joint cannot release itself"
            raise document.make_error(
                (*at, "released_by"), problem, expected="another joint", got=item.released_by
            )
        latches.append(
            Latch(item.joint, item.held_at, item.released_by, item.threshold, item.engaged_within)
        )
    return tuple(latches)
