"""Finds the pairs of shapes that a scene exempts from the clearance, and how deep they may overlap.

Furniture has smaller gaps than motions keep, and models of it overlap. Where two shapes are so at
the start, or with all joints at zero, they need no clearance while their joints keep them close.
They may overlap as deep as at the start, which exists. What they overlap with all joints at zero
alone is taken for an error of the model up to 5 mm, else for an obstacle.

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
_STEPS = 96  # samples of a joint between its state and a limit
_BISECTIONS = 24  # of the interval between two samples in which a pair separates
_TURN = np.pi  # [rad] that a joint without limits is followed


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
    scene: Scene, solids: CollisionShapes, dist_safe: float
) -> tuple[ExemptPairs, ...]:
    """Return the pairs of shapes that a scene allows to be close, and neighbours.

    Args:
        scene: The scene.
        solids: Its shapes as one plain tree.
        dist_safe: Clearance of all other pairs [m].
    """
    states = (make_state_key(placed) for placed in scene.objects.values())
    key = ("exempt pairs", dist_safe, *states)

    def find() -> tuple[ExemptPairs, ...]:
        return (
            *_list_allowed_pairs(scene, solids),
            *_NeighbourSearch(scene, solids, dist_safe).find(),
        )

    return get_cached(scene, key, find)


def _list_allowed_pairs(scene: Scene, solids: CollisionShapes) -> Iterator[ExemptPairs]:
    labels = np.array(solids.world.collision_labels)
    for names, margin in scene.allowed.items():
        if len(names) != 2:
            continue
        ones, others = (np.flatnonzero(labels == name) for name in sorted(names))
        pairs = np.stack(np.meshgrid(ones, others, indexing="ij"), axis=-1).reshape(-1, 2)
        yield ExemptPairs(np.sort(pairs, axis=1), margin, "the scene allows it")


class _NeighbourSearch:
    """Compares the shapes of articulated objects with all that is fixed."""

    def __init__(self, scene: Scene, solids: CollisionShapes, dist_safe: float) -> None:
        self._scene, self._solids, self._dist_safe = scene, solids, dist_safe
        world = solids.world
        self._coordinates = world.coordinates
        self._owners = [label.partition(".")[0] for label in world.collision_labels]
        robot_size = len(world.bodies.geometryObjects) - sum(
            len(placed.object.collision.geometryObjects) for placed in scene.objects.values()
        )
        fixed = {name for name, placed in scene.objects.items() if not placed.object.free}
        move_of = {move.joint: move for move in world.coordinates.moves}
        # The coordinates that move each shape; whether they all rotate it.
        self._columns, self._only_turns = list[list[int]](), list[bool]()
        for k, shape in enumerate(world.shapes):
            moves = []
            if k < solids.body_count and self._owners[k] in fixed:
                moves = [move_of[j] for j in world.model.supports[shape.parentJoint] if j]
            self._columns.append(sorted({move.coordinate for move in moves}))
            self._only_turns.append(not any(move.slides for move in moves))
        self._pairs = np.array(
            [
                (i, k)
                for i, columns in enumerate(self._columns)
                if columns
                for k in range(robot_size, len(world.shapes))
                if self._owners[k] not in (self._owners[i], FLOOR)
                and (k >= solids.body_count or self._owners[k] in fixed)
                and (i < k or not self._columns[k])
            ],
            int,
        ).reshape(-1, 2)
        size = world.coordinates.size
        self._lower, self._upper = np.full(size, -np.inf), np.full(size, np.inf)
        for name in fixed:
            placed = scene.objects[name].object
            for joint, lower, upper in zip(
                placed.coordinates.names, placed.lower, placed.upper, strict=True
            ):
                column = world.coordinates.index(f"{name}.{joint}")
                self._lower[column], self._upper[column] = lower, upper

    def find(self) -> Iterator[ExemptPairs]:
        if not len(self._pairs):
            return
        start = self._solids.world.start
        yield from self._find_at(start, is_start=True)
        built = start.copy()
        moving = sorted({column for columns in self._columns for column in columns})
        built[moving] = np.clip(0.0, self._lower[moving], self._upper[moving])
        if not np.array_equal(built, start):
            yield from self._find_at(built, is_start=False)

    def _find_at(self, z: Floats, *, is_start: bool) -> Iterator[ExemptPairs]:
        """Yield the neighbours in a state of the world, shape (n,)."""
        near, distances = self._find_close_pairs(z)
        ranges = {
            column: self._find_ranges(z, column, near)
            for column in sorted({c for pair in near.tolist() for c in self._move_pair(pair)})
        }
        keys = self._solids.world.collision_keys
        for k, (pair, distance) in enumerate(zip(near.tolist(), distances.tolist(), strict=True)):
            columns = self._move_pair(pair)
            lower, upper, overlaps = (
                np.array([ranges[column][part][k] for column in columns]) for part in range(3)
            )
            depth = 0.0
            if distance < -CONTACT_DEPTH:
                depth = max(_BUILT_IN, CONTACT_DEPTH - distance if is_start else 0.0)
                if is_start and overlaps.all() and self._turns(pair):
                    # Its hinge is inside the other shape: its edge may take the place of its face.
                    depth = max(depth, CONTACT_DEPTH - distance + self._compute_thickness(pair))
                if -distance > depth:
                    continue  # only with all joints at zero: an obstacle
            side = "apart" if distance >= 0.0 else "inside each other"
            names = " – ".join(keys[shape] for shape in pair)
            reason = f"{names} stand {abs(1e3 * distance):.1f} mm {side} as built"
            yield ExemptPairs(
                np.sort(np.array([pair]), axis=1), -depth, reason, np.array(columns), lower, upper
            )

    def _move_pair(self, pair: Sequence[int]) -> list[int]:
        """Return the coordinates that move one of two shapes."""
        return [column for shape in pair for column in self._columns[shape]]

    def _turns(self, pair: Sequence[int]) -> bool:
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
        near = self._pairs[placed.compute_lower_bounds(here, self._pairs) < reach]
        distances = placed.compute_distances(here[: len(near)], near)
        return near[distances < reach], distances[distances < reach]

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
        ends, overlaps = list[Floats](), np.ones(len(near), bool)
        for limit, sign in ((self._lower[column], -1.0), (self._upper[column], 1.0)):
            last = limit if np.isfinite(limit) else z[column] + sign * _TURN
            values = np.linspace(z[column], last, _STEPS + 1)
            states = np.repeat(np.arange(len(values)), len(near))
            distances = self._measure(z, column, values, states, np.tile(near, (len(values), 1)))
            table = distances.reshape(len(values), len(near))
            overlaps &= table.max(axis=0) < -CONTACT_DEPTH
            is_apart = table >= self._dist_safe
            end = np.full(len(near), sign * np.inf)
            parted = np.flatnonzero(is_apart.any(axis=0) & (last != z[column]))
            first = is_apart.argmax(axis=0)[parted]
            close, apart = values[np.maximum(first - 1, 0)], values[first]
            for _ in range(_BISECTIONS):
                middle = (close + apart) / 2.0
                there = np.arange(len(parted))
                beyond = (
                    self._measure(z, column, middle, there, near[parted]) >= self._dist_safe
                    if len(parted)
                    else np.zeros(0, bool)
                )
                close, apart = np.where(beyond, close, middle), np.where(beyond, middle, apart)
            end[parted] = apart
            ends.append(end)
        return ends[0], ends[1], overlaps

    def _measure(self, z: Floats, column: int, values: Floats, states: Ints, pairs: Ints) -> Floats:
        """Return distances of pairs while one coordinate has values; infinite beyond clearance."""
        rows = np.tile(z, (len(values), 1))
        rows[:, column] = values
        placed = self._solids.place(self._coordinates.q(rows))
        distances = np.full(len(pairs), np.inf)
        near = np.flatnonzero(placed.compute_lower_bounds(states, pairs) < self._dist_safe)
        distances[near] = placed.compute_distances(states[near], pairs[near])
        return distances
