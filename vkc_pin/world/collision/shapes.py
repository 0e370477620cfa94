"""Distances between some of many shapes, at many states at once."""

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

TOLERANCE = 1e-6  # coal's own, of GJK
_WORTH = 128  # distances, some 0.2 ms, for which another thread is worth starting


class Witnesses(NamedTuple):
    """Distances of pairs, and where they are.

    Attributes:
        distance: Signed, negative where shapes overlap, shape (n,) [m].
        normal: From the first to the second, world frame, shape (n, 3).
        first, second: The points that are closest, or deepest, on either, world frame, shape (n, 3)
            each [m].
    """

    distance: Floats
    normal: Floats
    first: Floats
    second: Floats


class Shapes:
    """Shapes that move, then shapes that stand, G in all; coal's distances between them, whatever was asked before.

    They are coal's to the last bit (`coal.distance` with a result of its own), however many threads
    look for them. States say where what moves is: placements in the world, shape (W, M, 12), see
    `placements.flatten_placements`.

    Args:
        geometries: coal's shapes, first those that move.
        standing: Where the last of them stand in the world, S of them; the other M move.
        tolerance: Of GJK. At 1e-8 normals are good enough for gradients, at coal's own 1e-6 these
            are off by up to 5e-3. It takes no longer. (Penetration keeps its tolerance: below 1e-6
            it fails for cylinders.)
        threads: How many look for distances at most; None: as many as there are cores for this
            process, 8 at most, or `OMP_NUM_THREADS`.

    Raises:
        InputError: A shape is of a kind that is not known; see `solids.convert_solid`.
        BuildError: See `solids.load_compiled`.
    """

    def __init__(
        self,
        geometries: Sequence[coal.CollisionGeometry],
        standing: Sequence[pin.SE3] = (),
        *,
        tolerance: float = TOLERANCE,
        threads: int | None = None,
    ) -> None:
        self.threads = count_threads() if threads is None else threads
        solids = [convert_solid(geometry) for geometry in geometries]
        self.compiled: Any = load_compiled().Shapes(solids, flatten_placements(standing), tolerance)

    def placed(self, where: Mapping[int, pin.SE3]) -> Shapes:
        """Return the same with some that stand placed elsewhere in the world; `where` goes by their numbers among the G."""
        other = object.__new__(Shapes)
        other.threads = self.threads
        other.compiled = self.compiled.placed(
            np.array(list(where), np.int64), flatten_placements(list(where.values()))
        )
        return other

    def distances(self, moving: Floats, states: Ints, pairs: Ints) -> Floats:
        """Return the signed distances of pairs, each at one of the states, shape (n,) [m].

        Args:
            moving: The states, shape (W, M, 12).
            states: Which state each pair is looked at in, shape (n,).
            pairs: Numbers of shapes, shape (n, 2).

        Raises:
            IndexError: There is no such state or shape.
        """
        found = self.compiled.distances(moving, states, pairs, False, self._threads(len(pairs)))
        return np.asarray(found, float)

    def witnesses(self, moving: Floats, states: Ints, pairs: Ints) -> Witnesses:
        """Return distances, normals and the closest points; arguments and errors as of `distances`."""
        return _witnesses(
            self.compiled.distances(moving, states, pairs, True, self._threads(len(pairs)))
        )

    def shortest(
        self,
        moving: Floats,
        edges: Ints,
        pairs: Ints,
        *,
        numbers: Ints,
        margins: Floats,
        bounds: Floats,
        reach: float,
        most: int | None,
        rounding: float,
    ) -> tuple[Ints, Witnesses]:
        """Return, for each state, the pairs closer than `reach` that fall shortest of their margins, and their distances.

        Args:
            moving: The states, shape (W, M, 12).
            edges: Where each state's pairs begin, and where the last one's end, shape (W + 1,).
            pairs: Numbers of shapes, shape (n, 2), for each state in the order of `bounds`.
            numbers: Which goes first of two that are equal, shape (n,).
            margins: What distances are compared with, shape (n,) [m].
            bounds: What is known of distance − margin: at least so much, shape (n,) [m].
            reach: Pairs further apart are left out [m].
            most: How many to return for each state; None: all. Pairs of which `bounds` shows that
                they are not among them are not asked for.
            rounding: How much larger than distance − margin `bounds` may be [m].

        Returns:
            Which of the n they are, by state and then by distance − margin, and their distances.

        Raises:
            IndexError: There is no such shape.
        """
        limits, limit = np.column_stack([margins, bounds]), -1 if most is None else most
        threads = self._threads(len(pairs))
        chosen, table = self.compiled.shortest(
            moving, edges, pairs, numbers, limits, reach, limit, rounding, threads
        )
        return chosen, _witnesses(table)

    def _threads(self, rows: int) -> int:
        return max(1, min(self.threads, rows // _WORTH))


def _witnesses(table: Floats) -> Witnesses:
    return Witnesses(table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7:10])


def count_distance_queries() -> int:
    """Return how many distances were asked of coal so far here, by this process: what bounds have not saved."""
    return int(load_compiled().asked())
