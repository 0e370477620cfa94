"""Finds close pairs along a motion, at waypoints and continuously between them.

The distance of two bodies changes by at most the length of their relative motion. An interval
between two waypoints is skipped for a pair only if this bound proves that it cannot come close.
All remaining intervals are evaluated at once, then all their halves, and so on.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.validation.distances import PlacedShapes, bound_displacements
from vkc_pin.validation.pairs import PairTable

__all__ = ["Hit", "sweep"]

RESOLUTION = 1e-3  # largest penetration that may be missed between two samples [m]
MIN_MOTION = 1e-6  # smaller relative motions between two samples are ignored [m]


class Hit(NamedTuple):
    """The distance of a pair at sample `row`, or between it and the next sample.

    Attributes:
        margin: Required clearance at waypoints [m].
        contact: Overlap that counts as contact [m].
        exempt_clearance: Clearance from which the pair is exempt [m]; 0 if it is not exempt.
        shapes: Indices of the two shapes in the world.
    """

    row: int
    first: str
    second: str
    distance: float
    margin: float
    contact: float
    at_waypoint: bool
    exempt_clearance: float = 0.0
    shapes: tuple[int, int] = (-1, -1)


def sweep(table: PairTable, z: Floats, waypoints: Ints) -> Iterator[Hit]:
    """Yield close pairs along a motion: at first those at waypoints, at least one at each.

    `z` are configurations of the world, shape (S, n), evenly spaced between `waypoints`, which are
    rows of it, shape (T,).
    """
    return _Sweep(table).find_hits(z, waypoints)


class _Sweep:
    def __init__(self, table: PairTable) -> None:
        self._table, self._solids = table, table.solids
        self._waypoints = np.zeros(0, int)

    def find_hits(self, z: Floats, waypoints: Ints) -> Iterator[Hit]:
        placed = self._solids.place(self._solids.world.coordinates.q(z[waypoints]))
        at, pairs, distances = self._find_nearest(placed)
        self._waypoints, margins = waypoints, self._table.get_margins(pairs, at)
        apart = np.flatnonzero(margins > -np.inf)  # pairs that do not move together
        closest = apart[_find_group_minima(at[apart], distances[apart])]
        exempt = self._table.find_exempt(pairs, at) & (distances < self._table.margins[pairs])
        chosen = np.union1d(
            closest, np.flatnonzero((distances < np.maximum(margins, 0.0)) | exempt)
        )
        yield from self._make_hits(
            waypoints[at[chosen]], pairs[chosen], distances[chosen], at_waypoint=True
        )
        # Pairs that stay further apart do not affect the report.
        smallest = max(RESOLUTION, float(distances[closest].min(initial=np.inf)))
        moved = bound_displacements(self._solids, z)
        stretch, pairs = self._find_active_pairs(
            placed, np.diff(moved[waypoints], axis=0), smallest
        )
        ends = placed.compute_distances(
            np.concatenate([stretch, stretch + 1]), np.tile(self._table.pairs[pairs], (2, 1))
        )
        before, after = np.split(ends, 2)
        yield from self._search_intervals(
            z,
            Intervals(waypoints[stretch], waypoints[stretch + 1], pairs, before, after),
            moved,
            smallest,
        )

    def _search_intervals(
        self, z: Floats, todo: Intervals, moved: Floats, smallest: float
    ) -> Iterator[Hit]:
        """Bisect intervals and yield pairs that come closer than `smallest` inside of them.

        Every state s in between satisfies d(s) ≥ (d_t + d_{t+1} − relative motion) / 2, so that
        intervals with a larger bound are dropped. Without relative motion the distance is constant;
        only overlaps are followed then, to report all of their samples.
        """
        while len(todo.pair):
            motion = self._bound_motion(todo, moved)
            todo = todo.select(
                (todo.before + todo.after - motion < 2 * smallest)
                & ((motion > MIN_MOTION) | (todo.before < 0))
            )
            next_to = todo.high - todo.low == 1
            yield from self._find_tunnelling(z, todo.select(next_to), moved)
            todo = todo.select(~next_to)
            middle = (todo.low + todo.high) // 2
            rows, at = np.unique(middle, return_inverse=True)
            distances = self._solids.place(
                self._solids.world.coordinates.q(z[rows])
            ).compute_distances(at, self._table.pairs[todo.pair])
            told = np.union1d(_find_group_minima(at, distances), np.flatnonzero(distances < 0))
            yield from self._make_hits(middle[told], todo.pair[told], distances[told])
            todo = Intervals(
                np.append(todo.low, middle),
                np.append(middle, todo.high),
                np.tile(todo.pair, 2),
                np.append(todo.before, distances),
                np.append(distances, todo.after),
            )

    def _bound_motion(self, todo: Intervals, moved: Floats) -> Floats:
        """Bound the relative motion of pairs in intervals, shape (n,) [m]."""
        first, second = self._table.pairs[todo.pair].T
        return (moved[todo.high, first] - moved[todo.low, first]) + (
            moved[todo.high, second] - moved[todo.low, second]
        )

    def _find_tunnelling(self, z: Floats, todo: Intervals, moved: Floats) -> Iterator[Hit]:
        """Yield pairs that overlap between two adjacent samples, but at neither of them.

        Penetrations deeper than `RESOLUTION` are never missed.
        """
        first, motion = self._find_interval(todo.low), self._bound_motion(todo, moved)
        overlap = self._table.get_contact_overlaps(todo.pair, first, first + 1)
        free = (np.minimum(todo.before, todo.after) >= -overlap) & (
            todo.before + todo.after < motion
        )
        free &= ~self._table.find_moving_together(todo.pair, first, first + 1)
        stacks = {
            c: [(0.0, 1.0, float(todo.before[c]), float(todo.after[c]))]
            for c in np.flatnonzero(free).tolist()
        }
        while True:  # one step of the search of every interval at once
            steps = {c: step for c in stacks if (step := _pop_open_part(stacks[c], motion[c]))}
            if not steps:
                return
            which = np.array(list(steps))
            middle = np.array([(low + high) / 2 for low, high, _, _ in steps.values()])
            places, at = np.unique([todo.low[which], middle], axis=1, return_inverse=True)
            rows, share = places[0].astype(int), places[1][:, None]
            found = self._solids.place(
                self._solids.world.coordinates.q((1 - share) * z[rows] + share * z[rows + 1])
            ).compute_distances(at.ravel(), self._table.pairs[todo.pair[which]])
            yield from self._make_hits(todo.low[which], todo.pair[which], found)
            for (c, step), half, between in zip(
                steps.items(), middle.tolist(), found.tolist(), strict=True
            ):
                low, high, before, after = step
                if between < -overlap[c]:
                    del stacks[c]
                else:
                    stacks[c] += [(low, half, before, between), (half, high, between, after)]

    def _find_nearest(self, placed: PlacedShapes) -> tuple[Ints, Ints, Floats]:
        """Return states, pairs and distances [m] of the closest pairs and all below margins."""
        found, todo = list[tuple[Ints, Ints, Floats]](), np.arange(len(placed))
        reach = max(self._table.margins.max(), RESOLUTION)
        while len(todo):
            at, pairs = self._table.find_close_pairs(
                placed, todo, todo, np.zeros((len(todo), len(self._table.groups))), reach
            )
            states = todo[at]
            distances = placed.compute_distances(states, self._table.pairs[pairs])
            least, apart = (
                np.full(len(placed), np.inf),
                self._table.get_margins(pairs, states) > -np.inf,
            )
            np.minimum.at(least, states[apart], distances[apart])
            done = ~(least > reach)  # all other pairs are further apart
            kept = done[states]
            found.append((states[kept], pairs[kept], distances[kept]))
            todo, reach = todo[~done[todo]], 2.0 * reach
        states, pairs, distances = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.lexsort((pairs, states))
        return states[order], pairs[order], distances[order]

    def _find_active_pairs(
        self, placed: PlacedShapes, moved: Floats, smallest: float
    ) -> tuple[Ints, Ints]:
        """Find segments and pairs that may come closer than `smallest` between two waypoints.

        By the bound of `_search_intervals`, the distance at one of both ends is then less than
        `smallest` plus half the relative motion.
        """
        return self._table.find_close_pairs(
            placed, np.arange(len(moved)), np.arange(1, len(moved) + 1), moved, smallest
        )

    def _find_interval(self, rows: Ints) -> Ints:
        """Return the last waypoint at or before each sample, shape (n,)."""
        return np.searchsorted(self._waypoints, rows, side="right") - 1

    def _make_hits(
        self, rows: Ints, pairs: Ints, distances: Floats, *, at_waypoint: bool = False
    ) -> Iterator[Hit]:
        at = self._find_interval(rows)
        margins = self._table.get_margins(pairs, at)
        contacts = self._table.get_contact_overlaps(pairs, at, at if at_waypoint else at + 1)
        labels = self._solids.world.collision_labels
        exempt_clearance = np.where(
            self._table.find_exempt(pairs, at), self._table.margins[pairs], 0.0
        )
        columns = (rows, self._table.pairs[pairs], distances, margins, contacts, exempt_clearance)
        for row, (i, j), distance, margin, contact, clearance in zip(
            *(c.tolist() for c in columns), strict=True
        ):
            yield Hit(
                row, labels[i], labels[j], distance, margin, contact, at_waypoint, clearance, (i, j)
            )


class Intervals(NamedTuple):
    """Pairs in intervals between samples, with distances at both ends [m], shape (n,) each."""

    low: Ints
    high: Ints
    pair: Ints
    before: Floats
    after: Floats

    def select(self, which: Bools) -> Intervals:
        return Intervals(
            self.low[which],
            self.high[which],
            self.pair[which],
            self.before[which],
            self.after[which],
        )


_Part = tuple[float, float, float, float]  # begin and end of it, distances there [m]


def _pop_open_part(stack: list[_Part], motion: float) -> _Part | None:
    """Pop the next part of an interval in which a pair may overlap unseen; None without any."""
    while stack:
        low, high, before, after = part = stack.pop()
        width = (high - low) * motion
        if width > 2 * RESOLUTION and before + after < width:
            return part
    return None


def _find_group_minima(groups: Ints, values: Floats) -> Ints:
    """Return the index of the first smallest value of each group."""
    order = np.lexsort((values, groups))
    return order[np.flatnonzero(np.diff(groups[order], prepend=-1))]
