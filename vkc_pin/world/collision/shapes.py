"""Computes signed distances and witness points of pairs of shapes, at many states at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.placements import flatten_placements
from vkc_pin.world.collision.solids import convert_solid, load_compiled
from vkc_pin.world.collision.threads import count_threads

__all__ = ["TOLERANCE", "Shapes", "Witnesses", "count_distance_queries"]

TOLERANCE = 1e-6  # coal's default tolerance of GJK
_MIN_PAIRS_PER_THREAD = 128  # distances, about 0.2 ms: fewer do not pay for another thread


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

    Distances equal those of `coal.distance` with a fresh result bit for bit, for any number of
    threads. A state is the placements of the moving shapes in the world frame, shape (M, 12), in
    the format of `placements.flatten_placements`.

    Args:
        geometries: coal's shapes, moving ones first.
        fixed: Placements of the fixed shapes in the world frame.
        tolerance: Tolerance of GJK. With 1e-8, normals are accurate enough for gradients; with
            coal's default of 1e-6, they are off by up to 5e-3. Both take the same time. EPA keeps
            its default, since below 1e-6 it fails for cylinders.
        threads: Maximum number of threads. Default: `threads.count_threads`.
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
        other.compiled = self.compiled.placed(
            np.array(list(where), np.int64), flatten_placements(list(where.values()))
        )
        return other

    def compute_distances(self, moving: Floats, states: Ints, pairs: Ints) -> Floats:
        """Return the signed distances of pairs of shapes, shape (n,) [m].

        Args:
            moving: States, shape (W, M, 12).
            states: State of each pair, shape (n,).
            pairs: Pairs of shape indices, shape (n, 2).
        """
        found = self.compiled.distances(
            moving, states, pairs, False, self._count_threads(len(pairs))
        )
        return np.asarray(found, float)

    def compute_witnesses(self, moving: Floats, states: Ints, pairs: Ints) -> Witnesses:
        """Return distances, normals and witness points; see `compute_distances`."""
        return _to_witnesses(
            self.compiled.distances(moving, states, pairs, True, self._count_threads(len(pairs)))
        )

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
        limits, limit = np.column_stack([margins, bounds]), -1 if max_pairs is None else max_pairs
        threads = self._count_threads(len(pairs))
        chosen, table = self.compiled.shortest(
            moving, edges, pairs, ranks, limits, reach, limit, rounding, threads
        )
        return chosen, _to_witnesses(table)

    def _count_threads(self, rows: int) -> int:
        return max(1, min(self.threads, rows // _MIN_PAIRS_PER_THREAD))


def _to_witnesses(table: Floats) -> Witnesses:
    return Witnesses(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7:10])


def count_distance_queries() -> int:
    """Return the number of distances that coal has computed in this process.

    Pairs that bounds excluded are not counted.
    """
    return int(load_compiled().asked())
