"""Finds paths of base and arm around obstacles in open phases with two random trees.

RRT-Connect (Kuffner and LaValle, ICRA 2000) in all coordinates of the robot. Samples are uniform,
so that every path is found in the end. Where the base drives, half of them are near a guide path of
it, with arm postures that are likely to be needed there: narrow passages are found quickly.
Three choices decide how soon a path leads out of a shelf or a cage:

- A tree grows by whole pieces of at most `_PIECE`, never by a part of one that ends at an obstacle.
  Otherwise the pocket around a narrow goal fills with nodes at its walls.
- The smaller tree grows, since the one in the narrower place grows more slowly.
- Many samples are tried at once: most pieces are blocked, and the checks of a batch are one
  compiled call.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.keyframes import (
    KeyframeSampler,
    compute_shortfall,
    sample_smoothstep,
)
from vkc_pin.utils.arrays import Bools, Floats, Ints

_PIECE = 0.5  # longest edge of a tree, in the metric of searches: [rad] of a joint
_CHECK_STEP = 0.05  # between collision checks while trees grow
_FINE_STEP = 0.01  # between those of the result
_SAMPLES = 32  # towards which a tree grows at once
# largest standard deviation of guided samples from guide path and likely postures
_BASE_SPREAD = 0.1  # [m] and [rad]
_ARM_SPREAD = 0.4  # [m] and [rad]
_SHORTCUTS = 20  # lines between random points of a path, tried at once
# Shortcuts end with a round that saves less than this fraction of the length; with 3 %, motions are
# 4 % longer
_ROUND_SAVING = 0.01
_STRAIGHTENING_ROUNDS = 3
_PRODUCT_SIZE = 200_000  # multiplications in a product of matrices that needs no threads
_FAR = 1e6  # scaled coordinates of nodes that are cut off
# An arm on a fixed base searches further paths, until this multiple of the checks of the first one
# or this number of paths; the shortest is used
_CHECKS_FACTOR = 2
_PATHS = 5
_MIN_DETOUR = 1e-6  # [rad] by which a corner is further from its neighbours than on a line
_MIN_SAVING = 1e-3  # relative saving in length that a shortcut needs


class Guide(NamedTuple):
    """Where samples are likely to be needed.

    Attributes:
        poses: x, y [m] and yaw [rad] along a path of the base, shape (P, 3).
        arms: Postures of the arm, shape (A, m - 3) [m] or [rad].
    """

    poses: Floats
    arms: Floats


class _Tree:
    """Configurations, shape (T, m), and the number of the parent of each; -1: a root.

    Distances between configurations are Euclidean in scaled coordinates `weights * z`.
    """

    def __init__(self, roots: Floats, weights: Floats) -> None:
        self.z = roots
        self.parents = np.full(len(roots), -1)
        self.weights = weights
        self.scaled = weights * roots

    def __len__(self) -> int:
        return len(self.z)

    def add_branch(self, parent: int, z: Floats) -> int:
        """Add configurations one after the other to a node; return the number of the last."""
        numbers = np.arange(len(self.z), len(self.z) + len(z))
        self.z = np.concatenate([self.z, z])
        self.scaled = np.concatenate([self.scaled, self.weights * z])
        self.parents = np.concatenate([self.parents, [parent], numbers[:-1]])
        return int(numbers[-1])

    def list_ancestors(self, node: int) -> list[int]:
        """Return the numbers of a node, its parent and so on, up to a root."""
        nodes = [node]
        while self.parents[nodes[-1]] >= 0:
            nodes.append(int(self.parents[nodes[-1]]))
        return nodes

    def remove_branch(self, node: int) -> None:
        """Make a node and all its descendants unreachable."""
        cut = np.zeros(len(self.z), bool)
        cut[node] = True
        for number in range(node + 1, len(self.z)):
            cut[number] = self.parents[number] >= 0 and cut[self.parents[number]]
        self.z[cut] = np.nan
        self.scaled[cut] = _FAR

    def find_nearest(self, goals: Floats) -> tuple[Ints, Floats]:
        """Return the numbers of the nodes nearest to goals, and their distances, shape (B,)."""
        scaled = self.weights * goals
        # |a − b|² = |a|² − 2 a·b + |b|²; the last part is the same for all nodes. BLAS computes
        # large products in threads, which cost more than they save here.
        squares = np.einsum("ij,ij->i", self.scaled, self.scaled)
        part_count = 1 + scaled.size * len(self.z) // _PRODUCT_SIZE
        nearest_of_parts = []
        for part in np.array_split(scaled, part_count):
            differences = squares - 2.0 * part @ self.scaled.T
            nearest_of_parts.append(differences.argmin(axis=1))
        nearest = np.concatenate(nearest_of_parts)
        return nearest, np.linalg.norm(self.scaled[nearest] - scaled, axis=1)


class OpenSearch:
    """Searches a path of the robot's coordinates, z of shape (m,), in an open phase.

    Args:
        sampler: Keyframe sampler of the problem.
        phase: Number of the phase.
        first: Start configuration, shape (n,); coordinates outside the robot stay constant.
        ends: Possible end configurations, shape (E, n). If all of them lack more than `allowed`,
            the least violating one is used unless it is deep in collision.
        guide: Where samples are likely to be needed; None, as for an arm on a fixed base: nowhere
            in particular.
        allowed: Clearance that configurations may lack [m].
    """

    def __init__(
        self,
        sampler: KeyframeSampler,
        phase: int,
        first: Floats,
        ends: Floats,
        guide: Guide | None,
        *,
        allowed: float,
    ) -> None:
        self.problem = sampler.problem
        self.rng = sampler.rng
        self.guide = guide
        self.phase = phase
        self.waypoint = self.problem.contacts.find_waypoint(phase)
        self.first = first
        self.size = sampler.robot_size
        self.weights = sampler.weights[: self.size]
        self.checks = 0
        names = self.problem.chain.names[: self.size]
        limits = np.array([self.problem.limits(name) for name in names])
        self.lower, self.upper = limits.T
        # Joints that can turn more than once are sampled within half a turn of the middle.
        middle = (first + ends[0])[: self.size] / 2.0
        is_angle = np.array([self.problem.unit(name) == "rad" for name in names])
        is_endless = is_angle & (self.upper - self.lower > 2.0 * np.pi)
        self.lowest = np.where(is_endless, np.maximum(self.lower, middle - np.pi), self.lower)
        self.highest = np.where(is_endless, np.minimum(self.upper, middle + np.pi), self.upper)
        self.start = first[None, : self.size]
        self.ends = ends[:, : self.size]
        # A search cannot keep more clearance than its ends, but these may not be deep in collision.
        (start_shortfall,) = self._compute_shortfall(self.start)
        end_shortfalls = self._compute_shortfall(self.ends)
        needed = max(float(start_shortfall), float(end_shortfalls.min()))
        self.allowed = max(allowed, min(needed, 2.0 * self.problem.options.dist_safe))
        self.ends = self.ends[end_shortfalls <= self.allowed]
        self.has_ends = needed <= self.allowed
        self._reset_trees()

    def _compute_shortfall(self, z: Floats) -> Floats:
        """Return the clearance that configurations lack, shape (B,) [m]."""
        return compute_shortfall(self.problem, self._complete(z), self.waypoint)

    def find_path(self, steps: int, max_checks: int) -> Floats | None:
        """Find waypoints, shape (steps, n); None if no path was found.

        Corners of the path are waypoints if there are fewer of them than waypoints.

        Args:
            steps: Number of waypoints.
            max_checks: Number of collision checks after which the search ends.
        """
        if not self.has_ends:
            return None
        first = self._connect(max_checks)
        if first is None:
            return None
        paths = [first]
        limit = _CHECKS_FACTOR * self.checks
        while self.guide is None and len(paths) < _PATHS and self.checks < limit:
            self._reset_trees()
            other = self._connect(limit)
            if other is not None:
                paths.append(other)
        shorter = [self._cut_corners(path, _CHECK_STEP) for path in paths]
        lengths = [self._measure_along(path)[-1] for path in shorter]
        best = int(np.argmin(lengths))
        path = self._straighten(shorter[best], _CHECK_STEP)
        if not self._are_lines_free(path[:-1], path[1:], _FINE_STEP).all():
            shorter_path = self._cut_corners(paths[best], _FINE_STEP)
            path = self._straighten(shorter_path, _FINE_STEP)
        return self._resample(path, steps)

    def find_obstruction(self) -> tuple[str, str] | None:
        """Return the pair that collides first between the nearest nodes of the trees, by its names.

        None: one of the ends is in collision.
        """
        if not self.has_ends:
            return None
        tree_of_start, tree_of_ends = self.trees
        goals = tree_of_ends.z[np.isfinite(tree_of_ends.z).all(axis=1)]
        nearest, gaps = tree_of_start.find_nearest(goals)
        k = int(gaps.argmin())
        start = tree_of_start.z[nearest[k]]
        end = goals[k]
        count = max(int(np.ceil(gaps[k] / _FINE_STEP)), 1)
        s = np.arange(1, count + 1)[:, None] / count
        contacts = self.problem.contacts.evaluate(
            self._complete(start + s * (end - start)),
            np.full(count, self.waypoint),
            reach=self.problem.options.largest_margin,
            nearest=1,
        )
        colliding = np.flatnonzero(contacts.margin - contacts.distance > self.allowed)
        if not len(colliding):
            return None
        labels = self.problem.contacts.phases[self.phase].labels
        first, second = contacts.pair[colliding[0]]
        return labels[first], labels[second]

    def _reset_trees(self) -> None:
        """Start again with one tree at the start, and one at all ends."""
        self.trees = (_Tree(self.start, self.weights), _Tree(self.ends, self.weights))

    def _connect(self, max_checks: int) -> Floats | None:
        """Find a path from the start to one of the ends, shape (P, m); None if there is none."""
        trees = self.trees
        grown = 1  # number of the tree that has grown
        tips = np.arange(len(self.ends))  # its new nodes
        while True:
            path = self._try_connect(trees[grown], trees[1 - grown], tips)
            if path is not None:
                return path if grown == 0 else path[::-1]
            if self.checks >= max_checks:
                return None
            grown = 0 if len(trees[0]) <= len(trees[1]) else 1
            size_before = len(trees[grown])
            last_nodes, _ = self._grow(trees[grown], self._sample())
            tips = np.unique(last_nodes)
            tips = tips[tips >= size_before]

    def _sample(self) -> Floats:
        """Sample configurations, shape (_SAMPLES, m): with a guide, half of them near it."""
        z = self.rng.uniform(self.lowest, self.highest, (_SAMPLES, self.size))
        if self.guide is None:
            return z
        half = _SAMPLES // 2
        quarter = _SAMPLES // 4
        near_guide = z[:half]
        near_guide[:, :3] = self.rng.choice(self.guide.poses, half)
        near_guide[:, 3:] = self.rng.choice(self.guide.arms, half)
        # Half of these are exactly on the guide path, in one of the likely postures.
        spread = self.rng.uniform(0.0, 1.0, (half, 1)) * self.rng.integers(2, size=(half, 1))
        deviation = np.repeat([_BASE_SPREAD, _ARM_SPREAD], [3, self.size - 3])
        near_guide += spread * deviation * self.rng.normal(size=near_guide.shape)
        # A quarter of all have any posture on the guide path.
        z[half : half + quarter, :3] = self.rng.choice(self.guide.poses, quarter)
        return np.clip(z, self.lower, self.upper)

    def _grow(self, tree: _Tree, goals: Floats) -> tuple[Ints, Bools]:
        """Grow a tree straight towards goals, shape (B, m), by whole pieces while they are free.

        Returns:
            The number of the last node towards each goal, and whether it is there, shape (B,).
        """
        nearest, gaps = tree.find_nearest(goals)
        pieces = np.maximum(np.ceil(gaps / _PIECE).astype(int), 1)
        starts = tree.z[nearest]
        free = self._count_free_pieces(starts, goals, pieces)
        tips = nearest.copy()
        for k in np.flatnonzero((free > 0) & (gaps > 0.0)):
            s = np.arange(1, free[k] + 1)[:, None] / pieces[k]
            branch = starts[k] + s * (goals[k] - starts[k])
            tips[k] = tree.add_branch(int(nearest[k]), branch)
        return tips, free == pieces

    def _try_connect(self, tree: _Tree, other: _Tree, tips: Ints) -> Floats | None:
        """Grow `other` to the nodes `tips` of `tree`; return the path if they meet."""
        tips = tips[np.isfinite(tree.z[tips]).all(axis=1)]
        if not len(tips):
            return None
        ends, are_reached = self._grow(other, tree.z[tips])
        for tip, end in zip(tips[are_reached], ends[are_reached], strict=True):
            path = self._join(tree, int(tip), other, int(end))
            if path is not None:
                return path
        return None

    def _join(self, tree: _Tree, tip: int, other: _Tree, end: int) -> Floats | None:
        """Return the path through two nodes at the same place if it is free in fine steps.

        Otherwise its blocked edges are cut.
        """
        is_whole = True
        for each, node in ((tree, tip), (other, end)):
            nodes = each.list_ancestors(node)
            if not np.isfinite(each.z[nodes]).all():
                return None
            if len(nodes) > 1:
                free = self._are_lines_free(each.z[nodes[1:]], each.z[nodes[:-1]], _FINE_STEP)
                for blocked in np.flatnonzero(~free):
                    each.remove_branch(nodes[int(blocked)])
                is_whole = is_whole and bool(free.all())
        if not is_whole:
            return None
        to_tip = tree.list_ancestors(tip)[::-1]
        from_end = other.list_ancestors(end)[1:]
        return np.vstack([tree.z[to_tip], other.z[from_end]])

    def _measure(self, z: Floats, other: Floats) -> Floats:
        """Return distances between configurations in the metric of searches."""
        return np.asarray(np.linalg.norm((z - other) * self.weights, axis=-1))

    def _complete(self, z: Floats) -> Floats:
        """Return whole configurations, shape (B, n), with robot coordinates z, shape (B, m)."""
        whole = np.tile(self.first, (len(z), 1))
        whole[:, : self.size] = z
        return whole

    def _count_free(self, starts: Floats, ends: Floats, fractions: Sequence[Floats]) -> Ints:
        """Return how many configurations of straight lines precede the first collision, shape (B,).

        Args:
            starts: Starts of the lines, shape (B, m).
            ends: Their ends, shape (B, m).
            fractions: For each line, the fractions of its length at which it is checked, in order.
        """
        if not fractions:
            return np.zeros(0, int)
        counts = [len(of_line) for of_line in fractions]
        lines = np.repeat(np.arange(len(counts)), counts)
        edges = np.cumsum([0, *counts])
        s = np.concatenate(fractions)[:, None]
        z = starts[lines] + s * (ends - starts)[lines]
        reach = self.problem.options.largest_margin
        free = self.problem.contacts.count_free(
            self._complete(z), edges, self.waypoint, reach=reach, allowed=self.allowed
        )
        self.checks += int(np.minimum(free + 1, counts).sum())
        return free

    def _are_lines_free(self, starts: Floats, ends: Floats, step: float = _CHECK_STEP) -> Bools:
        """Return which straight lines are free behind their starts, shape (B,).

        Configurations far apart are checked first, since they are most likely to differ.
        """
        counts = np.maximum(np.ceil(self._measure(starts, ends) / step).astype(int), 1)
        fractions = [_order_fractions(count) for count in counts.tolist()]
        return np.asarray(self._count_free(starts, ends, fractions) == counts)

    def _count_free_pieces(self, starts: Floats, ends: Floats, pieces: Ints) -> Ints:
        """Return how many pieces of straight lines are free, from their starts on, shape (B,).

        Most lines are blocked in their first piece, which is therefore checked alone.
        """
        lengths = self._measure(starts, ends) / pieces
        steps = np.maximum(np.ceil(lengths / _CHECK_STEP).astype(int), 1)
        fractions = [np.arange(1, count + 1) / count for count in (pieces * steps).tolist()]
        first_pieces = [of_line[:step] for of_line, step in zip(fractions, steps, strict=True)]
        free = self._count_free(starts, ends, first_pieces)
        longer = np.flatnonzero((free == steps) & (pieces > 1))
        other_pieces = [fractions[k][steps[k] :] for k in longer]
        free[longer] += self._count_free(starts[longer], ends[longer], other_pieces)
        return np.asarray(free // steps)

    def _cut_corners(self, path: Floats, step: float) -> Floats:
        """Replace pieces of a path, shape (P, m), between random points on it by straight lines.

        Many are checked at once; of those that overlap, the one that saves most is used.
        """
        passed = self._measure_along(path)
        last_length = np.inf
        while passed[-1] < (1.0 - _ROUND_SAVING) * last_length:
            last_length = passed[-1]
            at = np.sort(self.rng.uniform(0.0, passed[-1], (_SHORTCUTS, 2)), axis=1)
            ends = _interpolate(at.ravel(), passed, path).reshape(_SHORTCUTS, 2, -1)
            savings = at[:, 1] - at[:, 0] - self._measure(ends[:, 0], ends[:, 1])
            useful = np.flatnonzero(savings > _MIN_SAVING * passed[-1])
            is_free = self._are_lines_free(ends[useful, 0], ends[useful, 1], step)
            free = useful[is_free]
            by_saving = free[np.argsort(-savings[free], kind="stable")]
            for k in _select_disjoint(at, by_saving.tolist()):
                # `passed` stays the length along the path before.
                is_before = passed < at[k, 0]
                is_after = passed > at[k, 1]
                path = np.vstack([path[is_before], ends[k], path[is_after]])
                passed = np.concatenate([passed[is_before], at[k], passed[is_after]])
            passed = self._measure_along(path)
        return path

    def _straighten(self, path: Floats, step: float) -> Floats:
        """Move the arm, and each joint alone, evenly along a path where that is free.

        A path through a narrow passage with another posture moves all joints. Straight lines in all
        coordinates seldom undo that, and the solver cannot, because obstacles are in between
        (partial shortcuts: Geraerts and Overmars, IJRR 2007).
        """
        arm = [*range(3, self.size)]
        single_joints = [[column] for column in arm]
        for number in range(1 + _STRAIGHTENING_ROUNDS):
            for columns in [arm, *single_joints]:
                passed = self._measure_along(path)
                first = 0.0
                last = float(passed[-1])
                if number > 0:  # the first round is along the whole path
                    first, last = np.sort(self.rng.uniform(0.0, passed[-1], 2))
                path = self._replace(path, passed, first, last, columns, step)
        return path

    def _measure_along(self, path: Floats) -> Floats:
        """Return the length of a path up to each of its configurations, shape (P,)."""
        return np.concatenate([[0.0], np.cumsum(self._measure(path[1:], path[:-1]))])

    def _replace(
        self,
        path: Floats,
        passed: Floats,
        first: float,
        last: float,
        columns: Sequence[int],
        step: float,
    ) -> Floats:
        """Move some coordinates evenly between two points on a path, if it is free and shorter.

        Args:
            path: Configurations, shape (P, m).
            passed: Length of the path up to each of them, shape (P,).
            first: Length up to the first point.
            last: Length up to the last point.
            columns: The coordinates.
            step: Distance between collision checks.
        """
        inside = (passed > first) & (passed < last)
        if not inside.any():
            return path
        at = np.array([first, *passed[inside], last])
        old = _interpolate(at, passed, path)
        new = old.copy()
        s = ((at - first) / (last - first))[:, None]
        new[:, columns] = (old[0] + s * (old[-1] - old[0]))[:, columns]
        old_length = self._measure(old[1:], old[:-1]).sum()
        new_length = self._measure(new[1:], new[:-1]).sum()
        is_shorter = new_length < (1.0 - _MIN_SAVING) * old_length
        if not is_shorter or not self._are_lines_free(new[:-1], new[1:], step).all():
            return path
        return np.vstack([path[passed < first], new, path[passed > last]])

    def _resample(self, path: Floats, steps: int) -> Floats:
        """Return whole configurations along a path, shape (steps, n), slow at both ends.

        The waypoint nearest to a corner is moved there.
        """
        passed = self._measure_along(path)
        at = passed[-1] * sample_smoothstep(steps)
        lengths = np.diff(passed)
        detours = lengths[1:] + lengths[:-1] - self._measure(path[2:], path[:-2])
        for corner in passed[1:-1][detours > _MIN_DETOUR]:
            at[int(np.argmin(np.abs(at[:-1] - corner)))] = corner
        return self._complete(_interpolate(at, passed, path))


def _interpolate(at: Floats, passed: Floats, path: Floats) -> Floats:
    """Return configurations at lengths `at` along a path, shape (A, m)."""
    return np.stack([np.interp(at, passed, column) for column in path.T], axis=1)


def _select_disjoint(spans: Floats, numbers: Sequence[int]) -> list[int]:
    """Return the numbers of spans, (K, 2), that overlap none that were selected before."""
    selected = list[int]()
    for k in numbers:
        if all(spans[k, 0] > spans[j, 1] or spans[k, 1] < spans[j, 0] for j in selected):
            selected.append(k)
    return selected


@functools.cache
def _order_fractions(count: int) -> Floats:
    """Return 1/count, 2/count, ..., 1 in an order of bisection: 1, then about 1/2, 1/4, 3/4."""
    stride = count
    order = [count]
    known = {count}
    while len(order) < count:
        stride = max(1, stride // 2)
        for number in range(stride, count, stride):
            if number not in known:
                known.add(number)
                order.append(number)
    return np.array(order) / count
