"""Computes signed distances of pairs of shapes, and finds those that violate their margins most.

Distances are coal's, except where its closed forms for spheres and capsules are wrong: when their
centres or axes lie inside the other shape (`overlaps.hpp`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.solids import (
    convert_solid,
    count_threads,
    flatten_placements,
    load_compiled,
)

TOLERANCE = 1e-6  # coal's default tolerance of GJK
_MIN_PAIRS_PER_THREAD = 128  # distances, about 0.2 ms: fewer do not pay for another thread
_ROUNDING = 1e-6  # [m] numerical error of coal's distances
_MIN_ROWS_PER_THREAD = 16  # configurations, about 0.3 ms: fewer do not pay for another thread
_NO_LIMIT = -1  # of the number of pairs, in calls of the compiled module


class Witnesses(NamedTuple):
    """Signed distances of n pairs of shapes, with normals and witness points.

    Attributes:
        distance: Signed distance, shape (n,) [m].
        normal: Unit normal from the first to the second shape, world frame, shape (n, 3).
        first, second: Witness points (closest, or deepest), world frame, shape (n, 3) each [m].
    """

    distance: Floats
    normal: Floats
    first: Floats
    second: Floats


class Shapes:
    """G shapes between which coal computes distances: first the M moving ones, then the fixed ones.

    Distances are independent of earlier ones and of the number of threads. A state is the
    placements of the moving shapes in the world frame, shape (M, 12), in the format of
    `solids.flatten_placements`.

    Args:
        geometries: coal's shapes, moving ones first.
        fixed: Placements of the fixed shapes in the world frame.
        tolerance: Tolerance of GJK. With 1e-8, normals are accurate enough for gradients; with
            coal's default of 1e-6, they are off by up to 5e-3. Both take the same time. EPA keeps
            its default tolerance, since below 1e-6 it fails for cylinders.
        threads: Maximum number of threads. Default: `solids.count_threads`.
    """

    def __init__(
        self,
        geometries: Sequence[coal.CollisionGeometry],
        fixed: Sequence[pin.SE3] = (),
        *,
        tolerance: float = TOLERANCE,
        threads: int | None = None,
    ) -> None:
        self.threads = count_threads() if threads is None else threads
        solids = [convert_solid(geometry) for geometry in geometries]
        self.compiled: Any = load_compiled().Shapes(solids, flatten_placements(fixed), tolerance)

    def move_fixed(self, where: Mapping[int, pin.SE3]) -> Shapes:
        """Return a copy with some fixed shapes moved.

        Args:
            where: Index among all shapes → placement in the world frame.
        """
        other = object.__new__(Shapes)
        other.threads = self.threads
        which = np.array(list(where), np.int64)
        rows = flatten_placements(list(where.values()))
        other.compiled = self.compiled.placed(which, rows)
        return other

    def compute_distances(self, moving: Floats, states: Ints, pairs: Ints) -> Floats:
        """Return the signed distances of pairs of shapes, shape (n,) [m].

        Args:
            moving: States, shape (W, M, 12).
            states: State of each pair, shape (n,).
            pairs: Pairs of shape indices, shape (n, 2).
        """
        threads = self._count_threads(len(pairs))
        with_witnesses = False
        found = self.compiled.distances(moving, states, pairs, with_witnesses, threads)
        return np.asarray(found, float)

    def compute_witnesses(self, moving: Floats, states: Ints, pairs: Ints) -> Witnesses:
        """Return distances, normals and witness points; see `compute_distances`."""
        threads = self._count_threads(len(pairs))
        with_witnesses = True
        table = self.compiled.distances(moving, states, pairs, with_witnesses, threads)
        return _to_witnesses(table)

    def find_closest_pairs(
        self,
        moving: Floats,
        edges: Ints,
        pairs: Ints,
        *,
        ranks: Ints,
        margins: Floats,
        bounds: Floats,
        reach: float,
        max_pairs: int | None,
        rounding: float,
    ) -> tuple[Ints, Witnesses]:
        """Return, for each state, the pairs closer than `reach` with least distance − margin.

        Args:
            moving: States, shape (W, M, 12).
            edges: Index of the first pair of each state, and the end of the last, shape (W + 1,).
            pairs: Pairs of shape indices, shape (n, 2), sorted by `bounds` in each state.
            ranks: Order of pairs that tie, shape (n,).
            margins: Margins, shape (n,) [m].
            bounds: Lower bounds of distance − margin, shape (n,) [m]; pairs they exclude are not
                evaluated.
            reach: Largest distance [m].
            max_pairs: Maximum number of pairs per state. Default: no limit.
            rounding: Numerical error of `bounds` [m].

        Returns:
            Indices of the selected pairs, sorted by state, then by distance − margin; and their
            witnesses.
        """
        margins_and_bounds = np.column_stack([margins, bounds])
        limit = _NO_LIMIT if max_pairs is None else max_pairs
        threads = self._count_threads(len(pairs))
        chosen, table = self.compiled.shortest(
            moving, edges, pairs, ranks, margins_and_bounds, reach, limit, rounding, threads
        )
        return chosen, _to_witnesses(table)

    def _count_threads(self, pairs: int) -> int:
        return max(1, min(self.threads, pairs // _MIN_PAIRS_PER_THREAD))


def _to_witnesses(table: Floats) -> Witnesses:
    return Witnesses(
        distance=table[:, 0], normal=table[:, 1:4], first=table[:, 4:7], second=table[:, 7:10]
    )


def compute_distance(
    first: Any, first_placement: Floats, second: Any, second_placement: Floats
) -> tuple[float, Floats]:
    """Compute the signed distance of two solids.

    Args:
        first: Result of `solids.convert_solid`.
        first_placement: Row of `solids.flatten_placements`, shape (12,).
        second: The other solid.
        second_placement: Its placement.

    Returns:
        The distance [m], and the unit normal from the first to the second solid, shape (3,).
    """
    row = load_compiled().distance(first, first_placement, second, second_placement, TOLERANCE)
    return float(row[0]), row[1:4]


def find_near_points(solid: Any, placement: Floats, points: Floats, reach: float) -> Bools:
    """Return whether each point is closer to a solid than `reach`, shape (n,).

    Args:
        solid: Result of `solids.convert_solid`.
        placement: Row of `solids.flatten_placements`, shape (12,).
        points: Points in the world frame, shape (n, 3) [m].
        reach: Distance [m].
    """
    near = load_compiled().near(solid, placement, points, reach, TOLERANCE)
    return np.asarray(near).astype(bool)


def count_distance_queries() -> int:
    """Return the number of distances that coal has computed in this process.

    Pairs that bounds excluded are not counted.
    """
    return int(load_compiled().asked())


class MarginRegion(NamedTuple):
    """A box in configuration space in which some pairs have a smaller margin.

    Attributes:
        pairs: Indices of the pairs, shape (k,).
        margin: Margin in the region [m]; -inf disables the check.
        columns: Indices in z of the bounded coordinates, shape (m,).
        lower, upper: Their bounds, shape (m,) each, [m] or [rad].
    """

    pairs: Ints
    margin: float
    columns: Ints
    lower: Floats
    upper: Floats


class Margins:
    """Margins of pairs: a default each, reduced between some waypoints and in some regions.

    Args:
        default: Default margins, shape (P,) [m].
        relaxed: Pair → spans of waypoints (first, last, margin [m]) with a smaller margin.
        regions: Regions with smaller margins.
    """

    def __init__(
        self,
        default: Floats,
        relaxed: Mapping[int, Sequence[tuple[int, int, float]]],
        regions: Iterable[MarginRegion] = (),
    ) -> None:
        self.compiled: Any = load_compiled().Margins(default)
        for pair, spans in relaxed.items():
            for first, last, margin in spans:
                self.compiled.ease(pair, first, last, margin)
        for region in regions:
            self.compiled.near(*region)

    def compute_margins(self, pairs: Ints, waypoints: Ints, z: Floats, rows: Ints) -> Floats:
        """Return the margins of pairs [m], shape (n,); -inf where a pair need not be checked.

        Args:
            pairs: Indices of the pairs, shape (n,).
            waypoints: Waypoint of each pair, shape (n,).
            z: Minimal coordinates, shape (W, m).
            rows: Row of `z` for each pair, shape (n,).
        """
        return np.asarray(self.compiled.at(pairs, waypoints, z, rows), float)


class ClosePairs(NamedTuple):
    """C pairs of close shapes, sorted by configuration, then by distance − margin.

    Attributes:
        row: Index of the configuration, shape (C,).
        pair: Index of the pair, shape (C,).
        distance: Signed distance, shape (C,) [m].
        margin: Required clearance, shape (C,) [m].
        normal: Unit normal from the first to the second shape, world frame, shape (C, 3).
        first, second: Witness points (closest, or deepest), world frame, shape (C, 3) each [m].
    """

    row: Ints
    pair: Ints
    distance: Floats
    margin: Floats
    normal: Floats
    first: Floats
    second: Floats


class Clearances:
    """Computes kinematics, bounding volumes and distances of a model's shapes in one compiled call.

    Results depend neither on the number of threads nor on which configurations are evaluated
    together.
    """

    def __init__(
        self, placements: BatchedModel, boxes: Boxes, shapes: Shapes, margins: Margins
    ) -> None:
        self.placements = placements
        self.boxes = boxes
        self.shapes = shapes
        self.margins = margins
        self._parts = (placements.compiled, boxes.compiled, shapes.compiled, margins.compiled)
        self._find_closest_pairs = load_compiled().nearest
        self._count_free = load_compiled().count_free

    def move_fixed(self, boxes: Boxes, where: Mapping[int, pin.SE3]) -> Clearances:
        """Return a copy with some fixed shapes at other placements.

        Args:
            boxes: The bounding boxes at the new placements.
            where: Shape index → new placement in the world frame.
        """
        return Clearances(self.placements, boxes, self.shapes.move_fixed(where), self.margins)

    def find_closest_pairs(
        self,
        q: Floats,
        z: Floats,
        waypoints: Ints,
        *,
        reach: float,
        max_pairs: int | None = None,
        include_fixed: bool = True,
    ) -> ClosePairs:
        """Return, per configuration, the pairs closer than `reach` with least distance − margin.

        Args:
            q: Pinocchio configurations, shape (W, nq).
            z: Minimal coordinates, shape (W, n), which select the margins together with
                `waypoints`.
            waypoints: Indices of waypoints, shape (W,).
            reach: Largest distance [m].
            max_pairs: Maximum number of pairs per configuration. Default: no limit.
            include_fixed: Include pairs of a moving and a fixed shape.
        """
        threads = max(1, min(self.shapes.threads, len(q) // _MIN_ROWS_PER_THREAD))
        limit = _NO_LIMIT if max_pairs is None else max_pairs
        columns = self._find_closest_pairs(
            *self._parts, q, z, waypoints, reach, limit, include_fixed, _ROUNDING, threads
        )
        return ClosePairs(*columns)

    def count_free(
        self, q: Floats, z: Floats, edges: Ints, waypoint: int, *, reach: float, allowed: float
    ) -> Ints:
        """Return how many configurations of each run precede the first violation, shape (R,).

        A configuration violates if a pair lacks more than `allowed` [m] of its margin.

        Args:
            q: Pinocchio configurations, shape (W, nq).
            z: Minimal coordinates, shape (W, n).
            edges: Index of the first configuration of each run, and the end of the last, (R + 1,).
            waypoint: Index of the waypoint, which selects the margins.
            reach: Pairs further apart are ignored [m].
            allowed: Tolerated violation [m].
        """
        counts = self._count_free(*self._parts, q, z, edges, waypoint, reach, allowed, _ROUNDING)
        return np.asarray(counts)
