"""Checks whether an open hand has clearance at a grasp of an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance, get_link_name

__all__ = ["HandClearance", "Obstruction"]


@dataclass(frozen=True)
class Obstruction:
    """Reason why a hand has no clearance.

    Attributes:
        what: "fingers": the grasped link is too close to them; "others": another link is; "floor":
            the hand would be below the object's support.
        link: The obstructing link of the object.
    """

    what: str
    link: str = ""


class HandClearance:
    """Clearance between a hand and an object at some joint positions.

    Args:
        item: The object.
        hand: The hand.
        dist_safe: Clearance between hand and object [m].
        grasp_clearance: Clearance between the touch links and the grasped link [m].
    """

    def __init__(
        self, item: ArticulatedObject, hand: Hand, dist_safe: float, grasp_clearance: float
    ) -> None:
        self.item, self.hand = item, hand
        self._safe, self._close = dist_safe, grasp_clearance
        self._shapes = list(item.collision.geometryObjects)
        self.links = np.array([get_link_name(shape.name) for shape in self._shapes])
        self._joints = [shape.parentJoint for shape in self._shapes]
        self._boxes = [compute_bounding_box(shape) for shape in self._shapes]
        self._touch = np.array([True] * len(hand.touch) + [False] * len(hand.others))
        self._hand = [*hand.touch, *hand.others]
        self._hand_boxes = [
            compute_bounding_box(pin.GeometryObject("", 0, where, shape))
            for shape, where in self._hand
        ]
        self._data = item.model.createData()
        self.place(np.clip(np.zeros(len(item.lower)), item.lower, item.upper))
        self.floor = float(self._low[:, 2].min()) if len(self._shapes) else -np.inf

    def place(self, state: Floats) -> None:
        """Set the object's joint positions, shape (n,), [rad] or [m]."""
        self.state = np.array(state, float)
        pin.forwardKinematics(self.item.model, self._data, self.item.coordinates.q(self.state))
        self._at = [
            self._data.oMi[joint] * shape.placement
            for joint, shape in zip(self._joints, self._shapes, strict=True)
        ]
        corners = np.array(
            [_transform_box(box, where) for box, where in zip(self._boxes, self._at, strict=True)]
        ).reshape(-1, 2, 3)
        self._low, self._high = corners[:, 0], corners[:, 1]

    def joint(self, number: int) -> pin.SE3:
        """Return the placement of a joint of the object's model in its base frame."""
        return self._data.oMi[number]

    def find_obstruction(
        self, tool: pin.SE3, held: str, *, extra_clearance: float = 0.0
    ) -> Obstruction | None:
        """Return what obstructs a hand at `tool`, in the object's base frame; None if nothing does.

        Args:
            tool: Placement of the tool frame.
            held: The grasped link.
            extra_clearance: Clearance in excess of the required one from other links [m].
        """
        is_held = self.links == held
        for (shape, where), box, touches in zip(
            self._hand, self._hand_boxes, self._touch, strict=True
        ):
            placed = tool * where
            low, high = _transform_box(box, placed)
            if low[2] < self.floor:
                return Obstruction("floor")
            margins = np.where(is_held & touches, self._close, self._safe + extra_clearance)
            gaps = np.maximum(self._low - high, low - self._high).max(axis=1)
            for k in np.flatnonzero(gaps < margins).tolist():
                if (
                    compute_shape_distance(shape, placed, self._shapes[k].geometry, self._at[k])
                    < margins[k]
                ):
                    return Obstruction(
                        "fingers" if is_held[k] and touches else "others", str(self.links[k])
                    )
        return None


def _transform_box(box: tuple[Floats, Floats], where: pin.SE3) -> tuple[Floats, Floats]:
    """Return the lower and upper corner of a box, given by centre and half extents, in the world."""
    centre, extent = where.rotation @ box[0] + where.translation, np.abs(where.rotation) @ box[1]
    return centre - extent, centre + extent
