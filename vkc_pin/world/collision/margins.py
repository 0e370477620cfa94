"""Which clearance each pair must keep where."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["MarginRegion", "Margins"]


class MarginRegion(NamedTuple):
    """Pairs that may be closer than others as long as some coordinates are within limits.

    Attributes:
        pairs: Which, shape (k,).
        margin: What they keep there [m]; -inf: nothing.
        columns: The coordinates in z, shape (m,).
        lower, upper: Their limits, shape (m,) each.
    """

    pairs: Ints
    margin: float
    columns: Ints
    lower: Floats
    upper: Floats


class Margins:
    """What pairs must keep: usually a clearance of their own, between some waypoints and in some places less.

    Args:
        usual: The pairs' clearances, shape (P,) [m].
        eased: Pair → (first waypoint, last waypoint, margin [m]): between these it may come closer,
            so close.
        places: Where pairs may come closer.

    Raises:
        IndexError: There is no such pair.
        BuildError: See `solids.load_compiled`.
    """

    def __init__(
        self,
        usual: Floats,
        eased: Mapping[int, Sequence[tuple[int, int, float]]],
        places: Iterable[MarginRegion] = (),
    ) -> None:
        self.compiled: Any = load_compiled().Margins(usual)
        for pair, spans in eased.items():
            for first, last, margin in spans:
                self.compiled.ease(pair, first, last, margin)
        for place in places:
            self.compiled.near(*place)

    def at(self, pairs: Ints, waypoints: Ints, z: Floats, rows: Ints) -> Floats:
        """Return what pairs must keep, each at a waypoint and in one of the places z, shape (n,) [m]; -inf: nothing.

        Args:
            pairs: Shape (n,).
            waypoints: Shape (n,).
            z: Coordinates, shape (W, m).
            rows: Which of these each pair is looked at in, shape (n,).
        """
        return np.asarray(self.compiled.at(pairs, waypoints, z, rows), float)
