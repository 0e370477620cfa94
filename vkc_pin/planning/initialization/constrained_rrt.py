"""The robot's path while something fixed is held, by random trees on the manifold on which the hand stays where it holds.

Two trees whose steps are projected to the manifold (Berenson, Srinivasa, Ferguson and Kuffner,
*Manipulation planning on constraint manifolds*, ICRA 2009) grow towards random configurations that
are on it. How far the objects' joints are on the way that the task has for them is one more
coordinate: a door may wait until the arm is out of its frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.keyframes import SCATTER, Knots, depth
from vkc_pin.planning.initialization.rrt import STEP, spread
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.utils.arrays import Bools, Floats, Ints

__all__ = ["held_path", "obstructed"]


def obstructed(knots: Knots, phase: int, through: Floats, straight: Floats) -> bool:
    """Return whether something is in the straight way through a phase, and trees may lead around it.

    Not where the base drives on wheels, whose arcs trees do not know, or where the robot overlaps
    things as the phase begins.

    Args:
        knots: Of the problem.
        phase: The phase's number, in which something fixed is held.
        through: Configurations at its begin, within and at its end, shape (K, n).
        straight: Its waypoints on straight lines through them, shape (steps, n).
    """
    if knots.curves is not None:
        return False
    search = _Search(knots, phase, len(straight))
    closed, _ = search.close(straight, np.arange(search.begin + 1.0, search.end + 1.0))
    return not search.free(closed).all() and bool(search.free(through[:1]).all())


def held_path(knots: Knots, phase: int, through: Floats, steps: int, tries: int) -> Floats | None:
    """Return waypoints of a phase in which something fixed is held, closed, from the first of some configurations.

    Args:
        knots: Of the problem, whose base does not drive on wheels.
        phase: The phase's number.
        through: Configurations at its begin, within and at its end, shape (K, n).
        steps: How many waypoints the phase has.
        tries: How often trees may grow until they meet.

    Returns:
        The waypoints, shape (steps, n), which overlap nothing but may end elsewhere; None if none
        are found.

    Raises:
        SpentError: The effort of planning is spent.
    """
    search = _Search(knots, phase, steps)
    path = search.run(through, tries)
    return None if path is None else search.spread(search.shortened(path), steps)


class _Path(NamedTuple):
    """Configurations, shape (P, n), and the waypoints, not whole numbers, as whose the objects' joints are there, shape (P,)."""

    z: Floats
    at: Floats


class _Tree:
    """Configurations, each with the waypoint as whose the objects' joints are there, and the node that it grew from."""

    def __init__(self, z: Floats, at: Floats) -> None:
        self.z, self.at, self.parents = z, at, np.full(len(z), -1)

    def add(self, z: Floats, at: Floats, parents: Ints) -> Ints:
        """Add nodes; return their numbers."""
        self.z, self.at = np.concatenate([self.z, z]), np.concatenate([self.at, at])
        self.parents = np.concatenate([self.parents, parents])
        return np.arange(len(self.z) - len(z), len(self.z))

    def branch(self, node: int) -> _Path:
        """Return the way from a node to its root."""
        way = [node]
        while self.parents[way[-1]] >= 0:
            way.append(int(self.parents[way[-1]]))
        return _Path(self.z[way], self.at[way])


class _Search:
    """Looks for paths through one phase, which has so many waypoints.

    Attributes:
        begin: The waypoint at which the phase before ends.
        end: The phase's last waypoint.
    """

    def __init__(self, knots: Knots, phase: int, steps: int) -> None:
        self.knots, self.problem = knots, knots.problem
        self.end = int(self.problem.ends[phase])
        self.begin = self.end - steps
        self.waypoint = self.problem.contacts.find_waypoint(phase)
        pose = knots.pose_at(self.end)
        assert pose is not None, "what is held closes the chain"
        self.solver, self.target = knots.solver(pose)
        before = self.problem.start if self.begin == 0 else knots.objects[self.begin - 1]
        self.moved = np.vstack([before, knots.objects[self.begin : self.end]])[:, knots.driven]
        self.chosen = knots.chosen(self.end)

    def close(self, z: Floats, at: Floats) -> tuple[Floats, Bools]:
        """Return the nearest configurations with the objects as they are at waypoints, in the hand, and which of them are."""
        z, driven = z.copy(), self.knots.driven
        whole = np.arange(self.begin, self.end + 1)
        z[:, driven] = np.column_stack([np.interp(at, whole, column) for column in self.moved.T])
        lower, upper = self.knots.limits(z, self.waypoint)
        lower[:, driven] = upper[:, driven] = z[:, driven]
        return self.solver.solve(
            z,
            self.target,
            lower=lower,
            upper=upper,
            weights=self.knots.weights,
            tolerance=TOLERANCE,
        )

    def free(self, z: Floats) -> Bools:
        """Return which configurations overlap nothing, shape (B,): the solver pushes apart what is too close."""
        return depth(self.problem, z, self.waypoint, reach=0.0) <= self.problem.options.dist_safe

    def apart(self, z: Floats, other: Floats) -> Floats:
        """Return how far configurations are from others in the metric of searches."""
        return np.asarray(np.linalg.norm((z - other) * self.knots.weights, axis=-1))

    def drawn(self, through: Floats, waypoint: int) -> Floats:
        """Return random configurations at a waypoint that hold what is held, as it was grasped, and overlap nothing."""
        before, found = through[np.arange(SCATTER // 4) % len(through)], []
        for how in ("scatter", "shake"):
            z, closed = self.knots.knot(before, waypoint, how)
            found.append(z[closed & (z[:, self.chosen] == through[0, self.chosen]).all(axis=1)])
        z = np.concatenate(found)
        return z[self.free(z)] if len(z) else z

    def run(self, through: Floats, tries: int) -> _Path | None:
        """Return a path from the first of some configurations to the end of the phase; None if trees do not meet."""
        ends = np.vstack([through[-1:], self.drawn(through, self.end)])
        ends = ends[self.free(ends)]
        one, other = (
            _Tree(through[:1], np.array([float(self.begin)])),
            _Tree(ends, np.full(len(ends), float(self.end))),
        )
        forwards, grown, tips = True, 0, np.zeros(1, int)
        while len(ends) and grown < tries:
            path = self.meet(one, other, tips)
            if path is not None:
                return path if forwards else _Path(path.z[::-1], path.at[::-1])
            forwards, one, other = not forwards, other, one
            waypoint = int(self.knots.rng.integers(self.begin + 1, self.end + 1))
            goals = self.drawn(through, waypoint)
            tips = np.unique(self.grow(one, goals, np.full(len(goals), float(waypoint))))
            grown += max(len(goals), 1)
        return None

    def meet(self, tree: _Tree, other: _Tree, tips: Ints) -> _Path | None:
        """Grow the other tree towards nodes of one; return the path from root to root if they meet."""
        if not len(tips):
            return None
        reached = self.grow(other, tree.z[tips], tree.at[tips])
        gaps = self.apart(other.z[reached], tree.z[tips])
        best = int(np.argmin(gaps))
        if gaps[best] > STEP:
            return None
        here, there = tree.branch(int(tips[best])), other.branch(int(reached[best]))
        return _Path(np.vstack([here.z[::-1], there.z]), np.concatenate([here.at[::-1], there.at]))

    def grow(self, tree: _Tree, goals: Floats, at: Floats) -> Ints:
        """Grow a tree towards configurations at waypoints, step by step as far as it goes; return where each way ends, (B,)."""
        ends = np.array([int(np.argmin(self.apart(tree.z, goal))) for goal in goals], int)
        going = np.arange(len(goals))
        while len(going):
            left = self.apart(tree.z[ends[going]], goals[going])
            going, left = going[left > STEP], left[left > STEP]
            here, share = ends[going], STEP / left
            moved, closed = self.close(
                tree.z[here] + share[:, None] * (goals[going] - tree.z[here]),
                now := tree.at[here] + share * (at[going] - tree.at[here]),
            )
            nearer = left - self.apart(moved, goals[going])
            good = closed & (self.apart(moved, tree.z[here]) <= 2.0 * STEP) & (nearer > STEP / 4.0)
            good[good] = self.free(moved[good])
            going = going[good]
            ends[going] = tree.add(moved[good], now[good], here[good])
        return ends

    def shortened(self, path: _Path) -> _Path:
        """Return a path that goes straight, but for closures, between random places on it where nothing is in the way."""
        for _ in range(len(path.z)):
            first, last = sorted(self.knots.rng.integers(len(path.z), size=2))
            count = int(np.ceil(self.apart(path.z[first], path.z[last]) / STEP))
            if not 1 < count < last - first:
                continue
            share = np.arange(1, count)[:, None] / count
            at = path.at[first] + share[:, 0] * (path.at[last] - path.at[first])
            between, closed = self.close(path.z[first] + share * (path.z[last] - path.z[first]), at)
            way = np.vstack([path.z[first], between, path.z[last]])
            gaps, before = self.apart(way[1:], way[:-1]), path.z[first : last + 1]
            shorter = (
                gaps.max() <= 2.0 * STEP and gaps.sum() < self.apart(before[1:], before[:-1]).sum()
            )
            if closed.all() and shorter and self.free(between).all():
                z = np.vstack([path.z[: first + 1], between, path.z[last:]])
                path = _Path(z, np.concatenate([path.at[: first + 1], at, path.at[last:]]))
        return path

    def spread(self, path: _Path, steps: int) -> Floats | None:
        """Return waypoints along a path, shape (steps, n), slow at both ends; None if one of them cannot be closed."""
        rows = spread(np.column_stack([path.z, path.at]), steps, np.append(self.knots.weights, 0.0))
        rows, closed = self.close(rows[:, :-1], rows[:, -1])
        return rows if closed.all() else None
