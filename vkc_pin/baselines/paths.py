"""Paths of the base: straight if that is free, else the shortest by A*; of the bare base, or with the arm as it is."""

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

__all__ = ["BasePaths", "headings"]

_STEPS, _STEP = (
    25,
    0.08,
)  # poses on a straight path that are looked at: at least so many, and at most so far apart [m]


class BasePaths:
    """Paths of the base between places, around all that stands in the last phase of a problem.

    Attributes:
        grid: Where the base fits.
    """

    def __init__(self, problem: TrajectoryProblem, *, whole: bool = False) -> None:
        """Look at the floor.

        Args:
            problem: Whose base it is.
            whole: The arm counts as well, as it is at the start, with what it holds; otherwise the
                bare base alone.
        """
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
        # Without margins where an optimisation follows: it restores them.
        self._fine: dict[str, Any] = {
            "margin": 0.0 if whole else margin,
            "cells": compute_fine_cell_count(arena, margin),
        }

    @functools.cached_property
    def finer(self) -> BaseGrid:
        """A grid of smaller cells, for narrow passages."""
        return self._grid(**self._fine)

    def path(self, start: Floats, goals: Floats, steps: int) -> Floats | None:
        """Return poses after the start, slow at both ends, the last at a goal, shape (steps, 3); None: there is no path.

        Args:
            start: x, y, yaw [m, rad].
            goals: The same, shape (3,), or several of them, shape (G, 3): the first that can be
                reached straight, else the one to which the path is the shortest.
            steps: How many poses.
        """
        goals = np.atleast_2d(goals)
        for goal in goals if self.omni else ():
            places = max(_STEPS, int(np.ceil(np.hypot(*(goal - start)[:2]) / _STEP)))
            if all(self.grid.is_pose_free(*pose) for pose in np.linspace(start, goal, places)):
                return np.asarray(start + sample_smoothstep(steps)[:, None] * (goal - start))
        find = functools.partial(shortest_path, start=start.tolist(), goals=goals)
        found = find(self.grid) or find(self.finer)
        return None if found is None else sample_poses(found, steps, turning=self.grid.turning)

    def along(self, problem: TrajectoryProblem, goal: Floats) -> Floats | None:
        """Return the base at every waypoint, shape (N, 3): it stands while a latch is released; None: there is no path."""
        base = [problem.start[None, :3]]
        for phase in problem.task.phases:
            moves = phase.kind == "move"
            part = (
                self.path(base[-1][-1], goal, phase.segments)
                if moves
                else np.tile(base[-1][-1], (phase.segments, 1))
            )
            if part is None:
                return None
            base.append(part)
        return np.concatenate(base[1:])

    def seeds(self, problem: TrajectoryProblem, goals: Floats) -> Iterator[InitialGuess]:
        """Yield the path from a problem's start to one of `goals`, shape (G, 3), the arm at rest, if there is one."""
        path = self.path(problem.start[:3], goals, problem.segments)
        if path is not None:
            z = np.tile(problem.start, (problem.segments, 1))
            z[:, :3] = path
            yield InitialGuess("astar", problem.clip(z))


def headings(step: GoTo, yaw: float) -> Floats:
    """Return the poses in which a step may end, shape (G, 3): one, or one per heading, those nearest to `yaw` [rad] first."""
    turns = (
        np.linspace(0.0, 2.0 * np.pi, HEADINGS, endpoint=False)
        if step.yaw is None
        else np.array([step.yaw - yaw])
    )
    turns = wrap_angle(turns)
    turns = turns[np.argsort(np.abs(turns), kind="stable")]
    return np.column_stack([np.tile([step.x, step.y], (len(turns), 1)), yaw + turns])
