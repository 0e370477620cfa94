"""Whether shapes that ride on the base keep their distance from what stands in the world, all along a drive or a turn.

Turning and driving keep every shape's height, so two shapes whose heights are far apart never meet.
For the others, the plan view bounds the distance from below: along a direction u, they are u·p −
h(u) apart, where p is the place of the base and h adds the support functions of both. One direction
that leaves room during the whole motion is enough. Only for pairs without one is coal asked, and
its normal says how far the motion may go until the next question.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["FAN", "Body", "Shape", "Standing", "hull_points"]

Shape = tuple[coal.CollisionGeometry, pin.SE3]
"""A convex shape and where it is."""

# Towards the neighbours of a cell and those a knight's move away, since bases and walls mostly have
# such sides; and between.
_TOWARDS = np.arctan2([0, 1, 1, 2], [1, 2, 1, 1])
_QUADRANT = np.column_stack([_TOWARDS, (_TOWARDS + np.append(_TOWARDS[1:], np.pi / 2)) / 2]).ravel()
_ANGLES = np.concatenate([_QUADRANT + quarter * np.pi / 2 for quarter in range(4)])
FAN = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Unit vectors along which distances are bounded, in turn, eight to a quadrant from the x axis on, shape (32, 2)."""

_AXES = slice(0, len(FAN), len(FAN) // 4)  # of `FAN`, those along the axes of the world
_RIM = 2 * np.pi * np.arange(16) / 16  # corners that stand for a circle
_CORNERS = np.array(
    list(itertools.product((False, True), repeat=3))
)  # of a box, whether they are its upper ends
_STEP, _ARC = 0.25, 0.13  # [m], [rad]: longer motions are halved before coal is asked
_LONG_ARC = 0.5  # [rad] that one row of bounds may sweep
# [m] that a motion goes on at least before the next question: half of it is how far it may come too
# close
_BLINK = 2e-3
_ROUNDING = 1e-6  # [m] of coal
_KEPT = 512  # tables


class Standing:
    """What stands in the world.

    Attributes:
        shapes: Convex shapes and where they are.
        support: Their support functions along `FAN`, shape (S, 32) [m].
        extent: Of these, along the axes of the world alone, shape (S, 4) [m].
        height: Their lowest and highest z, shape (S, 2) [m].
    """

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self.shapes = [(shape, _transform(placement)) for shape, placement in shapes]
        self.support, self.height = np.empty((len(shapes), len(FAN))), np.empty((len(shapes), 2))
        for s, (shape, placement) in enumerate(shapes):
            points, radius = hull_points(shape, placement, outer=True)
            self.support[s] = (points[:, :2] @ FAN.T).max(axis=0) + radius
            self.height[s] = points[:, 2].min() - radius, points[:, 2].max() + radius
        self.extent = self.support[:, _AXES].copy()


class Body:
    """Shapes that ride on the base together, and the pairs of them and of what stands in the world that share heights.

    Attributes:
        span: How far a place must be from each standing shape that these can hit at no heading;
            -inf: never, shape (S,) [m].
    """

    def __init__(self, shapes: Sequence[Shape], world: Standing, margin: float) -> None:
        self.world, self.margin = world, margin
        self.shapes = [(shape, _transform(placement)) for shape, placement in shapes]
        outlines = [hull_points(shape, placement, outer=True) for shape, placement in shapes]
        radius = np.array([radius for _, radius in outlines])
        low = np.array([points[:, 2].min() for points, _ in outlines]) - radius
        high = np.array([points[:, 2].max() for points, _ in outlines]) + radius
        self.reach = np.array([np.hypot(*points[:, :2].T).max() for points, _ in outlines]) + radius
        apart = np.maximum(low[:, None] - world.height[:, 1], world.height[:, 0] - high[:, None])
        self.moving, self.standing = np.nonzero(apart < margin)
        self.span = np.full(len(world.shapes), -np.inf)
        np.maximum.at(self.span, self.standing, self.reach[self.moving] + margin)
        self._points = (
            np.concatenate([points[:, :2] for points, _ in outlines])
            if outlines
            else np.empty((0, 2))
        )
        self._first = np.concatenate(
            [[0], np.cumsum([len(points) for points, _ in outlines])[:-1]]
        ).astype(int)
        self._radius = radius[:, None]
        self._tables: dict[tuple[float, float], Floats] = {}
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()
        order = np.argsort(self.standing, kind="stable")
        self._of_standing = np.split(
            order, np.searchsorted(self.standing[order], np.arange(1, len(world.shapes)))
        )
        self._margins = np.full(len(world.shapes), margin)

    def driven(self, a: Floats, b: Floats, yaw: float, margins: Floats | None = None) -> bool:
        """Return whether the margins are kept along a straight line; see `BaseGrid.driven`."""
        if not len(self.moving):
            return True
        margins = self._margins if margins is None else margins
        rows = self._close(np.minimum(FAN @ a, FAN @ b))
        return not len(rows) or self._drive(
            a, b, yaw, extents=self._extents(yaw, yaw, rows), rows=rows, margins=margins
        )

    def turned(self, at: Floats, start: float, end: float, margins: Floats | None = None) -> bool:
        """Return whether the margins are kept while turning; see `BaseGrid.turned`."""
        if not len(self.moving):
            return True
        along = FAN @ at
        rows = self._close(along)
        yaws = np.linspace(
            start, end, 1 + max(1, int(np.ceil(abs(end - start) / _LONG_ARC)))
        ).tolist()
        margins = self._margins if margins is None else margins
        return not len(rows) or all(
            self._turn(at, along, p, q, rows=rows, margins=margins)
            for p, q in itertools.pairwise(yaws)
        )

    def leaving(self, at: Floats, yaw: float) -> Floats:
        """Return the margins kept at a pose; see `BaseGrid.leaving`."""
        margins = self._margins.copy()
        for row in self._close(FAN @ at).tolist():
            distance, _ = self._distance(row, at, yaw)
            least = distance - _ROUNDING if distance > 0.0 else -np.inf
            margins[self.standing[row]] = min(margins[self.standing[row]], least)
        return margins

    def _close(self, along: Floats) -> Ints:
        """Return the pairs that may meet where the base's origin is at least `along` in the directions `FAN`, shape (32,) [m]."""
        world = self.world
        near = np.flatnonzero((along[_AXES] - world.extent).max(axis=1) < self.span)
        near = near[(along - world.support[near]).max(axis=1) < self.span[near]]
        return (
            np.sort(np.concatenate([self._of_standing[s] for s in near.tolist()]))
            if len(near)
            else near
        )

    def _extents(self, start: float, end: float, rows: Ints) -> Floats:
        """Return by how much pairs extend against the directions `FAN` while the base turns, at most: shape (n, 32) [m]."""
        moving = self.moving[rows]
        extents = self._table(start, end)[moving] + self.world.support[self.standing[rows]]
        return (
            extents
            if start == end
            else extents + (self.reach * (1.0 - np.cos((end - start) / 4)))[moving, None]
        )

    def _table(self, start: float, end: float) -> Floats:
        """Return by how much each shape extends against `FAN` at both yaws and half-way, at most: shape (M, 32) [m]."""
        key = (start, end)
        if key not in self._tables:
            if start == end:
                cosine, sine = np.cos(start), np.sin(start)
                turned = FAN @ np.array(
                    [[-cosine, sine], [-sine, -cosine]]
                )  # against u, in the base's frame
                table = (
                    np.maximum.reduceat(self._points @ turned.T, self._first, axis=0) + self._radius
                )
            else:
                middle = (start + end) / 2
                table = np.maximum(self._table(start, start), self._table(end, end))
                table = np.maximum(table, self._table(middle, middle))
            if len(self._tables) >= _KEPT:
                self._tables.clear()
            self._tables[key] = table
        return self._tables[key]

    def _drive(
        self, a: Floats, b: Floats, yaw: float, *, extents: Floats, rows: Ints, margins: Floats
    ) -> bool:
        """Return whether pairs (`rows`) keep their margins along a line; `extents` as from `_extents`."""
        near = (np.minimum(FAN @ a, FAN @ b) - extents).max(axis=1) < margins[self.standing[rows]]
        rows, extents = rows[near], extents[near]
        if not len(rows):
            return True
        length = float(np.hypot(*(b - a)))
        if length > _STEP:
            ends = itertools.pairwise((a, (a + b) / 2, b))
            return all(
                self._drive(*half, yaw, extents=extents, rows=rows, margins=margins)
                for half in ends
            )
        direction = (b - a) / max(length, 1e-12)

        def closing(row: int, at: float) -> tuple[float, float]:
            room, normal = self._distance(row, a + at * direction, yaw)
            return room, float(direction @ normal)

        return all(self._keeps(row, closing, length, _BLINK, margins) for row in rows.tolist())

    def _turn(
        self, at: Floats, along: Floats, start: float, end: float, *, rows: Ints, margins: Floats
    ) -> bool:
        """Return whether pairs (`rows`) keep their margins during a turn at a place, that is `along` in the directions `FAN`."""
        gaps = (along - self._extents(start, end, rows)).max(axis=1)
        rows = rows[gaps < margins[self.standing[rows]]]
        if not len(rows):
            return True
        angle = abs(end - start)
        if angle > _ARC:
            ends = itertools.pairwise((start, (start + end) / 2, end))
            return all(self._turn(at, along, *half, rows=rows, margins=margins) for half in ends)

        def closing(row: int, turned: float) -> tuple[float, float]:
            room, normal = self._distance(row, at, start + np.copysign(turned, end - start))
            return room, float(self.reach[self.moving[row]] * np.hypot(*normal))

        return all(
            self._keeps(row, closing, angle, _BLINK / self.reach[self.moving[row]], margins)
            for row in rows.tolist()
        )

    def _keeps(
        self,
        row: int,
        closing: Callable[[int, float], tuple[float, float]],
        end: float,
        blink: float,
        margins: Floats,
    ) -> bool:
        """Return whether a pair keeps its margin up to `end`; `closing` says how far it is and at most how fast it comes closer.

        The plane between two convex shapes goes on separating them until one has moved through it.
        """
        at, margin = 0.0, margins[self.standing[row]]
        while True:
            room, speed = closing(row, at)
            if room < margin:
                return False
            sure = (room - margin) / max(speed, 1e-9)
            if at >= end or at + sure >= end:
                return True
            at = min(at + max(sure, blink), end)

    def _distance(self, row: int, at: Floats, yaw: float) -> tuple[float, Floats]:
        """Return coal's distance [m] of a pair with the base at a pose, and the normal towards what stands, in the plane."""
        shape, placement = self.shapes[self.moving[row]]
        other, where = self.world.shapes[self.standing[row]]
        cosine, sine = math.cos(yaw), math.sin(yaw)
        turned = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        self._result.clear()
        there = coal.Transform3s(turned, np.array([at[0], at[1], 0.0])) * placement
        distance = coal.distance(shape, there, other, where, self._request, self._result)
        return distance, self._result.normal[:2].copy()


def _transform(placement: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(placement.rotation, placement.translation)


def hull_points(
    shape: coal.CollisionGeometry, placement: pin.SE3, *, outer: bool
) -> tuple[Floats, float]:
    """Return points, shape (n, 3) [m], and a radius around them: their hull contains a shape or, if not `outer`, is inside it."""
    rim = np.column_stack([np.cos(_RIM), np.sin(_RIM), np.zeros(len(_RIM))]) / (
        np.cos(_RIM[1] / 2) if outer else 1.0
    )
    radius = shape.getSweptSphereRadius() if outer else 0.0
    if isinstance(shape, coal.Cylinder | coal.Cone):
        top = np.array([0.0, 0.0, shape.halfLength])
        points = np.concatenate(
            [
                shape.radius * rim - top,
                shape.radius * rim + top if isinstance(shape, coal.Cylinder) else top[None],
            ]
        )
    elif isinstance(shape, coal.Sphere | coal.Capsule):
        top = np.array([0.0, 0.0, shape.halfLength if isinstance(shape, coal.Capsule) else 0.0])
        balls = (
            np.zeros((1, 3))
            if outer
            else shape.radius * np.concatenate([rim, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
        )
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
