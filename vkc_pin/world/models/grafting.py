"""Grafts one kinematic tree onto another, joint by joint.

Pinocchio's own `appendModel` aborts on equal names and has placed sub-models of fixed joints
wrongly (stack-of-tasks/pinocchio #2328, #2293, #2805); this adds every joint, inertia, frame and
geometry explicitly and leaves collision pairs to the caller.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin

__all__ = ["add_joint", "graft", "graft_geometry", "round_placement"]


def round_placement(placement: pin.SE3, tolerance: float = 1e-12) -> pin.SE3:
    """Return `placement` with entries within `tolerance` of 0 and ±1 rounded: keeps symbolic kinematics sparse."""
    rotation, translation = np.array(placement.rotation), np.array(placement.translation)
    for array in (rotation, translation):
        array[np.abs(array) < tolerance] = 0.0
    for sign in (-1.0, 1.0):
        rotation[np.abs(rotation - sign) < tolerance] = sign
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
    """Add `joint` to `model` with the name and limits that a joint of another model has.

    Args:
        model: Changed in place.
        parent: The joint of `model` that carries it.
        joint: With as many coordinates as the other joint.
        placement: In the frame of `parent`.
        like: The other model, and the joint's index there.
        prefix: Put before the name.

    Returns:
        Its index in `model`.
    """
    source, index = like
    twin = source.joints[index]
    q, v = slice(twin.idx_q, twin.idx_q + twin.nq), slice(twin.idx_v, twin.idx_v + twin.nv)
    limits = (
        source.effortLimit[v],
        source.velocityLimit[v],
        source.lowerPositionLimit[q],
        source.upperPositionLimit[q],
    )
    return int(model.addJoint(parent, joint, placement, prefix + source.names[index], *limits))


def graft(
    model: pin.Model, tree: pin.Model, *, parent: int, placement: pin.SE3, prefix: str = ""
) -> list[int]:
    """Add every joint, inertia and frame of `tree` to `model`, its universe at `placement` in joint `parent`.

    Args:
        model: Changed in place.
        tree: The tree to add; not changed.
        parent: The joint of `model` that carries it (0 is the world).
        placement: Of the tree's universe frame in the frame of `parent`.
        prefix: Put before every joint and frame name.

    Returns:
        For each joint of `tree` its index in `model`; for the universe, `parent`.
    """
    joints = [parent]
    if tree.inertias[0].mass > 0.0:  # of what is fixed to the tree's root
        model.appendBodyToJoint(parent, tree.inertias[0], placement)
    for index in range(1, tree.njoints):
        joint, above = tree.joints[index], tree.parents[index]
        local = tree.jointPlacements[index] if above else placement * tree.jointPlacements[index]
        added = add_joint(
            model, joints[above], joint, round_placement(local), like=(tree, index), prefix=prefix
        )
        model.appendBodyToJoint(added, tree.inertias[index], pin.SE3.Identity())
        joints.append(added)
    bodies = {frame.name for frame in tree.frames if frame.type == pin.FrameType.BODY}
    for frame in tree.frames[1:]:
        if frame.type != pin.FrameType.BODY and frame.name in bodies:
            # a joint and a link may share a name in a URDF, but Pinocchio finds no frame by a name
            # that two have
            continue
        local = frame.placement if frame.parentJoint else placement * frame.placement
        model.addFrame(
            pin.Frame(
                prefix + frame.name,
                joints[frame.parentJoint],
                0,
                round_placement(local),
                frame.type,
            )
        )
    return joints


def graft_geometry(
    geometry: pin.GeometryModel,
    objects: Iterable[pin.GeometryObject],
    *,
    joints: list[int],
    placement: pin.SE3,
    prefix: str = "",
) -> list[int]:
    """Add copies of `objects` to `geometry`, their parent joints mapped.

    Args:
        geometry: Changed in place.
        objects: The geometry of a tree that was grafted.
        joints: For each joint of the tree its index in the model; see `graft`.
        placement: Of the tree's universe frame in the frame of `joints[0]`.
        prefix: Put before every name.

    Returns:
        The indices of the copies in `geometry`.
    """
    added = []
    for original in objects:
        local = original.placement if original.parentJoint else placement * original.placement
        twin = pin.GeometryObject(original)
        twin.name, twin.parentJoint, twin.parentFrame = (
            prefix + original.name,
            joints[original.parentJoint],
            0,
        )
        twin.placement = local
        added.append(geometry.addGeometryObject(twin))
    return added
