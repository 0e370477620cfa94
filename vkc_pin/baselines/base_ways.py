"""The base's way while an object is moved: straight if that is free, else the shortest by A*, the arm left out of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vkc_pin.base_body import Shape
from vkc_pin.base_grid import BaseGrid
from vkc_pin.base_path import along, shortest_path
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.scene import FLOOR

__all__ = ["BaseWays"]

_STEPS = 25  # places of a straight way that are looked at


class BaseWays:
    """Ways of the bare base between places, around all that stands while an object is moved.

    Attributes:
        grid: Where the base fits.
    """

    def __init__(self, problem: TrajectoryProblem) -> None:
        robot = problem.chain.robot
        self.omni = robot.base == "omni"
        base: list[Shape] = [
            (shape.geometry, shape.placement) for shape in robot.collision.geometryObjects if shape.parentJoint == 1
        ]
        part = problem.contacts.phases[-1]
        standing: list[Shape] = [
            (shape.geometry, shape.placement)
            for shape, label in zip(part.shapes, part.labels, strict=True)
            if shape.parentJoint == 0 and label != FLOOR
        ]
        self.grid = BaseGrid(base, [], standing, problem.scene.arena, problem.options.dist_safe)

    def way(self, start: NDArray[np.float64], goal: NDArray[np.float64], steps: int) -> NDArray[np.float64] | None:
        """Return poses after the start, slow at both ends, the last at the goal, shape (steps, 3); None: there is no way.

        Args:
            start: x, y, yaw [m, rad].
            goal: The same.
            steps: How many poses.
        """
        u = np.arange(1, steps + 1)[:, None] / steps
        if self.omni and all(self.grid.clear(*pose) for pose in np.linspace(start, goal, _STEPS)):
            return np.asarray(start + u * u * (3.0 - 2.0 * u) * (goal - start))
        path = shortest_path(self.grid, start.tolist(), goal[None])
        return None if path is None else along(path, steps)
