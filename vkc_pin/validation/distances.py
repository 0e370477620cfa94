"""Computes distances of a world's shapes, and bounds their displacements along a motion.

Lower bounds of distances come from bounding boxes, exact distances from coal. Nothing is shared
with the planner's culling, so that its errors would be found here.
"""

from __future__ import annotations

import copy
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.collision.boxes import WorldBoxes
from vkc_pin.world.collision.distances import Shapes
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.models.coordinates import MovedJoint
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.world_model import World

# radius of the sphere that stands for a point [m]
POINT_RADIUS = 1e-4


class CollisionShapes:
    """The G collision shapes of a world, with their bounding boxes.

    The first `body_count` belong to the robot or an object; the others are obstacles. `center` and
    `half`, shape (G, 3) [m], are the boxes in the shapes' own frames.
    """

    def __init__(self, world: World) -> None:
        self.body_count = len(world.bodies.geometryObjects)
        bodies = world.shapes[: self.body_count]
        self._body_boxes = [compute_bounding_box(shape) for shape in bodies]
        self._placements = BatchedModel.of_shapes(world.model, world.bodies)
        self._set_obstacles(world)

    def with_obstacles(self, scene: Scene) -> CollisionShapes:
        """Return a copy with the obstacles of another scene; see `World.with_obstacles`."""
        other = copy.copy(self)
        other._set_obstacles(self.world.with_obstacles(scene))
        return other

    def _set_obstacles(self, world: World) -> None:
        """Set the attributes that depend on the obstacles of a world with the same bodies."""
        self.world = world
        boxes = list(self._body_boxes)
        boxes += [compute_bounding_box(shape) for shape in world.shapes[self.body_count :]]
        self.center = np.array([center for center, _ in boxes]).reshape(-1, 3)
        self.half = np.array([half for _, half in boxes]).reshape(-1, 3)
        obstacles = slice(self.body_count, None)
        placements = [shape.placement for shape in world.shapes[obstacles]]
        geometries = [shape.geometry for shape in world.shapes]
        self.distance_queries = Shapes(geometries, placements)
        self.obstacle_corners = self.compute_corners(flatten_placements(placements), obstacles)

    def place(self, q: Floats) -> PlacedShapes:
        """Place the shapes at Pinocchio's configurations of the world, shape (W, nq)."""
        return PlacedShapes(self, self._placements.compute_placements(q))

    def compute_corners(self, where: Floats, which: slice) -> tuple[Floats, Floats]:
        """Compute lower and upper corners of axis-aligned boxes, shape (..., k, 3) each [m].

        `where` are the shapes' placements in the world, shape (..., k, 12). A box with half sides h
        in its own frame has the half sides |R| h along the axes of the world.
        """
        rotation = where[..., :9].reshape(*where.shape[:-1], 3, 3).swapaxes(-1, -2)
        middle = np.einsum("...ij,...j->...i", rotation, self.center[which]) + where[..., 9:]
        extent = np.einsum("...ij,...j->...i", np.abs(rotation), self.half[which])
        return middle - extent, middle + extent


class PlacedShapes:
    """The shapes at W configurations, with the bodies' placements `where`, shape (W, M, 12)."""

    def __init__(self, solids: CollisionShapes, where: Floats) -> None:
        self._solids = solids
        self._where = where

    @cached_property
    def corners(self) -> tuple[Floats, Floats]:
        """Lower and upper corners of all axis-aligned boxes, shape (W, G, 3) each [m]."""
        body_lower, body_upper = self._compute_body_corners()
        obstacle_lower, obstacle_upper = self._solids.obstacle_corners
        shape = (len(self._where), *obstacle_lower.shape)
        lower = np.concatenate([body_lower, np.broadcast_to(obstacle_lower, shape)], axis=1)
        upper = np.concatenate([body_upper, np.broadcast_to(obstacle_upper, shape)], axis=1)
        return lower, upper

    @cached_property
    def boxes(self) -> WorldBoxes:
        """The axis-aligned boxes, prepared for proximity queries."""
        return WorldBoxes(*self._compute_body_corners(), *self._solids.obstacle_corners)

    def _compute_body_corners(self) -> tuple[Floats, Floats]:
        """Compute the corners of the bodies' axis-aligned boxes, shape (W, M, 3) each [m]."""
        return self._solids.compute_corners(self._where, slice(self._solids.body_count))

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
        distances = np.sqrt(np.einsum("ni,ni->n", outside, outside))
        is_apart = gaps.max(axis=1) > 0.0
        return np.where(is_apart, distances, -np.inf)

    def compute_distances(self, states: Ints, pairs: Ints) -> Floats:
        """Compute signed distances [m] of pairs, shape (n, 2), at states, shape (n,)."""
        return self._solids.distance_queries.compute_distances(self._where, states, pairs)

    def find_nearest(self, pairs: Ints) -> tuple[Ints, Floats]:
        """Find the nearest of pairs, shape (n, 2), at each state, and its distance [m]: (W,) each.

        Only pairs that could be the nearest are passed to coal.
        """
        state_count = len(self._where)
        pair_count = len(pairs)
        # One row for each state and pair, by state and lower bound.
        at = np.repeat(np.arange(state_count), pair_count)
        which = np.tile(np.arange(pair_count), state_count)
        bounds = self.compute_lower_bounds(at, pairs[which])
        order = np.lexsort((which, bounds, at))
        chosen, found = self._solids.distance_queries.find_closest_pairs(
            self._where,
            np.arange(state_count + 1) * pair_count,
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
        lower = self.corners[0][0]
        upper = self.corners[1][0]
        margin = reach + POINT_RADIUS
        is_near = (lower - point < margin) & (point - upper < margin)
        ball = coal.Sphere(POINT_RADIUS)
        placement = pin.SE3(np.eye(3), point)
        found: list[int] = []
        for i in np.flatnonzero(is_near.all(axis=1)).tolist():
            geometry = self._solids.world.shapes[i].geometry
            distance = compute_shape_distance(ball, placement, geometry, self._get_placement(i))
            if distance < reach:
                found.append(i)
        return found

    def _get_placement(self, shape: int) -> pin.SE3:
        """Return the placement of a shape at the first state."""
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
    model = world.model
    steps = np.abs(np.diff(samples, axis=0))
    planar_steps = np.linalg.norm(steps[:, :2], axis=1)
    offsets = [float(np.linalg.norm(placement.translation)) for placement in model.jointPlacements]
    of_joint: dict[int, list[MovedJoint]] = {}
    for move in world.coordinates.moves:
        of_joint.setdefault(move.joint, []).append(move)
    bounds = np.zeros((len(samples), len(world.shapes)))
    for g, shape in enumerate(world.shapes[: solids.body_count]):
        # Distance within which all points of the shape are from the joint's origin [m].
        radius = float(np.linalg.norm(solids.half[g]))
        reach = radius + float(np.linalg.norm(shape.placement.act(solids.center[g])))
        moved = np.zeros(len(steps))
        joint = shape.parentJoint
        while joint:
            moves = of_joint[joint]
            first = moves[0]
            column = first.coordinate
            if len(moves) == 7:  # the free joint of a free object
                columns = [move.coordinate for move in moves]
                moved += _bound_free_displacements(samples[:, columns], reach)
            elif len(moves) == 3:  # the planar base
                moved += planar_steps + steps[:, moves[2].coordinate] * reach
            elif first.slides:
                moved += abs(first.factor) * steps[:, column]
                travel = np.abs(first.factor * samples[:, column] + first.offset)
                reach += float(travel.max())
            else:
                moved += abs(first.factor) * steps[:, column] * reach
            reach += offsets[joint]
            joint = model.parents[joint]
        np.cumsum(moved, out=bounds[1:, g])
    return bounds


def _bound_free_displacements(samples: Floats, reach: float) -> Floats:
    """Bound the motion of points within `reach` [m] of a free joint between samples [m].

    Two unit quaternions p and q differ by a rotation of 2 arccos |p · q|.
    """
    shifts = np.linalg.norm(np.diff(samples[:, :3], axis=0), axis=1)
    quaternions = samples[:, 3:] / np.linalg.norm(samples[:, 3:], axis=1, keepdims=True)
    products = np.einsum("kc,kc->k", quaternions[1:], quaternions[:-1])
    half_angles = np.arccos(np.clip(np.abs(products), 0.0, 1.0))
    return np.asarray(shifts + 2.0 * half_angles * reach)
