"""How far a world's shapes are from each other at one configuration: lower bounds from boxes, and coal's own distances.

Nothing of it is the planner's, so that what its culling overlooked would be found here.
"""

from __future__ import annotations

from functools import cached_property

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.geometry import bounding_box
from vkc_pin.world import World

__all__ = ["Placed", "Solids"]


POINT = 1e-4  # [m], radius of a point


class Solids:
    """The collision shapes of a world.

    Attributes:
        world: The world.
        shapes: Its shapes, G of them.
        bodies: How many of these, the first, belong to the robot or an object; the others are obstacles.
        center, half: Of a box around each in its own frame, centre and half extents, shape (G, 3) [m].
    """

    def __init__(self, world: World) -> None:
        self.world, self.shapes = world, world.shapes
        self.bodies = len(world.bodies.geometryObjects)
        boxes = [bounding_box(shape) for shape in self.shapes]
        self.center = np.array([center for center, _ in boxes]).reshape(-1, 3)
        self.half = np.array([half for _, half in boxes]).reshape(-1, 3)
        self.data = world.model.createData()
        obstacles = self.shapes[self.bodies :]
        self._transforms: dict[int, coal.Transform3s] = {}
        self.request = coal.DistanceRequest()
        self._corners = self.corners([shape.placement for shape in obstacles], slice(self.bodies, None))

    def at(self, q: NDArray[np.float64]) -> Placed:
        """Return the shapes as they are placed at Pinocchio's configuration `q` of the world."""
        return Placed(self, q)

    def corners(self, placements: list[pin.SE3], which: slice) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of boxes along the world's axes around shapes at `placements`, lower and upper, shape (n, 3) [m]."""
        rotation = np.array([placement.rotation for placement in placements]).reshape(-1, 3, 3)
        translation = np.array([placement.translation for placement in placements]).reshape(-1, 3)
        middle = (rotation @ self.center[which, :, None])[..., 0] + translation
        extent = (np.abs(rotation) @ self.half[which, :, None])[..., 0]
        return middle - extent, middle + extent


class Placed:
    """The shapes at one configuration.

    Attributes:
        where: Placement of each shape of robot and objects in the world.
    """

    def __init__(self, solids: Solids, q: NDArray[np.float64]) -> None:
        self._solids = solids
        world, self._shapes = solids.world, pin.GeometryData(solids.world.bodies)
        pin.updateGeometryPlacements(world.model, solids.data, world.bodies, self._shapes, q)
        self.where = self._shapes.oMg
        self._transforms: dict[int, coal.Transform3s] = {}
        self._known: dict[tuple[int, int], float] = {}

    @cached_property
    def corners(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corners of boxes along the world's axes around all shapes, shape (G, 3) each [m]."""
        bodies = self._solids.corners(list(self.where), slice(self._solids.bodies))
        lower, upper = (np.concatenate(parts) for parts in zip(bodies, self._solids._corners, strict=True))
        return lower, upper

    def bounds(self, pairs: NDArray[np.int_]) -> NDArray[np.float64]:
        """Return lower bounds of the distances of pairs, shape (n, 2), shape (n,) [m]; -inf where the boxes overlap."""
        lower, upper = self.corners
        first, second = pairs.T
        gaps = np.maximum(lower[second] - upper[first], lower[first] - upper[second])
        outside = np.maximum(gaps, 0.0)
        return np.where(gaps.max(axis=1) > 0.0, np.sqrt(np.einsum("ni,ni->n", outside, outside)), -np.inf)

    def distance(self, first: int, second: int) -> float:
        """Return coal's signed distance of two shapes [m]."""
        key = (first, second)
        if key not in self._known:
            one, other = (self._solids.shapes[i].geometry for i in key)
            result = coal.DistanceResult()  # nothing is kept from one distance to the next, which would change its last digits
            coal.distance(one, self._transform(first), other, self._transform(second), self._solids.request, result)
            self._known[key] = float(result.min_distance)
        return self._known[key]

    def distances(self, pairs: NDArray[np.int_]) -> NDArray[np.float64]:
        """Return coal's signed distances of pairs, shape (n, 2), shape (n,) [m]."""
        return np.array([self.distance(first, second) for first, second in pairs.tolist()], float)

    def nearest(self, pairs: NDArray[np.int_]) -> tuple[int, float]:
        """Return which of pairs, shape (n, 2), is nearest, and its distance [m]; only what may be is asked of coal."""
        bounds = self.bounds(pairs)
        best, least = -1, np.inf
        for k in np.argsort(bounds, kind="stable").tolist():
            if bounds[k] >= least:
                break
            distance = self.distance(*pairs[k].tolist())
            if distance < least:
                best, least = k, distance
        return best, least

    def around(self, point: NDArray[np.float64], reach: float) -> list[int]:
        """Return the shapes that are closer than `reach` [m] to a point, shape (3,) [m]; a point has a size here, 0.1 mm."""
        lower, upper = self.corners
        near = np.flatnonzero(((lower - point < reach + POINT) & (point - upper < reach + POINT)).all(axis=1)).tolist()
        ball, there = coal.Sphere(POINT), coal.Transform3s(np.eye(3), point)
        request = self._solids.request
        return [
            i
            for i in near
            if coal.distance(ball, there, self._solids.shapes[i].geometry, self._transform(i), request, coal.DistanceResult())
            < reach
        ]

    def _transform(self, shape: int) -> coal.Transform3s:
        moves = shape < self._solids.bodies
        known = self._transforms if moves else self._solids._transforms
        if shape not in known:
            where = self.where[shape] if moves else self._solids.shapes[shape].placement
            known[shape] = coal.Transform3s(where.rotation, where.translation)
        return known[shape]
