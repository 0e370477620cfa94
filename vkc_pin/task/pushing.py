"""Which way a hand can push: it moves what it touches ahead of it, and pulls nothing."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats
from vkc_pin.errors import InputError
from vkc_pin.models.articulation import Attachment
from vkc_pin.scene.placed import PlacedObject
from vkc_pin.task.lookup import joint_limits

__all__ = ["advance", "pushed_ways"]

_PARTS = 9  # values of a freedom that turns, about points elsewhere, at which the contact is looked at; a slide's ends are enough
_LEAST = 1e-3  # [m] a radian, or of a metre: what moves the contact less is not pushed


def advance(placed: PlacedObject, attachment: Attachment, joint: str) -> tuple[float, float]:
    """Return how far the contact moves into its face when a joint does, [m/rad] or 1: the least and the most over the region.

    The velocity of the link at the contact is linear in where that is, so a region of slides has its extremes at corners.

    Args:
        placed: The object, at the state at which that is asked.
        attachment: Where it is pushed.
        joint: Of the object.
    """
    model, data = placed.object.model, placed.object.model.createData()
    frame, index = placed.object.link_frame(attachment.link), model.getJointId(joint)
    q = placed.object.coordinates.q(placed.state)
    jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL).reshape(6, -1)  # of one joint it has one dimension
    column = jacobian[:, model.joints[index].idx_v]
    into = attachment.placement.rotation[:, 2]
    found = [into @ (column[:3] + np.cross(column[3:], point)) for point in _region(attachment)]
    return float(min(found)), float(max(found))


def _region(attachment: Attachment) -> list[Floats]:
    """Return points of the region that may be touched, in the link's frame, among them its corners."""
    ranges = [
        np.linspace(own.lower, own.upper, 2 if own.kind == "prismatic" else _PARTS if own.through.any() else 1)
        for own in attachment.freedoms
    ]
    points = []
    for values in product(*ranges):
        moved = attachment.placement
        for freedom, value in zip(attachment.freedoms, values, strict=True):
            moved = moved * freedom.motion(float(value))
        points.append(moved.translation)
    return points


def pushed_ways(
    placed: PlacedObject, attachment: Attachment, state: Mapping[str, float], values: Mapping[str, float], where: str
) -> dict[str, int]:
    """Return which way a push moves each of some coordinates, 1 up or -1 down; nothing where the hand takes hold.

    Args:
        placed: The object.
        attachment: Where the hand has it.
        state: Coordinate "<object>.<joint>" → value at the begin [rad] or [m].
        values: The same at the end.
        where: The field that asks for it, for errors.

    Raises:
        InputError: Pushing there does not move a joint, or not all of the region moves it the same way, or not that way.
    """
    if attachment.contact != "push":
        return {}
    own = {name.partition(".")[2]: value for name, value in state.items() if name.partition(".")[0] == placed.name}
    placed, ways = placed.with_state(own), dict[str, int]()
    at = f"'{placed.name}' at '{attachment.name}'"
    for coordinate, value in values.items():
        joint = coordinate.partition(".")[2]
        least, most = advance(placed, attachment, joint)
        if least * most <= 0.0 or min(abs(least), abs(most)) < _LEAST:
            problem = f"pushing {at} does not move '{joint}' one way"
            raise InputError(problem, field=where, expected="a face all of which lies on one side of the joint's axis")
        ways[coordinate] = way = 1 if least > 0.0 else -1
        begin = state[coordinate]
        lower, upper = joint_limits(placed, coordinate)
        if (min(max(value, lower), upper) - begin) * way < 0.0:
            problem = f"pushing {at} moves '{joint}' {'up' if way > 0 else 'down'} only: a hand that pushes cannot pull"
            other = [name for name, one in placed.object.attachments.items() if one.contact != "push"]
            expected = f"{'≥' if way > 0 else '≤'} {begin:g}"
            expected += f", or an attachment to hold it by: {', '.join(other)}" if other else ""
            raise InputError(problem, field=where, expected=expected, got=value)
    return ways
