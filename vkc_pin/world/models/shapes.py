"""Provides helpers for collision shapes: names, surfaces, bounding boxes and distances."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.interrupt import defer_interrupt
from vkc_pin.world.collision.distances import compute_distance
from vkc_pin.world.collision.solids import convert_solid, flatten_placements
from vkc_pin.world.files.meshes import get_triangles
from vkc_pin.world.models.grafting import round_placement

LIMIT_SLACK = 1e-6
"""Joint values that exceed their limits by at most this are clamped [rad] or [m]."""
START_SLACK = 1e-2
"""Excess over the limits of a joint that is accepted of a start [rad] or [m].

Encoders of joints at their stops read up to 9 mrad or 9 mm beyond.
"""
_CIRCLE_SEGMENTS = 28  # segments of a circle


def clamp_to_limits(
    value: float,
    lower: float,
    upper: float,
    field: str | None,
    problem: str = "outside the joint's limits",
) -> float:
    """Return `value`, clamped to its limits if it exceeds them by rounding only."""
    if not np.isfinite(value):
        raise InputError("not a finite number", field=field, expected="a finite number", got=value)
    if not lower - LIMIT_SLACK <= value <= upper + LIMIT_SLACK:
        expected = f"{lower:g} to {upper:g}"
        raise InputError(problem, field=field, expected=expected, got=f"{value:.12g}")
    return float(min(max(value, lower), upper))


def check_start_value(value: float, lower: float, upper: float, field: str | None) -> float:
    """Return a joint's value at a start, which may be `START_SLACK` outside its limits."""
    if lower - START_SLACK <= value <= upper + START_SLACK:
        within_rounding = lower - LIMIT_SLACK <= value <= upper + LIMIT_SLACK
        return clamp_to_limits(value, lower, upper, field) if within_rounding else float(value)
    return clamp_to_limits(value, lower, upper, field)


def copy_shape(shape: pin.GeometryObject, name: str, placement: pin.SE3) -> pin.GeometryObject:
    """Return a copy of `shape` that is fixed at `placement` in the world frame."""
    copy = pin.GeometryObject(shape)
    copy.name = name
    copy.parentJoint = 0
    copy.parentFrame = 0
    copy.placement = round_placement(placement)
    return copy


def get_link_name(shape_name: str) -> str:
    """Return the name of a shape's link, given Pinocchio's shape name `<link>_<number>`."""
    return shape_name.rpartition("_")[0]


def get_local_name(shape_name: str) -> str:
    """Return the part of a shape's name after the object: `<object>.<local name>`."""
    return shape_name.partition(".")[2]


def list_placed_shapes(
    shapes: Iterable[pin.GeometryObject],
) -> list[tuple[coal.CollisionGeometry, pin.SE3]]:
    """Return (geometry, placement) of shapes fixed in the world, for `compute_clearance`."""
    return [(shape.geometry, shape.placement) for shape in shapes]


def compute_clearance(
    first: Iterable[tuple[coal.CollisionGeometry, pin.SE3]],
    second: Iterable[tuple[coal.CollisionGeometry, pin.SE3]],
    *,
    reach: float = np.inf,
) -> float:
    """Return the smallest signed distance between two groups of shapes [m].

    Args:
        first: Shapes with their placements in the world frame.
        second: Other shapes, likewise.
        reach: Cutoff [m]: if all distances are larger, the result is some number ≥ `reach`.
    """
    nearest, some, others = reach, list(first), list(second)
    boxes = [
        np.array([compute_world_box(*shape) for shape in group]).reshape(-1, 2, 3)
        for group in (some, others)
    ]
    (low, high), (lower, upper) = (each.swapaxes(0, 1) for each in boxes)
    # Shapes translated by the overlap of their boxes are separate, so that negative gaps are lower
    # bounds, too.
    gaps = np.maximum(lower - high[:, None], low[:, None] - upper).max(axis=2)
    pairs = np.argwhere(gaps < reach)
    pairs = pairs[np.argsort(gaps[tuple(pairs.T)], kind="stable")]
    for i, k in pairs.tolist():
        if gaps[i, k] >= nearest:
            break
        nearest = min(nearest, compute_shape_distance(*some[i], *others[k]))
    return nearest


def compute_shape_distance(
    first: coal.CollisionGeometry,
    first_placement: pin.SE3,
    second: coal.CollisionGeometry,
    second_placement: pin.SE3,
) -> float:
    """Return the signed distance between two shapes at placements in a common frame [m]."""
    where, there = flatten_placements([first_placement, second_placement])
    return compute_distance(convert_solid(first), where, convert_solid(second), there)[0]


def triangulate(shape: coal.CollisionGeometry) -> tuple[Floats, NDArray[np.int64]]:
    """Return the surface of a coal shape in its own frame.

    Returns:
        Vertices, shape (n, 3) [m], and faces, shape (m, 3).
    """
    if isinstance(shape, coal.BVHModelBase | coal.Convex):
        points = shape.points() if isinstance(shape, coal.Convex) else shape.vertices()
        return np.array(points, float), get_triangles(shape)

    # trimesh catches Ctrl-C while it imports others, and would go on without them.
    with defer_interrupt():
        import trimesh.creation as make

    if isinstance(shape, coal.Box):
        mesh = make.box(extents=2.0 * np.asarray(shape.halfSide))
    elif isinstance(shape, coal.Sphere):
        mesh = make.uv_sphere(radius=shape.radius, count=(_CIRCLE_SEGMENTS // 2, _CIRCLE_SEGMENTS))
    elif isinstance(shape, coal.Ellipsoid):
        mesh = make.uv_sphere(radius=1.0, count=(_CIRCLE_SEGMENTS // 2, _CIRCLE_SEGMENTS))
        mesh.apply_transform(np.diag([*np.asarray(shape.radii), 1.0]))
    elif isinstance(shape, coal.Cylinder):
        mesh = make.cylinder(
            radius=shape.radius, height=2.0 * shape.halfLength, sections=_CIRCLE_SEGMENTS
        )
    elif isinstance(shape, coal.Cone):
        mesh = make.cone(
            radius=shape.radius, height=2.0 * shape.halfLength, sections=_CIRCLE_SEGMENTS
        )
        mesh.apply_translation([0.0, 0.0, -shape.halfLength])
    elif isinstance(shape, coal.Capsule):
        length = 2.0 * shape.halfLength
        mesh = make.capsule(
            height=length, radius=shape.radius, count=(_CIRCLE_SEGMENTS, _CIRCLE_SEGMENTS)
        )
        mesh.apply_translation([0.0, 0.0, -(mesh.bounds[0, 2] + mesh.bounds[1, 2]) / 2.0])
    else:
        raise InputError(
            "this shape cannot be drawn", expected="a solid or a mesh", got=type(shape).__name__
        )
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def compute_bounding_box(shape: pin.GeometryObject) -> tuple[Floats, Floats]:
    """Return centre and half extents of a shape's bounding box in its own frame, (3,) each [m]."""
    shape.geometry.computeLocalAABB()
    return np.asarray(shape.geometry.aabb_local.center(), float), _get_half_extents(shape.geometry)


def compute_world_box(shape: coal.CollisionGeometry, placement: pin.SE3) -> tuple[Floats, Floats]:
    """Return the corners of a shape's axis-aligned box in the world frame, shape (3,) each [m]."""
    shape.computeLocalAABB()
    centre = placement.act(np.asarray(shape.aabb_local.center(), float))
    extent = np.abs(placement.rotation) @ _get_half_extents(shape)
    return centre - extent, centre + extent


class ShapeDistances:
    """Computes distances between shapes of a model with coal, one configuration at a time.

    Args:
        model: The kinematic model.
        configuration: Maps minimal coordinates, shape (n,), to Pinocchio's q, shape (nq,).
        shapes: Shapes attached to joints of the model.
    """

    def __init__(
        self,
        model: pin.Model,
        configuration: Callable[[Floats], Floats],
        shapes: Sequence[pin.GeometryObject],
    ) -> None:
        self._model, self._configuration, self._data = model, configuration, model.createData()
        geometries = [shape.geometry for shape in shapes]
        self._solids = [convert_solid(geometry) for geometry in geometries]
        self._joints = np.array([shape.parentJoint for shape in shapes])
        self._locals = [shape.placement for shape in shapes]
        for geometry in geometries:
            geometry.computeLocalAABB()
        self._radii = np.array([geometry.aabb_radius for geometry in geometries])
        self._middles = np.array(
            [
                place.act(geometry.aabb_center)
                for place, geometry in zip(self._locals, geometries, strict=True)
            ]
        )
        self._turns = np.array([place.rotation for place in self._locals])
        self._halves = np.array([_get_half_extents(geometry) for geometry in geometries])

    def set_configuration(self, z: Floats) -> None:
        """Set the model to the minimal coordinates `z`, shape (n,)."""
        pin.forwardKinematics(self._model, self._data, self._configuration(z))
        rotations = np.array([place.rotation for place in self._data.oMi])[self._joints]
        positions = np.array([place.translation for place in self._data.oMi])[self._joints]
        self._centres = np.einsum("kij,kj->ki", rotations, self._middles) + positions
        self._verticals = rotations[:, 2]
        self._places: dict[int, Floats] = {}

    def compute_lowest_points(self) -> Floats:
        """Return the lowest height of each shape's bounding box, shape (shapes,) [m]."""
        across = np.abs(np.einsum("kj,kji->ki", self._verticals, self._turns))
        return np.asarray(self._centres[:, 2] - np.einsum("ki,ki->k", across, self._halves))

    def compute_lower_bounds(self, pairs: Ints) -> Floats:
        """Return lower bounds [m], shape (P,), of the distances of `pairs`, by bounding spheres."""
        first, second = pairs[:, 0], pairs[:, 1]
        gaps = self._centres[first] - self._centres[second]
        return np.asarray(
            np.sqrt(np.einsum("ki,ki->k", gaps, gaps)) - self._radii[first] - self._radii[second]
        )

    def compute_distance(self, parts: Iterable[tuple[int, int]], cutoff: float = np.inf) -> float:
        """Return the smallest distance of pairs of shapes [m].

        If it is larger than `cutoff`, a lower bound larger than `cutoff` is returned.
        """
        smallest = np.inf
        for first, second in parts:
            gap = self._centres[first] - self._centres[second]
            bound = float(np.sqrt(gap @ gap) - self._radii[first] - self._radii[second])
            if bound <= min(smallest, cutoff):
                one, other = (
                    (self._solids[shape], self._compute_placement(shape))
                    for shape in (first, second)
                )
                bound, _ = compute_distance(*one, *other)
            smallest = min(smallest, bound)
        return smallest

    def _compute_placement(self, shape: int) -> Floats:
        if shape not in self._places:
            place = self._data.oMi[int(self._joints[shape])] * self._locals[shape]
            self._places[shape] = flatten_placements([place])[0]
        return self._places[shape]


class LinkDistances:
    """Computes distances between pairs of links, one configuration at a time.

    Bounding spheres of all pairs are evaluated at once and exclude most.

    Args:
        distances: Distances between the shapes.
        groups: Pair of links → pairs of their shapes.
    """

    links: list[tuple[str, str]]

    def __init__(
        self, distances: ShapeDistances, groups: Mapping[tuple[str, str], Sequence[tuple[int, int]]]
    ) -> None:
        self._distances = distances
        self._groups = {links: np.array(parts, np.int64) for links, parts in groups.items()}
        self._concatenate_pairs()

    def select(self, chosen: Sequence[bool] | Bools) -> None:
        """Keep only the `chosen` pairs of links, shape (links,)."""
        if not all(chosen):
            self._groups = {
                links: parts
                for (links, parts), keep in zip(self._groups.items(), chosen, strict=True)
                if keep
            }
            self._concatenate_pairs()

    def compute_lower_bounds(self) -> Floats:
        """Return lower bounds of all distances at the current configuration, shape (links,) [m]."""
        if not self._groups:
            return np.zeros(0)
        self._bounds = self._distances.compute_lower_bounds(self._pairs)
        return np.asarray(np.minimum.reduceat(self._bounds, self._starts))

    def compute_distance(self, number: int, cutoff: float) -> float:
        """Return the distance of the pair of links `number` [m], or some number above `cutoff`.

        Uses the bounds of the last call of `compute_lower_bounds`.
        """
        start, end = self._starts[number], self._ends[number]
        close = self._pairs[start:end][self._bounds[start:end] <= cutoff]
        return self._distances.compute_distance(map(tuple, close.tolist()), cutoff)

    def _concatenate_pairs(self) -> None:
        self.links = list(self._groups)
        counts = np.array([len(parts) for parts in self._groups.values()], np.int64)
        self._ends = np.cumsum(counts)
        self._starts = self._ends - counts
        self._pairs = np.vstack([np.zeros((0, 2), np.int64), *self._groups.values()])


def _get_half_extents(solid: coal.CollisionGeometry) -> Floats:
    box = solid.aabb_local
    return np.array([box.width(), box.height(), box.depth()]) / 2
