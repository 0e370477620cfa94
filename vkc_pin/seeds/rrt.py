"""A path of base and arm together from one configuration to another, by two random trees that grow towards each other.

RRT-Connect (Kuffner and LaValle, ICRA 2000) in the robot's coordinates. The base is drawn near a path that it could drive, the
arm near postures it is likely to need there, so that narrow passages are found soon.
"""

from __future__ import annotations

import itertools
from functools import cached_property

import numpy as np

from vkc_pin.arrays import Floats, Ints
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.seeds.knots import depth, smooth

__all__ = ["TRIES", "connect", "spread"]

TRIES = 1500
"""How often a tree may grow until they meet."""

_STEPS = (0.15, 0.04)  # [rad] between configurations that are looked at; the latter where the former overlooked something
_STRAIGHTENINGS = 11  # times that the arm and each of its joints are tried to be straightened between random places
_WORTH = 1e-3  # share of a path's length that is to be saved by it
_SHORTER = 0.02  # share for which they are tried so often once more where the arm goes far round
_PATHS = 3  # paths of trees at most, of which the shortest is kept
_DETOUR = 1 / 3  # share of a path that the arm goes beyond its straight way, up to which no other one is looked for
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

    Where the arm goes far round, other paths are looked for, too, and the shortest is kept: trees take a share of a second, and
    the solver stays on the side of things on which it begins.

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
    best = None
    for _ in range(_PATHS):
        path = coarse.run(ends, tries)
        if path is not None and not fine.free(path):
            finer = fine.run(ends, tries)
            path = path if finer is None else finer
        if path is None:
            break
        path = fine.straightened(path)
        best = path if best is None or fine.length(path) < fine.length(best) else best
        if fine.detour(best) <= _DETOUR:
            break
        tries = min(tries, 2 * coarse.grown)  # another one is welcome if it is found as soon
    return best


def spread(path: Floats, steps: int, metric: Floats) -> Floats:
    """Return `steps` configurations along a path, shape (K, m), without its first: slow at both ends, shape (steps, m)."""
    lengths = np.linalg.norm(np.diff(path, axis=0) * metric, axis=1)
    passed = np.concatenate([[0.0], np.cumsum(lengths + 1e-12)])
    at = passed[-1] * smooth(steps)
    return np.column_stack([np.interp(at, passed, column) for column in path.T])


class _Search:
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
        self.problem, self.first, self.poses, self.arms, self.rng, self.step = problem, first, poses, arms, rng, step
        self.size = problem.chain.robot.coordinates.size
        self.waypoint = problem.contacts.inside(phase)
        self.allowed = problem.options.dist_safe  # all of a margin may be missing: the solver pushes that apart
        self.weights = problem.chain.metric[: self.size]
        limits = np.array([problem.limits(name) for name in problem.chain.names[: self.size]])
        self.lower, self.upper = limits.T
        self.grown = 0  # how often trees grew until they met, or no more

    def run(self, ends: Floats, tries: int) -> Floats | None:
        """Return the path to one of `ends`."""
        start = self.first[: self.size]
        short = self._depth(ends)
        ends = ends[short <= max(self.allowed, short.min())]
        trees = _Tree(start[None], self.weights), _Tree(ends, self.weights)
        direct = [*ends]
        for number in range(tries):
            self.grown = number + 1
            tree, other = (trees[0], trees[1]) if direct or number % 2 else (trees[1], trees[0])
            if direct:
                node = self._grow(tree, direct.pop(0))
            elif self.rng.integers(2) and len(tree.runs) < len(self.runs):
                node = self._grow_to_run(tree)
            else:
                node = self._grow(tree, self._draw(start, ends))
            if node is None:
                continue
            met = self._grow(other, tree.nodes[node])
            if met is not None and np.array_equal(other.nodes[met], tree.nodes[node]):
                there, back = (node, met) if tree is trees[0] else (met, node)
                return self._shortened(np.concatenate([trees[0].path(there), trees[1].path(back)[-2::-1]]))
        return None

    @cached_property
    def runs(self) -> list[Floats]:
        """The parts of the base's path that are free with each of the arms, each shape (R, m)."""
        runs = []
        for arm in self.arms:
            rows = np.clip(np.column_stack([self.poses, np.tile(arm, (len(self.poses), 1))]), self.lower, self.upper)
            between = (rows[1:] + rows[:-1]) / 2
            free = self._depth(np.concatenate([rows, between])) <= self.allowed
            begin = None
            for k in range(len(rows)):
                if begin is None and free[k]:
                    begin = k
                if begin is not None and (k + 1 == len(rows) or not (free[len(rows) + k] and free[k + 1])):
                    runs.append(rows[begin : k + 1])
                    begin = None
        return runs

    def _grow_to_run(self, tree: _Tree) -> int | None:
        """Let a tree grow towards a free part of the base's path, and take in all of it if it gets there."""
        number = int(self.rng.choice([k for k in range(len(self.runs)) if k not in tree.runs]))
        rows = self.runs[number]
        at = int(self.rng.integers(len(rows)))
        node = self._grow(tree, rows[at])
        if node is not None and np.array_equal(tree.nodes[node], rows[at]):
            tree.runs.add(number)
            for side in (rows[at + 1 :], rows[:at][::-1]):
                parent = node
                for row in side:
                    parent = tree.add(row, parent)
        return node

    def _draw(self, start: Floats, ends: Floats) -> Floats:
        """Return a configuration beside the base's path or around one of its ends, the arm at or around a likely posture."""
        rng, guided = self.rng, self.rng.integers(2)
        poses = self.poses if guided else (start[None], ends)[rng.integers(2)]
        goal = np.concatenate([poses[rng.integers(len(poses)), :3], self.arms[rng.integers(len(self.arms))]])
        goal[:3] += rng.random() * (_BESIDE_PATH if guided else _AROUND) * rng.normal(size=3)
        goal[3:] += rng.integers(2) * rng.random() * _AROUND * rng.normal(size=self.size - 3)
        return np.clip(goal, self.lower, self.upper)

    def _grow(self, tree: _Tree, goal: Floats) -> int | None:
        """Let a tree grow from its nearest node towards a configuration, as far as nothing is hit; return the new node."""
        near = tree.nearest(goal)
        start = tree.nodes[near]
        if np.array_equal(goal, start):
            return near
        reached = self._along(start, goal)
        if reached <= 0.0:
            return None
        return tree.add(goal if reached == 1.0 else start + reached * (goal - start), near)

    def free(self, path: Floats) -> bool:
        """Return whether hardly anything is hit along a path, shape (K, m)."""
        return all(self._along(a, b) == 1.0 for a, b in itertools.pairwise(path))

    def _along(self, a: Floats, b: Floats) -> float:
        """Return what share of the straight line from `a` to `b`, both (m,), is free."""
        count = max(1, int(np.ceil(np.abs((b - a) * self.weights).max() / self.step)))
        s = np.arange(count + 1) / count
        z = self._robot_at(a + s[1:, None] * (b - a))
        return float(s[self.problem.contacts.first_blocked(z, self.waypoint, reach=0.0, allowed=self.allowed)])

    def _depth(self, rows: Floats) -> Floats:
        """Return how far the robot, shape (B, m), falls short of its margins where it overlaps something, shape (B,) [m]."""
        return depth(self.problem, self._robot_at(rows), self.waypoint, reach=0.0)

    def _robot_at(self, rows: Floats) -> Floats:
        """Return configurations with the robot at `rows`, shape (B, m): shape (B, n)."""
        z = np.empty((len(rows), len(self.first)))
        z[:], z[:, : self.size] = self.first, rows
        return z

    def _shortened(self, path: Floats) -> Floats:
        """Return a path that goes straight between random places on it, as many as it has, where nothing is in the way."""
        for _ in path:
            if len(path) < 3:
                break
            passed = self._passed(path)
            s, t = np.sort(self.rng.uniform(0.0, passed[-1], 2))
            i, j = np.searchsorted(passed, [s, t], side="right") - 1
            if i == j:
                continue
            a, b = (np.array([np.interp(at, passed, column) for column in path.T]) for at in (s, t))
            if self._along(a, b) == 1.0:
                path = np.concatenate([path[: i + 1], [a, b], path[j + 1 :]])
        return path

    def straightened(self, path: Floats) -> Floats:
        """Return a path on which the arm, and each of its joints alone, moves evenly between two places where nothing hinders it.

        What leads through a passage with another posture takes all joints along; straight lines of all coordinates seldom undo
        that, and the solver cannot, since things are between. So coordinates are taken apart (partial shortcuts: Geraerts and
        Overmars, IJRR 2007), at first all along the path, then between random places on it; where the arm goes far round, as
        long as that is worth it.
        """
        groups = [np.arange(3, self.size), *(np.array([column]) for column in range(3, self.size))]
        length = np.inf
        for columns in groups:
            path = self._even(path, columns, 0.0, self.length(path))
        while self.length(path) < (1.0 - _SHORTER) * length:
            length = self.length(path)
            for _, columns in itertools.product(range(_STRAIGHTENINGS), groups):
                path = self._even(path, columns, *np.sort(self.rng.uniform(0.0, self.length(path), 2)))
            if self.detour(path) <= _DETOUR:
                break
        return path

    def _even(self, path: Floats, columns: Ints, s: float, t: float) -> Floats:
        """Return a path that is shorter as some coordinates change evenly from `s` to `t` along it; if nothing hinders that."""
        passed = self._passed(path)
        at = np.concatenate([[s], passed[(s < passed) & (passed < t)], [t]])
        part = np.column_stack([np.interp(at, passed, column) for column in path.T])
        share = ((at - s) / max(t - s, 1e-12))[:, None]
        part[1:-1, columns] = (part[0, columns] + share * (part[-1, columns] - part[0, columns]))[1:-1]
        changed = np.concatenate([path[passed <= s], part, path[passed >= t]])
        if self.length(changed) >= (1.0 - _WORTH) * passed[-1] or not self.free(part):
            return path
        return changed[np.diff(self._passed(changed), prepend=-1.0) > 0.0]

    def length(self, path: Floats) -> float:
        """Return how long a path is, shape (K, m)."""
        return float(self._passed(path)[-1])

    def detour(self, path: Floats) -> float:
        """Return which share of a path, shape (K, m), the arm goes beyond its straight way."""
        base, arm = (part * weights for part, weights in zip(np.split(path, [3], 1), np.split(self.weights, [3]), strict=True))
        way, driven = np.abs(np.diff(arm, axis=0)).sum(), np.linalg.norm(np.diff(base, axis=0), axis=1).sum()
        return float((way - np.abs(arm[-1] - arm[0]).sum()) / max(way + driven, 1e-12))

    def _passed(self, path: Floats) -> Floats:
        """Return how far it is along a path to each of its configurations, shape (K,)."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0) * self.weights, axis=1))])


class _Tree:
    """Configurations, each with the one it was reached from."""

    def __init__(self, roots: Floats, weights: Floats) -> None:
        self._rows, self.parents, self.weights = roots.copy(), [-1] * len(roots), weights  # rows: those in use, and spare ones
        self.runs: set[int] = set()

    @property
    def nodes(self) -> Floats:
        """The configurations, shape (K, m)."""
        return self._rows[: len(self.parents)]

    def nearest(self, goal: Floats) -> int:
        return int(np.argmin(np.linalg.norm((self.nodes - goal) * self.weights, axis=1)))

    def add(self, node: Floats, parent: int) -> int:
        number = len(self.parents)
        if number == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        self._rows[number] = node
        self.parents.append(parent)
        return number

    def path(self, node: int) -> Floats:
        """Return the configurations from the root to a node, shape (K, m)."""
        found = []
        while node >= 0:
            found.append(self.nodes[node])
            node = self.parents[node]
        return np.array(found[::-1])
