"""Re-roots an articulated object at a grasped link, so that a robot's hand can carry the tree."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.grafting import add_joint, round_placement

__all__ = ["invert"]


def invert(
    obj: ArticulatedObject, link: str, state: ArrayLike
) -> tuple[pin.Model, pin.GeometryModel]:
    """Re-root an object at a link, whose frame becomes the universe frame.

    With placement P and motion J(q) of a joint, parent → child is P·J(q), so child → parent is
    J(q)⁻¹·P⁻¹, where J(q)⁻¹ is the same joint with a negated axis. A constant rotation aligns it
    with z and is absorbed into the adjacent placements; z-aligned joints have the shortest
    expressions.

    Args:
        obj: The object.
        link: The new root link.
        state: Joint positions, shape (n,), at which joints off the path to the base link are
            locked.

    Returns:
        Joints on the path from the link to the base link, with their names and limits, and a body
        frame for each link; and the collision geometry on these bodies.

    Raises:
        UnknownNameError: The object has no such link.
        InputError: `state` has the wrong size, or a joint on the path cannot be inverted.
    """
    source = check_instance(obj, ArticulatedObject, "obj").model
    root = source.frames[obj.link_frame(link)]
    data = source.createData()
    pin.forwardKinematics(source, data, obj.coordinates.q(state))
    path = [root.parentJoint]  # from the link's joint down to the universe
    while path[-1] != 0:
        path.append(source.parents[path[-1]])

    model = pin.Model()
    model.name = obj.name
    # joint of the path → joint of the new model that carries its body, and the body's placement
    carrier: dict[int, tuple[int, pin.SE3]] = {path[0]: (0, root.placement.inverse())}
    for child, parent in pairwise(path):
        new_parent, body = carrier[child]
        joint, axis = _align_with_z(source, data, child)
        turn = pin.SE3(_rotate_z_to(-axis), np.zeros(3))
        index = add_joint(
            model, new_parent, joint, round_placement(body * turn), like=(source, child)
        )
        carrier[parent] = (index, turn.inverse() * source.jointPlacements[child].inverse())

    def place(joint: int, placement: pin.SE3) -> tuple[int, pin.SE3]:
        """Return the new joint that carries `placement` of the old `joint`, and its placement."""
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
            body_frame = pin.Frame(frame.name, new, 0, placement, pin.FrameType.BODY)
            frames[index] = model.addFrame(body_frame, False)

    collision = pin.GeometryModel()
    for shape in obj.collision.geometryObjects:
        copy = pin.GeometryObject(shape)
        copy.parentJoint, copy.placement = place(shape.parentJoint, shape.placement)
        copy.parentFrame = frames[shape.parentFrame]
        collision.addGeometryObject(copy)
    return model, collision


def _align_with_z(model: pin.Model, data: pin.Data, index: int) -> tuple[pin.JointModel, Floats]:
    """Return the z-aligned joint of the same kind, and the unit axis of joint `index`."""
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


def _rotate_z_to(axis: Floats) -> Floats:
    """Return a rotation, shape (3, 3), from z to the unit vector `axis`, with many zeros."""
    basis = np.eye(3)
    x = basis[int(np.argmin(np.abs(axis)))]
    x = x - axis * (axis @ x)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
