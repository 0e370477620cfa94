"""How far a world's shapes are from each other at one configuration, and how far they move along a motion, at most.

There are lower bounds of distances from boxes, and coal's own. Nothing of it is the planner's, so that what its culling
overlooked would be found here.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats, Ints
from vkc_pin.models.shapes import bounding_box
from vkc_pin.motion.world import World

__all__ = ["Placed", "Solids", "travelled"]

POINT = 1e-4  # [m], radius of a point


class Solids:
    """The collision shapes of a world.

    Attributes:
        world: The world, with G shapes.
        bodies: How many of these, the first, belong to the robot or an object; the others are obstacles.
        center, half: Of a box around each in its own frame, centre and half extents, shape (G, 3) [m].
        obstacle_corners, obstacle_transforms: See `corners`, and where they are, for coal.
    """

    def __init__(self, world: World) -> None:
        self.world, self.bodies = world, len(world.bodies.geometryObjects)
        boxes = [bounding_box(shape) for shape in world.shapes]
        self.center = np.array([center for center, _ in boxes]).reshape(-1, 3)
        self.half = np.array([half for _, half in boxes]).reshape(-1, 3)
        obstacles = slice(self.bodies, None)
        self.obstacle_corners = self.corners([shape.placement for shape in world.shapes[obstacles]], obstacles)
        self.obstacle_transforms = [_transform(shape.placement) for shape in world.shapes[obstacles]]
        self._geometries = [shape.geometry for shape in world.shapes]
        self._data = world.model.createData()
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()

    def at(self, q: Floats) -> Placed:
        """Return the shapes as they are placed at Pinocchio's configuration `q` of the world."""
        placed = pin.GeometryData(self.world.bodies)
        pin.updateGeometryPlacements(self.world.model, self._data, self.world.bodies, placed, q)
        return Placed(self, placed)

    def corners(self, where: Sequence[pin.SE3], which: slice) -> tuple[Floats, Floats]:
        """Return lower and upper corners of boxes along the world's axes around some shapes, shape (k, 3) each [m].

        Args:
            where: Placements of these shapes in the world.
            which: The shapes.
        """
        rotation = np.array([placement.rotation for placement in where]).reshape(-1, 3, 3)
        translation = np.array([placement.translation for placement in where]).reshape(-1, 3)
        middle = (rotation @ self.center[which, :, None])[..., 0] + translation
        extent = (np.abs(rotation) @ self.half[which, :, None])[..., 0]
        return middle - extent, middle + extent

    def distance(
        self, first: int | coal.CollisionGeometry, here: coal.Transform3s, second: int, there: coal.Transform3s
    ) -> float:
        """Return coal's signed distance [m] of two shapes, or of any other and a shape, placed `here` and `there` in the world.

        Nothing is kept from one distance to the next, which would change its last digits.
        """
        self._result.clear()
        one = self._geometries[first] if isinstance(first, int) else first
        return float(coal.distance(one, here, self._geometries[second], there, self._request, self._result))


class Placed:
    """The shapes at one configuration.

    Args:
        solids: The shapes.
        placed: Where those of robot and objects are in the world.
    """

    def __init__(self, solids: Solids, placed: pin.GeometryData) -> None:
        self._solids, self._where = solids, placed.oMg
        self._transforms: dict[int, coal.Transform3s] = {}
        self._known: dict[tuple[int, int], float] = {}

    @cached_property
    def corners(self) -> tuple[Floats, Floats]:
        """Lower and upper corners of boxes along the world's axes around all shapes, shape (G, 3) each [m]."""
        bodies = self._solids.corners(list(self._where), slice(self._solids.bodies))
        lower, upper = (np.concatenate(parts) for parts in zip(bodies, self._solids.obstacle_corners, strict=True))
        return lower, upper

    def bounds(self, pairs: Ints) -> Floats:
        """Return lower bounds of the distances of pairs, shape (n, 2), shape (n,) [m]; -inf where the boxes overlap."""
        lower, upper = self.corners
        first, second = pairs.T
        gaps = np.maximum(lower[second] - upper[first], lower[first] - upper[second])
        outside = np.maximum(gaps, 0.0)
        return np.where(gaps.max(axis=1) > 0.0, np.sqrt(np.einsum("ni,ni->n", outside, outside)), -np.inf)

    def distance(self, first: int, second: int) -> float:
        """Return coal's signed distance of two shapes [m]."""
        if (first, second) not in self._known:
            here, there = self._transform(first), self._transform(second)
            self._known[first, second] = self._solids.distance(first, here, second, there)
        return self._known[first, second]

    def distances(self, pairs: Ints) -> Floats:
        """Return coal's signed distances of pairs, shape (n, 2), shape (n,) [m]."""
        return np.array([self.distance(first, second) for first, second in pairs.tolist()], float)

    def nearest(self, pairs: Ints) -> tuple[int, float]:
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

    def around(self, point: Floats, reach: float) -> list[int]:
        """Return the shapes that are closer than `reach` [m] to a point, shape (3,) [m]; a point has a size here, 0.1 mm."""
        lower, upper = self.corners
        near = np.flatnonzero(((lower - point < reach + POINT) & (point - upper < reach + POINT)).all(axis=1)).tolist()
        ball, here = coal.Sphere(POINT), coal.Transform3s(np.eye(3), point)
        return [i for i in near if self._solids.distance(ball, here, i, self._transform(i)) < reach]

    def _transform(self, shape: int) -> coal.Transform3s:
        if shape >= self._solids.bodies:
            return self._solids.obstacle_transforms[shape - self._solids.bodies]
        if shape not in self._transforms:
            self._transforms[shape] = _transform(self._where[shape])
        return self._transforms[shape]


def _transform(placement: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(placement.rotation, placement.translation)


def travelled(solids: Solids, samples: Floats) -> Floats:
    """Return how far any point of each shape can have moved since the first sample, shape (S, G) [m].

    A joint's rotation moves a point by at most the angle times its distance from the axis, and that is at most the sum of the
    offsets of all joints between, and of the shape itself; a prismatic joint adds its travel.

    Args:
        solids: The shapes, G of them.
        samples: Configurations of their world, one after the other, shape (S, n).
    """
    world = solids.world
    model, steps = world.model, np.abs(np.diff(samples, axis=0))
    spans = np.linalg.norm(steps[:, :2], axis=1)
    offset = [float(np.linalg.norm(placement.translation)) for placement in model.jointPlacements]
    of_joint: dict[int, list[int]] = {}
    for index, joint in enumerate(world.coordinates.joints):
        of_joint.setdefault(joint, []).append(index)
    prismatic = {j: model.joints[j].shortname().startswith("JointModelP") and j > 1 for j in of_joint}
    found = np.zeros((len(samples), len(world.shapes)))
    for g, shape in enumerate(world.shapes[: solids.bodies]):
        reach = float(np.linalg.norm(solids.half[g])) + float(np.linalg.norm(shape.placement.act(solids.center[g])))
        joint, moved = shape.parentJoint, np.zeros(len(steps))
        while joint:
            columns = of_joint[joint]
            if len(columns) == 7:  # the free joint of what can be carried
                moved += _free(samples[:, columns], reach)
            elif len(columns) == 3:  # the planar base
                moved += spans + steps[:, columns[2]] * reach
            elif prismatic[joint]:
                moved += steps[:, columns[0]]
                reach += float(np.abs(samples[:, columns[0]]).max())
            else:
                moved += steps[:, columns[0]] * reach
            reach += offset[joint]
            joint = model.parents[joint]
        np.cumsum(moved, out=found[1:, g])
    return found


def _free(samples: Floats, reach: float) -> Floats:
    """Return how far a point at `reach` [m] from a free joint moves from each sample to the next, shape (S − 1,) [m]."""
    turns = samples[:, 3:] / np.linalg.norm(samples[:, 3:], axis=1, keepdims=True)
    half = np.arccos(np.clip(np.abs(np.einsum("kc,kc->k", turns[1:], turns[:-1])), 0.0, 1.0))
    return np.asarray(np.linalg.norm(np.diff(samples[:, :3], axis=0), axis=1) + 2.0 * half * reach)
