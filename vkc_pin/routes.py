"""Ways of the base for every phase of a problem: A* around what stands there, with what is carried."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.base_body import Shape
from vkc_pin.base_grid import BaseGrid
from vkc_pin.base_path import BasePath, along, shortest_path
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.scene import FLOOR

__all__ = ["Routes"]

_FOOT = 2  # the joint of the model that is the arm's first: joint 1 is the base
_NEAR = 0.4  # [m] from the ends of a way: there the arm reaches in and out, and only the base counts
_COARSE = 0.5  # [m]: starts closer together share their distances


class Routes:
    """The base's ways in each phase of a problem, looked for when they are asked for."""

    def __init__(self, problem: TrajectoryProblem) -> None:
        self.problem = problem
        self._grids: dict[int, BaseGrid] = {}
        self._distances: dict[tuple[int, int, int], NDArray[np.float64]] = {}
        self._ways: dict[tuple[int, bytes, bytes], BasePath | None] = {}

    def grid(self, phase: int) -> BaseGrid:
        """Return where the base fits in a phase: alone near the ends of a way, elsewhere with the arm at home and its load."""
        if phase not in self._grids:
            problem, part = self.problem, self.problem.contacts.phases[phase]
            chain, shapes = problem.chain, part.shapes
            z = problem.start.copy()
            z[:3], z[3 : chain.robot.coordinates.size] = 0.0, chain.robot.home
            for names in chain.virtual.values():
                for column in map(chain.index, names):
                    z[column] = np.clip(0.0, chain.lower[column], chain.upper[column])
            rotations, translations = chain.joint_placements(z[None])
            robot = range(len(chain.robot.collision.geometryObjects))
            held = [i for hold in problem.task.phases[phase].held for i in chain.held_geometries[hold]]
            base: list[Shape] = []
            carried: list[Shape] = []
            for i in [*robot, *held]:
                joint = shapes[i].parentJoint
                carrier = pin.SE3(rotations[0, joint], translations[0, joint])
                # Where the arm stands on the base it is always: a low base does not go under a table that the arm does not.
                (base if joint <= _FOOT else carried).append((shapes[i].geometry, carrier * shapes[i].placement))
            standing: list[Shape] = [
                (shape.geometry, shape.placement)
                for shape, label in zip(shapes, part.labels, strict=True)
                if shape.parentJoint == 0 and label != FLOOR
            ]
            self._grids[phase] = BaseGrid(base, carried, standing, problem.scene.arena, problem.options.dist_safe, near=_NEAR)
        return self._grids[phase]

    def distances(self, phase: int, starts: NDArray[np.float64], goals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far it is at least from starts to goals, both (B, 3), one by one, shape (B,) [m]; infinite: no way."""
        grid = self.grid(phase)
        keys = [(phase, *np.floor(start[:2] / _COARSE).astype(int).tolist()) for start in starts]
        new = {key: start[:2] for key, start in zip(keys, starts, strict=True) if key not in self._distances}
        if new:
            self._distances |= dict(zip(new, grid.distances_from(np.array(list(new.values()))), strict=True))
        cells = np.clip(np.floor((goals[:, :2] - grid.origin) / grid.step + 0.5).astype(int), 0, grid.cells - 1)
        return np.array([self._distances[key][i, j] for key, (i, j) in zip(keys, cells, strict=True)])

    def way(self, phase: int, start: NDArray[np.float64], goal: NDArray[np.float64], steps: int) -> NDArray[np.float64] | None:
        """Return `steps` poses of the base from start to goal, both (3,), the last at the goal's place: shape (steps, 3).

        The heading is continuous from the start's, and ends at one equal to the goal's. None if there is no way.
        """
        key = (phase, start.tobytes(), goal.tobytes())
        if key not in self._ways:
            self._ways[key] = shortest_path(self.grid(phase), start.tolist(), goal[None])
        path = self._ways[key]
        return None if path is None else along(path, steps)
