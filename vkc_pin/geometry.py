"""Where things stand: articulated objects placed in the world, and distances between groups of shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.articulation import ArticulatedObject
from vkc_pin.assembly import clean
from vkc_pin.errors import InputError, UnknownNameError

__all__ = [
    "LIMIT_SLACK",
    "PlacedObject",
    "bounding_box",
    "clearance",
    "copy_shape",
    "link_name",
    "own_name",
    "placed_shapes",
    "shape_distance",
    "standing_geometry",
    "within_limits",
    "world_box",
]

LIMIT_SLACK = 1e-6
"""Joint values up to this far outside their limits, [rad] or [m], count as rounding and are moved to the limit."""


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """An articulated object that stands in the world (or is held).

    Attributes:
        name: Its name in the scene.
        object: What it is.
        placement: Its base link in the world frame.
        state: Its joint values, shape (n,), [rad] or [m], in the order of `object.coordinates.names`.
    """

    name: str
    object: ArticulatedObject
    placement: pin.SE3
    state: NDArray[np.float64]

    def __repr__(self) -> str:
        state = ", ".join(f"{n}={v:.4g}" for n, v in zip(self.object.coordinates.names, self.state, strict=True))
        return f"<PlacedObject {self.name}: {self.object.name}{f', {state}' if state else ''}>"

    def with_state(self, values: Mapping[str, float]) -> PlacedObject:
        """Return the object with joints at `values`, by joint name, [rad] or [m]; the other joints stay.

        Raises:
            UnknownNameError: It has no such joint.
            InputError: A value is not finite or outside the joint's limits.
        """
        state, coordinates = self.state.copy(), self.object.coordinates
        for joint, value in values.items():
            if joint not in coordinates.names:
                raise UnknownNameError(f"joint of {self.name}", joint, coordinates.names, field=f"{self.name}.{joint}")
            index = coordinates.index(joint)
            state[index] = within_limits(value, self.object.lower[index], self.object.upper[index], f"{self.name}.{joint}")
        return dataclasses.replace(self, state=state)

    def link_placement(self, link: str) -> pin.SE3:
        """Return the placement of `link` in the world frame. Raises `UnknownNameError` if there is none."""
        return self.placement * self.object.link_placement(link, self.state)


def within_limits(value: float, lower: float, upper: float, field: str | None) -> float:
    """Return `value`, moved to the limit if it is outside by rounding only. Raises `InputError` if it is further out."""
    if not np.isfinite(value):
        raise InputError("not a finite number", field=field, expected="a finite number", got=value)
    if not lower - LIMIT_SLACK <= value <= upper + LIMIT_SLACK:
        raise InputError("outside the joint's limits", field=field, expected=f"{lower:g} to {upper:g}", got=f"{value:g}")
    return float(min(max(value, lower), upper))


def standing_geometry(placed: PlacedObject, *, visual: bool = False) -> list[pin.GeometryObject]:
    """Return copies of an object's shapes where they stand: parent joint 0, placements in the world frame.

    Args:
        placed: The object.
        visual: Return what to draw instead of what collides.

    Returns:
        The shapes in the object's own order, with their names in the object (`<link>_<number>`).
    """
    model, geometry = placed.object.model, placed.object.visual if visual else placed.object.collision
    data = model.createData()
    pin.forwardKinematics(model, data, placed.object.coordinates.q(placed.state))
    return [
        copy_shape(shape, shape.name, placed.placement * data.oMi[shape.parentJoint] * shape.placement)
        for shape in geometry.geometryObjects
    ]


def copy_shape(shape: pin.GeometryObject, name: str, placement: pin.SE3) -> pin.GeometryObject:
    """Return a copy of `shape` that stands still at `placement` in the world frame."""
    copy = pin.GeometryObject(shape)
    copy.name, copy.parentJoint, copy.parentFrame, copy.placement = name, 0, 0, clean(placement)
    return copy


def link_name(shape_name: str) -> str:
    """Return the name of the link that a shape belongs to: Pinocchio calls its shapes `<link>_<number>`."""
    return shape_name.rpartition("_")[0]


def own_name(shape_name: str) -> str:
    """Return the name in its object of a shape that is called `<object>.<own name>`."""
    return shape_name.partition(".")[2]


def placed_shapes(shapes: Iterable[pin.GeometryObject]) -> list[tuple[coal.CollisionGeometry, pin.SE3]]:
    """Return (shape, placement) for shapes that stand in the world, for `clearance`."""
    return [(shape.geometry, shape.placement) for shape in shapes]


def clearance(
    first: Iterable[tuple[coal.CollisionGeometry, pin.SE3]],
    second: Iterable[tuple[coal.CollisionGeometry, pin.SE3]],
    *,
    reach: float = np.inf,
) -> float:
    """Return the smallest signed distance [m] between two groups of shapes with their placements in the world frame.

    Args:
        first: One group; a negative distance is a penetration depth.
        second: The other group.
        reach: Distances above this do not matter [m]: the result is then some number ≥ `reach`.
    """
    nearest, request, others = reach, coal.DistanceRequest(), list(second)
    boxes = np.array([world_box(shape, placement) for shape, placement in others]).reshape(-1, 2, 3)
    for shape, placement in first:
        low, high = world_box(shape, placement)
        # Moved apart by as much as their boxes overlap, shapes are separate: a bound also where it is negative.
        gaps = np.maximum(boxes[:, 0] - high, low - boxes[:, 1]).max(axis=1)
        transform = coal.Transform3s(placement.rotation, placement.translation)
        for k in np.argsort(gaps, kind="stable").tolist():
            if gaps[k] >= nearest:
                break
            other, where = others[k]
            there = coal.Transform3s(where.rotation, where.translation)
            nearest = min(nearest, coal.distance(shape, transform, other, there, request, coal.DistanceResult()))
    return float(nearest)


def shape_distance(
    first: coal.CollisionGeometry, first_placement: pin.SE3, second: coal.CollisionGeometry, second_placement: pin.SE3
) -> float:
    """Return the signed distance [m] between two shapes at placements in one frame."""
    a, b = (coal.Transform3s(where.rotation, where.translation) for where in (first_placement, second_placement))
    return float(coal.distance(first, a, second, b, coal.DistanceRequest(), coal.DistanceResult()))


def bounding_box(shape: pin.GeometryObject) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centre and half extents of a shape's bounding box in its own frame."""
    shape.geometry.computeLocalAABB()
    box = shape.geometry.aabb_local
    return np.asarray(box.center(), float), np.array([box.width(), box.height(), box.depth()]) / 2


def world_box(shape: coal.CollisionGeometry, placement: pin.SE3) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper corner, shape (3,) each [m], of a box along the world's axes around a shape."""
    shape.computeLocalAABB()
    box = shape.aabb_local
    centre = placement.act(np.asarray(box.center(), float))
    extent = np.abs(placement.rotation) @ np.array([box.width(), box.height(), box.depth()]) / 2
    return centre - extent, centre + extent
