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
    return FixedShapes(second).compute_clearance(first, reach=reach)


class FixedShapes:
    """Shapes at fixed placements, whose boxes are computed once for several distances.

    Args:
        shapes: Shapes with their placements in the world frame.
    """

    def __init__(self, shapes: Iterable[tuple[coal.CollisionGeometry, pin.SE3]]) -> None:
        self._shapes = list(shapes)
        self._lower, self._upper = _compute_world_boxes(self._shapes)

    def compute_clearance(
        self, others: Iterable[tuple[coal.CollisionGeometry, pin.SE3]], *, reach: float = np.inf
    ) -> float:
        """Return the smallest signed distance to other shapes [m]; see `compute_clearance`."""
        shapes = list(others)
        lower, upper = _compute_world_boxes(shapes)
        # Gaps between the boxes along the axes, shape (others, fixed shapes, 3). The largest is a
        # lower bound of the distance even if it is negative, since a translation by that amount
        # separates the shapes.
        gaps = np.maximum(self._lower - upper[:, None], lower[:, None] - self._upper)
        bounds = gaps.max(axis=2)
        pairs = np.argwhere(bounds < reach)
        order = np.argsort(bounds[tuple(pairs.T)], kind="stable")
        nearest = reach
        for i, k in pairs[order].tolist():
            if bounds[i, k] >= nearest:
                break
            distance = compute_shape_distance(*shapes[i], *self._shapes[k])
            nearest = min(nearest, distance)
        return nearest


def _compute_world_boxes(
    shapes: Sequence[tuple[coal.CollisionGeometry, pin.SE3]],
) -> tuple[Floats, Floats]:
    """Return the corners of the shapes' axis-aligned boxes, shape (n, 3) each [m]."""
    centers = np.empty((len(shapes), 3))
    half_extents = np.empty((len(shapes), 3))
    rotations = np.empty((len(shapes), 3, 3))
    for k, (shape, placement) in enumerate(shapes):
        shape.computeLocalAABB()
        centers[k] = placement.act(np.asarray(shape.aabb_local.center(), float))
        half_extents[k] = _get_half_extents(shape)
        rotations[k] = placement.rotation
    # A box with the half extents h and the rotation R reaches |R| h along the axes of the world.
    extents = np.einsum("nij,nj->ni", np.abs(rotations), half_extents)
    return centers - extents, centers + extents


def compute_shape_distance(
    first: coal.CollisionGeometry,
    first_placement: pin.SE3,
    second: coal.CollisionGeometry,
    second_placement: pin.SE3,
) -> float:
    """Return the signed distance between two shapes at placements in a common frame [m]."""
    first_row, second_row = flatten_placements([first_placement, second_placement])
    distance, _ = compute_distance(
        convert_solid(first), first_row, convert_solid(second), second_row
    )
    return distance


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
        lower, upper = mesh.bounds
        mesh.apply_translation([0.0, 0.0, -(lower[2] + upper[2]) / 2.0])
    else:
        raise InputError(
            "this shape cannot be drawn", expected="a solid or a mesh", got=type(shape).__name__
        )
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def compute_bounding_box(shape: pin.GeometryObject) -> tuple[Floats, Floats]:
    """Return centre and half extents of a shape's bounding box in its own frame, (3,) each [m]."""
    geometry = shape.geometry
    geometry.computeLocalAABB()
    center = np.asarray(geometry.aabb_local.center(), float)
    return center, _get_half_extents(geometry)


def compute_world_box(shape: coal.CollisionGeometry, placement: pin.SE3) -> tuple[Floats, Floats]:
    """Return the corners of a shape's axis-aligned box in the world frame, shape (3,) each [m]."""
    (lower,), (upper,) = _compute_world_boxes([(shape, placement)])
    return lower, upper


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
        self._model = model
        self._configuration = configuration
        self._data = model.createData()
        self._solids = [convert_solid(shape.geometry) for shape in shapes]
        # Placements of the shapes, and bounding spheres and boxes, in the frames of their joints.
        self._joints = np.array([shape.parentJoint for shape in shapes])
        self._placements = [shape.placement for shape in shapes]
        self._rotations = np.array([placement.rotation for placement in self._placements])
        centers = list[Floats]()
        radii = list[float]()
        half_extents = list[Floats]()
        for shape in shapes:
            shape.geometry.computeLocalAABB()
            centers.append(shape.placement.act(shape.geometry.aabb_center))
            radii.append(shape.geometry.aabb_radius)
            half_extents.append(_get_half_extents(shape.geometry))
        self._centers_in_joints = np.array(centers)
        self._radii = np.array(radii)
        self._half_extents = np.array(half_extents)

    def set_configuration(self, z: Floats) -> None:
        """Set the model to the minimal coordinates `z`, shape (n,)."""
        pin.forwardKinematics(self._model, self._data, self._configuration(z))
        joint_placements = self._data.oMi
        rotations = np.array([placement.rotation for placement in joint_placements])[self._joints]
        positions = np.array([placement.translation for placement in joint_placements])[
            self._joints
        ]
        self._centers = np.einsum("kij,kj->ki", rotations, self._centers_in_joints) + positions
        # The last row of a rotation is the vertical of the world in the frame of the joint.
        self._verticals = rotations[:, 2]
        self._placement_rows: dict[int, Floats] = {}

    def compute_lowest_points(self) -> Floats:
        """Return the lowest height of each shape's bounding box, shape (shapes,) [m]."""
        verticals_in_shapes = np.einsum("kj,kji->ki", self._verticals, self._rotations)
        # A box with the half extents h reaches |v| · h below its centre along the unit vector v.
        depths = np.einsum("ki,ki->k", np.abs(verticals_in_shapes), self._half_extents)
        return np.asarray(self._centers[:, 2] - depths)

    def compute_lower_bounds(self, pairs: Ints) -> Floats:
        """Return lower bounds [m], shape (P,), of the distances of `pairs`, by bounding spheres."""
        first = pairs[:, 0]
        second = pairs[:, 1]
        offsets = self._centers[first] - self._centers[second]
        center_distances = np.sqrt(np.einsum("ki,ki->k", offsets, offsets))
        return np.asarray(center_distances - self._radii[first] - self._radii[second])

    def compute_distance(self, parts: Iterable[tuple[int, int]], cutoff: float = np.inf) -> float:
        """Return the smallest distance of pairs of shapes [m].

        If it is larger than `cutoff`, a lower bound larger than `cutoff` is returned.
        """
        smallest = np.inf
        for first, second in parts:
            offset = self._centers[first] - self._centers[second]
            bound = float(np.sqrt(offset @ offset) - self._radii[first] - self._radii[second])
            if bound <= min(smallest, cutoff):
                bound, _ = compute_distance(
                    self._solids[first],
                    self._compute_placement_row(first),
                    self._solids[second],
                    self._compute_placement_row(second),
                )
            smallest = min(smallest, bound)
        return smallest

    def _compute_placement_row(self, shape: int) -> Floats:
        """Return the placement of a shape in the world frame; see `flatten_placements`."""
        if shape not in self._placement_rows:
            joint = int(self._joints[shape])
            placement = self._data.oMi[joint] * self._placements[shape]
            self._placement_rows[shape] = flatten_placements([placement])[0]
        return self._placement_rows[shape]


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
        if all(chosen):
            return
        groups = {}
        for (links, parts), is_chosen in zip(self._groups.items(), chosen, strict=True):
            if is_chosen:
                groups[links] = parts
        self._groups = groups
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
        own = slice(self._starts[number], self._ends[number])
        is_close = self._bounds[own] <= cutoff
        close_pairs = self._pairs[own][is_close]
        return self._distances.compute_distance(map(tuple, close_pairs.tolist()), cutoff)

    def _concatenate_pairs(self) -> None:
        self.links = list(self._groups)
        counts = np.array([len(parts) for parts in self._groups.values()], np.int64)
        self._ends = np.cumsum(counts)
        self._starts = self._ends - counts
        # The empty array gives the shape if there are no pairs.
        self._pairs = np.vstack([np.zeros((0, 2), np.int64), *self._groups.values()])


def _get_half_extents(solid: coal.CollisionGeometry) -> Floats:
    box = solid.aabb_local
    return np.array([box.width(), box.height(), box.depth()]) / 2
