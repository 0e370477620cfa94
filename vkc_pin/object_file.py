"""Reads the description file of an articulated object and builds the object."""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType

import numpy as np
import pinocchio as pin

from vkc_pin.articulation import DEFAULT_ACCELERATION, DEFAULT_VELOCITY, ArticulatedObject, Attachment, Freedom, Latch
from vkc_pin.assembly import clean
from vkc_pin.coordinates import Coordinates
from vkc_pin.documents import Document, check, read_yaml
from vkc_pin.errors import InputError
from vkc_pin.object_schema import AttachmentSchema, ObjectSchema
from vkc_pin.urdf import load_urdf

__all__ = ["read_object"]


def read_object(file: Path) -> ArticulatedObject:
    """Read the description `file` (YAML); see `vkc_pin.articulation.load_object`, which is its public face."""
    document = read_yaml(file)
    schema = check(document, ObjectSchema)
    urdf = file.parent / schema.urdf
    with document.at(("urdf",)):
        tree = load_urdf(urdf)
        coordinates = Coordinates(tree.model)
    names, links = coordinates.names, [frame.name for frame in tree.model.frames if frame.type == pin.FrameType.BODY]
    velocity, acceleration = coordinates.velocity.copy(), np.full(coordinates.size, DEFAULT_ACCELERATION)
    velocity[np.isinf(velocity)] = DEFAULT_VELOCITY
    for joint, limits in schema.joints.items():
        if joint not in names:
            raise document.unknown(("joints", joint), "joint", joint, names)
        index = coordinates.index(joint)
        velocity[index] = limits.velocity or velocity[index]
        acceleration[index] = limits.acceleration or acceleration[index]
    if not (velocity > 0.0).all():
        slow = names[int(np.argmin(velocity))]
        raise InputError(
            "a joint without velocity cannot move", file=urdf, field=f"{slow}.limit.velocity", expected="> 0", got=velocity.min()
        )
    attachments: dict[str, Attachment] = {}
    for index, item in enumerate(schema.attachments):
        if item.link not in links:
            raise document.unknown(("attachments", index, "link"), "link", item.link, links)
        if item.name in attachments:
            raise document.error(("attachments", index, "name"), "this name is taken", expected="a new name", got=item.name)
        attachment = _attachment(item, firm=schema.free)
        taken = {name for other in attachments.values() for name in other.coordinates}.intersection(attachment.coordinates)
        if taken:  # "grip_slide" beside a "grip" that slides
            raise document.error(
                ("attachments", index, "name"), "its coordinate's name is taken", expected="a new name", got=", ".join(taken)
            )
        attachments[item.name] = attachment
    return ArticulatedObject(
        name=file.stem,
        urdf=urdf,
        model=tree.model,
        collision=tree.collision,
        visual=tree.visual,
        coordinates=coordinates,
        lower=coordinates.lower,
        upper=coordinates.upper,
        velocity=velocity,
        acceleration=acceleration,
        attachments=MappingProxyType(attachments),
        latches=_latches(document, schema, coordinates),
        base_link=links[0],
        free=schema.free,
    )


def _attachment(item: AttachmentSchema, *, firm: bool) -> Attachment:
    """Return the attachment; `firm` holds where its description does not say."""
    if item.approach is not None and item.closing is not None:
        z, x = (np.array(v) / np.linalg.norm(v) for v in (item.approach, item.closing))
        rotation = np.column_stack([x, np.cross(z, x), z])
    else:
        rotation = pin.rpy.rpyToMatrix(*(item.rpy or (0.0, 0.0, 0.0)))
    return Attachment(
        name=item.name,
        link=item.link,
        placement=clean(pin.SE3(rotation, np.array(item.position))),
        joint=item.joint,
        freedoms=_freedoms(item),
        standoff=item.standoff,
        firm=firm if item.firm is None else item.firm,
    )


def _freedoms(item: AttachmentSchema) -> tuple[Freedom, ...]:
    if item.joint == "spherical":
        limits = item.limits or (-np.pi, np.pi)
        return tuple(Freedom(f"_{name}", "revolute", axis, *limits) for name, axis in zip("xyz", np.eye(3), strict=True))
    if item.axis is None or item.limits is None:  # a fixed grasp, as the schema says
        return ()
    axis = np.array(item.axis) / np.linalg.norm(item.axis)
    if item.turn is not None:
        return Freedom("_slide", "prismatic", axis, *item.limits), Freedom("_turn", "revolute", axis, *item.turn)
    return (Freedom("", item.joint, axis, *item.limits),)


def _latches(document: Document, schema: ObjectSchema, coordinates: Coordinates) -> tuple[Latch, ...]:
    latches = []
    for number, item in enumerate(schema.latches):
        at = ("latches", number)
        for role, joint, value in (("joint", item.joint, item.held_at), ("released_by", item.released_by, item.threshold)):
            if joint not in coordinates.names:
                raise document.unknown((*at, role), "joint", joint, coordinates.names)
            index = coordinates.index(joint)
            lower, upper = coordinates.lower[index], coordinates.upper[index]
            if not lower <= value <= upper:
                what = "held_at" if role == "joint" else "threshold"
                raise document.error((*at, what), f"outside the limits of {joint}", expected=f"{lower:g} to {upper:g}", got=value)
        if item.joint == item.released_by:
            raise document.error(
                (*at, "released_by"), "a joint cannot release itself", expected="another joint", got=item.released_by
            )
        latches.append(Latch(item.joint, item.held_at, item.released_by, item.threshold, item.engaged_within))
    return tuple(latches)
