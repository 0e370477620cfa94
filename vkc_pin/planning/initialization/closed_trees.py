"""Finds paths of base and arm around obstacles in closed phases with two random trees.

RRT-Connect (Kuffner and LaValle, ICRA 2000) in all coordinates. Steps are projected to the closure
manifold (Berenson, Srinivasa, Ferguson and Kuffner, *Manipulation planning on constraint
manifolds*, ICRA 2009), and the progress of the object joints along their given motion is one more
coordinate: a door may wait until the arm is out of its frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.keyframes import (
    SAMPLE_COUNT,
    KeyframeSampler,
    compute_shortfall,
    sample_smoothstep,
)
from vkc_pin.utils.arrays import Bools, Floats, Ints

MAX_EXTENSIONS = 3000
"""Maximum number of tree extensions."""
_STEP = 0.15  # between collision checks, in the metric of searches: [rad] of a joint
_SAMPLES = SAMPLE_COUNT // 4
_MIN_SAVING = 1e-3  # relative saving in length that a shortcut needs


def needs_trees(sampler: KeyframeSampler, phase: int, through: Floats, straight: Floats) -> bool:
    """Return whether straight lines through a closed-chain phase collide and trees may help.

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
    search = _ClosedSearch(sampler, phase, through, len(straight))
    closed, _ = search.project(straight, np.arange(search.begin + 1.0, search.end + 1.0))
    return not search.are_free(closed).all() and bool(search.are_free(through[:1]).all())


def find_closed_path(
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
        Nearly collision-free waypoints, shape (steps, n), which may end at another configuration;
        None if no path was found.
    """
    search = _ClosedSearch(sampler, phase, through, steps)
    ends = np.vstack([through[-1:], search.sample_waypoint(int(search.end))])
    path = search.connect(through[:1], ends, max_extensions)
    return None if path is None else search.resample(search.shorten(path), steps)


class _Path(NamedTuple):
    """Configurations, shape (P, n), and their progress as fractional waypoints, shape (P,)."""

    z: Floats
    at: Floats


class _Tree:
    """Nodes of a tree: configurations, (P, n), their progress and parents, (P,); -1: a root."""

    def __init__(self, z: Floats, at: float) -> None:
        self.z = z
        self.at = np.full(len(z), at)
        self.parents = np.full(len(z), -1)

    def add(self, z: Floats, at: Floats, parents: Ints) -> Ints:
        """Add nodes; return their numbers."""
        self.z = np.concatenate([self.z, z])
        self.at = np.concatenate([self.at, at])
        self.parents = np.concatenate([self.parents, parents])
        return np.arange(len(self.z) - len(z), len(self.z))

    def trace_to_root(self, node: int) -> _Path:
        """Return the path from a node to its root."""
        nodes = [node]
        while self.parents[nodes[-1]] >= 0:
            nodes.append(int(self.parents[nodes[-1]]))
        return _Path(self.z[nodes], self.at[nodes])


class _ClosedSearch:
    """Searches a closed phase, with the grasp of its first configuration."""

    def __init__(self, sampler: KeyframeSampler, phase: int, through: Floats, steps: int) -> None:
        self.sampler = sampler
        self.problem = sampler.problem
        end = int(self.problem.ends[phase])
        self.begin = float(end - steps)
        self.end = float(end)
        self.waypoint = self.problem.contacts.find_waypoint(phase)
        pose = sampler.find_pose(end)
        assert pose is not None, "a grasped articulated object closes the chain"
        self.pose = pose
        self.through = through
        motion = np.vstack([self.problem.start, sampler.object_motion])
        self.object_motion = motion[end - steps : end + 1, sampler.object_columns]
        self.grasp_columns = sampler.find_grasp_columns(end)

    def project(self, z: Floats, at: Floats) -> tuple[Floats, Bools]:
        """Project configurations, shape (B, n), with their progress to the constraints.

        Returns projected configurations, and a mask of those that satisfy the constraints.
        """
        z = z.copy()
        columns = self.sampler.object_columns
        waypoints = np.arange(self.begin, self.end + 1)
        positions = [np.interp(at, waypoints, column) for column in self.object_motion.T]
        z[:, columns] = np.stack(positions, axis=1)
        lower, upper = self.sampler.compute_limits(z, self.waypoint)
        lower[:, columns] = z[:, columns]
        upper[:, columns] = z[:, columns]
        return self.sampler.solve_pose(z, self.pose, lower, upper)

    def sample(self) -> tuple[Floats, float]:
        """Sample nearly collision-free configurations, shape (B, n), and their progress."""
        waypoint = int(self.sampler.rng.integers(int(self.begin) + 1, int(self.end) + 1))
        return self.sample_waypoint(waypoint), float(waypoint)

    def sample_waypoint(self, waypoint: int) -> Floats:
        """Sample nearly collision-free configurations at a waypoint with the phase's grasp."""
        before = self.through[np.arange(_SAMPLES) % len(self.through)]
        found = []
        for how in ("scatter", "shake"):
            z, closed = self.sampler.sample(before, waypoint, how)
            is_same = z[:, self.grasp_columns] == self.through[0, self.grasp_columns]
            found.append(z[closed & is_same.all(axis=1)])
        z = np.concatenate(found)
        return z[self.are_free(z)] if len(z) else z

    def are_free(self, z: Floats) -> Bools:
        """Return which configurations are nearly collision-free, shape (B,).

        Shortfalls up to `Options.dist_safe` are allowed: the solver resolves them.
        """
        return self.compute_shortfall(z) <= self.problem.options.dist_safe

    def compute_shortfall(self, z: Floats) -> Floats:
        """Return the clearance that configurations lack, shape (B,) [m]."""
        return compute_shortfall(self.problem, z, self.waypoint, reach=0.0)

    def compute_distances(self, z: Floats, other: Floats) -> Floats:
        """Return the distances of configurations in the metric of searches."""
        return np.asarray(np.linalg.norm((z - other) * self.sampler.weights, axis=-1))

    def compute_gaps(self, z: Floats) -> Floats:
        """Return the distances of consecutive configurations, (P, n): shape (P − 1,)."""
        return self.compute_distances(z[1:], z[:-1])

    def connect(self, first: Floats, ends: Floats, max_extensions: int) -> _Path | None:
        """Find a path from `first`, shape (1, n), to one of `ends`, shape (E, n).

        If none of the ends is nearly collision-free, the least violating ones are used.
        """
        shortfall = self.compute_shortfall(ends)
        ends = ends[shortfall <= max(self.problem.options.dist_safe, float(shortfall.min()))]
        tree = _Tree(first, self.begin)
        other = _Tree(ends, self.end)
        starts_at_first = True  # whether `tree` does
        extensions = 0
        tips = np.zeros(1, int)
        while extensions < max_extensions:
            path = self.try_connect(tree, other, tips)
            if path is not None:
                return path if starts_at_first else _Path(path.z[::-1], path.at[::-1])
            tree, other = other, tree
            starts_at_first = not starts_at_first
            goals, at = self.sample()
            tips = np.unique(self.grow(tree, goals, np.full(len(goals), at)))
            extensions += max(len(goals), 1)
        return None

    def try_connect(self, tree: _Tree, other: _Tree, tips: Ints) -> _Path | None:
        """Grow `other` towards the `tips` of `tree`; return the connecting path if they meet."""
        if not len(tips):
            return None
        reached = self.grow(other, tree.z[tips], tree.at[tips])
        gaps = self.compute_distances(other.z[reached], tree.z[tips])
        best = int(np.argmin(gaps))
        if gaps[best] > _STEP:
            return None
        part = tree.trace_to_root(int(tips[best]))
        other_part = other.trace_to_root(int(reached[best]))
        return _Path(
            np.vstack([part.z[::-1], other_part.z]),
            np.concatenate([part.at[::-1], other_part.at]),
        )

    def grow(self, tree: _Tree, goals: Floats, at: Floats) -> Ints:
        """Grow a tree step by step towards goals; return the last node of each branch, (B,)."""
        nearest = [int(np.argmin(self.compute_distances(tree.z, goal))) for goal in goals]
        ends = np.array(nearest, int)
        growing = np.arange(len(goals))  # branches
        while len(growing):
            remaining = self.compute_distances(tree.z[ends[growing]], goals[growing])
            is_far = remaining > _STEP
            growing = growing[is_far]
            remaining = remaining[is_far]
            here = ends[growing]
            s = _STEP / remaining
            progress = tree.at[here] + s * (at[growing] - tree.at[here])
            z = tree.z[here] + s[:, None] * (goals[growing] - tree.z[here])
            moved, is_feasible = self.project(z, progress)
            gain = remaining - self.compute_distances(moved, goals[growing])
            is_near = self.compute_distances(moved, tree.z[here]) <= 2.0 * _STEP
            is_good = is_feasible & is_near & (gain > _STEP / 4.0)
            is_good[is_good] = self.are_free(moved[is_good])
            growing = growing[is_good]
            ends[growing] = tree.add(moved[is_good], progress[is_good], here[is_good])
        return ends

    def shorten(self, path: _Path) -> _Path:
        """Shortcut a path between random points on it, with projected steps."""
        for _ in range(len(path.z)):
            first, last = sorted(self.sampler.rng.integers(len(path.z), size=2))
            count = int(np.ceil(self.compute_distances(path.z[first], path.z[last]) / _STEP))
            if not 1 < count < last - first:
                continue
            s = np.arange(1, count) / count
            at = path.at[first] + s * (path.at[last] - path.at[first])
            z = path.z[first] + s[:, None] * (path.z[last] - path.z[first])
            path = self.replace(path, first, last, z, at)
        return path

    def replace(self, path: _Path, first: int, last: int, z: Floats, at: Floats) -> _Path:
        """Replace the piece between two points of a path by a shorter, collision-free one."""
        z, feasible = self.project(z, at)
        gaps = self.compute_gaps(np.vstack([path.z[first], z, path.z[last]]))
        before = self.compute_gaps(path.z[first : last + 1]).sum()
        is_shorter = gaps.max() <= 2.0 * _STEP and gaps.sum() < (1.0 - _MIN_SAVING) * before
        if not (feasible.all() and is_shorter and self.are_free(z).all()):
            return path
        return _Path(
            np.vstack([path.z[: first + 1], z, path.z[last:]]),
            np.concatenate([path.at[: first + 1], at, path.at[last:]]),
        )

    def resample(self, path: _Path, steps: int) -> Floats | None:
        """Resample a path to `steps` waypoints, slow at both ends; None if a projection fails."""
        passed = np.concatenate([[0.0], np.cumsum(self.compute_gaps(path.z) + 1e-12)])
        rows = passed[-1] * sample_smoothstep(steps)
        z = np.stack([np.interp(rows, passed, column) for column in path.z.T], axis=1)
        z, feasible = self.project(z, np.interp(rows, passed, path.at))
        return z if feasible.all() else None
