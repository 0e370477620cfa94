"""Makes joints of a Pinocchio model follow others: they have no coordinate then, and all algorithms know it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.world.models.couplings.coupled_joints import JointCoupling

__all__ = ["add_mimics", "sort_joints"]


def add_mimics(
    model: pin.Model, couplings: Sequence[JointCoupling], joints: Sequence[int]
) -> pin.Model:
    """Return a model in which some joints follow others.

    Args:
        model: A model of which they are joints like others.
        couplings: How they follow.
        joints: Their numbers, larger than those of the joints that they follow.
    """
    for led, joint in zip(couplings, joints, strict=True):
        model = pin.transformJointIntoMimic(
            model, model.getJointId(led.leader), joint, led.factor, led.offset
        )
    return model


def sort_joints(full: pin.Model, before: Mapping[int, Collection[int]]) -> list[int]:
    """Return the joints of a model in their order, but for those that have to wait for others.

    Args:
        full: The model; its universe is left out.
        before: Joint → joints that come before it, such as the one that it follows.

    Raises:
        InputError: Leaders hang on joints that follow others, and these on theirs, in a circle.
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
                "joints hang on each other's followers",
                field=names,
                expected="leaders nearer to the base",
            )
        waiting = later
    return order
