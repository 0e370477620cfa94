"""Beam search: from knot to knot along a task, keeping the cheapest paths, on the closure's manifold where something is held."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.base_routes import Routes
from vkc_pin.planning.initialization.keyframes import ALIKE, SCATTER, Knots
from vkc_pin.planning.nlp.pose_goals import find_approach_waypoint
from vkc_pin.utils.arrays import Bools, Floats, Ints

__all__ = ["Beam", "Found"]

_BATCHES = 6  # batches of random samples at most: good grasps are rare
# free configurations at a knot with which no more are drawn, nor pushed, where nothing fixed is
# held
_FREE = 60
# [s] from knot to knot along a phase in which something fixed is held, at `Options.dt` a waypoint
_KNOT_TIME = 1.0
_WIDTH = 24  # configurations kept per knot
_COLLISION, _DEPTH = (
    10.0,
    300.0,
)  # cost of a collision, and of its depth [1/m], a radian of a joint costing 1
_NOT_FOUND = 1e3  # cost if there is no configuration, or no path of the base
_TOLERABLE = 60.0  # cost of collisions that the solver may be left to push apart: a graze or two
_SHORTENINGS = 8  # times that each knot of paths is drawn to its neighbours
_SECTORS, _EACH = (
    8,
    4,
)  # of headings of the base, and how many of each are kept before more of the others
# [m] of the base from knot to knot while something fixed is held: a path through an obstacle, no
# doubt
_JUMP = 0.5


class Found(NamedTuple):
    """What a search found.

    Attributes:
        paths: Configurations at the knots, shape (B, knots, n), the start first.
        cost: What each costs, shape (B,).
        trouble: How much of that is for collisions, shape (B,).
        at: The knots' waypoints.
    """

    paths: Floats
    cost: Floats
    trouble: Floats
    at: list[int]


class _Mode(NamedTuple):
    """How a search goes on; see `Beam.search`."""

    thorough: bool
    backwards: bool
    apart: bool = False


class Beam:
    """Searches a problem's knots.

    Args:
        knots: Where configurations come from.
        routes: The paths that the base would drive; None: as if it drove straight.
        careful: Whether grasps count as free only if the straight path to them is free, too, none
            are shortened, and paths of the base are those with the arm folded: for narrow places.
    """

    def __init__(
        self, knots: Knots, routes: Routes | None = None, *, careful: bool = False
    ) -> None:
        self.knots, self.problem, self.routes, self.careful = knots, knots.problem, routes, careful
        self.metric = np.sqrt(self.problem.effort.metric / self.problem.options.velocity_weight_arm)
        self.approaches = {
            int(end): find_approach_waypoint(
                int(end) - phase.segments, int(end), self.problem.options
            )
            for phase, end in zip(self.problem.task.phases, self.problem.ends, strict=True)
            if phase.grasps
        }

    def search(self, *, thorough: bool, backwards: bool = False, apart: bool = False) -> Found:
        """Go from knot to knot, keeping the cheapest paths.

        Args:
            thorough: Draw more, and shake the arms at every knot at which something fixed is held.
            backwards: Where something fixed is held, begin where it is let go of, and go back to
                where it is grasped: a passage may be wide at its end only, and hardly anything that
                is free at its beginning leads there.
            apart: Keep paths on which the base heads elsewhere, too: one that is steered needs room
                to turn, and the cheapest so far may head where there is none.
        """
        # A hand that chooses where to grasp, and then clamps, chooses before it moves anything.
        chosen = [
            grasp + 1 for _, grasp, _ in self.problem.choices if grasp < self.problem.segments
        ]
        backwards = backwards and not any(map(self._closed_at, chosen))
        mode = _Mode(thorough, backwards, apart)
        problem = self.problem
        found = Found(problem.start[None, None, :], np.zeros(1), np.zeros(1), [0])
        closed = [problem.closed(phase) for phase in problem.task.phases]
        number = 0
        while number < len(closed):
            last = number
            while backwards and not closed[number] and closed[last + 1 : last + 2] == [True]:
                last += 1
            knots = self._knots(number, last)
            if last > number:
                found = self._go_back(found, knots, number, mode)
            else:
                for knot in knots:
                    found = self._go_on(found, knot, number, mode)
            number = last + 1
        return found

    def tolerable(self, found: Found) -> bool:
        """Return whether the cheapest path hits little and, if paths of the base count, never jumps while something is held."""
        best = int(np.argmin(found.cost))
        held = [self._closed_at(knot) for knot in found.at[1:]]
        jumps = np.abs(np.diff(found.paths[best, :, :2], axis=0)).max(axis=1) > _JUMP
        return bool(
            found.trouble[best] <= _TOLERABLE and (self.routes is None or not np.any(jumps & held))
        )

    def _closed_at(self, waypoint: int) -> bool:
        return self.problem.closed(
            self.problem.task.phases[self.problem.contacts.find_phase(waypoint)]
        )

    def _knots(self, first: int, last: int) -> list[int]:
        problem, knots = self.problem, list[int]()
        for number in range(first, last + 1):
            begin, end = int(problem.ends[number - 1]) if number else 0, int(problem.ends[number])
            closed, steps = (
                problem.closed(problem.task.phases[number]),
                problem.options.steps(_KNOT_TIME),
            )
            pieces = max(1, round((end - begin) / steps)) if closed else 1
            knots += np.linspace(begin, end, pieces + 1).round().astype(int)[1:].tolist()
        return knots

    def _go_on(self, found: Found, knot: int, phase: int, mode: _Mode) -> Found:
        """Return the cheapest paths to the next knot, to which something of a phase leads."""
        parents, z, bad = self._continue(found.paths, found.cost, knot, phase, mode)
        total = found.cost[parents] + self._path_cost(found.paths[parents, -1], z, phase) + bad
        drawn = len(z)
        open_phase = not self.problem.closed(self.problem.task.phases[phase])
        if not self.careful and open_phase and self.knots.pose_at(knot) is not None:
            parents, z, bad, total = self._with_shortened(
                found, parents, z, bad, total, knot, phase
            )
        best = self._kept(total, z, drawn, _WIDTH, _SECTORS if mode.apart else 1)
        paths = np.concatenate([found.paths[parents[best]], z[best, None]], axis=1)
        return Found(paths, total[best], (found.trouble[parents] + bad)[best], [*found.at, knot])

    def _with_shortened(
        self,
        found: Found,
        parents: Ints,
        z: Floats,
        bad: Floats,
        total: Floats,
        knot: int,
        phase: int,
    ) -> tuple[Ints, Floats, Floats, Floats]:
        """Return continuations, and after them what the best of them become when the ways to them are shortened."""
        best = np.argsort(total, kind="stable")[: 2 * _WIDTH]
        before = found.paths[parents[best]]
        paths = np.concatenate([before, z[best, None]], axis=1)
        short = self.shortened(
            Found(paths, total[best], bad[best], [*found.at, knot]), len(found.at)
        )
        end = short.paths[:, -1]
        price = (
            found.cost[parents[best]] + self._path_cost(before[:, -1], end, phase) + short.trouble
        )
        return (
            np.concatenate([parents, parents[best]]),
            np.concatenate([z, end]),
            np.concatenate([bad, short.trouble]),
            np.concatenate([total, price]),
        )

    @staticmethod
    def _kept(total: Floats, z: Floats, drawn: int, width: int, sectors: int = 1) -> Ints:
        """Return which continuations to keep: of those that are alike the cheapest, and of these the cheapest.

        At most half of them are not as they were `drawn`, the first ones: what is short may be what
        nothing goes on from. With more than one sector of headings, those come last before which
        there are enough of their sector.
        """
        rest, kept, late = np.argsort(total, kind="stable"), list[int](), list[int]()
        headings = (
            np.floor(z[:, 2] / (2 * np.pi) * sectors).astype(int) % sectors
            if sectors > 1
            else np.zeros(len(z), int)
        )
        full = np.zeros(sectors, int)
        while len(rest) and len(kept) < width:
            first = int(rest[0])
            (late if sectors > 1 and full[headings[first]] >= _EACH else kept).append(first)
            full[headings[first]] += 1
            rest = rest[np.abs(z[rest] - z[first]).max(axis=1) > ALIKE]
            if np.count_nonzero(np.array(kept) >= drawn) >= width // 2:
                rest = rest[rest < drawn]
        return np.array(kept + late[: width - len(kept)])

    def _go_back(self, found: Found, knots: list[int], phase: int, mode: _Mode) -> Found:
        """Return the cheapest paths through knots, of which all but the first are while something fixed is held after a phase."""
        known = found.paths.shape[1]
        found = self._go_on(found, knots[-1], phase, mode)
        for knot in knots[-2::-1]:
            found = self._go_on(found, knot, phase + 1, mode)
        paths = np.concatenate([found.paths[:, :known], found.paths[:, : known - 1 : -1]], axis=1)
        start, grasp, end = paths[:, known - 1], paths[:, known], paths[:, -1]
        cost = (
            found.cost + self._path_cost(start, grasp, phase) - self._path_cost(start, end, phase)
        )
        return Found(paths, cost, found.trouble, [*found.at[:known], *knots])

    def _path_cost(self, first: Floats, last: Floats, phase: int) -> Floats:
        """Return the length of the ways from `first` to `last`, both (B, n), in a phase, in radians of the arm, shape (B,)."""
        cost = np.abs(last - first) * self.metric
        cost[:, 0], cost[:, 1] = np.hypot(cost[:, 0], cost[:, 1]), 0.0
        if self.knots.curves is not None:
            lengths, turns = self.knots.curves.lengths(first[:, :3], last[:, :3])
            cost[:, 0], cost[:, 2] = self.metric[0] * lengths, self.metric[2] * turns
        if self.routes is not None and not self.problem.closed(self.problem.task.phases[phase]):
            distances = self.routes.distances(phase, first[:, :3], last[:, :3], folded=self.careful)
            cost[:, 0] = self.metric[0] * distances
            np.minimum(cost, _NOT_FOUND, out=cost)  # where there is no path, others come first
        elif self.routes is not None:
            cost[:, 0] += _TOLERABLE * (np.abs(last - first)[:, :2].max(axis=1) > _JUMP)
        return np.asarray(cost.sum(axis=1))

    def _continue(
        self, paths: Floats, cost: Floats, waypoint: int, phase: int, mode: _Mode
    ) -> tuple[Ints, Floats, Floats]:
        """Return continuations of `paths` to a waypoint: which path each goes on from, where to, and what is wrong there."""
        knots = self.knots
        if not self.problem.closed(self.problem.task.phases[phase]):
            samples = []
            for _ in range(_BATCHES):
                parents = np.arange(SCATTER if mode.thorough else SCATTER // 2) % len(paths)
                z, found = knots.knot(paths[parents, -1], waypoint, "scatter")
                price = cost[parents] + self._path_cost(paths[parents, -1], z, phase)
                samples.append(self._cheapest(price, parents, z, found, waypoint))
                if sum(np.count_nonzero(bad == 0) for _, _, bad in samples) >= _FREE:
                    break
            parents, z, bad = (np.concatenate(parts) for parts in zip(*samples, strict=True))
            return self._pushed(paths, cost, parents, z, bad, waypoint, phase)
        parents = np.arange(len(paths))
        z, found = knots.knot(paths[:, -1], waypoint, "track")
        if not mode.thorough:
            bad = self._bad(z, found, waypoint)
            if not bad.any():
                return parents, z, bad
        more = np.arange(SCATTER // 2 - len(paths)) % len(paths)
        shaken, also = knots.knot(paths[more, -1], waypoint, "shake")
        parents, z, found = (
            np.concatenate([parents, more]),
            np.concatenate([z, shaken]),
            np.concatenate([found, also]),
        )
        price = cost[parents] + self._path_cost(paths[parents, -1], z, phase)
        parents, z, bad = self._cheapest(price, parents, z, found, waypoint)
        if not mode.backwards:
            return parents, z, bad
        return self._pushed(paths, cost, parents, z, bad, waypoint, phase)

    def _pushed(
        self,
        paths: Floats,
        cost: Floats,
        parents: Ints,
        z: Floats,
        bad: Floats,
        waypoint: int,
        phase: int,
    ) -> tuple[Ints, Floats, Floats]:
        """Return continuations and, if few of them are free, the best of them pushed out of what they are in."""
        if np.count_nonzero(bad == 0) >= (_WIDTH if self._closed_at(waypoint) else _FREE):
            return parents, z, bad
        price = cost[parents] + self._path_cost(paths[parents, -1], z, phase) + bad
        best = np.argsort(price, kind="stable")[: 2 * _WIDTH]
        pushed = self.knots.clear(z[best], waypoint)
        more = self._bad(pushed, np.ones(len(pushed), bool), waypoint)
        return (
            np.concatenate([parents, parents[best]]),
            np.concatenate([z, pushed]),
            np.concatenate([bad, more]),
        )

    def shortened(self, found: Found, first: int = 1) -> Found:
        """Return paths whose ways to what they reach and grasp are as short as a local search makes them.

        In turn each such knot, from `first` on, is drawn to the middle of its neighbours, along the
        pose's manifold, by a share that is halved when that makes the path no cheaper. So paths
        compare by what the solver can make of them, not by luck.
        """
        paths, cost, trouble, at, robot = (
            found.paths.copy(),
            found.cost.copy(),
            found.trouble.copy(),
            found.at,
            self.knots.robot,
        )
        moved = [
            k
            for k in range(first, len(at))
            if not self._closed_at(at[k]) and self.knots.pose_at(at[k]) is not None
        ]
        share = np.full((len(paths), len(at), 1), 0.5)
        hit = {k: self._bad(paths[:, k], np.ones(len(paths), bool), at[k]) for k in moved}
        for k in moved * _SHORTENINGS:
            drawn = paths[:, k].copy()
            middle = paths[:, [k - 1, *([k + 1] if k + 1 < len(at) else [])]].mean(axis=1)
            drawn[:, :robot] += share[:, k] * (middle - drawn)[:, :robot]
            drawn, reached = self.knots.knot(drawn, at[k], "track")
            hits = self._bad(drawn, reached, at[k])
            gain = (
                self._around(paths, paths[:, k], at, k)
                + hit[k]
                - self._around(paths, drawn, at, k)
                - hits
            )
            cheaper = gain > 0.0
            paths[cheaper, k] = drawn[cheaper]
            cost[cheaper] -= gain[cheaper]
            trouble[cheaper] += (hits - hit[k])[cheaper]
            hit[k][cheaper] = hits[cheaper]
            share[~cheaper, k] /= 2.0
        return Found(paths, cost, trouble, at)

    def _around(self, paths: Floats, z: Floats, at: list[int], k: int) -> Floats:
        """Return what paths cost from the knot before `k` to the one after it, if they went through z, shape (B, n), there."""
        cost = self._path_cost(paths[:, k - 1], z, self.problem.contacts.find_phase(at[k]))
        if k + 1 < len(at):
            cost = cost + self._path_cost(
                z, paths[:, k + 1], self.problem.contacts.find_phase(at[k + 1])
            )
        return cost

    def _cheapest(
        self, price: Floats, parents: Ints, z: Floats, found: Bools, waypoint: int
    ) -> tuple[Ints, Floats, Floats]:
        """Return continuations, the cheapest first; what the beam cannot keep anyway need not be looked at."""
        order = np.argsort(price + _NOT_FOUND * ~found, kind="stable")
        parents, z, found = parents[order], z[order], found[order]
        half = min(2 * _WIDTH, len(z))
        bad = self._bad(z[:half], found[:half], waypoint)
        if np.count_nonzero(bad == 0) >= _WIDTH:
            return parents[:half], z[:half], bad
        return parents, z, np.concatenate([bad, self._bad(z[half:], found[half:], waypoint)])

    def _bad(self, z: Floats, found: Bools, waypoint: int) -> Floats:
        """Return what is wrong with configurations at a waypoint, as a cost, shape (B,)."""
        bad = np.full(len(z), _NOT_FOUND)
        if found.any():
            depth = self.knots.depth(z[found], waypoint)
            bad[found] = _hits(depth)
            if self.careful and waypoint in self.approaches and (depth <= 0).any():
                free = np.flatnonzero(found)[depth <= 0]
                at = self.approaches[waypoint]
                near, reached = self.knots.knot(z[free], at, "track")
                bad[free] += _hits(self.knots.depth(near, at)) + _NOT_FOUND * ~reached
        return bad


def _hits(depth: Floats) -> Floats:
    """Return what collisions of some depth [m] cost, shape (B,)."""
    return np.where(depth > 0, _COLLISION + _DEPTH * depth, 0.0)
