"""Grafts one kinematic tree onto another, joint by joint.

Pinocchio's `appendModel` aborts on equal names and has misplaced sub-models at fixed joints
(stack-of-tasks/pinocchio #2328, #2293, #2805). This module adds joints, inertias, frames and
geometry explicitly and leaves collision pairs to the caller.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin


def round_placement(placement: pin.SE3, tolerance: float = 1e-12) -> pin.SE3:
    """Return `placement` with entries within `tolerance` of 0 and ±1 rounded.

    Exact entries keep symbolic kinematics sparse.
    """
    rotation = np.array(placement.rotation)
    translation = np.array(placement.translation)
    translation[np.abs(translation) < tolerance] = 0.0
    for exact in (0.0, -1.0, 1.0):
        rotation[np.abs(rotation - exact) < tolerance] = exact
    return pin.SE3(rotation, translation)


def add_joint(
    model: pin.Model,
    parent: int,
    joint: pin.JointModel,
    placement: pin.SE3,
    *,
    like: tuple[pin.Model, int],
    prefix: str = "",
) -> int:
    """Add `joint` to `model` with the name and limits of a joint of another model.

    Args:
        model: Changed in place.
        parent: Index of the parent joint.
        joint: Joint with as many coordinates as the other one.
        placement: Placement of the joint in the frame of `parent`.
        like: The other model, and the index of the joint in it.
        prefix: Prefix of the name.

    Returns:
        Index of the joint in `model`.
    """
    source, index = like
    original = source.joints[index]
    q = slice(original.idx_q, original.idx_q + original.nq)
    v = slice(original.idx_v, original.idx_v + original.nv)
    added = model.addJoint(
        parent,
        joint,
        placement,
        prefix + source.names[index],
        source.effortLimit[v],
        source.velocityLimit[v],
        source.lowerPositionLimit[q],
        source.upperPositionLimit[q],
    )
    return int(added)


def graft(
    model: pin.Model, tree: pin.Model, *, parent: int, placement: pin.SE3, prefix: str = ""
) -> list[int]:
    """Add all joints, inertias and frames of `tree` to `model`.

    Args:
        model: Changed in place.
        tree: The tree to add; not changed.
        parent: Index of the joint of `model` that carries the tree (0 is the world).
        placement: Placement of the tree's universe frame in the frame of `parent`.
        prefix: Prefix of all joint and frame names.

    Returns:
        For each joint of `tree`, its index in `model`; for the universe, `parent`.
    """
    joints = [parent]
    if tree.inertias[0].mass > 0.0:  # of links fixed to the root
        model.appendBodyToJoint(parent, tree.inertias[0], placement)
    for index in range(1, tree.njoints):
        local = tree.jointPlacements[index]
        tree_parent = tree.parents[index]
        if tree_parent == 0:
            local = placement * local
        added = add_joint(
            model,
            joints[tree_parent],
            tree.joints[index],
            round_placement(local),
            like=(tree, index),
            prefix=prefix,
        )
        model.appendBodyToJoint(added, tree.inertias[index], pin.SE3.Identity())
        joints.append(added)
    links = {frame.name for frame in tree.frames if frame.type == pin.FrameType.BODY}
    for frame in tree.frames[1:]:
        # A joint and a link of a URDF may share a name, but Pinocchio cannot look up frames whose
        # names are not unique.
        if frame.type != pin.FrameType.BODY and frame.name in links:
            continue
        local = frame.placement
        if frame.parentJoint == 0:
            local = placement * local
        joint = joints[frame.parentJoint]
        name = prefix + frame.name
        model.addFrame(pin.Frame(name, joint, 0, round_placement(local), frame.type))
    return joints


def graft_geometry(
    geometry: pin.GeometryModel,
    objects: Iterable[pin.GeometryObject],
    *,
    joints: list[int],
    placement: pin.SE3,
    prefix: str = "",
) -> list[int]:
    """Add copies of `objects` to `geometry`, with mapped parent joints.

    Args:
        geometry: Changed in place.
        objects: Geometry objects of a grafted tree.
        joints: For each joint of the tree, its index in the model; see `graft`.
        placement: Placement of the tree's universe frame in the frame of `joints[0]`.
        prefix: Prefix of all names.

    Returns:
        The indices of the copies in `geometry`.
    """
    added = []
    for original in objects:
        local = original.placement
        if original.parentJoint == 0:
            local = placement * local
        copy = pin.GeometryObject(original)
        copy.name = prefix + original.name
        copy.parentJoint = joints[original.parentJoint]
        copy.parentFrame = 0
        copy.placement = local
        added.append(geometry.addGeometryObject(copy))
    return added
