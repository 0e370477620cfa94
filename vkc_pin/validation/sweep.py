"""Looks along a motion for pairs that come close: at waypoints, and wherever between them two could.

A pair is left out of a stretch between two waypoints only where it cannot come close: the distance
of two bodies changes by at most what their relative motion is long. All stretches are looked at
together, all their halves next, and so on.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.validation.distances import PlacedShapes, bound_displacements
from vkc_pin.validation.pairs import PairTable

__all__ = ["Hit", "sweep"]

RESOLUTION = 1e-3  # [m] of penetration that may stay unseen between two samples
# [m] of relative motion between two samples that changes nothing, as of what stands where it was
# put
MIN_MOTION = 1e-6


class Hit(NamedTuple):
    """A pair's distance [m] at one state: at sample `row`, or between it and the next.

    `margin` is the clearance asked for at waypoints, `contact` the overlap that counts as contact
    [m]. `exempt_clearance` is the clearance that the pair would have to keep were it not exempt, and 0 where
    it is not; `shapes` are its numbers in the world.
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
    """Yield what is close along a motion, and at least the closest pair of every waypoint: these first.

    Args:
        table: The pairs.
        z: Sampled configurations of its world, shape (S, n), evenly spaced between waypoints.
        waypoints: Rows of `z` that are waypoints, shape (T,).
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
        apart = np.flatnonzero(margins > -np.inf)  # what moves as one is as close as it was
        closest = apart[_find_group_minima(at[apart], distances[apart])]
        exempt = self._table.find_exempt(pairs, at) & (distances < self._table.margins[pairs])
        chosen = np.union1d(
            closest, np.flatnonzero((distances < np.maximum(margins, 0.0)) | exempt)
        )
        yield from self._make_hits(
            waypoints[at[chosen]], pairs[chosen], distances[chosen], at_waypoint=True
        )
        smallest = max(
            RESOLUTION, float(distances[closest].min(initial=np.inf))
        )  # what cannot come closer than that changes nothing
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
        """Yield what comes closer than `smallest` at samples between two others, halves of which are left out where nothing can.

        d(s) ≥ (d_t + d_{t+1} − relative motion) / 2 for every state in between. Without motion it
        is what it is at both ends; an overlap is looked at all the same, to be told of wherever it
        is.

        Args:
            z: Sampled configurations of the world, shape (S, n).
            todo: Where to look, of all stretches at once; those of the same samples are next to
                each other.
            moved: See `bound_displacements`.
            smallest: [m].
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
        """Return how far any two points of pairs can move relative to each other in stretches, shape (n,) [m]."""
        first, second = self._table.pairs[todo.pair].T
        return (moved[todo.high, first] - moved[todo.low, first]) + (
            moved[todo.high, second] - moved[todo.low, second]
        )

    def _find_tunnelling(self, z: Floats, todo: Intervals, moved: Floats) -> Iterator[Hit]:
        """Yield what overlaps between a sample and the next, at both of which it is free: nothing deeper than 1 mm can hide.

        Args:
            z: Sampled configurations of the world, shape (S, n).
            todo: Intervals from one sample to the next.
            moved: See `bound_displacements`.
        """
        first, motion = self._find_interval(todo.low), self._bound_motion(todo, moved)
        overlap = self._table.get_contact_overlaps(todo.pair, first, first + 1)
        free = (np.minimum(todo.before, todo.after) >= -overlap) & (
            todo.before + todo.after < motion
        )
        free &= ~self._table.find_moving_together(todo.pair, first, first + 1)
        for c in np.flatnonzero(free).tolist():
            row, k = todo.low[c], todo.pair[c]
            stack = [(0.0, 1.0, todo.before[c], todo.after[c])]
            while stack:
                low, high, before, after = stack.pop()
                if (width := (high - low) * motion[c]) <= 2 * RESOLUTION or before + after >= width:
                    continue
                middle = (low + high) / 2
                state = self._solids.place(
                    self._solids.world.coordinates.q(
                        (1 - middle) * z[[row]] + middle * z[[row + 1]]
                    )
                )
                found = state.compute_distances(np.zeros(1, int), self._table.pairs[[k]])
                yield from self._make_hits(np.array([row]), np.array([k]), found)
                between = float(found[0])
                if between < -overlap[c]:
                    break
                stack += [(low, middle, before, between), (middle, high, between, after)]

    def _find_nearest(self, placed: PlacedShapes) -> tuple[Ints, Ints, Floats]:
        """Return (state, pair), the closest and all that fall short of their margins among them, and their distances [m]."""
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
            done = ~(least > reach)  # all others are further apart
            kept = done[states]
            found.append((states[kept], pairs[kept], distances[kept]))
            todo, reach = todo[~done[todo]], 2.0 * reach
        states, pairs, distances = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.lexsort((pairs, states))
        return states[order], pairs[order], distances[order]

    def _find_active_pairs(
        self, placed: PlacedShapes, moved: Floats, smallest: float
    ) -> tuple[Ints, Ints]:
        """Return (t, pair) of all but those that boxes prove to stay `smallest` apart between waypoints t and t + 1 [m].

        Where d(s) of `_search_intervals` is less, one of both distances is less than `smallest` and half the
        relative motion.

        Args:
            placed: The world at the T waypoints.
            moved: How far any point of each geometry moves from each to the next, shape (T − 1, G)
                [m].
            smallest: [m].
        """
        return self._table.find_close_pairs(
            placed, np.arange(len(moved)), np.arange(1, len(moved) + 1), moved, smallest
        )

    def _find_interval(self, rows: Ints) -> Ints:
        """Return the waypoints from which the stretches begin in which samples are, shape (n,)."""
        return np.searchsorted(self._waypoints, rows, side="right") - 1

    def _make_hits(
        self, rows: Ints, pairs: Ints, distances: Floats, *, at_waypoint: bool = False
    ) -> Iterator[Hit]:
        """Yield the distances of pairs at samples, or between these and the next, all of shape (n,)."""
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
    """Pairs between two samples, `low` and `high`, and their distances at these, `before` and `after` [m]; shape (n,) each."""

    low: Ints
    high: Ints
    pair: Ints
    before: Floats
    after: Floats

    def select(self, which: Bools) -> Intervals:
        """Return those of them."""
        return Intervals(
            self.low[which],
            self.high[which],
            self.pair[which],
            self.before[which],
            self.after[which],
        )


def _find_group_minima(groups: Ints, values: Floats) -> Ints:
    """Return where the smallest value of each group is, the first of them."""
    order = np.lexsort((values, groups))
    return order[np.flatnonzero(np.diff(groups[order], prepend=-1))]
