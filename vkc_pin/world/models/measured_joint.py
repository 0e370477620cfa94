"""Defines joints of objects that were measured elsewhere than described."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject


@dataclass(frozen=True, eq=False)
class MeasuredJoint:
    """Where a joint of an object was measured, in the frames of its description.

    As in a URDF, a joint is between a parent and its own link. If the joint moves by M(v), its link
    is at `placement · M(v) · link` in the parent's frame.

    Attributes:
        placement: The joint's frame at value 0 in the parent link's frame.
        link: Its own link in the moving frame of the joint; identity as described.
    """

    placement: pin.SE3
    link: pin.SE3


def compute_axis(model: pin.Model, joint: int) -> Floats:
    """Return the unit axis of a joint of one degree of freedom in its own frame, shape (3,)."""
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    subspace = np.array(data.joints[joint].S, float).ravel()  # linear part, then angular part
    is_revolute = bool(subspace[3:].any())
    return np.asarray(subspace[3:] if is_revolute else subspace[:3])


def mount_joint(
    item: ArticulatedObject, joint: int, placement: pin.SE3, shift: pin.SE3
) -> ArticulatedObject:
    """Return an object with a joint elsewhere; its names, limits and axis in its frame stay.

    Args:
        item: The object.
        joint: Index of the joint in its model.
        placement: New placement of the joint in the frame of its parent joint.
        shift: Displacement, in the frame of the joint, of all that the joint carries.
    """
    model = pin.Model(item.model)
    model.jointPlacements[joint] = placement
    model.inertias[joint] = shift.act(model.inertias[joint])
    for child in range(1, model.njoints):
        if model.parents[child] == joint:
            model.jointPlacements[child] = shift * model.jointPlacements[child]
    for frame in model.frames:
        # The frames of joints are those that the kinematics place.
        if frame.parentJoint == joint and frame.type != pin.FrameType.JOINT:
            frame.placement = shift * frame.placement
    return dataclasses.replace(
        item,
        model=model,
        collision=_shift_shapes(item.collision, joint, shift),
        visual=_shift_shapes(item.visual, joint, shift),
    )


def _shift_shapes(shapes: pin.GeometryModel, joint: int, shift: pin.SE3) -> pin.GeometryModel:
    """Return copies of shapes; those that a joint carries are displaced in its frame."""
    moved = shapes.copy()
    for shape in moved.geometryObjects:
        if shape.parentJoint == joint:
            shape.placement = shift * shape.placement
    return moved
