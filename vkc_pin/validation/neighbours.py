"""Finds the pairs of shapes that a scene exempts from the clearance, and how deep they may overlap.

Furniture has smaller gaps than motions keep, and models of it overlap. Where two shapes are so at
the start, or with all joints at zero, they need no clearance while their joints keep them close.
They may overlap as deep as at the start, which exists. An overlap with all joints at zero alone is
taken for an error of the model up to 5 mm, else for an obstacle.

The planner finds such pairs by code of its own (`world.scene.clearance_exemptions`): an error there
is found here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.world.scene.clearance_exemptions import (
    ACCEPTED_SHORTFALL,
    CONTACT_DEPTH,
    get_cached,
    make_state_key,
)
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene

# [m] overlap of closed furniture that counts as an error of the model: kitchens of other packages
# have up to 4.0 mm
_BUILT_IN = 5e-3
# samples of a joint between its state and a limit
_STEPS = 96
# bisections of the interval between two samples in which a pair separates
_BISECTIONS = 24
# [rad] that a joint without limits is followed
_TURN = np.pi


@dataclass(frozen=True, eq=False)
class ExemptPairs:
    """Pairs of shapes that need less than the usual clearance while some joints are in ranges.

    Attributes:
        pairs: Pairs of indices of the world's shapes, the smaller index first, shape (k, 2).
        margin: Clearance that they keep instead [m]; negative: an allowed overlap; -inf: none.
        reason: Reason for the exemption.
        columns: Coordinates of the world with ranges, shape (m,).
        lower, upper: Their ranges, shape (m,) each, [m] or [rad].
    """

    pairs: Ints
    margin: float
    reason: str
    columns: Ints = field(default_factory=lambda: np.zeros(0, int))
    lower: Floats = field(default_factory=lambda: np.zeros(0))
    upper: Floats = field(default_factory=lambda: np.zeros(0))

    def are_active(self, z: Floats) -> Bools:
        """Return whether the pairs are exempt at coordinates of the world, shape (S, n): (S,)."""
        values = z[:, self.columns]
        return np.asarray(((self.lower <= values) & (values <= self.upper)).all(axis=1))


def find_exempt_pairs(
    scene: Scene, solids: CollisionShapes, dist_safe: float, *, obstacles_only: bool = False
) -> tuple[ExemptPairs, ...]:
    """Return the pairs of shapes that a scene allows to be close, and neighbours.

    Args:
        scene: The scene.
        solids: Its shapes as one plain tree.
        dist_safe: Clearance of all other pairs [m].
        obstacles_only: Whether neighbours that are no obstacles are left out.
    """
    states = [make_state_key(placed) for placed in scene.objects.values()]
    key = ("exempt pairs", dist_safe, obstacles_only, *states)

    def find() -> tuple[ExemptPairs, ...]:
        allowed = list(_list_allowed_pairs(scene, solids))
        search = _NeighbourSearch(scene, solids, dist_safe, obstacles_only=obstacles_only)
        return (*allowed, *search.find())

    return get_cached(scene, key, find)


def _list_allowed_pairs(scene: Scene, solids: CollisionShapes) -> Iterator[ExemptPairs]:
    labels = np.array(solids.world.collision_labels)
    for names, margin in scene.allowed.items():
        if len(names) != 2:
            continue
        first_name, second_name = sorted(names)
        ones = np.flatnonzero(labels == first_name)
        others = np.flatnonzero(labels == second_name)
        grid = np.meshgrid(ones, others, indexing="ij")
        pairs = np.stack(grid, axis=-1).reshape(-1, 2)
        yield ExemptPairs(np.sort(pairs, axis=1), margin, "the scene allows it")


class _NeighbourSearch:
    """Compares the shapes of articulated objects with all that is fixed."""

    def __init__(
        self, scene: Scene, solids: CollisionShapes, dist_safe: float, *, obstacles_only: bool
    ) -> None:
        self._scene = scene
        self._solids = solids
        self._dist_safe = dist_safe
        self._obstacles_only = obstacles_only
        self._world = solids.world
        self._coordinates = solids.world.coordinates
        self._owners = [label.partition(".")[0] for label in self._world.collision_labels]
        self._fixed = {name for name, placed in scene.objects.items() if not placed.object.free}
        # The coordinates that move each shape; whether they all rotate it.
        self._columns: list[list[int]] = []
        self._only_turns: list[bool] = []
        self._list_moving_coordinates()
        self._pairs = self._list_pairs()
        self._lower = np.full(self._coordinates.size, -np.inf)
        self._upper = np.full(self._coordinates.size, np.inf)
        self._fill_limits()

    def _list_moving_coordinates(self) -> None:
        """List the coordinates that move each shape of fixed objects; other shapes have none."""
        world = self._world
        move_of = {move.joint: move for move in world.coordinates.moves}
        for k, shape in enumerate(world.shapes):
            moves = []
            if k < self._solids.body_count and self._owners[k] in self._fixed:
                moves = [move_of[j] for j in world.model.supports[shape.parentJoint] if j]
            self._columns.append(sorted({move.coordinate for move in moves}))
            self._only_turns.append(not any(move.slides for move in moves))

    def _list_pairs(self) -> Ints:
        """List the pairs of a shape that moves with one that may be its neighbour, shape (n, 2)."""
        world = self._world
        object_sizes = [
            len(placed.object.collision.geometryObjects) for placed in self._scene.objects.values()
        ]
        robot_size = len(world.bodies.geometryObjects) - sum(object_sizes)
        first = self._solids.body_count if self._obstacles_only else robot_size
        pairs: list[tuple[int, int]] = []
        for i, columns in enumerate(self._columns):
            if not columns:
                continue
            for k in range(first, len(world.shapes)):
                if self._is_candidate(i, k):
                    pairs.append((i, k))
        return np.array(pairs, int).reshape(-1, 2)

    def _is_candidate(self, i: int, k: int) -> bool:
        """Return whether shape k may be a neighbour of shape i, which moves.

        A pair of two shapes that move counts once, with i < k.
        """
        if self._owners[k] in (self._owners[i], FLOOR):
            return False
        is_obstacle = k >= self._solids.body_count
        if not is_obstacle and self._owners[k] not in self._fixed:
            return False
        return i < k or not self._columns[k]

    def _fill_limits(self) -> None:
        """Fill in the limits of the joints of fixed objects."""
        for name in self._fixed:
            item = self._scene.objects[name].object
            joints = zip(item.coordinates.names, item.lower, item.upper, strict=True)
            for joint, lower, upper in joints:
                column = self._coordinates.index(f"{name}.{joint}")
                self._lower[column] = lower
                self._upper[column] = upper

    def find(self) -> Iterator[ExemptPairs]:
        if not len(self._pairs):
            return
        start = self._world.start
        yield from self._find_at(start, is_start=True)
        moving = sorted(set[int]().union(*self._columns))
        built = start.copy()
        built[moving] = np.clip(0.0, self._lower[moving], self._upper[moving])
        if not np.array_equal(built, start):
            yield from self._find_at(built, is_start=False)

    def _find_at(self, z: Floats, *, is_start: bool) -> Iterator[ExemptPairs]:
        """Yield the neighbours in a state of the world, shape (n,)."""
        near, distances = self._find_close_pairs(z)
        moving = set[int]()
        for pair in near.tolist():
            moving.update(self._list_columns(pair))
        ranges = {column: self._find_ranges(z, column, near) for column in sorted(moving)}
        for k, (pair, distance) in enumerate(zip(near.tolist(), distances.tolist(), strict=True)):
            columns = self._list_columns(pair)
            lower = np.array([ranges[column][0][k] for column in columns])
            upper = np.array([ranges[column][1][k] for column in columns])
            overlaps = np.array([ranges[column][2][k] for column in columns])
            depth = self._choose_depth(
                pair, distance, is_start=is_start, overlaps=bool(overlaps.all())
            )
            if -distance > max(depth, CONTACT_DEPTH):
                continue  # only with all joints at zero: an obstacle
            ordered = np.sort(np.array([pair]), axis=1)
            reason = self._explain(pair, distance)
            yield ExemptPairs(ordered, -depth, reason, np.array(columns), lower, upper)

    def _choose_depth(
        self, pair: Sequence[int], distance: float, *, is_start: bool, overlaps: bool
    ) -> float:
        """Return the overlap that two shapes may have [m]; 0 where they do not overlap now.

        `overlaps` says whether they overlap at all values of their joints.
        """
        if not distance < -CONTACT_DEPTH:
            return 0.0
        if not is_start:
            return _BUILT_IN
        depth = max(_BUILT_IN, CONTACT_DEPTH - distance)
        if overlaps and self._only_turn(pair):
            # Its hinge is inside the other shape: its edge may take the place of its face.
            depth = max(depth, CONTACT_DEPTH - distance + self._compute_thickness(pair))
        return depth

    def _explain(self, pair: Sequence[int], distance: float) -> str:
        """Return the reason for an exemption."""
        keys = self._world.collision_keys
        names = " – ".join(keys[shape] for shape in pair)
        side = "apart" if distance >= 0.0 else "inside each other"
        return f"{names} stand {abs(1e3 * distance):.1f} mm {side} as built"

    def _list_columns(self, pair: Sequence[int]) -> list[int]:
        """Return the coordinates that move one of two shapes."""
        first, second = pair
        return [*self._columns[first], *self._columns[second]]

    def _only_turn(self, pair: Sequence[int]) -> bool:
        """Return whether no joint displaces either of two shapes along an axis."""
        return all(self._only_turns[shape] for shape in pair)

    def _compute_thickness(self, pair: Sequence[int]) -> float:
        """Return the smallest side of the bounding boxes of the shapes that move [m]."""
        moving = [shape for shape in pair if self._columns[shape]]
        return float(2.0 * self._solids.half[moving].min())

    def _find_close_pairs(self, z: Floats) -> tuple[Ints, Floats]:
        """Return the pairs that lack clearance in a state, shape (k, 2), and distances [m]."""
        reach = self._dist_safe - ACCEPTED_SHORTFALL
        placed = self._solids.place(self._coordinates.q(z[None]))
        here = np.zeros(len(self._pairs), int)
        lower_bounds = placed.compute_lower_bounds(here, self._pairs)
        near = self._pairs[lower_bounds < reach]
        distances = placed.compute_distances(here[: len(near)], near)
        is_close = distances < reach
        return near[is_close], distances[is_close]

    def _find_ranges(self, z: Floats, column: int, near: Ints) -> tuple[Floats, Floats, Bools]:
        """Find the values of one coordinate that alone keep pairs closer than the clearance.

        Args:
            z: Coordinates of the world, shape (n,).
            column: The coordinate that changes.
            near: The pairs, shape (k, 2). Those that it does not move are never separated by it.

        Returns:
            Lower and upper ends, shape (k,) each, infinite where a limit comes first; and whether
            the pairs overlap at all values of the coordinate, shape (k,).
        """
        lower, overlaps_below = self._find_end(z, column, self._lower[column], -1.0, near)
        upper, overlaps_above = self._find_end(z, column, self._upper[column], 1.0, near)
        return lower, upper, overlaps_below & overlaps_above

    def _find_end(
        self, z: Floats, column: int, limit: float, sign: float, near: Ints
    ) -> tuple[Floats, Bools]:
        """Find where pairs get the clearance first while a coordinate goes to its limit.

        The coordinate is sampled. The interval before the first sample with the clearance is
        bisected.

        Returns:
            Values of the coordinate with the clearance, shape (k,), infinite where the limit comes
            first; and whether the pairs overlap at all samples, shape (k,).
        """
        last = limit if np.isfinite(limit) else z[column] + sign * _TURN
        values = np.linspace(z[column], last, _STEPS + 1)
        states = np.repeat(np.arange(len(values)), len(near))
        all_pairs = np.tile(near, (len(values), 1))
        distances = self._measure(z, column, values, states, all_pairs)
        table = distances.reshape(len(values), len(near))
        overlaps = table.max(axis=0) < -CONTACT_DEPTH
        is_apart = table >= self._dist_safe
        end = np.full(len(near), sign * np.inf)
        separated = np.flatnonzero(is_apart.any(axis=0) & (last != z[column]))
        if not len(separated):
            return end, overlaps
        first = is_apart.argmax(axis=0)[separated]
        close = values[np.maximum(first - 1, 0)]
        apart = values[first]
        rows = np.arange(len(separated))
        for _ in range(_BISECTIONS):
            middle = (close + apart) / 2.0
            distances = self._measure(z, column, middle, rows, near[separated])
            is_beyond = distances >= self._dist_safe
            close = np.where(is_beyond, close, middle)
            apart = np.where(is_beyond, middle, apart)
        end[separated] = apart
        return end, overlaps

    def _measure(self, z: Floats, column: int, values: Floats, states: Ints, pairs: Ints) -> Floats:
        """Return distances of pairs while one coordinate has values; infinite beyond clearance."""
        rows = np.tile(z, (len(values), 1))
        rows[:, column] = values
        placed = self._solids.place(self._coordinates.q(rows))
        distances = np.full(len(pairs), np.inf)
        lower_bounds = placed.compute_lower_bounds(states, pairs)
        near = np.flatnonzero(lower_bounds < self._dist_safe)
        distances[near] = placed.compute_distances(states[near], pairs[near])
        return distances
