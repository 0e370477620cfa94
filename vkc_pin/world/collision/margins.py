"""Looks up the clearance that each pair of shapes must keep, by waypoint and configuration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["MarginRegion", "Margins"]


class MarginRegion(NamedTuple):
    """A box in configuration space inside which some pairs have a smaller margin.

    Attributes:
        pairs: Indices of the pairs, shape (k,).
        margin: Their margin inside the region [m]; -inf disables the check.
        columns: Indices in z of the coordinates that bound the region, shape (m,).
        lower, upper: Bounds of these coordinates, shape (m,) each, [m] or [rad].
    """

    pairs: Ints
    margin: float
    columns: Ints
    lower: Floats
    upper: Floats


class Margins:
    """Margins of pairs: a default each, reduced between some waypoints and in some regions.

    Args:
        default: Default margins of the pairs, shape (P,) [m].
        relaxed: Pair → (first waypoint, last waypoint, margin [m]) of every span of waypoints with
            a smaller margin.
        regions: Regions with smaller margins.

    Raises:
        IndexError: A pair does not exist.
        BuildError: See `solids.load_compiled`.
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
        """Return the margins of pairs at given waypoints and configurations, shape (n,) [m].

        Args:
            pairs: Indices of the pairs, shape (n,).
            waypoints: Waypoint of each pair, shape (n,).
            z: Minimal coordinates, shape (W, m).
            rows: Row of `z` for each pair, shape (n,).

        Returns:
            The margins; -inf where a pair need not be checked.
        """
        return np.asarray(self.compiled.at(pairs, waypoints, z, rows), float)
