"""Looks up the clearance that each pair of shapes must keep, by waypoint and configuration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["MarginRegion", "Margins"]


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
