"""Finds paths of the base: straight if possible, else the shortest by A*."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from vkc_pin.planning.base_paths.base_path import sample_poses, shortest_path
from vkc_pin.planning.base_paths.grid import HEADINGS, BaseGrid, compute_fine_cell_count
from vkc_pin.planning.initialization.base_routes import collect_grid_shapes
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.initialization.keyframes import sample_smoothstep
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.task.steps import GoTo

# least number of checked poses on a line, and their largest distance [m]
_MIN_POSES = 25
_MAX_DISTANCE = 0.08


class BasePaths:
    """Paths of the base around fixed obstacles in the last phase of a problem."""

    def __init__(self, problem: KinematicProblem, *, whole: bool = False) -> None:
        """Make the grid; with `whole` for the robot with its present arm and grasped objects."""
        self.omni = problem.chain.robot.base == "omni"
        z = problem.start.copy()
        z[:3] = 0.0
        moving, fixed = collect_grid_shapes(problem, len(problem.task.phases) - 1, z)
        base = [shape for joint, shape in moving if whole or joint == 1]
        self._arena = problem.scene.arena
        self._margin = problem.options.dist_safe
        self._whole = whole
        self._make_grid = functools.partial(
            BaseGrid,
            base,
            [],
            fixed,
            self._arena,
            turning=problem.chain.robot.lever,
            cache=problem.cache,
        )
        self.grid = self._make_grid(self._margin)

    @functools.cached_property
    def finer(self) -> BaseGrid:
        """A grid of smaller cells, for narrow passages."""
        # Optimisation restores the margins.
        margin = 0.0 if self._whole else self._margin
        cells = compute_fine_cell_count(self._arena, self._margin)
        return self._make_grid(margin=margin, cells=cells)

    def path(self, start: Floats, goals: Floats, steps: int) -> Floats | None:
        """Return poses from `start` to a goal, slow at both ends, shape (steps, 3), or None.

        Of several goals, shape (G, 3), it is the first with a straight path, else the nearest.
        """
        goals = np.atleast_2d(goals)
        if self.omni:
            for goal in goals:
                if self._is_line_free(start, goal):
                    return np.asarray(start + sample_smoothstep(steps)[:, None] * (goal - start))
        found = shortest_path(self.grid, start=start.tolist(), goals=goals)
        if found is None:
            found = shortest_path(self.finer, start=start.tolist(), goals=goals)
        return None if found is None else sample_poses(found, steps, turning=self.grid.turning)

    def _is_line_free(self, start: Floats, goal: Floats) -> bool:
        """Return whether the base is free at poses on the line from a pose to another."""
        dx, dy, _ = goal - start
        count = max(_MIN_POSES, int(np.ceil(np.hypot(dx, dy) / _MAX_DISTANCE)))
        return all(self.grid.is_pose_free(*pose) for pose in np.linspace(start, goal, count))

    def find_base_path(self, problem: KinematicProblem, goal: Floats) -> Floats | None:
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

    def make_guesses(self, problem: KinematicProblem, goals: Floats) -> Iterator[InitialGuess]:
        """Yield the path from a problem's start to one of `goals`, shape (G, 3), if any."""
        path = self.path(problem.start[:3], goals, problem.segments)
        if path is not None:
            z = np.tile(problem.start, (problem.segments, 1))
            z[:, :3] = path
            yield InitialGuess("astar", problem.clip(z))


def find_goal_poses(step: GoTo, yaw: float) -> Floats:
    """Return the goal poses of a step, shape (G, 3), those with headings nearest to `yaw` first."""
    if step.yaw is None:
        turns = wrap_angle(np.linspace(0.0, 2.0 * np.pi, HEADINGS, endpoint=False))
    else:
        turns = wrap_angle(np.array([step.yaw - yaw]))
    turns = turns[np.argsort(np.abs(turns), kind="stable")]
    positions = np.tile([step.x, step.y], (len(turns), 1))
    return np.column_stack([positions, yaw + turns])
