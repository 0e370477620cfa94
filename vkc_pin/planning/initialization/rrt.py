"""Finds paths of base and arm between two configurations with RRT-Connect.

RRT-Connect (Kuffner and LaValle, ICRA 2000) in the robot's coordinates. The base is sampled near a
guide path, the arm near postures that are likely to be needed there, so that narrow passages are
found quickly.
"""

from __future__ import annotations

import itertools
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.planning.initialization.keyframes import compute_shortfall, sample_smoothstep
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.optional_imports import import_compiled

__all__ = ["MAX_EXTENSIONS", "STEP", "connect", "resample_path"]

MAX_EXTENSIONS = 1500
"""Maximum number of tree extensions."""
STEP = 0.15
"""Distance between collision checks, in the metric of searches: [rad] of a joint."""

# of successive searches: the second if the first one missed a collision
_STEP_SIZES = (STEP, 0.04)
_SHORTCUT_ROUNDS = 11  # partial shortcuts per coordinate between random points
# relative saving in length that a shortcut needs, or a further round of shortcuts
_MIN_SAVING = 1e-3
# share of a path by which the arm may exceed its straight path before another one is searched for
_MAX_DETOUR = 1 / 3
_PATH_SPREAD = 0.1  # [m], [rad] largest standard deviation of base samples from the guide path
_END_SPREAD = 0.4  # [m], [rad] largest standard deviation of base samples at the ends, and of arms


def connect(
    problem: TrajectoryProblem,
    phase: int,
    first: Floats,
    ends: Floats,
    *,
    poses: Floats,
    arms: Floats,
    rng: np.random.Generator,
    max_extensions: int = MAX_EXTENSIONS,
) -> Floats | None:
    """Find a nearly collision-free path of the robot.

    Args:
        problem: Problem.
        phase: Number of the phase, an open one.
        first: Start configuration, shape (n,); coordinates outside the robot stay constant.
        ends: Possible end configurations, shape (E, m).
        poses: x, y [m] and yaw [rad] along a guide path of the base, shape (P, 3).
        arms: Arm postures that are likely to be needed, shape (A, m - 3) [m] or [rad].
        rng: Random number generator.
        max_extensions: Maximum number of tree extensions.

    Returns:
        Corners of the path, shape (K, m); None if no path was found.
    """
    coarse, fine = (_Search(problem, phase, first, poses, arms, rng, step) for step in _STEP_SIZES)
    path = coarse.run(ends, max_extensions)
    if path is not None and not fine.is_free(path):
        path = fine.run(ends, max_extensions)
    return None if path is None else fine.straighten(path)


def _compute_detour(path: Floats, metric: Floats) -> float:
    """Return the share of a path, shape (K, m), by which the arm exceeds its straight path."""
    base, arm = np.split(path * metric, [3], axis=1)
    length = np.abs(np.diff(arm, axis=0)).sum()
    driven = np.linalg.norm(np.diff(base, axis=0), axis=1).sum()
    return float((length - np.abs(arm[-1] - arm[0]).sum()) / max(length + driven, 1e-12))


def resample_path(path: Floats, steps: int, metric: Floats) -> Floats:
    """Resample a path, shape (K, m), to `steps` rows without its first, slow at both ends."""
    lengths = np.linalg.norm(np.diff(path, axis=0) * metric, axis=1)
    passed = np.concatenate([[0.0], np.cumsum(lengths + 1e-12)])
    at = passed[-1] * sample_smoothstep(steps)
    return np.column_stack([np.interp(at, passed, column) for column in path.T])


class _Search:
    """Searches paths in one open phase; expensive parts are compiled (`_trees.cpp`)."""

    def __init__(
        self,
        problem: TrajectoryProblem,
        phase: int,
        first: Floats,
        poses: Floats,
        arms: Floats,
        rng: np.random.Generator,
        step: float,
    ) -> None:
        self.problem, self.first, self.poses, self.arms = problem, first, poses, arms
        self.rng, self.step = rng, step
        self.size = problem.chain.robot.coordinates.size
        self.waypoint = problem.contacts.find_waypoint(phase)
        # Shortfalls up to the margin are allowed: the solver resolves them.
        self.allowed = problem.options.dist_safe
        self.weights = problem.chain.metric[: self.size]
        limits = np.array([problem.limits(name) for name in problem.chain.names[: self.size]])
        self.lower, self.upper = limits.T

    def run(self, ends: Floats, max_extensions: int) -> Floats | None:
        """Find a path to one of `ends`, shape (E, m), with shortcuts between random points."""
        shortfall = self._compute_shortfall(ends)
        ends = ends[shortfall <= max(self.allowed, shortfall.min())]
        start = self.first[None, : self.size]
        path = self._call(self._trees.run, start, _as_rows(ends), max_extensions)
        return self._call(self._trees.shortened, path) if len(path) else None

    def _find_free_sections(self) -> list[Floats]:
        """Return collision-free sections of the guide path with each of the arms, (R, m) each."""
        sections = []
        for arm in self.arms:
            rows = np.column_stack([self.poses, np.tile(arm, (len(self.poses), 1))])
            rows = np.clip(rows, self.lower, self.upper)
            middles = (rows[1:] + rows[:-1]) / 2
            free = self._compute_shortfall(np.concatenate([rows, middles])) <= self.allowed
            at = np.flatnonzero(free[: len(rows)])
            is_joined = free[len(rows) + at[:-1]] & (np.diff(at) == 1)
            parts = np.split(at, np.flatnonzero(~is_joined) + 1)
            sections += [rows[part] for part in parts if len(part)]
        return sections

    @cached_property
    def _lines(self) -> Any:
        return self.problem.contacts.make_line_checker(
            self.first,
            self.waypoint,
            weights=self.weights,
            step=self.step,
            reach=0.0,
            allowed=self.allowed,
        )

    @cached_property
    def _trees(self) -> Any:
        sections = self._find_free_sections()
        rows = np.concatenate([np.empty((0, self.size)), *sections])
        parts = map(_as_rows, (self.weights, self.lower, self.upper, self.poses, self.arms, rows))
        lengths = np.array([len(section) for section in sections], np.int64)
        random_seed = int(self.rng.integers(2**63))
        module = import_compiled("vkc_pin.planning.initialization._trees")
        return module.Trees(self._lines, *parts, lengths, _PATH_SPREAD, _END_SPREAD, random_seed)

    def _call(self, method: Any, rows: ArrayLike, *arguments: Any) -> Any:
        """Call a method of the trees, and record the evaluations of its collision checks."""
        result = method(_as_rows(rows), *arguments)
        record_evaluations(self._lines.looked())
        return result

    def _compute_shortfall(self, rows: Floats) -> Floats:
        z = np.tile(self.first, (len(rows), 1))
        z[:, : self.size] = rows
        return compute_shortfall(self.problem, z, self.waypoint, reach=0.0)

    def is_free(self, path: Floats) -> bool:
        return all(self._call(self._trees.along, ends) == 1.0 for ends in itertools.pairwise(path))

    def straighten(self, path: Floats) -> Floats:
        """Straighten the motion of the arm, and of each joint alone, where that is collision-free.

        A path through a narrow passage with another posture moves all joints. Straight lines in all
        coordinates seldom undo that, and the solver cannot, because obstacles are in between. So
        coordinates are treated separately (partial shortcuts: Geraerts and Overmars, IJRR 2007),
        first along the whole path, then between random points on it. Detours of the arm are treated
        repeatedly as long as that pays off.
        """
        previous, path = np.inf, self._call(self._trees.evened, path, 0, _MIN_SAVING)
        while (length := self._compute_length(path)) < (1.0 - _MIN_SAVING) * previous:
            previous = length
            path = self._call(self._trees.evened, path, _SHORTCUT_ROUNDS, _MIN_SAVING)
            if _compute_detour(path, self.weights) <= _MAX_DETOUR:
                break
        return path

    def _compute_length(self, path: Floats) -> float:
        return float(np.linalg.norm(np.diff(path, axis=0) * self.weights, axis=1).sum())


def _as_rows(rows: ArrayLike) -> Floats:
    """Return a contiguous array, as the compiled code expects it."""
    return np.ascontiguousarray(rows, float)
