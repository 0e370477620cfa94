"""Beam search: from knot to knot along a task, keeping the cheapest ways, on the closure's manifold where something is held."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vkc_pin.knots import SCATTER, Knots
from vkc_pin.routes import Routes

__all__ = ["Beam", "Found"]

_DRAWS, _ENOUGH = 2, 12  # how often random seeds are drawn until so many of what they lead to are free
_BEAM, _QUICK_BEAM, _CHILDREN = 40, 24, 4  # configurations kept per knot, and tried from each for the next
_SPACING = 4  # waypoints between knots along a phase in which something is held
_APPROACH = 6  # configurations looked at on the way to a grasp
_EASY = 0.5  # share of the beam that must go on freely for a knot to be easy
_COLLISION, _DEPTH = 10.0, 300.0  # what a collision costs, and a metre of its depth, beside radians of motion
_NOT_FOUND = 1e3


class Found(NamedTuple):
    """What a search found.

    Attributes:
        paths: Configurations at the knots, shape (B, knots, n), the start first.
        cost: What each costs, shape (B,).
        trouble: How much of that is for collisions, shape (B,).
        at: The knots' waypoints.
    """

    paths: NDArray[np.float64]
    cost: NDArray[np.float64]
    trouble: NDArray[np.float64]
    at: list[int]


class Beam:
    """Searches a problem's knots.

    Args:
        knots: Where configurations come from.
        routes: The ways that the base would drive; None: as if it drove straight.
    """

    def __init__(self, knots: Knots, routes: Routes | None = None) -> None:
        self.knots, self.problem, self.routes = knots, knots.problem, routes
        self.width = _BEAM

    def search(self, *, thorough: bool) -> Found:
        """Go from knot to knot, keeping the cheapest paths."""
        self.width = _BEAM if thorough else _QUICK_BEAM
        problem = self.problem
        paths = problem.start[None, None, :]
        cost, trouble = np.zeros(1), np.zeros(1)
        at, begin = [0], 0
        for number, (phase, end) in enumerate(zip(problem.task.phases, problem.ends, strict=True)):
            closed = problem.closed(phase)
            pieces = max(1, round((end - begin) / _SPACING)) if closed else 1
            for knot in np.linspace(begin, end, pieces + 1).round().astype(int)[1:].tolist():
                parents, z, bad = self._continue(paths, cost, knot, number, thorough=thorough)
                total = cost[parents] + self._way(paths[parents, -1], z, number) + bad
                best = np.argsort(total, kind="stable")[: self.width]
                paths = np.concatenate([paths[parents[best]], z[best, None]], axis=1)
                cost, trouble = total[best], (trouble[parents] + bad)[best]
                at.append(knot)
            if not closed and self.routes is None:
                cost = cost + self._approach(paths[:, -2], paths[:, -1], begin, end)
            begin = end
        return Found(paths, cost, trouble, at)

    def _way(self, first: NDArray[np.float64], last: NDArray[np.float64], phase: int) -> NDArray[np.float64]:
        """Return what it costs to go from `first` to `last`, both (B, n), in a phase, shape (B,)."""
        way = np.abs(last - first) * self.knots.weights
        if self.routes is not None and not self.problem.closed(self.problem.task.phases[phase]):
            way[:, 0], way[:, 1] = self.knots.weights[0] * self.routes.distances(phase, first[:, :3], last[:, :3]), 0.0
            np.minimum(way, _NOT_FOUND, out=way)  # where there is no way, others come first
        return np.asarray(way.sum(axis=1))

    def _continue(
        self, paths: NDArray[np.float64], cost: NDArray[np.float64], waypoint: int, phase: int, *, thorough: bool
    ) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
        """Return continuations of `paths` to a waypoint: which path each goes on from, where to, and what is wrong there."""
        knots = self.knots
        if not self.problem.closed(self.problem.task.phases[phase]):
            draws = []
            for _ in range(_DRAWS):
                parents = np.arange(SCATTER if thorough else SCATTER // 2) % len(paths)
                z, found = knots.knot(paths[parents, -1], waypoint, "scatter")
                price = cost[parents] + self._way(paths[parents, -1], z, phase)
                draws.append(self._cheapest(price, parents, z, found, waypoint))
                if sum(np.count_nonzero(bad == 0) for _, _, bad in draws) >= _ENOUGH:
                    break
            parents, z, bad = (np.concatenate(parts) for parts in zip(*draws, strict=True))
            if np.count_nonzero(bad == 0) < _ENOUGH:  # push the best of the others out of what they are in
                price = cost[parents] + self._way(paths[parents, -1], z, phase) + bad
                best = np.argsort(price, kind="stable")[: 2 * self.width]
                pushed = knots.clear(z[best], waypoint)
                parents, z = np.concatenate([parents, parents[best]]), np.concatenate([z, pushed])
                bad = np.concatenate([bad, self._bad(pushed, np.ones(len(pushed), bool), waypoint)])
            return parents, z, bad
        parents = np.arange(len(paths))
        z, found = knots.knot(paths[:, -1], waypoint, "track")
        if not thorough:
            bad = self._bad(z, found, waypoint)
            if np.count_nonzero(bad == 0) >= _EASY * len(paths):
                return parents, z, bad
        more = np.arange(self.width * _CHILDREN - len(paths)) % len(paths)
        shaken, also = knots.knot(paths[more, -1], waypoint, "shake")
        parents, z, found = np.concatenate([parents, more]), np.concatenate([z, shaken]), np.concatenate([found, also])
        return self._cheapest(cost[parents] + self._way(paths[parents, -1], z, phase), parents, z, found, waypoint)

    def _cheapest(
        self,
        price: NDArray[np.float64],
        parents: NDArray[np.int_],
        z: NDArray[np.float64],
        found: NDArray[np.bool_],
        waypoint: int,
    ) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
        """Return continuations, the cheapest first; what the beam cannot keep anyway need not be looked at."""
        order = np.argsort(price + _NOT_FOUND * ~found, kind="stable")
        parents, z, found = parents[order], z[order], found[order]
        half = min(2 * self.width, len(z))
        bad = self._bad(z[:half], found[:half], waypoint)
        if np.count_nonzero(bad == 0) >= self.width:
            return parents[:half], z[:half], bad
        return parents, z, np.concatenate([bad, self._bad(z[half:], found[half:], waypoint)])

    def _bad(self, z: NDArray[np.float64], found: NDArray[np.bool_], waypoint: int) -> NDArray[np.float64]:
        """Return what is wrong with configurations at a waypoint, as a cost, shape (B,)."""
        bad = np.full(len(z), _NOT_FOUND)
        if found.any():
            depth = self.knots.depth(z[found], waypoint)
            bad[found] = np.where(depth > 0, _COLLISION + _DEPTH * depth, 0.0)
        return bad

    def _approach(self, first: NDArray[np.float64], last: NDArray[np.float64], begin: int, end: int) -> NDArray[np.float64]:
        """Return what the straight ways from `first` to `last`, both (B, n), cost in collisions, shape (B,)."""
        s = np.arange(1, _APPROACH) / _APPROACH
        between = first[:, None] + s[:, None] * (last - first)[:, None]
        depth = self.knots.depth(between.reshape(-1, between.shape[-1]), min(begin + 1, end))
        return np.asarray(np.sum(np.where(depth > 0, 1.0 + _DEPTH / _APPROACH * depth, 0.0).reshape(len(first), -1), axis=1))
