"""Turns joints of a Pinocchio model into mimic joints, which have no coordinate of their own."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.world.models.couplings.coupled_joints import JointCoupling

__all__ = ["add_mimics", "sort_joints"]


def add_mimics(
    model: pin.Model, couplings: Sequence[JointCoupling], joints: Sequence[int]
) -> pin.Model:
    """Return a model in which some joints are mimic joints.

    Args:
        model: A model in which they are ordinary joints.
        couplings: Coupling of each mimic joint.
        joints: Indices of the mimic joints, larger than those of their leaders.
    """
    for coupling, joint in zip(couplings, joints, strict=True):
        model = pin.transformJointIntoMimic(
            model, model.getJointId(coupling.leader), joint, coupling.factor, coupling.offset
        )
    return model


def sort_joints(full: pin.Model, before: Mapping[int, Collection[int]]) -> list[int]:
    """Return the joint indices of a model in topological order, otherwise unchanged.

    Args:
        full: The model; its universe is omitted.
        before: Joint → joints that must come before it, such as its leader.
    """
    order, waiting = list[int](), list(range(1, full.njoints))
    while waiting:
        ready = set[int]({0, *order})
        later = []
        for j in waiting:
            if full.parents[j] in ready and ready.issuperset(before.get(j, ())):
                ready.add(j)
                order.append(j)
            else:
                later.append(j)
        if len(later) == len(waiting):
            names = ", ".join(str(full.names[j]) for j in later if j in before)
            raise InputError(
                "leaders are descendants of each other's followers",
                field=names,
                expected="leaders nearer to the base than their followers",
            )
        waiting = later
    return order
