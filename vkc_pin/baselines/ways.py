"""The base's ways: straight if that is free, else the shortest by A*; of the bare base, or with the arm as it is."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from vkc_pin.driving.grid import HEADINGS, BaseGrid, fine_cells
from vkc_pin.driving.path import poses_along, shortest_path
from vkc_pin.interrupt import NEVER, Interrupt
from vkc_pin.models.coordinates import wrapped
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.seeds.knots import smooth
from vkc_pin.seeds.routes import grid_shapes
from vkc_pin.seeds.seed import Seed
from vkc_pin.task.steps import GoTo

__all__ = ["BaseWays", "headings"]

_STEPS, _STEP = 25, 0.08  # places of a straight way that are looked at: at least so many, and at most so far apart [m]


class BaseWays:
    """Ways of the base between places, around all that stands in the last phase of a problem.

    Attributes:
        grid: Where the base fits.
    """

    def __init__(self, problem: TrajectoryProblem, *, whole: bool = False, interrupt: Interrupt = NEVER) -> None:
        """Look at the floor.

        Args:
            problem: Whose ways they are.
            whole: The arm counts as well, as it is at the start, with what it holds; otherwise the bare base alone.
            interrupt: Ends a search, as if there were no way.
        """
        self.interrupt = interrupt
        self.omni = problem.chain.robot.base == "omni"
        z = problem.start.copy()
        z[:3] = 0.0
        moving, standing = grid_shapes(problem, len(problem.task.phases) - 1, z)
        base = [shape for joint, shape in moving if whole or joint == 1]
        arena, margin = problem.scene.arena, problem.options.dist_safe
        self.grid = BaseGrid(base, [], standing, arena, margin, cache=problem.cache)
        # Without margins where an optimisation follows: it restores them.
        cells = fine_cells(arena, margin)
        slack = 0.0 if whole else margin
        self._finer = functools.partial(BaseGrid, base, [], standing, arena, slack, cells=cells, cache=problem.cache)

    @functools.cached_property
    def finer(self) -> BaseGrid:
        """A grid of smaller cells, for narrow passages."""
        return self._finer()

    def way(self, start: NDArray[np.float64], goals: NDArray[np.float64], steps: int) -> NDArray[np.float64] | None:
        """Return poses after the start, slow at both ends, the last at a goal, shape (steps, 3); None: there is no way.

        Args:
            start: x, y, yaw [m, rad].
            goals: The same, shape (3,), or several of them, shape (G, 3): the first that can be reached straight, else the one
                to which the way is the shortest.
            steps: How many poses.
        """
        goals = np.atleast_2d(goals)
        for goal in goals if self.omni else ():
            places = max(_STEPS, int(np.ceil(np.hypot(*(goal - start)[:2]) / _STEP)))
            if all(self.grid.clear(*pose) for pose in np.linspace(start, goal, places)):
                return np.asarray(start + smooth(steps)[:, None] * (goal - start))
        path = shortest_path(self.grid, start.tolist(), goals, interrupt=self.interrupt)
        if path is None:
            path = shortest_path(self.finer, start.tolist(), goals, interrupt=self.interrupt)
        return None if path is None else poses_along(path, steps)

    def seeds(self, problem: TrajectoryProblem, goals: NDArray[np.float64]) -> Iterator[Seed]:
        """Yield the way from a problem's start to one of `goals`, shape (G, 3), the arm at rest, if there is one."""
        way = self.way(problem.start[:3], goals, problem.segments)
        if way is not None:
            z = np.tile(problem.start, (problem.segments, 1))
            z[:, :3] = way
            yield Seed("astar", problem.clip(z))


def headings(step: GoTo, yaw: float) -> NDArray[np.float64]:
    """Return the poses in which a step may end, shape (G, 3): one, or one per heading, those nearest to `yaw` [rad] first."""
    turns = np.linspace(0.0, 2.0 * np.pi, HEADINGS, endpoint=False) if step.yaw is None else np.array([step.yaw - yaw])
    turns = wrapped(turns)
    turns = turns[np.argsort(np.abs(turns), kind="stable")]
    return np.column_stack([np.tile([step.x, step.y], (len(turns), 1)), yaw + turns])
