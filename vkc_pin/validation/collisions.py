"""Lists pairs that could collide, and finds close ones at waypoints and continuously in between.

The distance of two bodies changes by at most the length of their relative motion. An interval
between two waypoints is skipped for a pair only if this bound proves that it cannot come close.
All remaining intervals are evaluated at once, then all their halves, and so on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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

# [m] or [rad]
_MOTION_TOLERANCE = 1e-9
# largest penetration that may be missed between two samples [m]
RESOLUTION = 1e-3
# smaller relative motions between two samples are ignored [m]
MIN_MOTION = 1e-6


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
        obstacles_only: Whether pairs of two bodies are left out.
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
        obstacles_only: bool = False,
    ) -> None:
        self.scene = scene
        self.world = solids.world
        self.solids = solids
        samples = Samples(scene, trajectory) if samples is None else samples
        own_margin = dist_safe if self_distance is None else self_distance
        robot_margins = scene.robot.own_margins(own_margin)
        self._robot_pairs = {frozenset(pair): margin for pair, margin in robot_margins.items()}
        self.groups = self._list_groups()
        moves = [
            self._find_moving_shapes(samples.z[samples.get_rows(phase)])
            for phase in trajectory.phases
        ]
        self._moves = np.array(moves)
        self._ever_moves: Bools = np.asarray(self._moves.any(axis=0))
        # The phase of each waypoint; of two, the earlier one.
        lasts = [phase.last for phase in trajectory.phases]
        self._phase = np.searchsorted(lasts, np.arange(len(trajectory.times)))
        own = np.zeros((0, 2), int) if obstacles_only else self._pair_bodies()
        self.pairs = np.concatenate([own, self._pair_with_obstacles()])
        if not len(self.pairs):
            raise InputError(
                "no pair of geometries can collide", field="scene", expected="collision geometry"
            )
        own_margins = [self._robot_pairs.get(frozenset(pair), dist_safe) for pair in own.tolist()]
        self.margins = np.full(len(self.pairs), float(dist_safe))
        self.margins[: len(own)] = own_margins
        self._windows = _WindowIndex(windows, self.pairs)

    @property
    def have_windows(self) -> Bools:
        """Which pairs may be closer at some time, shape (P,)."""
        return self._windows.have_any

    def _list_groups(self) -> list[str]:
        """Return for each shape "robot", the name of its object, or "" for an obstacle."""
        robot_size = len(self.scene.robot.collision.geometryObjects)
        groups: list[str] = []
        for i, label in enumerate(self.world.collision_labels):
            owner, dot, _ = label.partition(".")
            if i < robot_size:
                groups.append("robot")
            elif dot and owner in self.scene.objects:
                groups.append(owner)
            else:
                groups.append("")
        return groups

    def _pair_bodies(self) -> Ints:
        """Return the pairs of two bodies that can collide, shape (n, 2)."""
        pairs: list[tuple[int, int]] = []
        for j in range(self.solids.body_count):
            pairs += [(i, j) for i in range(j) if self._can_collide(i, j)]
        return np.array(pairs, int).reshape(-1, 2)

    def _find_moving_shapes(self, rows: Floats) -> Bools:
        """Return which shapes move in a sequence of configurations, shape (G,)."""
        world = self.world
        moved = world.coordinates.find_moved_joints(np.ptp(rows, axis=0) > _MOTION_TOLERANCE)
        for joint in range(1, len(moved)):
            moved[joint] |= moved[world.model.parents[joint]]
        robot_size = len(self.scene.robot.collision.geometryObjects)
        return np.array(
            [i < robot_size or moved[shape.parentJoint] for i, shape in enumerate(world.shapes)]
        )

    def get_margins(self, pairs: Ints, waypoints: Ints) -> Floats:
        """Return the required clearances of pairs at waypoints, shape (n,) each [m]; -inf: none."""
        margins = self.margins[pairs]
        k, which = self._windows.find(pairs, waypoints, waypoints)
        np.minimum.at(margins, k, self._windows.margin[which])
        return margins

    def get_contact_overlaps(self, pairs: Ints, first: Ints, last: Ints) -> Floats:
        """Return the overlaps that count as contact from `first` to `last`, shape (n,) each [m]."""
        overlap = np.zeros(len(pairs))
        k, which = self._windows.find(pairs, first, last)
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
        is_rigid = np.zeros(len(pairs), bool)
        k, which = self._windows.find(pairs, first, last)
        is_rigid[k[self._windows.moves_together[which]]] = True
        return is_rigid

    def _can_collide(self, i: int, j: int) -> bool:
        """Return whether bodies i < j (robot first, then objects) can collide."""
        first = self.groups[i]
        second = self.groups[j]
        if first == "robot" and second == "robot":
            return frozenset((i, j)) in self._robot_pairs
        if first == "robot":
            return True
        if first == second:  # self-collision of an object
            labels = self.world.collision_labels
            links = frozenset((labels[i].partition(".")[2], labels[j].partition(".")[2]))
            return links in self.scene.objects[first].object.own_pairs
        return bool(self._ever_moves[i] or self._ever_moves[j])

    def _pair_with_obstacles(self) -> Ints:
        """Return the pairs of moving bodies with obstacles, shape (n, 2), by obstacle.

        Those with the floor come last.
        """
        labels = self.world.collision_labels
        moving = [i for i in range(self.solids.body_count) if self._ever_moves[i]]
        over_floor = [i for i in moving if self._must_clear_floor(i)]
        obstacles: list[int] = []
        floors: list[int] = []
        for j in range(self.solids.body_count, len(labels)):
            if labels[j] == FLOOR:
                floors.append(j)
            else:
                obstacles.append(j)
        pairs = [_pair_all(moving, obstacles), _pair_all(over_floor, floors)]
        return np.concatenate(pairs)

    def _must_clear_floor(self, body: int) -> bool:
        """Return whether a body may not touch the floor, as wheels do, and mounted objects may."""
        group = self.groups[body]
        if group == "robot":
            return bool(self.world.shapes[body].parentJoint > 1)
        return group in self.scene.objects and self.scene.objects[group].object.free

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
        self._first = np.array([window.first for window in windows], int)
        self._last = np.array([window.last for window in windows], int)
        self.margin = np.array([window.margin for window in windows], float)
        self.contact = np.array([window.contact for window in windows], float)
        self.moves_together = np.array([window.moves_together for window in windows], bool)
        self.is_exempt = np.array([window.is_exempt for window in windows], bool)
        # The windows of pair p are `_which[_begin[p] : _begin[p] + _count[p]]`.
        listed = self._list_windows(windows, pairs)
        of_pair, self._which = listed[np.lexsort((listed[:, 1], listed[:, 0]))].T
        self._count = np.bincount(of_pair, minlength=len(pairs))
        self._begin = np.cumsum(self._count) - self._count
        self.have_any: Bools = self._count > 0

    @staticmethod
    def _list_windows(windows: Sequence[Window], pairs: Ints) -> Ints:
        """Return (pair, window) for each known pair of each window, shape (n, 2)."""
        largest = int(pairs.max())
        for window in windows:
            if len(window.pairs):
                largest = max(largest, int(window.pairs.max()))
        base = np.array([largest + 1, 1])
        numbers = pairs @ base  # unique for each pair
        order = np.argsort(numbers)
        rows = [np.zeros((0, 2), int)]
        for w, window in enumerate(windows):
            wanted = window.pairs @ base
            places = np.searchsorted(numbers, wanted, sorter=order)
            at = order[np.minimum(places, len(order) - 1)]
            is_known = numbers[at] == wanted
            rows.append(np.column_stack([at, np.full(len(at), w)])[is_known])
        return np.concatenate(rows)

    def find(self, pairs: Ints, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Return (k, window) for all windows of pair k that cover waypoints `first` to `last`."""
        some = np.flatnonzero(self._count[pairs])
        count = self._count[pairs[some]]
        k = np.repeat(some, count)
        # Row n of the result is window n − (rows of earlier pairs) of its pair.
        offsets = np.repeat(self._begin[pairs[some]] - np.cumsum(count) + count, count)
        which = self._which[offsets + np.arange(len(k))]
        is_covered = (self._first[which] <= first[k]) & (last[k] <= self._last[which])
        return k[is_covered], which[is_covered]


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
    exempt_clearance: float
    shapes: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Hits:
    """The distances of H pairs, all at waypoints or all elsewhere; see `Hit`.

    Attributes:
        rows, distances, margins, contacts, exempt_clearances: Shape (H,) each.
        pairs: Indices of the pairs in the table, shape (H,).
    """

    table: PairTable
    rows: Ints
    pairs: Ints
    distances: Floats
    margins: Floats
    contacts: Floats
    exempt_clearances: Floats
    at_waypoints: bool

    def to_list(self, which: Bools) -> list[Hit]:
        """Return those distances of a mask, shape (H,), as objects."""
        labels = self.table.world.collision_labels
        listed: list[Hit] = []
        for n in np.flatnonzero(which).tolist():
            i, j = self.table.pairs[self.pairs[n]].tolist()
            hit = Hit(
                row=int(self.rows[n]),
                first=labels[i],
                second=labels[j],
                distance=float(self.distances[n]),
                margin=float(self.margins[n]),
                contact=float(self.contacts[n]),
                at_waypoint=self.at_waypoints,
                exempt_clearance=float(self.exempt_clearances[n]),
                shapes=(i, j),
            )
            listed.append(hit)
        return listed


def sweep(
    table: PairTable,
    z: Floats,
    waypoints: Ints,
    *,
    moved: Floats | None = None,
    first_row: int = 0,
    deepest_only: Bools | None = None,
) -> Iterator[Hits]:
    """Yield close pairs along a motion: first those at waypoints, then those between them.

    Args:
        table: P pairs that could collide.
        z: Configurations of the world, shape (S, n), evenly spaced between waypoints.
        waypoints: Rows of `z` that are the waypoints, shape (T,).
        moved: Result of `bound_displacements` for `z`, if it exists already.
        first_row: First row of `z` that is searched.
        deepest_only: Pairs of which only the deepest overlap matters, shape (P,). If given, pairs
            that violate no clearance are not searched. Default: the closest pair of each waypoint
            is yielded, too, and that of the whole motion.
    """
    if moved is None:
        moved = bound_displacements(table.solids, z)
    return _Sweep(table, waypoints, first_row, deepest_only).find_hits(z, moved)


class _Sweep:
    """Searches a motion for close pairs, at waypoints and then between them."""

    def __init__(
        self, table: PairTable, waypoints: Ints, first_row: int, deepest_only: Bools | None
    ) -> None:
        self._table = table
        self._solids = table.solids
        self._waypoints = waypoints
        self._first_row = first_row
        self._close_only = deepest_only is not None
        # Deepest overlap so far of each pair of which only that matters, as a distance [m].
        self._deepest = np.full(len(table.pairs), np.inf)
        self._deepest_only = np.zeros(len(table.pairs), bool)
        if deepest_only is not None:
            self._deepest_only = deepest_only

    def find_hits(self, z: Floats, moved: Floats) -> Iterator[Hits]:
        waypoints = self._waypoints
        placed = self._place(z[waypoints])
        at, pairs, distances = self._find_nearest(placed)
        margins = self._table.get_margins(pairs, at)
        apart = np.flatnonzero(margins > -np.inf)  # pairs that do not move together
        closest = apart[_find_group_minima(at[apart], distances[apart])]
        is_exempt = self._table.find_exempt(pairs, at) & (distances < self._table.margins[pairs])
        # All overlaps at waypoints are yielded; between them only deeper ones may matter.
        self._select_overlaps(waypoints[at], pairs, distances)
        is_close = distances < np.maximum(margins, 0.0)
        chosen = np.union1d(closest, np.flatnonzero(is_close | is_exempt))
        yield self._make_hits(
            waypoints[at[chosen]], pairs[chosen], distances[chosen], at_waypoints=True
        )
        # Pairs that stay further apart do not affect the report.
        smallest = RESOLUTION
        if not self._close_only:
            smallest = max(RESOLUTION, float(distances[closest].min(initial=np.inf)))
        segments, pairs = self._find_active_pairs(
            placed, np.diff(moved[waypoints], axis=0), smallest
        )
        before, after = self._measure_both_ends(placed, segments, pairs)
        intervals = Intervals(waypoints[segments], waypoints[segments + 1], pairs, before, after)
        yield from self._search_intervals(z, intervals, moved, smallest)

    def _measure_both_ends(
        self, placed: PlacedShapes, segments: Ints, pairs: Ints
    ) -> tuple[Floats, Floats]:
        """Return the distances of pairs at both ends of segments, shape (n,) each [m]."""
        # A segment ends where the next one begins.
        states = np.append(segments, segments + 1)
        numbers, which = np.unique(
            states * len(self._table.pairs) + np.tile(pairs, 2), return_inverse=True
        )
        states, pairs = np.divmod(numbers, len(self._table.pairs))
        distances = placed.compute_distances(states, self._table.pairs[pairs])
        before, after = np.split(distances[which], 2)
        return before, after

    def _place(self, z: Floats) -> PlacedShapes:
        """Place the shapes at configurations of the world, shape (W, n)."""
        return self._solids.place(self._solids.world.coordinates.q(z))

    def _search_intervals(
        self, z: Floats, todo: Intervals, moved: Floats, smallest: float
    ) -> Iterator[Hits]:
        """Bisect intervals and yield pairs that come closer than `smallest` inside of them.

        Every state s in between satisfies d(s) ≥ (d_t + d_{t+1} − relative motion) / 2, so that
        intervals with a larger bound are dropped, and those with a bound above the deepest overlap
        of a pair of which only that matters. Without relative motion the distance is constant;
        only overlaps are followed then, to report all of their samples.
        """
        while len(todo.pair):
            motion = self._bound_motion(todo, moved)
            limit = np.minimum(smallest, self._deepest[todo.pair])
            may_be_close = todo.before + todo.after - motion < 2 * limit
            may_change = (motion > MIN_MOTION) | (todo.before < 0)
            is_left = todo.high > self._first_row
            todo = todo.select(may_be_close & may_change & is_left)
            is_adjacent = todo.high - todo.low == 1
            yield from self._find_tunnelling(z, todo.select(is_adjacent), moved)
            todo = todo.select(~is_adjacent)
            middle = (todo.low + todo.high) // 2
            rows, at = np.unique(middle, return_inverse=True)
            pairs = self._table.pairs[todo.pair]
            distances = self._place(z[rows]).compute_distances(at, pairs)
            chosen = self._select_overlaps(middle, todo.pair, distances)
            if not self._close_only:
                chosen = np.union1d(_find_group_minima(at, distances), chosen)
            yield self._make_hits(middle[chosen], todo.pair[chosen], distances[chosen])
            todo = Intervals(
                np.append(todo.low, middle),
                np.append(middle, todo.high),
                np.tile(todo.pair, 2),
                np.append(todo.before, distances),
                np.append(distances, todo.after),
            )

    def _select_overlaps(self, rows: Ints, pairs: Ints, distances: Floats) -> Ints:
        """Return the indices of overlaps that matter, of distances of pairs at rows, shape (n,).

        Of some pairs only the deepest overlap matters: it is noted, and those that are no deeper
        than an earlier one are left out.
        """
        matters = (rows >= self._first_row) & (distances < np.minimum(0.0, self._deepest[pairs]))
        overlaps = np.flatnonzero(matters)
        noted = overlaps[self._deepest_only[pairs[overlaps]]]
        np.minimum.at(self._deepest, pairs[noted], distances[noted])
        return overlaps[~(distances[overlaps] > self._deepest[pairs[overlaps]])]

    def _bound_motion(self, todo: Intervals, moved: Floats) -> Floats:
        """Bound the relative motion of pairs in intervals, shape (n,) [m]."""
        first, second = self._table.pairs[todo.pair].T
        first_motion = moved[todo.high, first] - moved[todo.low, first]
        second_motion = moved[todo.high, second] - moved[todo.low, second]
        return first_motion + second_motion

    def _find_tunnelling(self, z: Floats, todo: Intervals, moved: Floats) -> Iterator[Hits]:
        """Yield pairs that overlap between two adjacent samples, but at neither of them.

        Penetrations deeper than `RESOLUTION` are never missed.
        """
        first = self._find_interval(todo.low)
        motion = self._bound_motion(todo, moved)
        contact = self._table.get_contact_overlaps(todo.pair, first, first + 1)
        is_free_at_ends = np.minimum(todo.before, todo.after) >= -contact
        may_overlap = todo.before + todo.after < motion
        is_rigid = self._table.find_moving_together(todo.pair, first, first + 1)
        searched = np.flatnonzero(is_free_at_ends & may_overlap & ~is_rigid)
        # The parts of each interval that are still to be searched.
        stacks: dict[int, list[_Part]] = {}
        for k in searched.tolist():
            stacks[k] = [_Part(0.0, 1.0, float(todo.before[k]), float(todo.after[k]))]
        while True:  # one step of the search of every interval at once
            parts: dict[int, _Part] = {}
            for k, stack in stacks.items():
                part = _pop_open_part(stack, motion[k])
                if part is not None:
                    parts[k] = part
            if not parts:
                return
            which = np.array(list(parts))
            middle = np.array([(part.begin + part.end) / 2 for part in parts.values()])
            places, at = np.unique([todo.low[which], middle], axis=1, return_inverse=True)
            rows = places[0].astype(int)
            fraction = places[1][:, None]
            placed = self._place((1 - fraction) * z[rows] + fraction * z[rows + 1])
            pairs = self._table.pairs[todo.pair[which]]
            distances = placed.compute_distances(at.ravel(), pairs)
            yield self._make_hits(todo.low[which], todo.pair[which], distances)
            for k, half, distance in zip(parts, middle.tolist(), distances.tolist(), strict=True):
                if distance < -contact[k]:
                    del stacks[k]
                else:
                    stacks[k] += parts[k].split(half, distance)

    def _find_nearest(self, placed: PlacedShapes) -> tuple[Ints, Ints, Floats]:
        """Return states, pairs and distances [m] of the closest pairs and all below margins.

        The closest pairs are left out if only close ones are searched.
        """
        found = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0))]
        reach = max(self._table.margins.max(), RESOLUTION)
        # states whose closest pair is not known
        todo = np.flatnonzero(self._waypoints >= self._first_row)
        while len(todo):
            at_rest = np.zeros((len(todo), len(self._table.groups)))
            at, pairs = self._table.find_close_pairs(placed, todo, todo, at_rest, reach)
            states = todo[at]
            distances = placed.compute_distances(states, self._table.pairs[pairs])
            smallest = np.full(len(placed), np.inf)
            is_apart = self._table.get_margins(pairs, states) > -np.inf
            np.minimum.at(smallest, states[is_apart], distances[is_apart])
            # All other pairs are further apart, or do not matter.
            is_done = ~(smallest > reach) | self._close_only
            is_kept = is_done[states]
            found.append((states[is_kept], pairs[is_kept], distances[is_kept]))
            todo = todo[~is_done[todo]]
            reach = 2.0 * reach
        states = np.concatenate([part[0] for part in found])
        pairs = np.concatenate([part[1] for part in found])
        distances = np.concatenate([part[2] for part in found])
        order = np.lexsort((pairs, states))
        return states[order], pairs[order], distances[order]

    def _find_active_pairs(
        self, placed: PlacedShapes, moved: Floats, smallest: float
    ) -> tuple[Ints, Ints]:
        """Find segments and pairs that may come closer than `smallest` between two waypoints.

        By the bound of `_search_intervals`, the distance at one of both ends is then less than
        `smallest` plus half the relative motion.
        """
        first = self._find_interval(np.array([self._first_row]))[0]
        begin = np.arange(first, len(moved))
        at, pairs = self._table.find_close_pairs(placed, begin, begin + 1, moved[begin], smallest)
        return begin[at], pairs

    def _find_interval(self, rows: Ints) -> Ints:
        """Return the last waypoint at or before each sample, shape (n,)."""
        return np.searchsorted(self._waypoints, rows, side="right") - 1

    def _make_hits(
        self, rows: Ints, pairs: Ints, distances: Floats, *, at_waypoints: bool = False
    ) -> Hits:
        at = self._find_interval(rows)
        is_exempt = self._table.find_exempt(pairs, at)
        return Hits(
            table=self._table,
            rows=rows,
            pairs=pairs,
            distances=distances,
            margins=self._table.get_margins(pairs, at),
            contacts=self._table.get_contact_overlaps(pairs, at, at if at_waypoints else at + 1),
            exempt_clearances=np.where(is_exempt, self._table.margins[pairs], 0.0),
            at_waypoints=at_waypoints,
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


class _Part(NamedTuple):
    """A part of an interval between two samples, for one pair.

    Attributes:
        begin, end: Its ends, as fractions of the interval.
        before, after: Distances of the pair there [m].
    """

    begin: float
    end: float
    before: float
    after: float

    def split(self, at: float, distance: float) -> tuple[_Part, _Part]:
        """Return the parts before and after a fraction, at which the distance is known."""
        earlier = _Part(self.begin, at, self.before, distance)
        later = _Part(at, self.end, distance, self.after)
        return earlier, later


def _pop_open_part(stack: list[_Part], motion: float) -> _Part | None:
    """Pop the next part of an interval in which a pair may overlap unseen; None without any."""
    while stack:
        part = stack.pop()
        motion_in_part = (part.end - part.begin) * motion
        may_overlap = part.before + part.after < motion_in_part
        if motion_in_part > 2 * RESOLUTION and may_overlap:
            return part
    return None


def _pair_all(ones: Sequence[int], others: Sequence[int]) -> Ints:
    """Return all pairs of two lists, shape (n, 2), by the second one."""
    first = np.tile(np.array(ones, int), len(others))
    second = np.repeat(np.array(others, int), len(ones))
    return np.column_stack([first, second])


def _find_group_minima(groups: Ints, values: Floats) -> Ints:
    """Return the index of the first smallest value of each group."""
    order = np.lexsort((values, groups))
    is_first = np.diff(groups[order], prepend=-1)
    return order[np.flatnonzero(is_first)]
