"""Finds base paths for every phase with A*, and folded arm postures for narrow passages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.planning.base_paths.arcs import Curves, sample_path
from vkc_pin.planning.base_paths.base_clearance import Shape, compute_hull_points
from vkc_pin.planning.base_paths.base_path import BasePath, sample_poses, shortest_path
from vkc_pin.planning.base_paths.grid import BaseGrid, compute_fine_cell_count
from vkc_pin.planning.initialization.keyframes import SIMILARITY_TOLERANCE, compute_shortfall
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.collision.threads import count_threads
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR

__all__ = ["BaseRoutes", "collect_grid_shapes", "find_folded_arms"]

_ARM_BASE = 2  # first joint of the arm in the model: joint 1 is the base
# [m] from the ends of a path within which the arm approaches or retreats, and only the base counts
_REACHING_RADIUS = 0.4
# random postures: with 192 the arm may stay wider than the base, 4000 bring no improvement
_POSTURE_SAMPLES = 1000


class BaseRoutes:
    """Base paths in each phase of a problem, computed on demand.

    With the arm folded, the grid is made for narrow passages: cells are so small that one lies in
    the middle of any passage that is wide enough for the margins, and only contact counts.
    """

    def __init__(self, problem: TrajectoryProblem) -> None:
        self.problem = problem
        self.arm = slice(3, problem.chain.robot.coordinates.size)
        self._grids: dict[tuple[int, bool], BaseGrid] = {}
        self._folded: dict[tuple[Hold, ...], Floats] = {}
        self._distances: dict[tuple[int, bool, int, int], Floats] = {}
        self._paths: dict[tuple[int, bool, bytes, bytes], BasePath | None] = {}

    def get_grid(self, phase: int, *, folded: bool = False) -> BaseGrid:
        """Return the grid of free base poses in a phase.

        Near the ends of a path only the base counts, elsewhere also the arm and its load.

        Args:
            phase: Number of the phase.
            folded: Whether the arm is folded; otherwise it is at home.
        """
        key = (phase, folded)
        if key not in self._grids:
            z, arena, margin = (
                self._make_resting_configuration(),
                self.problem.scene.arena,
                self.problem.options.dist_safe,
            )
            cache, turning = self.problem.cache, self.problem.chain.robot.lever
            if folded:
                z[self.arm] = self.get_folded_arm(phase)
            moving, standing = collect_grid_shapes(self.problem, phase, z)
            # The arm's first link counts with the base: a low base must not drive under a table
            # that the arm would hit.
            base = [shape for joint, shape in moving if joint <= _ARM_BASE]
            carried = [shape for joint, shape in moving if joint > _ARM_BASE]
            how: dict[str, Any] = (
                {"margin": 0.0, "cells": compute_fine_cell_count(arena, margin)}
                if folded
                else {"margin": margin}
            )
            how |= {"near": _REACHING_RADIUS, "turning": turning, "cache": cache}
            self._grids[key] = BaseGrid(base, carried, standing, arena, **how)
        return self._grids[key]

    def get_folded_arm(self, phase: int) -> Floats:
        """Return the most compact posture in a phase, (m - 3,); see `find_folded_arms`."""
        return np.asarray(self._get_folded_arms(phase)[0])

    def find_nearest_folded_arm(self, phase: int, first: Floats, last: Floats) -> Floats:
        """Return the folded arm nearest to the motion between two postures, all (m - 3,)."""
        chain, arms = self.problem.chain, self._get_folded_arms(phase)
        turning = [self.problem.unit(name) == "rad" for name in chain.names[self.arm]]
        wound = arms + 2.0 * np.pi * np.array([0.0, -1.0, 1.0])[:, None, None] * turning
        lengths = (np.abs(wound - first) + np.abs(wound - last)) * chain.metric[self.arm]
        is_outside = (wound < chain.lower[self.arm]) | (wound > chain.upper[self.arm])
        lengths[1:][is_outside[1:]] = np.inf
        nearest = int(np.argmin(lengths.min(axis=0).sum(axis=1)))
        return np.asarray(wound[lengths[:, nearest].argmin(axis=0), nearest, np.arange(len(first))])

    def _get_folded_arms(self, phase: int) -> Floats:
        held = self.problem.task.phases[phase].held
        if held not in self._folded:
            self._folded[held] = find_folded_arms(
                self.problem, phase, self._make_resting_configuration()
            )
        return self._folded[held]

    def _make_resting_configuration(self) -> Floats:
        """Return the arm at home on a base at the origin, grasp coordinates near 0, shape (n,)."""
        chain, z = self.problem.chain, self.problem.start.copy()
        z[:3], z[self.arm] = 0.0, chain.robot.home
        for column in (chain.index(name) for names in chain.virtual.values() for name in names):
            z[column] = np.clip(0.0, chain.lower[column], chain.upper[column])
        return z

    def compute_distances(
        self, phase: int, starts: Floats, goals: Floats, *, folded: bool = False
    ) -> Floats:
        """Return lower bounds of the driving distance between poses, both (B, 3), shape (B,) [m].

        Infinite: there is no path. Starts within `SIMILARITY_TOLERANCE` share the distances of the
        first one.
        """
        grid = self.get_grid(phase, folded=folded)
        end = np.clip(
            np.floor((goals[:, :2] - grid.origin) / grid.step + 0.5).astype(int), 0, grid.cells - 1
        ).tolist()
        begin = np.floor(starts[:, :2] / SIMILARITY_TOLERANCE).astype(int).tolist()
        keys = [(phase, folded, *cell) for cell in begin]
        new = {
            key: start[:2]
            for key, start in zip(keys, starts, strict=True)
            if key not in self._distances
        }
        if new:
            found = grid.compute_distances(np.array(list(new.values())), threads=count_threads())
            self._distances |= dict(zip(new, found, strict=True))
        return np.array([self._distances[key][i, j] for key, (i, j) in zip(keys, end, strict=True)])

    def find_path(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Find `steps` base poses from start to goal, both (3,), without the start: (steps, 3).

        The heading is continuous and ends at an angle equivalent to the goal's. None if there is no
        path.
        """
        path = self._find_shortest(phase, start, goal)
        return (
            None
            if path is None
            else self._sample_poses(
                self.get_grid(phase), path, steps, self.problem.chain.robot.lever
            )
        )

    def _find_shortest(
        self, phase: int, start: Floats, goal: Floats, *, folded: bool = False
    ) -> BasePath | None:
        """Return the cached shortest base path from start to goal, both (3,), if there is one."""
        key = (phase, folded, start.tobytes(), goal.tobytes())
        if key not in self._paths:
            self._paths[key] = shortest_path(
                self.get_grid(phase, folded=folded), start.tolist(), goal[None]
            )
        return self._paths[key]

    def _sample_poses(self, grid: BaseGrid, path: BasePath, steps: int, turning: float) -> Floats:
        """Sample poses along a path; a base on wheels gets one at each corner, so that it rolls."""
        rolling = self.problem.rolling
        if rolling.is_omnidirectional:
            return sample_poses(path, steps, turning=turning)
        corners = path.poses
        if rolling.turning_radius > 0.0:
            corners = Curves(rolling.turning_radius, turning).fit(
                corners, lambda pose: grid.is_pose_free(*pose, reaching=True)
            )
        return sample_path(corners, steps, turning=turning)

    def find_guide_path(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Find a guide path of base poses from start to goal, both (3,), shape (steps, 3).

        The arm is at home or, if there is no such path, folded. None if there is no path at all.
        """
        for folded in (False, True):  # the fine grid only where it is needed
            path = self._find_shortest(phase, start, goal, folded=folded)
            if path is not None:
                grid = self.get_grid(phase, folded=folded)
                return self._sample_poses(grid, path, steps, grid.turning)
        return None


def find_folded_arms(problem: TrajectoryProblem, phase: int, resting: Floats) -> Floats:
    """Find compact arm postures among random ones, the same every time.

    The first posture minimizes the sum of the extents of arm and load from the base's origin along
    its three axes. The others extend no further in the plane than that one or the base itself. The
    robot is free of collisions with itself and its load.

    Args:
        problem: Problem.
        phase: Number of the phase, which determines the load.
        resting: Configuration of robot and load, shape (n,); only the arm changes, and the base
            pose does not matter.

    Returns:
        Postures, shape (F, m - 3) [m] or [rad].
    """
    chain, rng = problem.chain, np.random.default_rng(0)
    arm, home = slice(3, chain.robot.coordinates.size), chain.robot.home
    turns = np.array([problem.unit(name) == "rad" for name in chain.names[arm]])
    lower = np.where(turns, np.maximum(chain.lower[arm], home - np.pi), chain.lower[arm])
    upper = np.where(turns, np.minimum(chain.upper[arm], home + np.pi), chain.upper[arm])
    z = np.tile(resting, (_POSTURE_SAMPLES, 1))
    z[:, arm] = [home, *rng.uniform(lower, upper, (_POSTURE_SAMPLES - 1, len(home)))]
    reach, base = _compute_reach(problem, phase, z)
    order = np.argsort(reach.sum(axis=1), kind="stable")
    # One of the first is usually free.
    for tried in np.array_split(order, math.isqrt(_POSTURE_SAMPLES)):
        free = tried[_is_self_clear(problem, phase, z[tried])]
        if len(free):
            best = free[0]
            extent = np.maximum(base, reach[best])[:2]
            others = np.flatnonzero((reach[:, :2] <= extent).all(axis=1))
            return np.vstack(
                [z[best, arm], z[others[_is_self_clear(problem, phase, z[others])], arm]]
            )
    return np.array(home[None])


def _is_self_clear(problem: TrajectoryProblem, phase: int, z: Floats) -> Bools:
    """Return for which configurations, (B, n), robot and load keep their own margins, (B,)."""
    return (
        compute_shortfall(problem, z, problem.contacts.find_waypoint(phase), standing=False) <= 0.0
    )


def _compute_reach(problem: TrajectoryProblem, phase: int, z: Floats) -> tuple[Floats, Floats]:
    """Return extents along the base's axes of arm and load, (B, 3), and of the base, (3,) [m]."""
    chain, shapes = problem.chain, problem.contacts.phases[phase].shapes
    rotations, translations = chain.joint_placements(z)
    reach, base = np.zeros((len(z), 3)), np.zeros(3)
    carried = problem.contacts.find_attached_geometries(phase)
    for shape in (
        shapes[i] for i in [*range(len(chain.robot.collision.geometryObjects)), *carried]
    ):
        joint = shape.parentJoint
        corners, radius = compute_hull_points(shape.geometry, shape.placement, outer=True)
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


def collect_grid_shapes(
    problem: TrajectoryProblem, phase: int, z: Floats
) -> tuple[list[tuple[int, Shape]], list[Shape]]:
    """Collect the shapes of a base grid.

    Args:
        problem: Problem.
        phase: Number of the phase, which determines the load.
        z: Configuration with the base at the origin, shape (n,).

    Returns:
        Shapes on the base in its frame, with their joint, robot first; obstacles in the world
        without the floor and allowed contacts.
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
    hits = set(part.pairs[np.isin(part.pairs[:, 0], base), 1].tolist())  # without allowed contacts
    standing: list[Shape] = [
        (shape.geometry, shape.placement)
        for i, (shape, label) in enumerate(zip(part.shapes, part.labels, strict=True))
        if shape.parentJoint == 0 and label != FLOOR and (i in hits or not base)
    ]
    return moving, standing
