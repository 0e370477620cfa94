"""Tests the lookup of margins against an evaluation of the rules pair by pair."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.collision.distances import MarginRegion, Margins

PAIRS, COORDINATES = 12, 4


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_smallest_margin_applies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    default_margins = rng.uniform(0.0, 0.05, PAIRS)
    reduced = {
        int(pair): [
            (int(first), int(first + rng.integers(4)), float(rng.normal()))
            for first in rng.integers(0, 8, 2)
        ]
        for pair in rng.permutation(PAIRS)[:4]
    }
    regions = []
    for _ in range(3):
        columns, low = rng.permutation(COORDINATES)[: rng.integers(1, 3)], rng.normal(size=4)
        lower = low[: len(columns)]
        margin = float(rng.choice([-np.inf, -0.01, 0.01]))
        regions.append(
            MarginRegion(rng.permutation(PAIRS)[:5], margin, columns, lower, lower + 1.5)
        )
    pairs, waypoints = (grid.ravel() for grid in np.meshgrid(np.arange(PAIRS), np.arange(10)))
    z, rows = rng.normal(size=(6, COORDINATES)), rng.integers(0, 6, len(pairs))
    expected = []
    for pair, waypoint, row in zip(pairs.tolist(), waypoints.tolist(), rows.tolist(), strict=True):
        margins = [
            default_margins[pair],
            *(margin for first, last, margin in reduced.get(pair, ()) if first <= waypoint <= last),
        ]
        for region in regions:
            values = z[row, region.columns]
            if pair in region.pairs and np.all((region.lower <= values) & (values <= region.upper)):
                margins.append(region.margin)
        expected.append(min(margins))
    assert expected != default_margins[pairs].tolist(), "no margin is reduced"
    np.testing.assert_array_equal(
        Margins(default_margins, reduced, regions).compute_margins(pairs, waypoints, z, rows),
        expected,
    )
