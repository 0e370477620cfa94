"""Paths of the base for every phase of a problem: A* around what stands there, with what is carried; arms folded for it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.planning.base_paths.arcs import Curves, spread_along
from vkc_pin.planning.base_paths.base_clearance import Shape, hull_points
from vkc_pin.planning.base_paths.base_path import BasePath, poses_along, shortest_path
from vkc_pin.planning.base_paths.grid import BaseGrid, fine_cells
from vkc_pin.planning.initialization.keyframes import ALIKE, depth
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.collision.threads import count_threads
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR

__all__ = ["Routes", "folded_arms", "grid_shapes"]

_ARM_BASE = 2  # the joint of the model that is the arm's first: joint 1 is the base
# [m] from the ends of a path within which the arm reaches in and out, and only the base counts
_REACHING_RADIUS = 0.4
# random postures: with 192 the arm may stay wider than the base, with 4000 it gets no narrower
_POSTURES = 1000


class Routes:
    """The base's paths in each phase of a problem, looked for when they are asked for.

    With the arm folded, the grid is one for narrow passages: cells are so small that one of them is
    in the middle of any passage in which there is room for the margins, and there nothing but
    contact counts.
    """

    def __init__(self, problem: TrajectoryProblem) -> None:
        self.problem = problem
        self.arm = slice(3, problem.chain.robot.coordinates.size)
        self._grids: dict[tuple[int, bool], BaseGrid] = {}
        self._folded: dict[tuple[Hold, ...], Floats] = {}
        self._distances: dict[tuple[int, bool, int, int], Floats] = {}
        self._paths: dict[tuple[int, bool, bytes, bytes], BasePath | None] = {}

    def grid(self, phase: int, *, folded: bool = False) -> BaseGrid:
        """Return where the base fits in a phase: near the ends of a path alone, elsewhere with arm and load.

        Args:
            phase: The phase.
            folded: With the arm folded; otherwise it is at home.
        """
        key = (phase, folded)
        if key not in self._grids:
            z, arena, margin = (
                self._resting(),
                self.problem.scene.arena,
                self.problem.options.dist_safe,
            )
            cache, turning = self.problem.cache, self.problem.chain.robot.lever
            if folded:
                z[self.arm] = self.folded_arm(phase)
            moving, standing = grid_shapes(self.problem, phase, z)
            # Where the arm stands on the base it is always: a low base does not go under a table
            # that the arm does not.
            base = [shape for joint, shape in moving if joint <= _ARM_BASE]
            carried = [shape for joint, shape in moving if joint > _ARM_BASE]
            how: dict[str, Any] = (
                {"margin": 0.0, "cells": fine_cells(arena, margin)}
                if folded
                else {"margin": margin}
            )
            how |= {"near": _REACHING_RADIUS, "turning": turning, "cache": cache}
            self._grids[key] = BaseGrid(base, carried, standing, arena, **how)
        return self._grids[key]

    def folded_arm(self, phase: int) -> Floats:
        """Return the arm, shape (m - 3,) [m] and [rad], that is folded most with what is held in a phase; see `folded_arms`."""
        return np.asarray(self._folded_arms(phase)[0])

    def nearest_folded_arm(self, phase: int, first: Floats, last: Floats) -> Floats:
        """Return the folded arm, shape (m - 3,), by way of which it is least far from one to another, both (m - 3,)."""
        chain, arms = self.problem.chain, self._folded_arms(phase)
        turning = [self.problem.unit(name) == "rad" for name in chain.names[self.arm]]
        wound = arms + 2.0 * np.pi * np.array([0.0, -1.0, 1.0])[:, None, None] * turning
        ways = (np.abs(wound - first) + np.abs(wound - last)) * chain.metric[self.arm]
        ways[1:][(wound < chain.lower[self.arm])[1:] | (wound > chain.upper[self.arm])[1:]] = np.inf
        nearest = int(np.argmin(ways.min(axis=0).sum(axis=1)))
        return np.asarray(wound[ways[:, nearest].argmin(axis=0), nearest, np.arange(len(first))])

    def _folded_arms(self, phase: int) -> Floats:
        held = self.problem.task.phases[phase].held
        if held not in self._folded:
            self._folded[held] = folded_arms(self.problem, phase, self._resting())
        return self._folded[held]

    def _resting(self) -> Floats:
        """Return the arm at home on a base at the origin, with grasps as near to 0 as they go, shape (n,)."""
        chain, z = self.problem.chain, self.problem.start.copy()
        z[:3], z[self.arm] = 0.0, chain.robot.home
        for column in (chain.index(name) for names in chain.virtual.values() for name in names):
            z[column] = np.clip(0.0, chain.lower[column], chain.upper[column])
        return z

    def distances(
        self, phase: int, starts: Floats, goals: Floats, *, folded: bool = False
    ) -> Floats:
        """Return how far it is at least from starts to goals, both (B, 3), one by one, shape (B,) [m]; infinite: no path.

        Starts that are `ALIKE` share the distances of the first that was asked about.
        """
        grid = self.grid(phase, folded=folded)
        end = np.clip(
            np.floor((goals[:, :2] - grid.origin) / grid.step + 0.5).astype(int), 0, grid.cells - 1
        ).tolist()
        begin = np.floor(starts[:, :2] / ALIKE).astype(int).tolist()
        keys = [(phase, folded, *cell) for cell in begin]
        new = {
            key: start[:2]
            for key, start in zip(keys, starts, strict=True)
            if key not in self._distances
        }
        if new:
            found = grid.distances_from(np.array(list(new.values())), threads=count_threads())
            self._distances |= dict(zip(new, found, strict=True))
        return np.array([self._distances[key][i, j] for key, (i, j) in zip(keys, end, strict=True)])

    def path(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Return `steps` poses of the base from start to goal, both (3,), the last at the goal's place: shape (steps, 3).

        The heading is continuous from the start's, and ends at one equal to the goal's. None if
        there is no path.
        """
        path = self._shortest(phase, start, goal)
        return (
            None
            if path is None
            else self._poses(self.grid(phase), path, steps, self.problem.chain.robot.lever)
        )

    def _shortest(
        self, phase: int, start: Floats, goal: Floats, *, folded: bool = False
    ) -> BasePath | None:
        """Return the shortest path of the base from start to goal, both (3,), if there is one; looked for once."""
        key = (phase, folded, start.tobytes(), goal.tobytes())
        if key not in self._paths:
            self._paths[key] = shortest_path(
                self.grid(phase, folded=folded), start.tolist(), goal[None]
            )
        return self._paths[key]

    def _poses(self, grid: BaseGrid, path: BasePath, steps: int, turning: float) -> Floats:
        """Return poses along a path; those of a base on wheels at its corners, too, so that it rolls from each to the next."""
        rolling = self.problem.rolling
        if rolling.is_omnidirectional:
            return poses_along(path, steps, turning=turning)
        corners = path.poses
        if rolling.turning_radius > 0.0:
            corners = Curves(rolling.turning_radius, turning).through(
                corners, lambda pose: grid.clear(*pose, reaching=True)
            )
        return spread_along(corners, steps, turning=turning)

    def guide(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Return poses from a start to a goal, both (3,), on which the base fits, shape (steps, 3).

        With the arm at home or, if there is no such path, with the arm folded. None if there is
        none either.
        """
        for folded in (False, True):
            path = self._shortest(
                phase, start, goal, folded=folded
            )  # the fine grid only where it is needed
            if path is not None:
                grid = self.grid(phase, folded=folded)
                return self._poses(grid, path, steps, grid.turning)
        return None


def folded_arms(problem: TrajectoryProblem, phase: int, resting: Floats) -> Floats:
    """Return arms, shape (F, m - 3) [m] and [rad], with which the robot is compact: of random postures, the same every time.

    The first is the best of all: what counts is how far the arm, and what is carried, reach from
    the base's origin along its three axes, in sum. The others reach no further over the floor than
    that one, or than the base itself, along either axis. The robot is free of collisions with
    itself and with what it carries.

    Args:
        problem: Whose robot it is.
        phase: In which it carries what it carries.
        resting: Where robot and load rest, shape (n,): what is not the arm stays so; where the base
            is does not matter.
    """
    chain, rng = problem.chain, np.random.default_rng(0)
    arm, home = slice(3, chain.robot.coordinates.size), chain.robot.home
    turns = np.array([problem.unit(name) == "rad" for name in chain.names[arm]])
    lower = np.where(turns, np.maximum(chain.lower[arm], home - np.pi), chain.lower[arm])
    upper = np.where(turns, np.minimum(chain.upper[arm], home + np.pi), chain.upper[arm])
    z = np.tile(resting, (_POSTURES, 1))
    z[:, arm] = [home, *rng.uniform(lower, upper, (_POSTURES - 1, len(home)))]
    reach, base = _reach(problem, phase, z)
    order = np.argsort(reach.sum(axis=1), kind="stable")
    for tried in np.array_split(order, math.isqrt(_POSTURES)):  # one of the first is mostly free
        free = tried[_apart(problem, phase, z[tried])]
        if len(free):
            best = free[0]
            room = np.maximum(base, reach[best])[:2]
            others = np.flatnonzero((reach[:, :2] <= room).all(axis=1))
            return np.vstack([z[best, arm], z[others[_apart(problem, phase, z[others])], arm]])
    return np.array(home[None])


def _apart(problem: TrajectoryProblem, phase: int, z: Floats) -> Bools:
    """Return with which configurations, shape (B, n), the robot keeps its margins to itself and to what it carries."""
    return depth(problem, z, problem.contacts.find_waypoint(phase), standing=False) <= 0.0


def _reach(problem: TrajectoryProblem, phase: int, z: Floats) -> tuple[Floats, Floats]:
    """Return how far what the base carries in a phase reaches along the base's axes, and the base itself, (B, 3) and (3,) [m]."""
    chain, shapes = problem.chain, problem.contacts.phases[phase].shapes
    rotations, translations = chain.joint_placements(z)
    reach, base = np.zeros((len(z), 3)), np.zeros(3)
    carried = problem.contacts.find_attached_geometries(phase)
    for shape in (
        shapes[i] for i in [*range(len(chain.robot.collision.geometryObjects)), *carried]
    ):
        joint = shape.parentJoint
        corners, radius = hull_points(shape.geometry, shape.placement, outer=True)
        at = (
            rotations[:, joint] @ corners.T
            + translations[:, joint, :, None]
            - translations[:, 1, :, None]
        )
        own = np.abs(rotations[:, 1].transpose(0, 2, 1) @ at).max(axis=2) + radius
        if joint > 1:
            np.maximum(reach, own, out=reach)
        else:
            np.maximum(base, own[0], out=base)
    return reach, base


def grid_shapes(
    problem: TrajectoryProblem, phase: int, z: Floats
) -> tuple[list[tuple[int, Shape]], list[Shape]]:
    """Return what a grid of the base is made of: what rides on the base in a phase, and what stands in the world but the floor.

    Args:
        problem: Whose robot it is.
        phase: In which it holds what it holds.
        z: Its configuration with the base at the origin, shape (n,).

    Returns:
        Shapes in the base's frame, those of the robot first, each after the joint that carries it;
        shapes in the world that the base may not touch.
    """
    chain, part = problem.chain, problem.contacts.phases[phase]
    rotations, translations = chain.joint_placements(z[None])
    robot = range(len(chain.robot.collision.geometryObjects))
    held = problem.contacts.find_attached_geometries(phase)
    moving: list[tuple[int, Shape]] = []
    for shape in (part.shapes[i] for i in [*robot, *held]):
        joint = shape.parentJoint
        carrier = pin.SE3(rotations[0, joint], translations[0, joint])
        moving.append((joint, (shape.geometry, carrier * shape.placement)))
    base = [i for i in robot if part.shapes[i].parentJoint < _ARM_BASE]
    hits = set(part.pairs[np.isin(part.pairs[:, 0], base), 1].tolist())  # but for what it may touch
    standing: list[Shape] = [
        (shape.geometry, shape.placement)
        for i, (shape, label) in enumerate(zip(part.shapes, part.labels, strict=True))
        if shape.parentJoint == 0 and label != FLOOR and (i in hits or not base)
    ]
    return moving, standing
