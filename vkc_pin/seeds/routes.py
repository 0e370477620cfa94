"""Paths of the base for every phase of a problem: A* around what stands there, with what is carried."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats
from vkc_pin.distances.threads import available_threads
from vkc_pin.driving.body import Shape
from vkc_pin.driving.curves import Curves, spread_along
from vkc_pin.driving.grid import BaseGrid, fine_cells
from vkc_pin.driving.path import BasePath, poses_along, shortest_path
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.scene.hold import Hold
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.seeds.folded_arm import folded_arm
from vkc_pin.seeds.knots import ALIKE

__all__ = ["Routes", "grid_shapes"]

_ARM_BASE = 2  # the joint of the model that is the arm's first: joint 1 is the base
_REACHING_RADIUS = 0.4  # [m] from the ends of a path within which the arm reaches in and out, and only the base counts


class Routes:
    """The base's paths in each phase of a problem, looked for when they are asked for.

    With the arm folded, the grid is one for narrow passages: cells are so small that one of them is in the middle of any
    passage in which there is room for the margins, and there nothing but contact counts.
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
            self._folded[held] = folded_arm(self.problem, phase, self._resting())
        return self._folded[held]

    def _resting(self) -> Floats:
        """Return the arm at home on a base at the origin, with grasps as near to 0 as they go, shape (n,)."""
        chain, z = self.problem.chain, self.problem.start.copy()
        z[:3], z[self.arm] = 0.0, chain.robot.home
        for column in (chain.index(name) for names in chain.virtual.values() for name in names):
            z[column] = np.clip(0.0, chain.lower[column], chain.upper[column])
        return z

    def distances(self, phase: int, starts: Floats, goals: Floats, *, folded: bool = False) -> Floats:
        """Return how far it is at least from starts to goals, both (B, 3), one by one, shape (B,) [m]; infinite: no path.

        Starts that are `ALIKE` share the distances of the first that was asked about.
        """
        grid = self.grid(phase, folded=folded)
        end = np.clip(np.floor((goals[:, :2] - grid.origin) / grid.step + 0.5).astype(int), 0, grid.cells - 1).tolist()
        begin = np.floor(starts[:, :2] / ALIKE).astype(int).tolist()
        keys = [(phase, folded, *cell) for cell in begin]
        new = {key: start[:2] for key, start in zip(keys, starts, strict=True) if key not in self._distances}
        if new:
            found = grid.distances_from(np.array(list(new.values())), threads=available_threads())
            self._distances |= dict(zip(new, found, strict=True))
        return np.array([self._distances[key][i, j] for key, (i, j) in zip(keys, end, strict=True)])

    def path(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Return `steps` poses of the base from start to goal, both (3,), the last at the goal's place: shape (steps, 3).

        The heading is continuous from the start's, and ends at one equal to the goal's. None if there is no path.
        """
        path = self._shortest(phase, start, goal)
        return None if path is None else self._poses(self.grid(phase), path, steps, self.problem.chain.robot.lever)

    def _shortest(self, phase: int, start: Floats, goal: Floats, *, folded: bool = False) -> BasePath | None:
        """Return the shortest path of the base from start to goal, both (3,), if there is one; looked for once."""
        key = (phase, folded, start.tobytes(), goal.tobytes())
        if key not in self._paths:
            self._paths[key] = shortest_path(self.grid(phase, folded=folded), start.tolist(), goal[None])
        return self._paths[key]

    def _poses(self, grid: BaseGrid, path: BasePath, steps: int, turning: float) -> Floats:
        """Return poses along a path; those of a base on wheels at its corners, too, so that it rolls from each to the next."""
        rolling = self.problem.rolling
        if rolling.aside:
            return poses_along(path, steps, turning=turning)
        corners = path.poses
        if rolling.radius > 0.0:
            corners = Curves(rolling.radius, turning).through(corners, lambda pose: grid.clear(*pose, reaching=True))
        return spread_along(corners, steps, turning=turning)

    def guide(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Return poses from a start to a goal, both (3,), on which the base fits, shape (steps, 3).

        With the arm at home or, if there is no such path, with the arm folded. None if there is none either.
        """
        for folded in (False, True):
            path = self._shortest(phase, start, goal, folded=folded)  # the fine grid only where it is needed
            if path is not None:
                grid = self.grid(phase, folded=folded)
                return self._poses(grid, path, steps, grid.turning)
        return None


def grid_shapes(problem: TrajectoryProblem, phase: int, z: Floats) -> tuple[list[tuple[int, Shape]], list[Shape]]:
    """Return what a grid of the base is made of: what rides on the base in a phase, and what stands in the world but the floor.

    Args:
        problem: Whose robot it is.
        phase: In which it holds what it holds.
        z: Its configuration with the base at the origin, shape (n,).

    Returns:
        Shapes in the base's frame, those of the robot first, each after the joint that carries it; shapes in the world that the
        base may not touch.
    """
    chain, part = problem.chain, problem.contacts.phases[phase]
    rotations, translations = chain.joint_placements(z[None])
    robot = range(len(chain.robot.collision.geometryObjects))
    held = problem.contacts.carried(phase)
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
