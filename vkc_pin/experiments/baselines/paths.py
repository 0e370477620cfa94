"""Finds paths of the base: straight if possible, else the shortest by A*."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

from vkc_pin.planning.base_paths.base_path import sample_poses, shortest_path
from vkc_pin.planning.base_paths.grid import HEADINGS, BaseGrid, compute_fine_cell_count
from vkc_pin.planning.initialization.base_routes import collect_grid_shapes
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.initialization.keyframes import sample_smoothstep
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.task.steps import GoTo

_STEPS, _STEP = 25, 0.08  # least number and largest distance [m] of checked poses on a line


class BasePaths:
    """Paths of the base around fixed obstacles in the last phase of a problem."""

    def __init__(self, problem: TrajectoryProblem, *, whole: bool = False) -> None:
        """Make the grid; with `whole` for the robot with its present arm and grasped objects."""
        self.omni = problem.chain.robot.base == "omni"
        z = problem.start.copy()
        z[:3] = 0.0
        moving, standing = collect_grid_shapes(problem, len(problem.task.phases) - 1, z)
        base = [shape for joint, shape in moving if whole or joint == 1]
        arena, margin = problem.scene.arena, problem.options.dist_safe
        turning = problem.chain.robot.lever
        self._grid = functools.partial(
            BaseGrid, base, [], standing, arena, turning=turning, cache=problem.cache
        )
        self.grid = self._grid(margin)
        # Optimisation restores the margins.
        self._fine: dict[str, Any] = {
            "margin": 0.0 if whole else margin,
            "cells": compute_fine_cell_count(arena, margin),
        }

    @functools.cached_property
    def finer(self) -> BaseGrid:
        """A grid of smaller cells, for narrow passages."""
        return self._grid(**self._fine)

    def path(self, start: Floats, goals: Floats, steps: int) -> Floats | None:
        """Return poses from `start` to a goal, slow at both ends, shape (steps, 3), or None.

        Of several goals, shape (G, 3), it is the first with a straight path, else the nearest.
        """
        goals = np.atleast_2d(goals)
        for goal in goals if self.omni else ():
            places = max(_STEPS, int(np.ceil(np.hypot(*(goal - start)[:2]) / _STEP)))
            if all(self.grid.is_pose_free(*pose) for pose in np.linspace(start, goal, places)):
                return np.asarray(start + sample_smoothstep(steps)[:, None] * (goal - start))
        find = functools.partial(shortest_path, start=start.tolist(), goals=goals)
        found = find(self.grid) or find(self.finer)
        return None if found is None else sample_poses(found, steps, turning=self.grid.turning)

    def find_base_path(self, problem: TrajectoryProblem, goal: Floats) -> Floats | None:
        """Return the base at every waypoint, shape (N, 3), stationary while a latch is released."""
        base = [problem.start[None, :3]]
        for phase in problem.task.phases:
            last = base[-1][-1]
            part: Floats | None = np.tile(last, (phase.segments, 1))
            if phase.kind == "move":
                part = self.path(last, goal, phase.segments)
            if part is None:
                return None
            base.append(part)
        return np.concatenate(base[1:])

    def make_guesses(self, problem: TrajectoryProblem, goals: Floats) -> Iterator[InitialGuess]:
        """Yield the path from a problem's start to one of `goals`, shape (G, 3), if any."""
        path = self.path(problem.start[:3], goals, problem.segments)
        if path is not None:
            z = np.tile(problem.start, (problem.segments, 1))
            z[:, :3] = path
            yield InitialGuess("astar", problem.clip(z))


def find_goal_poses(step: GoTo, yaw: float) -> Floats:
    """Return the goal poses of a step, shape (G, 3), those with headings nearest to `yaw` first."""
    turns = np.linspace(0.0, 2.0 * np.pi, HEADINGS, endpoint=False)
    turns = wrap_angle(turns if step.yaw is None else np.array([step.yaw - yaw]))
    turns = turns[np.argsort(np.abs(turns), kind="stable")]
    return np.column_stack([np.tile([step.x, step.y], (len(turns), 1)), yaw + turns])
