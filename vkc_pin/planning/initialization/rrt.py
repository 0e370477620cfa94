"""A path of base and arm together from one configuration to another, by two random trees that grow towards each other.

RRT-Connect (Kuffner and LaValle, ICRA 2000) in the robot's coordinates. The base is drawn near a
path that it could drive, the arm near postures it is likely to need there, so that narrow passages
are found soon.
"""

from __future__ import annotations

import itertools
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.planning.initialization.keyframes import depth, smooth
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import spend
from vkc_pin.utils.optional_imports import compiled_module

__all__ = ["STEP", "TRIES", "connect", "far_round", "spread"]

TRIES = 1500
"""How often a tree may grow until they meet."""
STEP = 0.15
"""Between configurations that are looked at, in the metric of searches: [rad] of a joint."""

_STEPS = (
    STEP,
    0.04,
)  # of one search after the other: the latter where the former overlooked something
# times that the arm and each of its joints are tried to be straightened between random places
_STRAIGHTENINGS = 11
# share of a path's length that is to be saved by it, or by all of that once more where the arm goes
# far round
_WORTH = 1e-3
_DETOUR = (
    1 / 3
    # share of a path that the arm goes beyond its straight way, up to which no other one is looked for
)
_BESIDE_PATH = 0.1  # [m] and [rad] standard deviation, at most, of bases beside their path
_AROUND = 0.4  # [m] and [rad] standard deviation, at most, of bases around the ends, and of arms


def connect(
    problem: TrajectoryProblem,
    phase: int,
    first: Floats,
    ends: Floats,
    *,
    poses: Floats,
    arms: Floats,
    rng: np.random.Generator,
    tries: int = TRIES,
) -> Floats | None:
    """Return configurations of the robot, straight between which hardly anything is hit, shape (K, m), or None if none are found.

    Args:
        problem: Whose robot and phase it is.
        phase: In which nothing fixed is held.
        first: Where the path begins, shape (n,); what is not the robot stays so.
        ends: Where it may end, shape (E, m).
        poses: x, y [m] and yaw [rad] on a path that the base may take, shape (P, 3).
        arms: Postures that are likely to be needed, shape (A, m - 3) [m] and [rad].
        rng: Random numbers.
        tries: How often a tree may grow.
    """
    coarse, fine = (_Search(problem, phase, first, poses, arms, rng, step) for step in _STEPS)
    path = coarse.run(ends, tries)
    if path is not None and not fine.free(path):
        path = fine.run(ends, tries)
    return None if path is None else fine.straightened(path)


def far_round(problem: TrajectoryProblem, z: Floats) -> bool:
    """Return whether the arm goes far round in a phase of a motion, z_1..z_N of shape (N, n), in which nothing fixed is held."""
    rows, metric = (
        problem.waypoints(z)[:, : problem.chain.robot.coordinates.size],
        problem.chain.metric,
    )
    spans = zip(problem.task.phases, itertools.pairwise([0, *problem.ends.tolist()]), strict=True)
    ways = [rows[begin : end + 1] for phase, (begin, end) in spans if not problem.closed(phase)]
    return any(_detour(way, metric[: way.shape[1]]) > _DETOUR for way in ways)


def _detour(path: Floats, metric: Floats) -> float:
    """Return which share of a path of the robot, shape (K, m), the arm goes beyond its straight way, in a metric, shape (m,)."""
    base, arm = np.split(path * metric, [3], axis=1)
    way, driven = (
        np.abs(np.diff(arm, axis=0)).sum(),
        np.linalg.norm(np.diff(base, axis=0), axis=1).sum(),
    )
    return float((way - np.abs(arm[-1] - arm[0]).sum()) / max(way + driven, 1e-12))


def spread(path: Floats, steps: int, metric: Floats) -> Floats:
    """Return `steps` configurations along a path, shape (K, m), without its first: slow at both ends, shape (steps, m)."""
    lengths = np.linalg.norm(np.diff(path, axis=0) * metric, axis=1)
    passed = np.concatenate([[0.0], np.cumsum(lengths + 1e-12)])
    at = passed[-1] * smooth(steps)
    return np.column_stack([np.interp(at, passed, column) for column in path.T])


class _Search:
    """Looks for paths in one phase, in which nothing fixed is held; what takes long is compiled (`_trees.cpp`)."""

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
        self.problem, self.first, self.poses, self.arms, self.rng, self.step = (
            problem,
            first,
            poses,
            arms,
            rng,
            step,
        )
        self.size = problem.chain.robot.coordinates.size
        self.waypoint = problem.contacts.find_waypoint(phase)
        self.allowed = (
            problem.options.dist_safe
        )  # all of a margin may be missing: the solver pushes that apart
        self.weights = problem.chain.metric[: self.size]
        limits = np.array([problem.limits(name) for name in problem.chain.names[: self.size]])
        self.lower, self.upper = np.ascontiguousarray(limits.T)

    def run(self, ends: Floats, tries: int) -> Floats | None:
        """Return the path to one of `ends`."""
        short = self._depth(ends)
        ends = ends[short <= max(self.allowed, short.min())]
        path = self._trees.run(_array(self.first[None, : self.size]), _array(ends), tries)
        self._spend()
        return self._shortened(path) if len(path) else None

    @cached_property
    def runs(self) -> list[Floats]:
        """The parts of the base's path that are free with each of the arms, each shape (R, m)."""
        runs = []
        for arm in self.arms:
            rows = np.clip(
                np.column_stack([self.poses, np.tile(arm, (len(self.poses), 1))]),
                self.lower,
                self.upper,
            )
            between = (rows[1:] + rows[:-1]) / 2
            free = self._depth(np.concatenate([rows, between])) <= self.allowed
            begin = None
            for k in range(len(rows)):
                if begin is None and free[k]:
                    begin = k
                if begin is not None and (
                    k + 1 == len(rows) or not (free[len(rows) + k] and free[k + 1])
                ):
                    runs.append(rows[begin : k + 1])
                    begin = None
        return runs

    @cached_property
    def _lines(self) -> Any:
        """Looks at straight lines."""
        contacts, weights = self.problem.contacts, self.weights
        return contacts.make_line_checker(
            self.first,
            self.waypoint,
            weights=weights,
            step=self.step,
            reach=0.0,
            allowed=self.allowed,
        )

    @cached_property
    def _trees(self) -> Any:
        """Grows trees, and straightens what they find."""
        runs = np.concatenate(self.runs) if self.runs else np.empty((0, self.size))
        rows = map(_array, (self.weights, self.lower, self.upper, self.poses, self.arms, runs))
        lengths, seed = (
            np.array([len(run) for run in self.runs], np.int64),
            int(self.rng.integers(2**63)),
        )
        module = compiled_module("vkc_pin.planning.initialization._trees")
        return module.Trees(self._lines, *rows, lengths, _BESIDE_PATH, _AROUND, seed)

    def _spend(self) -> None:
        spend(self._lines.looked())

    def free(self, path: Floats) -> bool:
        """Return whether hardly anything is hit along a path, shape (K, m)."""
        return all(self.along(a, b) == 1.0 for a, b in itertools.pairwise(path))

    def along(self, a: Floats, b: Floats) -> float:
        """Return what share of the straight line from `a` to `b`, both (m,), is free."""
        share = float(self._trees.along(_array([a, b])))
        self._spend()
        return share

    def _depth(self, rows: Floats) -> Floats:
        """Return how far the robot, shape (B, m), falls short of its margins where it overlaps something, shape (B,) [m]."""
        z = np.tile(self.first, (len(rows), 1))
        z[:, : self.size] = rows
        return depth(self.problem, z, self.waypoint, reach=0.0)

    def _shortened(self, path: Floats) -> Floats:
        """Return a path that goes straight between random places on it, as many as it has, where nothing is in the way."""
        path = self._trees.shortened(_array(path))
        self._spend()
        return path

    def straightened(self, path: Floats) -> Floats:
        """Return a path on which the arm, and each of its joints alone, moves evenly between two places where nothing hinders it.

        What leads through a passage with another posture takes all joints along; straight lines of
        all coordinates seldom undo that, and the solver cannot, since things are between. So
        coordinates are taken apart (partial shortcuts: Geraerts and Overmars, IJRR 2007), at first
        all along the path, then between random places on it; where the arm goes far round, as long
        as that is worth it.
        """
        length, path = np.inf, self._evened(path, 0)
        while self.length(path) < (1.0 - _WORTH) * length:
            length, path = self.length(path), self._evened(path, _STRAIGHTENINGS)
            if _detour(path, self.weights) <= _DETOUR:
                break
        return path

    def _evened(self, path: Floats, times: int) -> Floats:
        """Return a path tried to be straightened all along it (`times` 0), or so many times between random places on it."""
        path = self._trees.evened(_array(path), times, _WORTH)
        self._spend()
        return path

    def length(self, path: Floats) -> float:
        """Return how long a path is, shape (K, m)."""
        return float(np.linalg.norm(np.diff(path, axis=0) * self.weights, axis=1).sum())


def _array(rows: ArrayLike) -> Floats:
    """Return rows as compiled code takes them."""
    return np.ascontiguousarray(rows, float)
