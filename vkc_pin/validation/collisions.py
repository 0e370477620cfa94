"""Lists pairs that could collide, and finds close ones at waypoints and continuously in between.

The distance of two bodies changes by at most the length of their relative motion. An interval
between two waypoints is skipped for a pair only if this bound proves that it cannot come close.
All remaining intervals are evaluated at once, then all their halves, and so on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.validation.contact_windows import Window
from vkc_pin.validation.distances import CollisionShapes, PlacedShapes, bound_displacements
from vkc_pin.validation.samples import Samples
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

_MOTION_TOLERANCE = 1e-9  # [m] or [rad]
RESOLUTION = 1e-3  # largest penetration that may be missed between two samples [m]
MIN_MOTION = 1e-6  # smaller relative motions between two samples are ignored [m]
_Part = tuple[float, float, float, float]  # begin and end of it, distances there [m]


class PairTable:
    """All pairs of a motion: indices of `world.shapes` and required clearances [m], shape (P,).

    Args:
        scene: Scene of the motion.
        solids: The shapes of the scene as one plain tree.
        trajectory: The motion.
        dist_safe: Required clearance at the waypoints [m].
        self_distance: Required clearance between links of the robot [m]. Default: `dist_safe`.
        windows: Pairs that may be closer, with their intervals.
        samples: Samples of the motion, if they exist already.
    """

    def __init__(
        self,
        scene: Scene,
        solids: CollisionShapes,
        trajectory: Trajectory,
        dist_safe: float,
        self_distance: float | None = None,
        *,
        windows: Sequence[Window] = (),
        samples: Samples | None = None,
    ) -> None:
        self.scene, self.world, self.solids = scene, solids.world, solids
        world, own_margin = self.world, dist_safe if self_distance is None else self_distance
        samples = Samples(scene, trajectory) if samples is None else samples
        lasts = [phase.last for phase in trajectory.phases]
        self._moves = np.array(
            [
                self._find_moving_shapes(samples.z[samples.get_rows(phase)])
                for phase in trajectory.phases
            ]
        )
        self._phase = np.searchsorted(lasts, np.arange(len(trajectory.times)))  # the earlier of two
        labels, bodies = world.collision_labels, range(solids.body_count)
        owners = [label.partition(".")[0] if "." in label else "" for label in labels]
        robots = len(scene.robot.collision.geometryObjects)
        self.groups = [
            "robot" if i < robots else name if name in scene.objects else ""
            for i, name in enumerate(owners)
        ]
        self._robot_pairs = {
            frozenset(pair): own for pair, own in scene.robot.own_margins(own_margin).items()
        }
        self._ever_moves: Bools = np.asarray(self._moves.any(axis=0))
        own = np.array(
            [(i, j) for j in bodies for i in range(j) if self._can_collide(i, j)], int
        ).reshape(-1, 2)
        self.pairs = np.concatenate([own, self._pair_with_obstacles()])
        if not len(self.pairs):
            raise InputError(
                "no pair of geometries can collide", field="scene", expected="collision geometry"
            )
        self.margins = np.full(len(self.pairs), float(dist_safe))
        self.margins[: len(own)] = [
            self._robot_pairs.get(frozenset(pair), dist_safe) for pair in own.tolist()
        ]
        self._windows = _WindowIndex(windows, self.pairs)

    def _find_moving_shapes(self, rows: Floats) -> Bools:
        """Return which shapes move in a sequence of configurations, shape (G,)."""
        world = self.world
        moved = world.coordinates.find_moved_joints(np.ptp(rows, axis=0) > _MOTION_TOLERANCE)
        for joint in range(1, len(moved)):
            moved[joint] |= moved[world.model.parents[joint]]
        robots = len(self.scene.robot.collision.geometryObjects)
        return np.array(
            [i < robots or moved[shape.parentJoint] for i, shape in enumerate(world.shapes)]
        )

    def get_margins(self, pairs: Ints, waypoints: Ints) -> Floats:
        """Return the required clearances of pairs at waypoints, shape (n,) each [m]; -inf: none."""
        margins, (k, which) = self.margins[pairs], self._windows.find(pairs, waypoints, waypoints)
        np.minimum.at(margins, k, self._windows.margin[which])
        return margins

    def get_contact_overlaps(self, pairs: Ints, first: Ints, last: Ints) -> Floats:
        """Return the overlaps that count as contact from `first` to `last`, shape (n,) each [m]."""
        overlap, (k, which) = np.zeros(len(pairs)), self._windows.find(pairs, first, last)
        np.maximum.at(overlap, k, self._windows.contact[which])
        return overlap

    def find_exempt(self, pairs: Ints, waypoints: Ints) -> Bools:
        """Return which pairs the scene exempts from clearance at waypoints, shape (n,) each."""
        exempt = np.zeros(len(pairs), bool)
        k, which = self._windows.find(pairs, waypoints, waypoints)
        exempt[k[self._windows.is_exempt[which]]] = True
        return exempt

    def find_moving_together(self, pairs: Ints, first: Ints, last: Ints) -> Bools:
        """Return which pairs move rigidly together from `first` to `last`, shape (n,) each."""
        as_one, (k, which) = np.zeros(len(pairs), bool), self._windows.find(pairs, first, last)
        as_one[k[self._windows.moves_together[which]]] = True
        return as_one

    def _can_collide(self, i: int, j: int) -> bool:
        """Return whether bodies i < j (robot first, then objects) can collide."""
        a, b = self.groups[i], self.groups[j]
        if a == "robot" and b == "robot":
            return frozenset((i, j)) in self._robot_pairs
        if a == "robot":
            return True
        if a == b:  # self-collision of an object
            links = frozenset(self.world.collision_labels[k].partition(".")[2] for k in (i, j))
            return links in self.scene.objects[a].object.own_pairs
        return bool(self._ever_moves[i] or self._ever_moves[j])

    def _pair_with_obstacles(self) -> Ints:
        """Return the pairs of moving bodies with obstacles, shape (n, 2), by obstacle."""
        bodies, labels = range(self.solids.body_count), self.world.collision_labels
        joints = [self.world.shapes[i].parentJoint for i in bodies]
        moving = [i for i in bodies if self._ever_moves[i]]
        # Wheels touch the floor, and mounted objects may.
        free = {name for name, placed in self.scene.objects.items() if placed.object.free}
        above = [
            i
            for i in moving
            if self.groups[i] in free or (self.groups[i] == "robot" and joints[i] > 1)
        ]
        obstacles = range(self.solids.body_count, len(labels))
        found = [np.zeros((0, 2), int)]
        for floor, ones in ((False, moving), (True, above)):
            others = [j for j in obstacles if (labels[j] == FLOOR) == floor]
            found.append(
                np.column_stack(
                    [np.tile(np.array(ones, int), len(others)), np.repeat(others, len(ones))]
                )
            )
        return np.concatenate(found).astype(int)

    def find_close_pairs(
        self, placed: PlacedShapes, first: Ints, last: Ints, moved: Floats, limit: float
    ) -> tuple[Ints, Ints]:
        """Find intervals and pairs that may come closer than `limit` [m], shape (n,) each.

        Pairs whose boxes prove a larger distance are left out, and so are pairs of shapes that do
        not move. The intervals are from waypoint `first` to `last`, shape (K,); `moved` is the
        largest displacement of each shape in them, shape (K, G) [m].
        """
        return placed.boxes.find_close_pairs(
            first,
            last,
            self.pairs,
            moved=moved,
            moves=self._moves,
            phases=self._phase[last],
            limit=limit,
        )


class _WindowIndex:
    """An index of windows for vectorized queries, with their properties as arrays."""

    def __init__(self, windows: Sequence[Window], pairs: Ints) -> None:
        most = max((int(window.pairs.max()) for window in windows if len(window.pairs)), default=0)
        base = np.array([max(most, int(pairs.max())) + 1, 1])
        numbers, rows = pairs @ base, [np.zeros((0, 2), int)]  # a unique number for each pair
        order = np.argsort(numbers)
        for w, window in enumerate(windows):
            wanted = window.pairs @ base
            at = order[np.minimum(np.searchsorted(numbers, wanted, sorter=order), len(order) - 1)]
            rows.append(np.column_stack([at, np.full(len(at), w)])[numbers[at] == wanted])
        found = np.concatenate(rows)
        of_pair, self._which = found[np.lexsort((found[:, 1], found[:, 0]))].T
        self._count = np.bincount(of_pair, minlength=len(pairs))
        self._begin = np.cumsum(self._count) - self._count
        self._first, self._last = (
            np.array([getattr(window, end) for window in windows], int) for end in ("first", "last")
        )
        self.margin, self.contact = (
            np.array([getattr(w, name) for w in windows], float) for name in ("margin", "contact")
        )
        self.moves_together, self.is_exempt = (
            np.array([getattr(w, name) for w in windows], bool)
            for name in ("moves_together", "is_exempt")
        )

    def find(self, pairs: Ints, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Return (k, window) for all windows of pair k that cover waypoints `first` to `last`."""
        some = np.flatnonzero(self._count[pairs])
        count = self._count[pairs[some]]
        k = np.repeat(some, count)
        place = np.repeat(self._begin[pairs[some]] - np.cumsum(count) + count, count)
        which = self._which[place + np.arange(len(k))]
        holds = (self._first[which] <= first[k]) & (last[k] <= self._last[which])
        return k[holds], which[holds]


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
            least = np.full(len(placed), np.inf)
            apart = self._table.get_margins(pairs, states) > -np.inf
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
        """Return some of the intervals."""
        return Intervals(
            self.low[which],
            self.high[which],
            self.pair[which],
            self.before[which],
            self.after[which],
        )


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
