"""Ways of the base for every phase of a problem: A* around what stands there, with what is carried."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.base_body import Shape
from vkc_pin.base_grid import BaseGrid, fine_cells
from vkc_pin.base_path import BasePath, along, shortest_path
from vkc_pin.compact import compact_arm
from vkc_pin.hold import Hold
from vkc_pin.interrupt import NEVER, Interrupt
from vkc_pin.obstacles import FLOOR
from vkc_pin.problem import TrajectoryProblem

__all__ = ["Routes"]

_FOOT = 2  # the joint of the model that is the arm's first: joint 1 is the base
_NEAR = 0.4  # [m] from the ends of a way: there the arm reaches in and out, and only the base counts
_COARSE = 0.5  # [m]: starts closer together share their distances
_BESIDE, _BESIDES = (0.4, 0.4, 0.6), 60  # how far from a goal a guide may end [m, m, rad], how many such places are tried,
_DEARER = 3.0  # and what it costs for each metre or radian


class Routes:
    """The base's ways in each phase of a problem, looked for when they are asked for.

    With the arm drawn in, the grid is one for narrow passages: cells are so small that one of them is in the middle of any
    passage in which there is room for the margins, and there nothing but contact counts.
    """

    def __init__(self, problem: TrajectoryProblem, interrupt: Interrupt = NEVER) -> None:
        self.problem, self.interrupt = problem, interrupt
        self.arm = slice(3, problem.chain.robot.coordinates.size)
        self._grids: dict[tuple[int, bool], BaseGrid] = {}
        self._compact: dict[tuple[Hold, ...], NDArray[np.float64]] = {}
        self._distances: dict[tuple[int, bool, int, int], NDArray[np.float64]] = {}
        self._ways: dict[tuple[int, bytes, bytes], BasePath | None] = {}

    def grid(self, phase: int, *, drawn_in: bool = False) -> BaseGrid:
        """Return where the base fits in a phase: near the ends of a way alone, elsewhere with arm and load.

        Args:
            phase: The phase.
            drawn_in: With the arm drawn in; otherwise it is at home.
        """
        key = (phase, drawn_in)
        if key not in self._grids:
            problem, part = self.problem, self.problem.contacts.phases[phase]
            chain, shapes, arena = problem.chain, part.shapes, problem.scene.arena
            z = self._resting()
            if drawn_in:
                z[self.arm] = self.compact(phase)
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
            margin = problem.options.dist_safe
            self._grids[key] = (
                BaseGrid(base, carried, standing, arena, 0.0, near=_NEAR, cells=fine_cells(arena, margin))
                if drawn_in
                else BaseGrid(base, carried, standing, arena, margin, near=_NEAR)
            )
        return self._grids[key]

    def compact(self, phase: int) -> NDArray[np.float64]:
        """Return the arm drawn in with what is held in a phase, shape (m - 3,); see `compact_arm`."""
        held = self.problem.task.phases[phase].held
        if held not in self._compact:
            self._compact[held] = compact_arm(self.problem, phase, self._resting(), self.interrupt)
        return self._compact[held]

    def _resting(self) -> NDArray[np.float64]:
        """Return the arm at home on a base at the origin, with grasps as near to 0 as they go, shape (n,)."""
        chain, z = self.problem.chain, self.problem.start.copy()
        z[:3], z[self.arm] = 0.0, chain.robot.home
        for column in (chain.index(name) for names in chain.virtual.values() for name in names):
            z[column] = np.clip(0.0, chain.lower[column], chain.upper[column])
        return z

    def distances(
        self, phase: int, starts: NDArray[np.float64], goals: NDArray[np.float64], *, drawn_in: bool = False
    ) -> NDArray[np.float64]:
        """Return how far it is at least from starts to goals, both (B, 3), one by one, shape (B,) [m]; infinite: no way."""
        grid = self.grid(phase, drawn_in=drawn_in)
        keys = [(phase, drawn_in, *np.floor(start[:2] / _COARSE).astype(int).tolist()) for start in starts]
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
            self._ways[key] = shortest_path(self.grid(phase), start.tolist(), goal[None], interrupt=self.interrupt)
        path = self._ways[key]
        return None if path is None else along(path, steps)

    def guide(self, phase: int, start: NDArray[np.float64], goal: NDArray[np.float64], steps: int) -> NDArray[np.float64] | None:
        """Return poses from a start to a goal, both (3,), or to next to it, on which the base fits, shape (steps, 3).

        With the arm at home or, if there is no such way, with the arm drawn in. None if there is none either.
        """
        rng = np.random.default_rng(0)
        beside = rng.normal(size=(_BESIDES, 3)) * rng.random((_BESIDES, 1)) * _BESIDE
        beside[0] = 0.0
        for drawn_in in (False, True):
            grid = self.grid(phase, drawn_in=drawn_in)  # the fine one only where it is needed
            for places in (beside[:1], beside[1:]):
                costs = _DEARER * np.abs(places).sum(axis=1)
                path = shortest_path(grid, start.tolist(), goal + places, costs=costs, interrupt=self.interrupt)
                if path is not None:
                    return along(path, steps)
        return None
