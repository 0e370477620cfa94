"""Paths of the base for every phase of a problem, A* around what stands there with what is carried, and the arm folded for them.

For passages that are too narrow for the robot as it is, the arm is folded over the base with what it carries.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats
from vkc_pin.driving.body import Shape, hull_points
from vkc_pin.driving.grid import BaseGrid, fine_cells
from vkc_pin.driving.path import BasePath, poses_along, shortest_path
from vkc_pin.interrupt import NEVER, Interrupt
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.scene.hold import Hold
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.seeds.knots import depth

__all__ = ["Routes", "folded_arm", "grid_shapes"]

_ARM_BASE = 2  # the joint of the model that is the arm's first: joint 1 is the base
_REACHING_RADIUS = 0.4  # [m] from the ends of a path within which the arm reaches in and out, and only the base counts
_START_CELL = 0.5  # [m] size of the squares within which starts share their distances
_BESIDE_GOAL = (0.4, 0.4, 0.6)  # [m, m, rad] standard deviations of where a guide may end beside a goal, at most
_BESIDE_COUNT = 60  # places beside a goal that are tried
_BESIDE_COST = 3.0  # [m/m] and [m/rad] what ending there costs
_POSTURES, _SEARCH_ROUNDS = 256, 8  # postures in a round of the random search
_PARENTS = 8  # free postures from which the next round begins
_CHECKED = 32  # postures whose clearance is found at once
_SPREAD, _SHRINK = 0.5, 0.7  # [m] and [rad] standard deviation of the first round; its ratio from round to round
_OVERHANG, _HEIGHT = 0.3, 0.2  # [m/m] cost of a metre before or behind the base, and up, a metre of width costing 1
_FROM_HOME = 0.01  # [m/rad] cost of the joint that is furthest from home
_LOW, _LOW_COST = 0.1, 10.0  # [m] over the floor, at least; [m/m] cost of less


class Routes:
    """The base's paths in each phase of a problem, looked for when they are asked for.

    With the arm folded, the grid is one for narrow passages: cells are so small that one of them is in the middle of any
    passage in which there is room for the margins, and there nothing but contact counts.
    """

    def __init__(self, problem: TrajectoryProblem, interrupt: Interrupt = NEVER) -> None:
        self.problem, self.interrupt = problem, interrupt
        self.arm = slice(3, problem.chain.robot.coordinates.size)
        self._grids: dict[tuple[int, bool], BaseGrid] = {}
        self._folded: dict[tuple[Hold, ...], Floats] = {}
        self._distances: dict[tuple[int, bool, int, int], Floats] = {}
        self._paths: dict[tuple[int, bytes, bytes], BasePath | None] = {}

    def grid(self, phase: int, *, folded: bool = False) -> BaseGrid:
        """Return where the base fits in a phase: near the ends of a path alone, elsewhere with arm and load.

        Args:
            phase: The phase.
            folded: With the arm folded; otherwise it is at home.
        """
        key = (phase, folded)
        if key not in self._grids:
            z, arena, margin = self._resting(), self.problem.scene.arena, self.problem.options.dist_safe
            cache, turning = self.problem.cache, self.problem.chain.robot.lever
            if folded:
                z[self.arm] = self.folded_arm(phase)
            moving, standing = grid_shapes(self.problem, phase, z)
            # Where the arm stands on the base it is always: a low base does not go under a table that the arm does not.
            base = [shape for joint, shape in moving if joint <= _ARM_BASE]
            carried = [shape for joint, shape in moving if joint > _ARM_BASE]
            how: dict[str, Any] = {"margin": 0.0, "cells": fine_cells(arena, margin)} if folded else {"margin": margin}
            how |= {"near": _REACHING_RADIUS, "turning": turning, "cache": cache}
            self._grids[key] = BaseGrid(base, carried, standing, arena, **how)
        return self._grids[key]

    def folded_arm(self, phase: int) -> Floats:
        """Return the arm folded with what is held in a phase, shape (m - 3,); see `folded_arm.folded_arm`."""
        held = self.problem.task.phases[phase].held
        if held not in self._folded:
            self._folded[held] = folded_arm(self.problem, phase, self._resting(), self.interrupt)
        return self._folded[held]

    def _resting(self) -> Floats:
        """Return the arm at home on a base at the origin, with grasps as near to 0 as they go, shape (n,)."""
        chain, z = self.problem.chain, self.problem.start.copy()
        z[:3], z[self.arm] = 0.0, chain.robot.home
        for column in (chain.index(name) for names in chain.virtual.values() for name in names):
            z[column] = np.clip(0.0, chain.lower[column], chain.upper[column])
        return z

    def distances(self, phase: int, starts: Floats, goals: Floats, *, folded: bool = False) -> Floats:
        """Return how far it is at least from starts to goals, both (B, 3), one by one, shape (B,) [m]; infinite: no path."""
        grid = self.grid(phase, folded=folded)
        keys = [(phase, folded, *np.floor(start[:2] / _START_CELL).astype(int).tolist()) for start in starts]
        new = {key: start[:2] for key, start in zip(keys, starts, strict=True) if key not in self._distances}
        if new:
            self._distances |= dict(zip(new, grid.distances_from(np.array(list(new.values()))), strict=True))
        cells = np.clip(np.floor((goals[:, :2] - grid.origin) / grid.step + 0.5).astype(int), 0, grid.cells - 1)
        return np.array([self._distances[key][i, j] for key, (i, j) in zip(keys, cells, strict=True)])

    def path(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Return `steps` poses of the base from start to goal, both (3,), the last at the goal's place: shape (steps, 3).

        The heading is continuous from the start's, and ends at one equal to the goal's. None if there is no path.
        """
        key = (phase, start.tobytes(), goal.tobytes())
        if key not in self._paths:
            self._paths[key] = shortest_path(self.grid(phase), start.tolist(), goal[None], interrupt=self.interrupt)
        path = self._paths[key]
        return None if path is None else poses_along(path, steps, turning=self.problem.chain.robot.lever)

    def guide(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Return poses from a start to a goal, both (3,), or to next to it, on which the base fits, shape (steps, 3).

        With the arm at home or, if there is no such path, with the arm folded. None if there is none either.
        """
        rng = np.random.default_rng(0)
        beside = rng.normal(size=(_BESIDE_COUNT, 3)) * rng.random((_BESIDE_COUNT, 1)) * _BESIDE_GOAL
        beside[0] = 0.0
        for folded in (False, True):
            grid = self.grid(phase, folded=folded)  # the fine one only where it is needed
            for places in (beside[:1], beside[1:]):
                costs = _BESIDE_COST * np.abs(places).sum(axis=1)
                path = shortest_path(grid, start.tolist(), goal + places, costs=costs, interrupt=self.interrupt)
                if path is not None:
                    return poses_along(path, steps, turning=grid.turning)
        return None


def grid_shapes(problem: TrajectoryProblem, phase: int, z: Floats) -> tuple[list[tuple[int, Shape]], list[Shape]]:
    """Return what a grid of the base is made of: what rides on the base in a phase, and what stands in the world but the floor.

    Args:
        problem: Whose robot it is.
        phase: In which it holds what it holds.
        z: Its configuration with the base at the origin, shape (n,).

    Returns:
        Shapes in the base's frame, those of the robot first, each after the joint that carries it; shapes in the world.
    """
    chain, part = problem.chain, problem.contacts.phases[phase]
    rotations, translations = chain.joint_placements(z[None])
    robot = range(len(chain.robot.collision.geometryObjects))
    held = [i for hold in problem.task.phases[phase].held for i in chain.held_geometries[hold]]
    moving: list[tuple[int, Shape]] = []
    for shape in (part.shapes[i] for i in [*robot, *held]):
        joint = shape.parentJoint
        carrier = pin.SE3(rotations[0, joint], translations[0, joint])
        moving.append((joint, (shape.geometry, carrier * shape.placement)))
    standing: list[Shape] = [
        (shape.geometry, shape.placement)
        for shape, label in zip(part.shapes, part.labels, strict=True)
        if shape.parentJoint == 0 and label != FLOOR
    ]
    return moving, standing


def folded_arm(problem: TrajectoryProblem, phase: int, resting: Floats, interrupt: Interrupt = NEVER) -> Floats:
    """Return the arm, shape (m - 3,) [m] and [rad], with which the robot is narrow: the best that a random search finds.

    What counts is how far the arm, and what is carried, reach to either side of the base's x axis; next, how far they reach
    beyond the base before and behind, how high, and how far the joints are from home. The robot is free of collisions with itself
    and with what it carries. The search is the same every time.

    Args:
        problem: Whose robot it is.
        phase: In which it carries what it carries.
        resting: Where robot and load rest, shape (n,): what is not the arm stays so; where the base is does not matter.
        interrupt: Ends the search, with what there is.
    """
    chain, rng = problem.chain, np.random.default_rng(0)
    arm, home = slice(3, chain.robot.coordinates.size), chain.robot.home
    turns = np.array([problem.unit(name) == "rad" for name in chain.names[arm]])
    lower = np.where(turns, np.maximum(chain.lower[arm], home - np.pi), chain.lower[arm])
    upper = np.where(turns, np.minimum(chain.upper[arm], home + np.pi), chain.upper[arm])
    body = _Body(problem, phase)
    z = np.tile(resting, (_POSTURES, 1))
    z[0, arm] = home
    z[1:, arm] = rng.uniform(lower, upper, (_POSTURES - 1, len(home)))
    best, spread = z[:1], _SPREAD
    for _ in range(_SEARCH_ROUNDS):
        if interrupt.pressed:
            break
        z = z[np.argsort(body.price(z) + _FROM_HOME * np.abs(z[:, arm] - home).max(axis=1), kind="stable")]
        best = body.free(z, _PARENTS)
        if not len(best):
            return home.copy()
        z = best[np.arange(_POSTURES) % len(best)]
        off = spread * rng.uniform(0.0, 1.0, (_POSTURES, 1)) * rng.normal(size=(_POSTURES, len(home)))
        off[: len(best)] = 0.0
        z[:, arm] = np.clip(z[:, arm] + off, lower, upper)
        spread *= _SHRINK
    return best[0, arm].copy()


class _Body:
    """What the base carries in a phase of a problem, and the base's own outline."""

    def __init__(self, problem: TrajectoryProblem, phase: int) -> None:
        self.problem, self.chain = problem, problem.chain
        self.waypoint = problem.contacts.inside(phase)
        shapes = problem.contacts.phases[phase].shapes
        moving = [*range(len(self.chain.robot.collision.geometryObjects))]
        moving += [i for hold in problem.task.phases[phase].held for i in self.chain.held_geometries[hold]]
        points: dict[int, list[Floats]] = {1: [np.zeros((1, 3))]}
        for i in moving:
            corners, radius = hull_points(shapes[i].geometry, shapes[i].placement, outer=True)
            corners = np.concatenate([corners - radius, corners + radius]) if radius else corners
            points.setdefault(shapes[i].parentJoint, []).append(corners)
        base = np.concatenate(points.pop(1))
        self.front, self.back = base[:, 0].max(), base[:, 0].min()
        self.points = {joint: np.concatenate(corners).T for joint, corners in points.items()}

    def price(self, z: Floats) -> Floats:
        """Return how far what is carried reaches, weighted as in `folded_arm`, shape (B,) [m]."""
        rotations, translations = self.chain.joint_placements(z)
        turned = rotations[0, 1].T @ rotations
        moved = (translations - translations[0, 1]) @ rotations[0, 1]
        at = np.concatenate(
            [turned[:, joint] @ points + moved[:, joint, :, None] for joint, points in self.points.items()], axis=2
        )
        (back, right, bottom), (front, left, top) = at.min(axis=2).T, at.max(axis=2).T
        beyond = np.maximum(front - self.front, 0.0) + np.maximum(self.back - back, 0.0)
        return np.asarray(
            np.maximum(left, -right) + _OVERHANG * beyond + _HEIGHT * top + _LOW_COST * np.maximum(_LOW - bottom, 0.0)
        )

    def free(self, z: Floats, count: int) -> Floats:
        """Return the first `count` configurations at which the robot keeps its clearances from itself and what it carries."""
        found = z[:0]
        for begin in range(0, len(z), _CHECKED):
            part = z[begin : begin + _CHECKED]
            found = np.concatenate([found, part[depth(self.problem, part, self.waypoint, standing=False) <= 0.0]])
            if len(found) >= count:
                break
        return found[:count]
