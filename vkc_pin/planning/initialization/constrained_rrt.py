"""Finds paths of closed-chain phases with constrained RRT on the closure manifold.

Two trees whose steps are projected to the manifold (Berenson, Srinivasa, Ferguson and Kuffner,
*Manipulation planning on constraint manifolds*, ICRA 2009) grow towards random configurations on
it. The progress of the object joints along their given motion is one more coordinate: a door may
wait until the arm is out of its frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.keyframes import (
    SAMPLE_COUNT,
    KeyframeSampler,
    compute_shortfall,
)
from vkc_pin.planning.initialization.rrt import STEP, resample_path
from vkc_pin.utils.arrays import Bools, Floats, Ints

__all__ = ["find_constrained_path", "is_obstructed"]


def is_obstructed(sampler: KeyframeSampler, phase: int, through: Floats, straight: Floats) -> bool:
    """Return whether straight lines through a phase are in collision and trees may help.

    Trees do not help a base with wheels, whose arcs they ignore, or a phase that starts in
    collision.

    Args:
        sampler: Keyframe sampler of the problem.
        phase: Number of the phase, with a closed chain.
        through: Configurations at its keyframes, shape (K, n).
        straight: Waypoints on straight lines through them, shape (steps, n).
    """
    if sampler.curves is not None:
        return False
    search = _Search(sampler, phase, len(straight))
    closed, _ = search.project(straight, np.arange(search.begin + 1.0, search.end + 1.0))
    return not search.are_free(closed).all() and bool(search.are_free(through[:1]).all())


def find_constrained_path(
    sampler: KeyframeSampler, phase: int, through: Floats, steps: int, max_extensions: int
) -> Floats | None:
    """Find waypoints of a closed-chain phase from the first of some configurations.

    Args:
        sampler: Keyframe sampler of the problem, whose base has no steered wheels.
        phase: Number of the phase.
        through: Configurations at its keyframes, shape (K, n).
        steps: Number of waypoints of the phase.
        max_extensions: Maximum number of tree extensions.

    Returns:
        Collision-free waypoints, shape (steps, n), which may end at another configuration; None if
        no path was found.
    """
    search = _Search(sampler, phase, steps)
    path = search.run(through, max_extensions)
    return None if path is None else search.resample(search.shorten(path), steps)


class _Path(NamedTuple):
    """Configurations, shape (P, n), and their progress as fractional waypoints, shape (P,)."""

    z: Floats
    at: Floats


class _Tree:
    def __init__(self, z: Floats, at: Floats) -> None:
        self.z, self.at, self.parents = z, at, np.full(len(z), -1)

    def add(self, z: Floats, at: Floats, parents: Ints) -> Ints:
        self.z, self.at = np.concatenate([self.z, z]), np.concatenate([self.at, at])
        self.parents = np.concatenate([self.parents, parents])
        return np.arange(len(self.z) - len(z), len(self.z))

    def trace_to_root(self, node: int) -> _Path:
        nodes = [node]
        while self.parents[nodes[-1]] >= 0:
            nodes.append(int(self.parents[nodes[-1]]))
        return _Path(self.z[nodes], self.at[nodes])


class _Search:
    def __init__(self, sampler: KeyframeSampler, phase: int, steps: int) -> None:
        self.sampler, self.problem = sampler, sampler.problem
        self.end = int(self.problem.ends[phase])
        self.begin = self.end - steps
        self.waypoint = self.problem.contacts.find_waypoint(phase)
        pose = sampler.find_pose(self.end)
        assert pose is not None, "a grasped articulated object closes the chain"
        self.pose = pose
        motion = np.vstack([self.problem.start, sampler.object_motion])
        self.object_motion = motion[self.begin : self.end + 1, sampler.object_columns]
        self.grasp_columns = sampler.find_grasp_columns(self.end)

    def project(self, z: Floats, at: Floats) -> tuple[Floats, Bools]:
        """Project configurations, shape (B, n), with their progress to the closure manifold.

        Returns projected configurations, and a mask of those that satisfy the closure.
        """
        z, columns = z.copy(), self.sampler.object_columns
        whole = np.arange(self.begin, self.end + 1)
        z[:, columns] = np.column_stack(
            [np.interp(at, whole, column) for column in self.object_motion.T]
        )
        lower, upper = self.sampler.compute_limits(z, self.waypoint)
        lower[:, columns] = upper[:, columns] = z[:, columns]
        return self.sampler.solve_pose(z, self.pose, lower, upper)

    def are_free(self, z: Floats) -> Bools:
        """Return which configurations are nearly collision-free, shape (B,)."""
        shortfall = compute_shortfall(self.problem, z, self.waypoint, reach=0.0)
        return shortfall <= self.problem.options.dist_safe

    def compute_distances(self, z: Floats, other: Floats) -> Floats:
        return np.asarray(np.linalg.norm((z - other) * self.sampler.weights, axis=-1))

    def sample_free(self, through: Floats, waypoint: int) -> Floats:
        """Sample collision-free configurations at a waypoint with the grasp of the first one."""
        before, found = through[np.arange(SAMPLE_COUNT // 4) % len(through)], []
        for how in ("scatter", "shake"):
            z, closed = self.sampler.sample(before, waypoint, how)
            is_same = z[:, self.grasp_columns] == through[0, self.grasp_columns]
            found.append(z[closed & is_same.all(axis=1)])
        z = np.concatenate(found)
        return z[self.are_free(z)] if len(z) else z

    def run(self, through: Floats, max_extensions: int) -> _Path | None:
        """Find a path from the first configuration to the end of the phase."""
        ends = np.vstack([through[-1:], self.sample_free(through, self.end)])
        ends = ends[self.are_free(ends)]
        one = _Tree(through[:1], np.array([float(self.begin)]))
        other = _Tree(ends, np.full(len(ends), float(self.end)))
        forwards, grown, tips = True, 0, np.zeros(1, int)
        while len(ends) and grown < max_extensions:
            path = self.try_connect(one, other, tips)
            if path is not None:
                return path if forwards else _Path(path.z[::-1], path.at[::-1])
            forwards, one, other = not forwards, other, one
            waypoint = int(self.sampler.rng.integers(self.begin + 1, self.end + 1))
            goals = self.sample_free(through, waypoint)
            tips = np.unique(self.grow(one, goals, np.full(len(goals), float(waypoint))))
            grown += max(len(goals), 1)
        return None

    def try_connect(self, tree: _Tree, other: _Tree, tips: Ints) -> _Path | None:
        """Grow `other` towards the `tips` of `tree`; return the connecting path if they meet."""
        if not len(tips):
            return None
        reached = self.grow(other, tree.z[tips], tree.at[tips])
        gaps = self.compute_distances(other.z[reached], tree.z[tips])
        best = int(np.argmin(gaps))
        if gaps[best] > STEP:
            return None
        here, there = tree.trace_to_root(int(tips[best])), other.trace_to_root(int(reached[best]))
        return _Path(np.vstack([here.z[::-1], there.z]), np.concatenate([here.at[::-1], there.at]))

    def grow(self, tree: _Tree, goals: Floats, at: Floats) -> Ints:
        """Grow a tree step by step towards goals; return the last node of each branch, (B,)."""
        ends = np.array(
            [int(np.argmin(self.compute_distances(tree.z, goal))) for goal in goals], int
        )
        growing = np.arange(len(goals))
        while len(growing):
            left = self.compute_distances(tree.z[ends[growing]], goals[growing])
            growing, left = growing[left > STEP], left[left > STEP]
            here, share = ends[growing], STEP / left
            progress = tree.at[here] + share * (at[growing] - tree.at[here])
            moved, closed = self.project(
                tree.z[here] + share[:, None] * (goals[growing] - tree.z[here]), progress
            )
            nearer = left - self.compute_distances(moved, goals[growing])
            good = (
                closed
                & (self.compute_distances(moved, tree.z[here]) <= 2.0 * STEP)
                & (nearer > STEP / 4.0)
            )
            good[good] = self.are_free(moved[good])
            growing = growing[good]
            ends[growing] = tree.add(moved[good], progress[good], here[good])
        return ends

    def shorten(self, path: _Path) -> _Path:
        """Shortcut a path between random points on it, with steps projected to the manifold."""
        for _ in range(len(path.z)):
            first, last = sorted(self.sampler.rng.integers(len(path.z), size=2))
            count = int(np.ceil(self.compute_distances(path.z[first], path.z[last]) / STEP))
            if not 1 < count < last - first:
                continue
            share = np.arange(1, count)[:, None] / count
            at = path.at[first] + share[:, 0] * (path.at[last] - path.at[first])
            middle, closed = self.project(
                path.z[first] + share * (path.z[last] - path.z[first]), at
            )
            gaps = self.compute_gaps(np.vstack([path.z[first], middle, path.z[last]]))
            is_shorter = (
                gaps.max() <= 2.0 * STEP
                and gaps.sum() < self.compute_gaps(path.z[first : last + 1]).sum()
            )
            if closed.all() and is_shorter and self.are_free(middle).all():
                z = np.vstack([path.z[: first + 1], middle, path.z[last:]])
                path = _Path(z, np.concatenate([path.at[: first + 1], at, path.at[last:]]))
        return path

    def compute_gaps(self, z: Floats) -> Floats:
        return self.compute_distances(z[1:], z[:-1])

    def resample(self, path: _Path, steps: int) -> Floats | None:
        """Resample a path to `steps` waypoints, slow at both ends; None if a projection fails."""
        rows = resample_path(
            np.column_stack([path.z, path.at]), steps, np.append(self.sampler.weights, 0.0)
        )
        rows, closed = self.project(rows[:, :-1], rows[:, -1])
        return rows if closed.all() else None
