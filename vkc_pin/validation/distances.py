"""Computes distances of a world's shapes, and bounds their displacements along a motion.

Lower bounds of distances come from bounding boxes, exact distances from coal. Nothing is shared
with the planner's culling, so that its errors would be found here.
"""

from __future__ import annotations

from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.boxes import WorldBoxes
from vkc_pin.world.collision.distances import Shapes
from vkc_pin.world.collision.solids import ShapePlacements, flatten_placements
from vkc_pin.world.models.coordinates import MovedJoint
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance
from vkc_pin.world.trajectory.world_model import World

POINT_RADIUS = 1e-4  # radius of the sphere that stands for a point [m]


class CollisionShapes:
    """The G collision shapes of a world, with their bounding boxes.

    The first `body_count` belong to the robot or an object; the others are obstacles. `center` and
    `half`, shape (G, 3) [m], are the boxes in the shapes' own frames.
    """

    def __init__(self, world: World) -> None:
        self.world, self.body_count = world, len(world.bodies.geometryObjects)
        boxes = [compute_bounding_box(shape) for shape in world.shapes]
        self.center = np.array([center for center, _ in boxes]).reshape(-1, 3)
        self.half = np.array([half for _, half in boxes]).reshape(-1, 3)
        obstacles = slice(self.body_count, None)
        where = [shape.placement for shape in world.shapes[obstacles]]
        self.distance_queries = Shapes([shape.geometry for shape in world.shapes], where)
        self.obstacle_corners = self.compute_corners(flatten_placements(where), obstacles)
        self._placements = ShapePlacements(world.model, world.bodies)

    def place(self, q: Floats) -> PlacedShapes:
        """Place the shapes at Pinocchio's configurations of the world, shape (W, nq)."""
        return PlacedShapes(self, self._placements.compute_placements(q))

    def compute_corners(self, where: Floats, which: slice) -> tuple[Floats, Floats]:
        """Compute lower and upper corners of axis-aligned boxes, shape (..., k, 3) each [m].

        `where` are the shapes' placements in the world, shape (..., k, 12).
        """
        rotation = where[..., :9].reshape(*where.shape[:-1], 3, 3).swapaxes(-1, -2)
        middle = np.einsum("...ij,...j->...i", rotation, self.center[which]) + where[..., 9:]
        extent = np.einsum("...ij,...j->...i", np.abs(rotation), self.half[which])
        return middle - extent, middle + extent


class PlacedShapes:
    """The shapes at W configurations, with the bodies' placements `where`, shape (W, M, 12)."""

    def __init__(self, solids: CollisionShapes, where: Floats) -> None:
        self._solids, self._where = solids, where

    @cached_property
    def corners(self) -> tuple[Floats, Floats]:
        """Lower and upper corners of all axis-aligned boxes, shape (W, G, 3) each [m]."""
        bodies = self._solids.compute_corners(self._where, slice(self._solids.body_count))
        obstacles = (
            np.broadcast_to(part, (len(self._where), *part.shape))
            for part in self._solids.obstacle_corners
        )
        lower, upper = (
            np.concatenate(parts, axis=1) for parts in zip(bodies, obstacles, strict=True)
        )
        return lower, upper

    @cached_property
    def boxes(self) -> WorldBoxes:
        """The axis-aligned boxes, prepared for proximity queries."""
        return WorldBoxes(
            *self._solids.compute_corners(self._where, slice(self._solids.body_count)),
            *self._solids.obstacle_corners,
        )

    def __len__(self) -> int:
        """Return W."""
        return len(self._where)

    def compute_lower_bounds(self, states: Ints, pairs: Ints) -> Floats:
        """Compute lower bounds of distances of pairs, shape (n, 2), at states, shape (n,) [m].

        They are -inf where the boxes overlap.
        """
        lower, upper = self.corners
        first, second = pairs.T
        gaps = np.maximum(
            lower[states, second] - upper[states, first],
            lower[states, first] - upper[states, second],
        )
        outside = np.maximum(gaps, 0.0)
        return np.where(
            gaps.max(axis=1) > 0.0, np.sqrt(np.einsum("ni,ni->n", outside, outside)), -np.inf
        )

    def compute_distances(self, states: Ints, pairs: Ints) -> Floats:
        """Compute signed distances [m] of pairs, shape (n, 2), at states, shape (n,)."""
        return self._solids.distance_queries.compute_distances(self._where, states, pairs)

    def find_nearest(self, pairs: Ints) -> tuple[Ints, Floats]:
        """Find the nearest of pairs, shape (n, 2), at each state, and its distance [m]: (W,) each.

        Only pairs that could be the nearest are passed to coal.
        """
        states, count = len(self._where), len(pairs)
        at, which = np.repeat(np.arange(states), count), np.tile(np.arange(count), states)
        bounds = self.compute_lower_bounds(at, pairs[which])
        order = np.lexsort((which, bounds, at))
        chosen, found = self._solids.distance_queries.find_closest_pairs(
            self._where,
            np.arange(states + 1) * count,
            pairs[which[order]],
            ranks=np.arange(len(order)),
            margins=np.zeros(len(order)),
            bounds=bounds[order],
            reach=np.inf,
            max_pairs=1,
            rounding=0.0,
        )
        return which[order[chosen]], found.distance

    def find_shapes_near(self, point: Floats, reach: float) -> list[int]:
        """Return the shapes closer than `reach` [m] to a point, shape (3,) [m], at the first state.

        The point is a sphere with a radius of 0.1 mm.
        """
        lower, upper = (corners[0] for corners in self.corners)
        near = np.flatnonzero(
            ((lower - point < reach + POINT_RADIUS) & (point - upper < reach + POINT_RADIUS)).all(
                axis=1
            )
        ).tolist()
        ball = coal.Sphere(POINT_RADIUS)
        here = pin.SE3(np.eye(3), point)
        shapes = self._solids.world.shapes
        return [
            i
            for i in near
            if compute_shape_distance(ball, here, shapes[i].geometry, self._placement(i)) < reach
        ]

    def _placement(self, shape: int) -> pin.SE3:
        if shape >= self._solids.body_count:
            return self._solids.world.shapes[shape].placement
        numbers = self._where[0, shape]
        return pin.SE3(numbers[:9].reshape(3, 3).T, numbers[9:])


def bound_displacements(solids: CollisionShapes, samples: Floats) -> Floats:
    """Bound the displacement of any point of each shape since the first sample, shape (S, G) [m].

    A revolute joint moves a point by at most its rotation times the point's distance from the axis.
    That distance is at most the sum of the offsets of the shape and of all joints between. A
    prismatic joint adds its travel.
    """
    world = solids.world
    model, steps = world.model, np.abs(np.diff(samples, axis=0))
    spans = np.linalg.norm(steps[:, :2], axis=1)
    offsets = [float(np.linalg.norm(placement.translation)) for placement in model.jointPlacements]
    of_joint: dict[int, list[MovedJoint]] = {}
    for move in world.coordinates.moves:
        of_joint.setdefault(move.joint, []).append(move)
    found = np.zeros((len(samples), len(world.shapes)))
    for g, shape in enumerate(world.shapes[: solids.body_count]):
        reach = float(np.linalg.norm(solids.half[g])) + float(
            np.linalg.norm(shape.placement.act(solids.center[g]))
        )
        joint, moved = shape.parentJoint, np.zeros(len(steps))
        while joint:
            moves = of_joint[joint]
            column, share, offset = moves[0].coordinate, abs(moves[0].factor), moves[0].offset
            if len(moves) == 7:  # the free joint of a free object
                moved += _bound_free_displacements(
                    samples[:, [move.coordinate for move in moves]], reach
                )
            elif len(moves) == 3:  # the planar base
                moved += spans + steps[:, moves[2].coordinate] * reach
            elif moves[0].slides:
                moved += share * steps[:, column]
                reach += float(np.abs(moves[0].factor * samples[:, column] + offset).max())
            else:
                moved += share * steps[:, column] * reach
            reach += offsets[joint]
            joint = model.parents[joint]
        np.cumsum(moved, out=found[1:, g])
    return found


def _bound_free_displacements(samples: Floats, reach: float) -> Floats:
    """Bound the motion of points within `reach` [m] of a free joint between samples [m]."""
    turns = samples[:, 3:] / np.linalg.norm(samples[:, 3:], axis=1, keepdims=True)
    half = np.arccos(np.clip(np.abs(np.einsum("kc,kc->k", turns[1:], turns[:-1])), 0.0, 1.0))
    return np.asarray(np.linalg.norm(np.diff(samples[:, :3], axis=0), axis=1) + 2.0 * half * reach)
