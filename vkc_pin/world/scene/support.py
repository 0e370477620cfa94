"""What stands on what, found from the shapes: whatever carries a link carries what stands on it, too."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.world.models.shapes import compute_shape_distance, compute_world_box, get_link_name
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes

__all__ = ["MAX_TILT", "SupportedObject", "compute_tilt", "find_supported_objects", "find_supports"]

RESTING_DISTANCE = 5e-3
"""An object stands on what it would overlap by more than half of this if it were lowered by this, but not if lifted [m]."""
MAX_TILT = 0.1
"""A link may tilt by this while something stands on it [rad]: less than friction of dry things holds."""
_DOWN = np.array([0.0, 0.0, -RESTING_DISTANCE])


@dataclass(frozen=True, eq=False)
class SupportedObject:
    """A free object that stands on a link and moves with it.

    Attributes:
        object: Its name.
        hold: What holds the object that the link belongs to.
        link: The link.
        local: The placement of its base link in the link's frame.
        carrier: Where the object that the link belongs to is when the ride begins.
    """

    object: str
    hold: Hold
    link: str
    placement_in_link: pin.SE3
    carrier_placement: pin.SE3

    @property
    def support(self) -> str:
        """What it stands on, "<object>.<link>"."""
        return f"{self.hold.object}.{self.link}"


def find_supports(
    placed: PlacedObject, shapes: Iterable[tuple[str, pin.GeometryObject]]
) -> set[str]:
    """Return the labels of what an object stands on.

    Args:
        placed: The object.
        shapes: Label and shape of all that stands there, placed in the world.
    """
    own = make_world_shapes(placed)
    boxes = [compute_world_box(shape.geometry, shape.placement) for shape in own]
    found: set[str] = set()
    for label, shape in shapes:
        if label in found:
            continue
        lower, upper = compute_world_box(shape.geometry, shape.placement)
        near = (
            (low < upper + RESTING_DISTANCE).all() and (high > lower - RESTING_DISTANCE).all()
            for low, high in boxes
        )
        if any(_bears(shape, one) for one, close in zip(own, near, strict=True) if close):
            found.add(label)
    return found


def find_supported_objects(
    objects: Mapping[str, PlacedObject], moving: Mapping[str, Collection[str]], free: Iterable[str]
) -> dict[str, str]:
    """Return what rides on links that move: free object → "<object>.<link>" of these, also where others are between.

    Args:
        objects: All, where they stand.
        moving: Object → its links that move.
        free: Those that nobody holds and that may ride.
    """
    shapes = [
        (f"{name}.{link}", shape)
        for name, links in moving.items()
        for shape in make_world_shapes(objects[name])
        if (link := get_link_name(shape.name)) in links
    ]
    left, found = [name for name in free if name not in moving], dict[str, str]()
    while left and shapes:
        on = {
            name: min(labels) for name in left if (labels := find_supports(objects[name], shapes))
        }
        found |= {name: found.get(label, label) for name, label in on.items()}
        left = [name for name in left if name not in on]
        shapes = [(name, shape) for name in on for shape in make_world_shapes(objects[name])]
    return found


def compute_tilt(before: pin.SE3, after: pin.SE3) -> float:
    """Return by how much a link that was level at `before` tilts at `after` [rad]."""
    vertical = (after.rotation @ before.rotation.T)[2]
    return float(np.arctan2(np.hypot(vertical[0], vertical[1]), vertical[2]))


def _bears(shape: pin.GeometryObject, one: pin.GeometryObject) -> bool:
    """Return whether a shape of an object stands on `shape`."""

    def distance(shift: float) -> float:
        moved = pin.SE3(one.placement.rotation, one.placement.translation + shift * _DOWN)
        return compute_shape_distance(one.geometry, moved, shape.geometry, shape.placement)

    lowered = distance(1.0)
    return lowered < -RESTING_DISTANCE / 2 and distance(-1.0) - lowered > RESTING_DISTANCE
