"""Tests step acceptance and trust-region adaptation, on either side of every threshold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.solver.trust_region import (
    ACTIVE_FRACTION,
    CLEARANCE_TOLERANCE,
    FIRST_RADIUS,
    NEGLIGIBLE_CHANGE,
    SETTLE_RADIUS,
    SHRINK,
    TrustRegion,
    is_step_acceptable,
)


@pytest.mark.parametrize(
    ("predicted", "actual", "step", "accepted", "factors"),
    [
        ((10.0, 10.0), (10.0, 10.0), (1.01 * ACTIVE_FRACTION, 0.5), True, (1.5, 1.0)),
        ((10.0, 10.0), (10.0, 10.0), (0.99 * ACTIVE_FRACTION, 0.5), True, (1.0, 1.0)),
        ((10.0, 10.0), (7.0 - 0.9 * NEGLIGIBLE_CHANGE, 5.0), (1.0, 1.0), True, (1.5, 1.0)),
        ((10.0, 10.0), (7.0 - 1.1 * NEGLIGIBLE_CHANGE, 5.0), (1.0, 1.0), True, (1.0, 1.0)),
        ((10.0, 10.0), (2.4, 2.6), (0.8, 0.8), True, (0.8 * SHRINK, 1.0)),
        ((0.1, 0.0), (0.1 - 0.9 * NEGLIGIBLE_CHANGE, 0.0), (0.8, 0.8), True, (1.0, 1.0)),
        ((0.1, 0.0), (0.1 - 1.1 * NEGLIGIBLE_CHANGE, 0.0), (0.8, 0.8), True, (0.8 * SHRINK, 1.0)),
        # a step longer than the radius counts as the radius
        ((10.0, 10.0), (0.0, 10.0), (1.2, 0.5), True, (SHRINK, 1.0)),
        # a rejected step shrinks the blocks that were predicted poorly, or else all
        ((10.0, 10.0), (10.0, 10.0), (1.0, 0.5), False, (SHRINK, 0.5 * SHRINK)),
        ((10.0, 10.0), (10.0, 0.0), (1.0, 0.5), False, (1.0, 0.5 * SHRINK)),
        ((10.0, 10.0), (10.0, 0.0), (1.0, 0.5), True, (1.5, 0.5 * SHRINK)),
        ((10.0, 10.0), (0.0, 10.0), (0.0, 0.5), True, (1e-6 / 0.3, 1.0)),
    ],
)
def test_each_block_adapts_to_its_own_prediction(
    predicted: tuple[float, ...],
    actual: tuple[float, ...],
    step: tuple[float, ...],
    accepted: bool,
    factors: tuple[float, ...],
) -> None:
    """Blocks of two waypoints: reductions add up within a block, the largest step counts."""
    original_radii = np.full(4, 0.3)
    region = TrustRegion(4, 2, original_radii)
    spread = np.zeros((3, 4))
    spread[0, ::2], spread[1, 1::2], spread[2, 1::2] = predicted, actual, 0.3 * np.array(step)
    region.adapt(*spread, accepted)
    np.testing.assert_allclose(region.radius, np.repeat(0.3 * np.array(factors), 2))
    np.testing.assert_array_equal(original_radii, 0.3)


@settings(max_examples=50, deadline=None)
@given(st.floats(-1.0, 10.0), st.floats(-10.0, 10.0), st.floats(-100.0, 100.0))
def test_step_is_accepted_if_enough_of_the_prediction_is_achieved(
    predicted: float, actual: float, merit: float
) -> None:
    negligible = 1e-4 * max(1.0, abs(merit))
    for share in (0.049, 0.051):
        assert is_step_acceptable(2 * negligible, 2 * share * negligible, merit) == (share > 0.05)
    if predicted >= negligible:
        assert is_step_acceptable(predicted, actual, merit) == (actual > 0.05 * predicted)
    else:
        assert is_step_acceptable(predicted, actual, merit) == (actual >= -negligible)


@pytest.mark.parametrize(
    ("radius", "step", "shortfall", "stalled"),
    [
        ([9.0, 0.9, 9.0], [9.0, 9.0, 9.0], [0.0, 1.1, 0.0], True),
        ([9.0, 9.0, 9.0], [9.0, 0.9, 9.0], [0.0, 1.1, 0.0], True),
        ([9.0, 1.1, 9.0], [9.0, 1.1, 9.0], [0.0, 1.1, 0.0], False),
        ([9.0, 0.9, 9.0], [9.0, 9.0, 9.0], [0.0, 1.1, 1.1], False),
        ([9.0, 0.9, 9.0], [9.0, 9.0, 9.0], [0.0, 0.9, 0.0], False),
        ([0.9, 0.9, 0.9], [9.0, 9.0, 9.0], [0.0, 0.9, 0.0], True),
    ],
)
def test_region_has_stalled_if_violated_waypoints_do_not_move(
    radius: list[float], step: list[float], shortfall: list[float], stalled: bool
) -> None:
    """All numbers are in units of the tolerance; without violation, all waypoints count."""
    region = TrustRegion(3, 1, CLEARANCE_TOLERANCE * np.array(radius))
    moved, missing = CLEARANCE_TOLERANCE * np.array([step, shortfall])
    assert region.has_stalled(moved, missing) == stalled


def test_limit_and_reset() -> None:
    region = TrustRegion(3, 1, np.array([0.01, SETTLE_RADIUS, 0.3]))
    region.limit()
    np.testing.assert_array_equal(region.radius, [0.01, SETTLE_RADIUS, SETTLE_RADIUS])
    region.reset()
    np.testing.assert_array_equal(region.radius, [FIRST_RADIUS] * 3)


@pytest.mark.parametrize(
    ("segments", "length", "blocks"),
    [(1, 10, 1), (4, 10, 1), (14, 10, 1), (16, 10, 2), (7, 2, 4), (5, 1, 5), (57, 10, 6)],
)
def test_blocks_are_consecutive_and_of_similar_size(
    segments: int, length: int, blocks: int
) -> None:
    found = TrustRegion(segments, length).block
    sizes = np.bincount(found)
    assert (len(sizes), found[0]) == (blocks, 0)
    assert (np.diff(found) >= 0).all()
    assert np.ptp(sizes) <= 1
