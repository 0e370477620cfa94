"""Finds paths of base and arm around obstacles with two random trees.

RRT-Connect (Kuffner and LaValle, ICRA 2000) in all coordinates of the robot, for phases without a
closed chain. Samples are near a guide path of the base, with arm postures that are likely to be
needed there, so that narrow passages are found quickly. Why not OMPL: docs/decisions/0012.
"""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.initialization.keyframes import (
    SAMPLE_COUNT,
    KeyframeSampler,
    compute_shortfall,
    sample_smoothstep,
)
from vkc_pin.utils.arrays import Bools, Floats, Ints

__all__ = ["MAX_EXTENSIONS", "find_open_path"]

MAX_EXTENSIONS = 1500
"""Maximum number of tree extensions."""
_STEP = 0.15  # between collision checks, in the metric of searches: [rad] of a joint
_GUIDED_SAMPLES = SAMPLE_COUNT // 8  # towards which a tree grows at once
# largest standard deviation of samples from guide path and likely postures
_BASE_SPREAD, _ARM_SPREAD = 0.1, 0.4  # [m] and [rad]
_STRAIGHTENING_ROUNDS = 3
_MIN_SAVING = 1e-3  # relative saving in length that a partial shortcut needs


def find_open_path(
    sampler: KeyframeSampler,
    phase: int,
    first: Floats,
    ends: Floats,
    steps: int,
    max_extensions: int,
    *,
    poses: Floats,
    arms: Floats,
) -> Floats | None:
    """Find waypoints of the robot in an open phase.

    Args:
        sampler: Keyframe sampler of the problem.
        phase: Number of the phase.
        first: Start configuration, shape (n,); coordinates outside the robot stay constant.
        ends: Possible end configurations, shape (E, n).
        steps: Number of waypoints.
        max_extensions: Maximum number of tree extensions.
        poses: x, y [m] and yaw [rad] along a guide path of the base, shape (P, 3).
        arms: Arm postures that are likely to be needed, shape (A, m - 3) [m] or [rad].

    Returns:
        Nearly collision-free waypoints, shape (steps, n); None if no path was found.
    """
    search = _Search(sampler, phase, first, poses, arms)
    path = search.connect(first[None], ends, max_extensions)
    return None if path is None else search.resample(search.straighten(search.shorten(path)), steps)


class _Tree:
    def __init__(self, z: Floats) -> None:
        self.z, self.parents = z, np.full(len(z), -1)

    def add(self, z: Floats, parents: Ints) -> Ints:
        self.z, self.parents = np.concatenate([self.z, z]), np.concatenate([self.parents, parents])
        return np.arange(len(self.z) - len(z), len(self.z))

    def trace_to_root(self, node: int) -> Floats:
        nodes = [node]
        while self.parents[nodes[-1]] >= 0:
            nodes.append(int(self.parents[nodes[-1]]))
        return self.z[nodes]


class _Search:
    """Searches paths, shape (P, n), in one phase, near a guide path of the base."""

    def __init__(
        self, sampler: KeyframeSampler, phase: int, first: Floats, poses: Floats, arms: Floats
    ) -> None:
        self.sampler, self.problem = sampler, sampler.problem
        self.waypoint = self.problem.contacts.find_waypoint(phase)
        self.first, self.poses, self.arms = first, poses, arms
        self.robot, self.arm = slice(sampler.robot_size), slice(3, sampler.robot_size)
        names = self.problem.chain.names[self.robot]
        self.lower, self.upper = np.array([self.problem.limits(name) for name in names]).T

    def are_free(self, z: Floats) -> Bools:
        """Return which configurations are nearly collision-free, shape (B,).

        Shortfalls up to `Options.dist_safe` are allowed: the solver resolves them.
        """
        return self.compute_shortfall(z) <= self.problem.options.dist_safe

    def compute_shortfall(self, z: Floats) -> Floats:
        return compute_shortfall(self.problem, z, self.waypoint, reach=0.0)

    def compute_distances(self, z: Floats, other: Floats) -> Floats:
        return np.asarray(np.linalg.norm((z - other) * self.sampler.weights, axis=-1))

    def compute_gaps(self, z: Floats) -> Floats:
        return self.compute_distances(z[1:], z[:-1])

    def sample(self) -> Floats:
        """Sample nearly collision-free configurations, shape (B, n)."""
        rng, count = self.sampler.rng, _GUIDED_SAMPLES
        z = np.tile(self.first, (count, 1))
        z[:, :3] = rng.choice(self.poses, count)
        z[:, self.arm] = rng.choice(self.arms, count)
        # Half of them are exactly on the guide path, in one of the likely postures.
        spread = rng.uniform(0.0, 1.0, (count, 1)) * rng.integers(2, size=(count, 1))
        z[:, :3] += _BASE_SPREAD * spread * rng.normal(size=(count, 3))
        z[:, self.arm] += _ARM_SPREAD * spread * rng.normal(size=z[:, self.arm].shape)
        z[:, self.robot] = np.clip(z[:, self.robot], self.lower, self.upper)
        return z[self.are_free(z)]

    def connect(self, first: Floats, ends: Floats, max_extensions: int) -> Floats | None:
        """Find a path from `first`, shape (1, n), to one of `ends`, shape (E, n).

        If none of the ends is nearly collision-free, the least violating ones are used.
        """
        shortfall = self.compute_shortfall(ends)
        ends = ends[shortfall <= max(self.problem.options.dist_safe, float(shortfall.min()))]
        one, other = _Tree(first), _Tree(ends)
        forwards, grown, tips = True, 0, np.zeros(1, int)
        while grown < max_extensions:
            path = self.try_connect(one, other, tips)
            if path is not None:
                return path if forwards else path[::-1]
            forwards, one, other = not forwards, other, one
            goals = self.sample()
            tips = np.unique(self.grow(one, goals))
            grown += max(len(goals), 1)
        return None

    def try_connect(self, tree: _Tree, other: _Tree, tips: Ints) -> Floats | None:
        """Grow `other` towards the `tips` of `tree`; return the connecting path if they meet."""
        if not len(tips):
            return None
        reached = self.grow(other, tree.z[tips])
        gaps = self.compute_distances(other.z[reached], tree.z[tips])
        best = int(np.argmin(gaps))
        if gaps[best] > _STEP:
            return None
        here, there = tree.trace_to_root(int(tips[best])), other.trace_to_root(int(reached[best]))
        return np.vstack([here[::-1], there])

    def grow(self, tree: _Tree, goals: Floats) -> Ints:
        """Grow a tree step by step towards goals; return the last node of each branch, (B,)."""
        ends = np.array(
            [int(np.argmin(self.compute_distances(tree.z, goal))) for goal in goals], int
        )
        growing = np.arange(len(goals))
        while len(growing):
            left = self.compute_distances(tree.z[ends[growing]], goals[growing])
            growing, left = growing[left > _STEP], left[left > _STEP]
            here, share = ends[growing], _STEP / left
            moved = tree.z[here] + share[:, None] * (goals[growing] - tree.z[here])
            free = self.are_free(moved)
            growing = growing[free]
            ends[growing] = tree.add(moved[free], here[free])
        return ends

    def shorten(self, path: Floats) -> Floats:
        """Shortcut a path between random points on it."""
        for _ in range(len(path)):
            first, last = sorted(self.sampler.rng.integers(len(path), size=2))
            count = int(np.ceil(self.compute_distances(path[first], path[last]) / _STEP))
            if 1 < count < last - first:
                share = np.arange(1, count) / count
                z = path[first] + share[:, None] * (path[last] - path[first])
                path = self.replace(path, first, last, z)
        return path

    def straighten(self, path: Floats) -> Floats:
        """Move the arm, and each joint alone, evenly along a path where that is collision-free.

        A path through a narrow passage with another posture moves all joints. Straight lines in all
        coordinates seldom undo that, and the solver cannot, because obstacles are in between. So
        coordinates are treated separately (partial shortcuts: Geraerts and Overmars, IJRR 2007),
        first along the whole path, then between random points on it.
        """
        arm = range(3, self.sampler.robot_size)
        for number in range(1 + _STRAIGHTENING_ROUNDS):
            for columns in [list(arm), *([column] for column in arm)]:
                first, last = 0, len(path) - 1
                if number:
                    first, last = sorted(self.sampler.rng.integers(len(path), size=2))
                if last - first > 1:
                    part = path[first : last + 1]
                    passed = np.cumsum(self.compute_gaps(part))
                    share, z = (passed[:-1] / max(passed[-1], 1e-12))[:, None], part[1:-1].copy()
                    z[:, columns] = part[0, columns] + share * (part[-1] - part[0])[columns]
                    path = self.replace(path, first, last, z)
        return path

    def replace(self, path: Floats, first: int, last: int, z: Floats) -> Floats:
        """Replace the piece between two points of a path by a shorter, collision-free one."""
        gaps = self.compute_gaps(np.vstack([path[first], z, path[last]]))
        before = self.compute_gaps(path[first : last + 1]).sum()
        if gaps.sum() >= (1.0 - _MIN_SAVING) * before or not self.are_free(z).all():
            return path
        return np.vstack([path[: first + 1], z, path[last:]])

    def resample(self, path: Floats, steps: int) -> Floats:
        """Resample a path to `steps` waypoints, slow at both ends."""
        passed = np.concatenate([[0.0], np.cumsum(self.compute_gaps(path) + 1e-12)])
        rows = passed[-1] * sample_smoothstep(steps)
        return np.stack([np.interp(rows, passed, column) for column in path.T], axis=1)
