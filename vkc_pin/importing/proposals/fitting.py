"""Whether an open hand has room where it takes hold of an object: its shapes against all shapes of the object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance, get_link_name

__all__ = ["Blocked", "Fitting"]


@dataclass(frozen=True)
class Blocked:
    """Why a hand has no room.

    Attributes:
        what: "fingers": the held link is too close to them; "others": another link is; "floor": it
            would be below what the object stands on.
        link: The object's link that is in the way.
    """

    what: str
    link: str = ""


class Fitting:
    """An object at some joint values, and what a hand must keep from it.

    Args:
        item: The object.
        hand: The hand.
        dist_safe: What the hand keeps from the object [m],
        grasp_clearance: but its touch links from the link that they hold [m].
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
        """Put the object's joints at some values, shape (n,), [rad] or [m]."""
        self.state = np.array(state, float)
        pin.forwardKinematics(self.item.model, self._data, self.item.coordinates.q(self.state))
        self._at = [
            self._data.oMi[joint] * shape.placement
            for joint, shape in zip(self._joints, self._shapes, strict=True)
        ]
        corners = np.array(
            [_world_box(box, where) for box, where in zip(self._boxes, self._at, strict=True)]
        ).reshape(-1, 2, 3)
        self._low, self._high = corners[:, 0], corners[:, 1]

    def joint(self, number: int) -> pin.SE3:
        """Return the placement of a joint of the object's model in the frame of its base."""
        return self._data.oMi[number]

    def find_obstruction(self, tool: pin.SE3, held: str, *, more: float = 0.0) -> Blocked | None:
        """Return why a hand at `tool`, in the frame of the object's base, has no room; None if it has.

        Args:
            tool: Of the tool frame.
            held: The link that it takes.
            more: What it must keep beyond the least clearance from other links than this one [m].
        """
        mine = self.links == held
        for (shape, where), box, touches in zip(
            self._hand, self._hand_boxes, self._touch, strict=True
        ):
            placed = tool * where
            low, high = _world_box(box, placed)
            if low[2] < self.floor:
                return Blocked("floor")
            margins = np.where(mine & touches, self._close, self._safe + more)
            gaps = np.maximum(self._low - high, low - self._high).max(axis=1)
            for k in np.flatnonzero(gaps < margins).tolist():
                if (
                    compute_shape_distance(shape, placed, self._shapes[k].geometry, self._at[k])
                    < margins[k]
                ):
                    return Blocked(
                        "fingers" if mine[k] and touches else "others", str(self.links[k])
                    )
        return None


def _world_box(box: tuple[Floats, Floats], where: pin.SE3) -> tuple[Floats, Floats]:
    centre, extent = where.rotation @ box[0] + where.translation, np.abs(where.rotation) @ box[1]
    return centre - extent, centre + extent
