"""Turns an articulated object round: the tree then starts at the link that is held, so that it can hang on the end of a robot."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import add_joint, round_placement

__all__ = ["InvertedTree", "invert"]


@dataclass(frozen=True, eq=False, kw_only=True)
class InvertedTree:
    """An object re-rooted at one of its links: `model`'s universe frame is that link's frame.

    Attributes:
        model: The joints on the path from the link to the base link, each with its name, coordinate
            and limits; a body frame for every link of the object, by its name.
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


def invert(obj: ArticulatedObject, link: str, state: ArrayLike) -> InvertedTree:
    """Re-root `obj` at `link`.

    With placement P and motion J(q) of a joint, parent → child is P·J(q), so child → parent is
    J(q)⁻¹·P⁻¹. For revolute and prismatic joints J(q)⁻¹ is the same joint with the axis negated.
    The axis is then turned into z by a constant rotation R, J(q)⁻¹ = R·J_z(q)·R⁻¹, which goes into
    the placements around it: every joint of the result is one of Pinocchio's z-aligned joints,
    whose symbolic expressions are the shortest.

    Args:
        obj: The object.
        link: The link that becomes the root.
        state: Joint values, shape (n,), [rad] or [m]. Joints beside the path from `link` to the
            base link are locked at these; the values of those on the path do not matter.

    Raises:
        UnknownNameError: The object has no such link.
        InputError: `state` has the wrong size, or a joint on the path cannot be inverted.
    """
    source = instance(obj, ArticulatedObject, "obj").model
    root = source.frames[obj.link_frame(link)]
    data = source.createData()
    pin.forwardKinematics(source, data, obj.coordinates.q(state))
    path = [root.parentJoint]  # from the link's joint down to the universe
    while path[-1] != 0:
        path.append(source.parents[path[-1]])

    model = pin.Model()
    model.name = obj.name
    # For every joint of the path: the joint of the new model that carries its body, and the body's
    # placement there.
    carrier: dict[int, tuple[int, pin.SE3]] = {path[0]: (0, root.placement.inverse())}
    for child, parent in pairwise(path):
        new_parent, body = carrier[child]
        joint, axis = _z_aligned(source, data, child)
        turn = pin.SE3(_z_to(-axis), np.zeros(3))
        index = add_joint(
            model, new_parent, joint, round_placement(body * turn), like=(source, child)
        )
        carrier[parent] = (index, turn.inverse() * source.jointPlacements[child].inverse())

    def place(joint: int, placement: pin.SE3) -> tuple[int, pin.SE3]:
        """Return the new joint that carries `placement`, given on the old `joint`, and the placement on the new one."""
        anchor = joint
        while anchor not in carrier:
            anchor = source.parents[anchor]
        new, body = carrier[anchor]
        return new, round_placement(body * data.oMi[anchor].actInv(data.oMi[joint]) * placement)

    for joint in range(source.njoints):
        if source.inertias[joint].mass > 0.0:
            new, placement = place(joint, pin.SE3.Identity())
            model.appendBodyToJoint(new, source.inertias[joint], placement)
    frames: dict[int, int] = {}
    for index, frame in enumerate(source.frames):
        if frame.type == pin.FrameType.BODY:
            new, placement = place(frame.parentJoint, frame.placement)
            frames[index] = model.addFrame(
                pin.Frame(frame.name, new, 0, placement, pin.FrameType.BODY), False
            )

    def carry(geometry: pin.GeometryModel) -> pin.GeometryModel:
        carried = pin.GeometryModel()
        for shape in geometry.geometryObjects:
            copy = pin.GeometryObject(shape)
            copy.parentJoint, copy.placement = place(shape.parentJoint, shape.placement)
            copy.parentFrame = frames[shape.parentFrame]
            carried.addGeometryObject(copy)
        return carried

    return InvertedTree(
        model=model,
        collision=carry(obj.collision),
        visual=carry(obj.visual),
        coordinates=Coordinates(model),
        link=link,
        base_link=obj.base_link,
    )


def _z_aligned(model: pin.Model, data: pin.Data, index: int) -> tuple[pin.JointModel, Floats]:
    """Return the joint of the same kind about or along z, and the unit axis of joint `index` in its own frame."""
    kind = model.joints[index].shortname().removeprefix("JointModel")
    subspace = np.array(data.joints[index].S, float).ravel()  # linear part, then angular part
    if kind in ("RX", "RY", "RZ", "RevoluteUnaligned"):
        return pin.JointModelRZ(), subspace[3:]
    if kind in ("RUBX", "RUBY", "RUBZ", "RevoluteUnboundedUnaligned"):
        return pin.JointModelRUBZ(), subspace[3:]
    if kind in ("PX", "PY", "PZ", "PrismaticUnaligned"):
        return pin.JointModelPZ(), subspace[:3]
    expected = "a revolute, continuous or prismatic joint"
    raise InputError(
        "this joint cannot be inverted", field=model.names[index], expected=expected, got=kind
    )


def _z_to(axis: Floats) -> Floats:
    """Return a rotation, shape (3, 3), that turns z into the unit vector `axis`, with as many zeros as possible."""
    others = np.eye(3)
    x = others[int(np.argmin(np.abs(axis)))]
    x = x - axis * (axis @ x)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
