"""Articulated objects: what can be grasped and moved (a door, a drawer, a stick), and how to re-root them.

An object is a URDF tree plus named attachments (where a tool takes hold of it) and latches. `invert` turns it round:
the tree then starts at the link that is held and ends at the link that stands in the world, so that it can be hung on
the end of a robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from vkc_pin.assembly import clean
from vkc_pin.attachment import Attachment, Freedom
from vkc_pin.coordinates import Coordinates
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.resources import find

__all__ = [
    "DEFAULT_ACCELERATION",
    "DEFAULT_VELOCITY",
    "ArticulatedObject",
    "Attachment",
    "Freedom",
    "InvertedTree",
    "Latch",
    "invert",
    "load_object",
]

DEFAULT_VELOCITY = 1.0
"""Velocity limit [rad/s] or [m/s] of an object's joint whose URDF states none (a continuous joint without limits)."""
DEFAULT_ACCELERATION = 2.0
"""Acceleration limit [rad/s²] or [m/s²] of an object's joint whose description states none: URDF has no such field."""


@dataclass(frozen=True)
class Latch:
    """Holds `joint` at a value until another joint is moved far enough, as a lever handle does with a door.

    The joint may leave `held_at` only while `released_by` ≥ `threshold`. The latch acts only while
    |joint - held_at| ≤ `engaged_within`; further out the joint moves freely.

    Attributes:
        joint: The joint that is held.
        held_at: The value it is held at, [rad] or [m].
        released_by: The joint that releases it.
        threshold: The value from which on it is released, [rad] or [m].
        engaged_within: The latch's reach, [rad] or [m].
    """

    joint: str
    held_at: float
    released_by: str
    threshold: float
    engaged_within: float


@dataclass(frozen=True, eq=False)
class ArticulatedObject:
    """A thing with joints that can be grasped at its attachments. Its base link's frame is the model's universe frame.

    Attributes:
        name: Its name.
        urdf: The URDF it came from.
        model: Its kinematics, without a root joint.
        collision: Its collision geometry, convex shapes only, no collision pairs.
        visual: What to draw.
        coordinates: Its minimal coordinates; their names are the joints' names.
        lower, upper: Position limits, shape (n,), [rad] or [m].
        velocity: Velocity limits, shape (n,), [rad/s] or [m/s].
        acceleration: Acceleration limits, shape (n,), [rad/s²] or [m/s²].
        attachments: By name; the first is the default.
        latches: Its latches.
        base_link: The name of its base link.
        free: Whether it can be carried away (a stick), instead of standing fixed in the world (a door).
    """

    name: str
    urdf: Path
    model: pin.Model
    collision: pin.GeometryModel
    visual: pin.GeometryModel
    coordinates: Coordinates
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    attachments: Mapping[str, Attachment]
    latches: tuple[Latch, ...]
    base_link: str
    free: bool = False

    def __repr__(self) -> str:
        return f"<ArticulatedObject {self.name}: joints {', '.join(self.coordinates.names) or 'none'}>"

    @property
    def links(self) -> tuple[str, ...]:
        """The names of its links."""
        return tuple(str(frame.name) for frame in self.model.frames if frame.type == pin.FrameType.BODY)

    def attachment(self, name: str | None = None) -> Attachment:
        """Return the attachment `name`, or the default one. Raises `UnknownNameError` if there is none."""
        if name is None:
            return next(iter(self.attachments.values()))
        if name not in self.attachments:
            raise UnknownNameError(f"attachment of {self.name}", name, self.attachments)
        return self.attachments[name]

    def link_placement(self, link: str, state: ArrayLike) -> pin.SE3:
        """Return the placement of `link` in the base link's frame at the joint values `state`, shape (n,)."""
        frame = self.model.frames[_body_frame(self, link)]
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, self.coordinates.q(state))
        return data.oMi[frame.parentJoint] * frame.placement


@dataclass(frozen=True, eq=False)
class InvertedTree:
    """An object re-rooted at one of its links: `model`'s universe frame is that link's frame.

    Attributes:
        model: The joints on the path from the link to the base link, each with its name, coordinate and limits; a body
            frame for every link of the object, by its name.
        collision, visual: The object's geometry, with its names, on the bodies of `model`.
        coordinates: The minimal coordinates of `model`.
        link: The link that is now the root.
        base_link: The object's base link, a body frame of `model`.
    """

    model: pin.Model
    collision: pin.GeometryModel
    visual: pin.GeometryModel
    coordinates: Coordinates
    link: str
    base_link: str


def load_object(name_or_path: str | Path) -> ArticulatedObject:
    """Load an articulated object: by the name of a description in `scenes/objects`, or by the path of one (.yaml).

    Raises:
        UnknownNameError: There is no such object, or its description names a field, link or joint that does not exist.
        InputError: The description or its URDF is wrong.
    """
    from vkc_pin.object_file import read_object

    text = str(name_or_path)
    by_path = isinstance(name_or_path, Path) or text.endswith((".yaml", ".yml")) or "/" in text
    file = Path(name_or_path) if by_path else find("scenes", "objects/*.yaml", text, what="object")
    return read_object(file)


def _body_frame(obj: ArticulatedObject, link: str) -> int:
    if link not in obj.links:
        raise UnknownNameError(f"link of {obj.name}", link, obj.links)
    return int(obj.model.getFrameId(link, pin.FrameType.BODY))


def invert(obj: ArticulatedObject, link: str, state: ArrayLike) -> InvertedTree:
    """Re-root `obj` at `link`.

    With placement P and motion J(q) of a joint, parent → child is P·J(q), so child → parent is J(q)⁻¹·P⁻¹. For revolute
    and prismatic joints J(q)⁻¹ is the same joint with the axis negated. The axis is then turned into z by a constant
    rotation R, J(q)⁻¹ = R·J_z(q)·R⁻¹, which goes into the placements around it: every joint of the result is one of
    Pinocchio's z-aligned joints, whose symbolic expressions are the shortest.

    Args:
        obj: The object.
        link: The link that becomes the root.
        state: Joint values, shape (n,), [rad] or [m]. Joints beside the path from `link` to the base link are locked at
            these; the values of those on the path do not matter.

    Raises:
        UnknownNameError: The object has no such link.
        InputError: `state` has the wrong size, or a joint on the path cannot be inverted.
    """
    source = obj.model
    root = source.frames[_body_frame(obj, link)]
    data = source.createData()
    pin.forwardKinematics(source, data, obj.coordinates.q(state))
    path = [root.parentJoint]  # from the link's joint down to the universe
    while path[-1] != 0:
        path.append(source.parents[path[-1]])

    model = pin.Model()
    model.name = obj.name
    # For every joint of the path: the joint of the new model that carries its body, and the body's placement there.
    carrier: dict[int, tuple[int, pin.SE3]] = {path[0]: (0, root.placement.inverse())}
    for child, parent in pairwise(path):
        new_parent, body = carrier[child]
        joint, axis = _z_aligned(source, data, child)
        turn = pin.SE3(_z_to(-axis), np.zeros(3))
        q, v = source.joints[child].idx_q, source.joints[child].idx_v
        nq = source.joints[child].nq
        index = model.addJoint(
            new_parent,
            joint,
            clean(body * turn),
            source.names[child],
            source.effortLimit[v : v + 1],
            source.velocityLimit[v : v + 1],
            source.lowerPositionLimit[q : q + nq],
            source.upperPositionLimit[q : q + nq],
        )
        carrier[parent] = (index, turn.inverse() * source.jointPlacements[child].inverse())

    def place(joint: int, placement: pin.SE3) -> tuple[int, pin.SE3]:
        """Return the new joint that carries `placement`, given on the old `joint`, and the placement on the new one."""
        anchor = joint
        while anchor not in carrier:
            anchor = source.parents[anchor]
        new, body = carrier[anchor]
        return new, clean(body * data.oMi[anchor].actInv(data.oMi[joint]) * placement)

    for joint in range(source.njoints):
        if source.inertias[joint].mass > 0.0:
            new, placement = place(joint, pin.SE3.Identity())
            model.appendBodyToJoint(new, source.inertias[joint], placement)
    frames: dict[int, int] = {}
    for index, frame in enumerate(source.frames):
        if frame.type == pin.FrameType.BODY:
            new, placement = place(frame.parentJoint, frame.placement)
            frames[index] = model.addFrame(pin.Frame(frame.name, new, 0, placement, pin.FrameType.BODY), False)

    def carry(geometry: pin.GeometryModel) -> pin.GeometryModel:
        carried = pin.GeometryModel()
        for shape in geometry.geometryObjects:
            copy = pin.GeometryObject(shape)
            copy.parentJoint, copy.placement = place(shape.parentJoint, shape.placement)
            copy.parentFrame = frames[shape.parentFrame]
            carried.addGeometryObject(copy)
        return carried

    return InvertedTree(model, carry(obj.collision), carry(obj.visual), Coordinates(model), link, obj.base_link)


def _z_aligned(model: pin.Model, data: pin.Data, index: int) -> tuple[pin.JointModel, NDArray[np.float64]]:
    """Return the joint of the same kind about or along z, and the unit axis of joint `index` in its own frame."""
    kind = model.joints[index].shortname().removeprefix("JointModel")
    subspace = np.array(data.joints[index].S, float).ravel()  # linear part, then angular part
    if kind in ("RX", "RY", "RZ", "RevoluteUnaligned"):
        return pin.JointModelRZ(), subspace[3:]
    if kind in ("RUBX", "RUBY", "RUBZ", "RevoluteUnboundedUnaligned"):
        return pin.JointModelRUBZ(), subspace[3:]
    if kind in ("PX", "PY", "PZ", "PrismaticUnaligned"):
        return pin.JointModelPZ(), subspace[:3]
    raise InputError(
        "this joint cannot be inverted", field=model.names[index], expected="a revolute, continuous or prismatic joint", got=kind
    )


def _z_to(axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation, shape (3, 3), that turns z into the unit vector `axis`, with as many zeros as possible."""
    others = np.eye(3)
    x = others[int(np.argmin(np.abs(axis)))]
    x = x - axis * (axis @ x)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
