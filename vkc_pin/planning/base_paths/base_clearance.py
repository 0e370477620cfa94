"""Checks whether shapes on the base keep their margins along a straight drive or a turn in place.

Shapes at different heights never meet. For the others, support functions of the plan view bound the
distance from below; one direction that separates them during the whole motion is sufficient. Only
pairs without one need coal, by conservative advancement.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.distances import compute_distance
from vkc_pin.world.collision.point_cloud import PointCloud
from vkc_pin.world.collision.solids import convert_solid, flatten_placements

Shape = tuple[coal.CollisionGeometry, pin.SE3]
"""A convex shape and its placement."""

# Towards the neighbours of a cell and the cells a knight's move away, since bases and walls mostly
# have such sides; and between these.
_TOWARDS = np.arctan2([0, 1, 1, 2], [1, 2, 1, 1])
_QUADRANT = np.column_stack([_TOWARDS, (_TOWARDS + np.append(_TOWARDS[1:], np.pi / 2)) / 2]).ravel()
_ANGLES = np.concatenate([_QUADRANT + quarter * np.pi / 2 for quarter in range(4)])
DIRECTIONS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Unit vectors along which distances are bounded, eight per quadrant from x on, shape (32, 2)."""

_AXES = slice(0, len(DIRECTIONS), len(DIRECTIONS) // 4)  # those of `DIRECTIONS` along world axes
_RIM_ANGLES = 2 * np.pi * np.arange(16) / 16  # corners that approximate a circle
_CORNERS = np.array(list(itertools.product((False, True), repeat=3)))  # of a box: upper ends or not
# lengths of motions above which they are halved before coal is called
_STEP = 0.25  # [m]
_ARC = 0.13  # [rad]
_LONG_ARC = 0.5  # [rad] of turning that one row of bounds may cover
# [m] minimum advance between distance queries: half of it is the largest undetected violation
_MIN_ADVANCE = 2e-3
_ROUNDING = 1e-6  # [m] rounding error of coal
_CACHE_SIZE = 512  # tables


class Obstacles:
    """Obstacles in the world.

    Attributes:
        solids: Results of `convert_solid`, and placements, shape (12,) each.
        support: Support functions along `DIRECTIONS`, shape (S, 32) [m].
        extent: Support functions along the world axes, shape (S, 4) [m].
        height: Lowest and highest z, shape (S, 2) [m].
    """

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self.solids = [
            (convert_solid(shape), flatten_placements([placement])[0])
            for shape, placement in shapes
        ]
        self.support = np.empty((len(shapes), len(DIRECTIONS)))
        self.height = np.empty((len(shapes), 2))
        for s, (shape, placement) in enumerate(shapes):
            points, radius = compute_hull_points(shape, placement, outer=True)
            self.support[s] = (points[:, :2] @ DIRECTIONS.T).max(axis=0) + radius
            z = points[:, 2]
            self.height[s] = (z.min() - radius, z.max() + radius)
        self.extent = self.support[:, _AXES].copy()


class MovingShapes:
    """Shapes that move with the base, and their pairs with obstacles at the same height.

    Attributes:
        solids: Results of `convert_solid`, and placements on the base.
        exclusion_radius: Distance from each obstacle beyond which no heading collides with it;
            -inf if no shape shares its height, shape (S,) [m].
    """

    def __init__(self, shapes: Sequence[Shape], world: Obstacles, margin: float) -> None:
        self.world = world
        self.margin = margin
        self.solids = [(convert_solid(shape), placement) for shape, placement in shapes]
        hulls = [compute_hull_points(shape, placement, outer=True) for shape, placement in shapes]
        points_of_shapes = [points for points, _ in hulls]
        radius = np.array([radius for _, radius in hulls])
        low = np.array([points[:, 2].min() for points in points_of_shapes]) - radius
        high = np.array([points[:, 2].max() for points in points_of_shapes]) + radius
        distances = [np.hypot(points[:, 0], points[:, 1]) for points in points_of_shapes]
        self.reach = np.array([from_axis.max() for from_axis in distances]) + radius
        # Pairs of shapes and obstacles at the same height.
        gaps = np.maximum(low[:, None] - world.height[:, 1], world.height[:, 0] - high[:, None])
        self.moving, self.obstacle = np.nonzero(gaps < margin)
        self.exclusion_radius = np.full(len(world.solids), -np.inf)
        np.maximum.at(self.exclusion_radius, self.obstacle, self.reach[self.moving] + margin)
        plan_views = [points[:, :2] for points in points_of_shapes]
        self._points = np.concatenate([np.empty((0, 2)), *plan_views])
        counts = [len(points) for points in points_of_shapes]
        self._first_point = np.cumsum([0, *counts])[:-1]
        self._radius = radius[:, None]
        self._tables: dict[tuple[float, float], Floats] = {}
        order = np.argsort(self.obstacle, kind="stable")
        edges = np.searchsorted(self.obstacle[order], np.arange(1, len(world.solids)))
        self._pairs_by_obstacle = np.split(order, edges)
        self._margins = np.full(len(world.solids), margin)

    def is_drive_free(
        self, a: Floats, b: Floats, yaw: float, margins: Floats | None = None
    ) -> bool:
        """Return whether the margins are kept along a line; see `BaseGrid.is_drive_free`."""
        if not len(self.moving):
            return True
        rows = self._find_close_pairs(np.minimum(DIRECTIONS @ a, DIRECTIONS @ b))
        if not len(rows):
            return True
        margins = self._margins if margins is None else margins
        extents = self._compute_extents(yaw, yaw, rows)
        return self._check_drive(a, b, yaw, extents=extents, rows=rows, margins=margins)

    def is_turn_free(
        self, at: Floats, start: float, end: float, margins: Floats | None = None
    ) -> bool:
        """Return whether the margins are kept while turning; see `BaseGrid.is_turn_free`."""
        if not len(self.moving):
            return True
        along = DIRECTIONS @ at
        rows = self._find_close_pairs(along)
        if not len(rows):
            return True
        margins = self._margins if margins is None else margins
        parts = max(1, int(np.ceil(abs(end - start) / _LONG_ARC)))
        yaws = np.linspace(start, end, 1 + parts).tolist()
        for before, after in itertools.pairwise(yaws):
            if not self._check_turn(at, along, before, after, rows=rows, margins=margins):
                return False
        return True

    def compute_exit_margins(self, at: Floats, yaw: float) -> Floats:
        """Return the margins that hold at a pose; see `BaseGrid.compute_exit_margins`."""
        margins = self._margins.copy()
        for row in self._find_close_pairs(DIRECTIONS @ at).tolist():
            distance, _ = self._compute_distance(row, at, yaw)
            largest = distance - _ROUNDING if distance > 0.0 else -np.inf
            obstacle = self.obstacle[row]
            margins[obstacle] = min(margins[obstacle], largest)
        return margins

    def _find_close_pairs(self, along: Floats) -> Ints:
        """Return pairs that may collide, given lower bounds of the base position, (32,) [m]."""
        world = self.world
        near = np.flatnonzero((along[_AXES] - world.extent).max(axis=1) < self.exclusion_radius)
        near = near[(along - world.support[near]).max(axis=1) < self.exclusion_radius[near]]
        if not len(near):
            return near
        return np.sort(np.concatenate([self._pairs_by_obstacle[s] for s in near.tolist()]))

    def _compute_extents(self, start: float, end: float, rows: Ints) -> Floats:
        """Return upper bounds of the extents of pairs against `DIRECTIONS`, shape (n, 32) [m].

        While turning from yaw `start` to `end` the extent of a shape exceeds that at the nearest of
        both ends and the middle, at most a quarter of the turn away, by no more than its reach
        times 1 − cos of that quarter.
        """
        moving = self.moving[rows]
        support = self.world.support[self.obstacle[rows]]
        extents = self._get_extent_table(start, end)[moving] + support
        if start == end:
            return extents
        growth = self.reach * (1.0 - np.cos((end - start) / 4))
        return extents + growth[moving, None]

    def _get_extent_table(self, start: float, end: float) -> Floats:
        """Return upper bounds of the shapes' extents between two yaws, shape (M, 32) [m]."""
        key = (start, end)
        if key not in self._tables:
            if start == end:
                cosine = np.cos(start)
                sine = np.sin(start)
                # −u for each direction u, in the base's frame
                turned = DIRECTIONS @ np.array([[-cosine, sine], [-sine, -cosine]])
                along = self._points @ turned.T
                table = np.maximum.reduceat(along, self._first_point, axis=0) + self._radius
            else:
                yaws = (start, end, (start + end) / 2)
                table = np.maximum.reduce([self._get_extent_table(yaw, yaw) for yaw in yaws])
            if len(self._tables) >= _CACHE_SIZE:
                self._tables.clear()
            self._tables[key] = table
        return self._tables[key]

    def _check_drive(
        self, a: Floats, b: Floats, yaw: float, *, extents: Floats, rows: Ints, margins: Floats
    ) -> bool:
        """Return whether pairs `rows` keep their margins along a line, given their extents.

        Along a unit vector u, a shape at the base position p is at least u·p − e away from its
        obstacle, with the extent e of the pair; on a line this is least at one of its ends.
        """
        gaps = (np.minimum(DIRECTIONS @ a, DIRECTIONS @ b) - extents).max(axis=1)
        is_near = gaps < margins[self.obstacle[rows]]
        rows = rows[is_near]
        extents = extents[is_near]
        if not len(rows):
            return True
        length = float(np.hypot(*(b - a)))
        if length > _STEP:
            middle = (a + b) / 2
            for begin, end in ((a, middle), (middle, b)):
                if not self._check_drive(
                    begin, end, yaw, extents=extents, rows=rows, margins=margins
                ):
                    return False
            return True
        direction = (b - a) / max(length, 1e-12)

        def query(row: int, at: float) -> tuple[float, float]:
            distance, normal = self._compute_distance(row, a + at * direction, yaw)
            return distance, float(direction @ normal)

        return all(
            self._keeps_margin(row, query, length, _MIN_ADVANCE, margins) for row in rows.tolist()
        )

    def _check_turn(
        self, at: Floats, along: Floats, start: float, end: float, *, rows: Ints, margins: Floats
    ) -> bool:
        """Return whether pairs `rows` keep their margins during a turn, given `DIRECTIONS` @ at."""
        gaps = (along - self._compute_extents(start, end, rows)).max(axis=1)
        rows = rows[gaps < margins[self.obstacle[rows]]]
        if not len(rows):
            return True
        angle = abs(end - start)
        if angle > _ARC:
            middle = (start + end) / 2
            for before, after in ((start, middle), (middle, end)):
                if not self._check_turn(at, along, before, after, rows=rows, margins=margins):
                    return False
            return True

        def query(row: int, turned: float) -> tuple[float, float]:
            yaw = start + np.copysign(turned, end - start)
            distance, normal = self._compute_distance(row, at, yaw)
            return distance, float(self.reach[self.moving[row]] * np.hypot(*normal))

        advances = _MIN_ADVANCE / self.reach[self.moving[rows]]
        return all(
            self._keeps_margin(row, query, angle, advance, margins)
            for row, advance in zip(rows.tolist(), advances, strict=True)
        )

    def _keeps_margin(
        self,
        row: int,
        query: Callable[[int, float], tuple[float, float]],
        end: float,
        advance: float,
        margins: Floats,
    ) -> bool:
        """Return whether a pair keeps its margin, by conservative advancement.

        A pair at a distance d from which it closes at no more than the speed v keeps its margin m
        for another (d − m)/v. `query` returns d [m] and v at some progress.
        """
        at = 0.0
        margin = margins[self.obstacle[row]]
        while True:
            distance, speed = query(row, at)
            if distance < margin:
                return False
            certain_advance = (distance - margin) / max(speed, 1e-9)
            if at >= end or at + certain_advance >= end:
                return True
            at = min(at + max(certain_advance, advance), end)

    def _compute_distance(self, row: int, at: Floats, yaw: float) -> tuple[float, Floats]:
        """Return the distance of a pair at a base pose [m], and its normal in the plane, (2,)."""
        solid, placement = self.solids[self.moving[row]]
        cosine = math.cos(yaw)
        sine = math.sin(yaw)
        turned = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        moved = pin.SE3(turned, np.array([at[0], at[1], 0.0])) * placement
        where = flatten_placements([moved])[0]
        obstacle, obstacle_placement = self.world.solids[self.obstacle[row]]
        distance, normal = compute_distance(solid, where, obstacle, obstacle_placement)
        return distance, normal[:2]


def compute_hull_points(
    shape: coal.CollisionGeometry, placement: pin.SE3, *, outer: bool
) -> tuple[Floats, float]:
    """Return points, shape (n, 3), and a radius around them that bound a convex shape [m].

    `outer`: their hull contains the shape; otherwise it is inside.
    """
    rim = np.column_stack([np.cos(_RIM_ANGLES), np.sin(_RIM_ANGLES), 0.0 * _RIM_ANGLES])
    rim = rim / (np.cos(_RIM_ANGLES[1] / 2) if outer else 1.0)
    radius = shape.getSweptSphereRadius() if outer else 0.0
    if isinstance(shape, PointCloud) and not outer:
        points = np.empty((0, 3))  # no convex part is worth the search
    elif isinstance(shape, coal.Cylinder | coal.Cone):
        top = np.array([0.0, 0.0, shape.halfLength])
        upper = shape.radius * rim + top if isinstance(shape, coal.Cylinder) else top[None]
        points = np.concatenate([shape.radius * rim - top, upper])
    elif isinstance(shape, coal.Sphere | coal.Capsule):
        top = np.array([0.0, 0.0, shape.halfLength if isinstance(shape, coal.Capsule) else 0.0])
        poles = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
        balls = np.zeros((1, 3)) if outer else shape.radius * np.concatenate([rim, poles])
        points = np.concatenate([balls - top, balls + top])
        radius += shape.radius if outer else 0.0
    elif isinstance(shape, coal.ConvexBase):
        points = np.asarray(shape.points())
    elif isinstance(shape, coal.Box) or outer:
        shape.computeLocalAABB()
        box = shape.aabb_local
        points = np.where(_CORNERS, box.max_, box.min_)
    else:
        points = np.empty((0, 3))
    return points @ placement.rotation.T + placement.translation, radius
