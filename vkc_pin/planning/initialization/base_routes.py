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
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.solids import count_threads
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR

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

    def __init__(self, problem: KinematicProblem) -> None:
        self.problem = problem
        self.chain = problem.chain
        self.arm = slice(3, self.chain.robot.coordinates.size)
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
            self._grids[key] = self._make_grid(phase, folded)
        return self._grids[key]

    def _make_grid(self, phase: int, folded: bool) -> BaseGrid:
        """Return a new grid; see `get_grid`."""
        z = self._make_resting_configuration()
        arena = self.problem.scene.arena
        dist_safe = self.problem.options.dist_safe
        settings: dict[str, Any] = {"margin": dist_safe}
        if folded:
            z[self.arm] = self.get_folded_arm(phase)
            settings = {"margin": 0.0, "cells": compute_fine_cell_count(arena, dist_safe)}
        moving, fixed = collect_grid_shapes(self.problem, phase, z)
        # The arm's first link counts with the base: a low base must not drive under a table that
        # the arm would hit.
        base = [shape for joint, shape in moving if joint <= _ARM_BASE]
        carried = [shape for joint, shape in moving if joint > _ARM_BASE]
        return BaseGrid(
            base,
            carried,
            fixed,
            arena,
            near=_REACHING_RADIUS,
            turning=self.chain.robot.lever,
            cache=self.problem.cache,
            **settings,
        )

    def get_folded_arm(self, phase: int) -> Floats:
        """Return the most compact posture in a phase, (m - 3,); see `find_folded_arms`."""
        return np.asarray(self._get_folded_arms(phase)[0])

    def find_nearest_folded_arm(self, phase: int, first: Floats, last: Floats) -> Floats:
        """Return the folded arm nearest to the motion between two postures, all (m - 3,).

        Each of its angles may be a full turn more or less, within limits.
        """
        chain = self.chain
        arms = self._get_folded_arms(phase)
        is_angle = [self.problem.unit(name) == "rad" for name in chain.names[self.arm]]
        full_turns = 2.0 * np.pi * np.array([0.0, -1.0, 1.0])[:, None, None] * is_angle
        variants = arms + full_turns  # (3, F, m - 3)
        lengths = (np.abs(variants - first) + np.abs(variants - last)) * chain.metric[self.arm]
        is_outside = (variants < chain.lower[self.arm]) | (variants > chain.upper[self.arm])
        lengths[1:][is_outside[1:]] = np.inf
        nearest = int(np.argmin(lengths.min(axis=0).sum(axis=1)))
        best_turns = lengths[:, nearest].argmin(axis=0)
        return np.asarray(variants[best_turns, nearest, np.arange(len(first))])

    def _get_folded_arms(self, phase: int) -> Floats:
        """Return all folded postures in a phase, (F, m - 3); see `find_folded_arms`."""
        held = self.problem.task.phases[phase].held
        if held not in self._folded:
            resting = self._make_resting_configuration()
            self._folded[held] = find_folded_arms(self.problem, phase, resting)
        return self._folded[held]

    def _make_resting_configuration(self) -> Floats:
        """Return the arm at home on a base at the origin, grasp coordinates near 0, shape (n,)."""
        chain = self.chain
        z = self.problem.start.copy()
        z[:3] = 0.0
        z[self.arm] = chain.robot.home
        for names in chain.virtual.values():
            for name in names:
                column = chain.index(name)
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
        goal_cells = np.floor((goals[:, :2] - grid.origin) / grid.step + 0.5).astype(int)
        goal_cells = np.clip(goal_cells, 0, grid.cells - 1)
        start_cells = np.floor(starts[:, :2] / SIMILARITY_TOLERANCE).astype(int).tolist()
        keys = [(phase, folded, i, j) for i, j in start_cells]
        new_starts = {}
        for key, start in zip(keys, starts, strict=True):
            if key not in self._distances:
                new_starts[key] = start[:2]
        if new_starts:
            places = np.array(list(new_starts.values()))
            maps = grid.compute_distances(places, threads=count_threads())
            self._distances.update(zip(new_starts, maps, strict=True))
        distances = []
        for key, (i, j) in zip(keys, goal_cells.tolist(), strict=True):
            distances.append(self._distances[key][i, j])
        return np.array(distances)

    def find_path(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Find `steps` base poses from start to goal, both (3,), without the start: (steps, 3).

        The heading is continuous and ends at an angle equivalent to the goal's. None if there is no
        path.
        """
        return self._find_path(phase, start, goal, steps, folded=False)

    def find_guide_path(self, phase: int, start: Floats, goal: Floats, steps: int) -> Floats | None:
        """Find a path as `find_path` does, with the arm at home or, if there is none, folded."""
        path = self._find_path(phase, start, goal, steps, folded=False)
        if path is None:  # the fine grid only where it is needed
            path = self._find_path(phase, start, goal, steps, folded=True)
        return path

    def _find_path(
        self, phase: int, start: Floats, goal: Floats, steps: int, *, folded: bool
    ) -> Floats | None:
        """Find a path with the arm at home or folded; see `find_path`."""
        grid = self.get_grid(phase, folded=folded)
        rolling = self.problem.rolling
        turning = self.chain.robot.lever
        key = (phase, folded, start.tobytes(), goal.tobytes())
        if key not in self._paths:
            self._paths[key] = shortest_path(grid, start.tolist(), goal[None])
        path = self._paths[key]
        if path is None:
            return None
        if rolling.is_omnidirectional:
            return sample_poses(path, steps, turning=turning)
        corners = path.poses  # a base on wheels gets a pose at each corner, so that it rolls
        if rolling.turning_radius > 0.0:

            def is_free(pose: Floats) -> bool:
                return grid.is_pose_free(*pose, reaching=True)

            corners = Curves(rolling.turning_radius, turning).fit(corners, is_free)
        return sample_path(corners, steps, turning=turning)


def find_folded_arms(problem: KinematicProblem, phase: int, resting: Floats) -> Floats:
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
    chain = problem.chain
    arm = slice(3, chain.robot.coordinates.size)
    home = chain.robot.home
    is_angle = np.array([problem.unit(name) == "rad" for name in chain.names[arm]])
    lower = np.where(is_angle, np.maximum(chain.lower[arm], home - np.pi), chain.lower[arm])
    upper = np.where(is_angle, np.minimum(chain.upper[arm], home + np.pi), chain.upper[arm])
    rng = np.random.default_rng(0)
    z = np.tile(resting, (_POSTURE_SAMPLES, 1))
    z[0, arm] = home
    z[1:, arm] = rng.uniform(lower, upper, (_POSTURE_SAMPLES - 1, len(home)))
    waypoint = problem.contacts.find_waypoint(phase)

    def select_free(postures: Ints) -> Ints:
        """Select those that keep the margins of robot and load themselves."""
        shortfall = compute_shortfall(problem, z[postures], waypoint, static=False)
        return postures[shortfall <= 0.0]

    reach, base = _compute_reach(problem, phase, z)
    order = np.argsort(reach.sum(axis=1), kind="stable")
    # One of the first is usually free.
    for postures in np.array_split(order, math.isqrt(_POSTURE_SAMPLES)):
        free = select_free(postures)
        if len(free):
            best = free[0]
            extent = np.maximum(base, reach[best])[:2]
            others = select_free(np.flatnonzero((reach[:, :2] <= extent).all(axis=1)))
            return np.vstack([z[best, arm], z[others, arm]])
    return np.array(home[None])


def _compute_reach(problem: KinematicProblem, phase: int, z: Floats) -> tuple[Floats, Floats]:
    """Return extents along the base's axes of arm and load, (B, 3), and of the base, (3,) [m]."""
    rotations, translations = problem.chain.joint_placements(z)
    base_rotations = rotations[:, 1]
    base_translations = translations[:, 1, :, None]
    reach = np.zeros((len(z), 3))
    base = np.zeros(3)
    for shape in _collect_moving_shapes(problem, phase):
        joint = shape.parentJoint
        points, radius = compute_hull_points(shape.geometry, shape.placement, outer=True)
        # R₁ᵀ (R_j x + t_j − t₁) for the points x of a shape on joint j, with the base on joint 1
        from_base = (
            rotations[:, joint] @ points.T + translations[:, joint, :, None] - base_translations
        )
        in_base = base_rotations.transpose(0, 2, 1) @ from_base
        own = np.abs(in_base).max(axis=2) + radius
        if joint > 1:
            np.maximum(reach, own, out=reach)
        else:
            np.maximum(base, own[0], out=base)
    return reach, base


def _collect_moving_shapes(problem: KinematicProblem, phase: int) -> list[pin.GeometryObject]:
    """Return the shapes of the robot and of its load."""
    robot = range(len(problem.chain.robot.collision.geometryObjects))
    attached = problem.contacts.find_attached_geometries(phase)
    return [problem.contacts.phases[phase].shapes[i] for i in [*robot, *attached]]


def collect_grid_shapes(
    problem: KinematicProblem, phase: int, z: Floats
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
    part = problem.contacts.phases[phase]
    rotations, translations = problem.chain.joint_placements(z[None])
    moving: list[tuple[int, Shape]] = []
    for shape in _collect_moving_shapes(problem, phase):
        joint = shape.parentJoint
        carrier = pin.SE3(rotations[0, joint], translations[0, joint])
        moving.append((joint, (shape.geometry, carrier * shape.placement)))
    robot = part.shapes[: len(problem.chain.robot.collision.geometryObjects)]
    base = [i for i, shape in enumerate(robot) if shape.parentJoint < _ARM_BASE]
    with_base = np.isin(part.pairs[:, 0], base)
    paired = set(part.pairs[with_base, 1].tolist())  # without allowed contacts
    fixed: list[Shape] = []
    for i, (shape, label) in enumerate(zip(part.shapes, part.labels, strict=True)):
        is_obstacle = shape.parentJoint == 0 and label != FLOOR
        if is_obstacle and (i in paired or not base):
            fixed.append((shape.geometry, shape.placement))
    return moving, fixed
