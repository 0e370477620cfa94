"""Finds out from the shapes which objects rest on which links."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.world.models.shapes import compute_shape_distance, compute_world_box, get_link_name
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes

RESTING_DISTANCE = 5e-3
"""Displacement of the support test [m].

An object rests on a shape if lowering it by this makes the two overlap by more than half of it, and
lifting it by this separates them.
"""
MAX_TILT = 0.1
"""Largest tilt of a link while an object rests on it [rad]; dry friction holds beyond that."""
_DOWN = np.array([0.0, 0.0, -RESTING_DISTANCE])


@dataclass(frozen=True, eq=False)
class SupportedObject:
    """A free object that rests on a link and moves with it.

    Attributes:
        object: Its name.
        hold: Hold of the object that the supporting link belongs to.
        link: Supporting link.
        placement_in_link: Placement of its base link in the frame of the supporting link.
        carrier_placement: Placement of the supporting object when the motion begins, world frame.
    """

    object: str
    hold: Hold
    link: str
    placement_in_link: pin.SE3
    carrier_placement: pin.SE3

    @property
    def support(self) -> str:
        """Label of the supporting link, "<object>.<link>"."""
        return f"{self.hold.object}.{self.link}"


def find_supports(
    placed: PlacedObject, shapes: Iterable[tuple[str, pin.GeometryObject]]
) -> set[str]:
    """Return the labels of the shapes that an object rests on."""
    return {label for label, _, _ in find_supporting_pairs(placed, shapes)}


def find_supporting_pairs(
    placed: PlacedObject, shapes: Iterable[tuple[str, pin.GeometryObject]]
) -> list[tuple[str, pin.GeometryObject, pin.GeometryObject]]:
    """Return label and shape of everything an object rests on, with its own shape between them."""
    own = make_world_shapes(placed)
    boxes = [compute_world_box(shape.geometry, shape.placement) for shape in own]
    found = list[tuple[str, pin.GeometryObject, pin.GeometryObject]]()
    for label, shape in shapes:
        lower, upper = compute_world_box(shape.geometry, shape.placement)
        for one, (low, high) in zip(own, boxes, strict=True):
            is_low = (low < upper + RESTING_DISTANCE).all()
            is_near = is_low and (high > lower - RESTING_DISTANCE).all()
            if is_near and _is_supporting(shape, one):
                found.append((label, one, shape))
    return found


def find_supported_objects(
    objects: Mapping[str, PlacedObject], moving: Mapping[str, Collection[str]], free: Iterable[str]
) -> dict[str, str]:
    """Return the free objects that rest on moving links, directly or on top of others.

    Returns:
        Free object → "<object>.<link>" of the moving link at the bottom of the stack.
    """
    shapes = list[tuple[str, pin.GeometryObject]]()
    for name, links in moving.items():
        for shape in make_world_shapes(objects[name]):
            link = get_link_name(shape.name)
            if link in links:
                shapes.append((f"{name}.{link}", shape))
    remaining = [name for name in free if name not in moving]
    found = dict[str, str]()
    # Each round finds the objects that rest on those found in the round before.
    while remaining and shapes:
        resting = dict[str, str]()
        for name in remaining:
            labels = find_supports(objects[name], shapes)
            if labels:
                support = min(labels)
                resting[name] = found.get(support, support)
        found.update(resting)
        remaining = [name for name in remaining if name not in resting]
        shapes = []
        for name in resting:
            shapes += [(name, shape) for shape in make_world_shapes(objects[name])]
    return found


def compute_tilt(before: pin.SE3, after: pin.SE3) -> float:
    """Return the angle between a link's verticals at two placements [rad]."""
    vertical = (after.rotation @ before.rotation.T)[2]
    return float(np.arctan2(np.hypot(vertical[0], vertical[1]), vertical[2]))


def _is_supporting(shape: pin.GeometryObject, one: pin.GeometryObject) -> bool:
    """Return whether `shape` supports `one`, a shape of an object."""

    def measure(shift: float) -> float:
        """Return the distance of the two after a displacement by `shift` · `_DOWN` [m]."""
        moved = pin.SE3(one.placement.rotation, one.placement.translation + shift * _DOWN)
        return compute_shape_distance(one.geometry, moved, shape.geometry, shape.placement)

    lowered = measure(1.0)
    return lowered < -RESTING_DISTANCE / 2 and measure(-1.0) - lowered > RESTING_DISTANCE
