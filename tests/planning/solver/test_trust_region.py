"""Tests of step acceptance and trust-region adaptation."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.solver.trust_region import (
    CLEARANCE_TOLERANCE,
    FIRST_RADIUS,
    SETTLE_RADIUS,
    Trial,
    TrustRegion,
    is_step_acceptable,
)

SEGMENTS, BLOCK = 30, 10  # three blocks


def trial(predicted_penalty: Any = 0.0, *, step: Any = 0.1) -> Trial:
    """Return a trial with a predicted penalty and a step."""
    rows = [
        np.broadcast_to(np.asarray(values, float), (SEGMENTS,)).copy()
        for values in (predicted_penalty, step)
    ]
    fields = dict.fromkeys(field.name for field in dataclasses.fields(Trial))
    return Trial(**{**fields, "predicted_penalty": rows[0], "step": rows[1]})  # type: ignore[arg-type]


@settings(max_examples=100, deadline=None)
@given(st.floats(-1.0, 10.0), st.floats(-10.0, 10.0), st.floats(0.0, 100.0))
def test_step_is_accepted_if_enough_of_the_prediction_is_achieved(
    promised: float, actual: float, merit: float
) -> None:
    accepted = is_step_acceptable(promised, actual, merit)
    if promised >= 1e-4 * max(1.0, merit):
        assert accepted == (actual > 0.05 * promised)
    else:  # nothing was to be had: it may not become worse
        assert accepted == (actual >= -1e-4 * max(1.0, merit))


def test_blocks_have_similar_sizes() -> None:
    for segments in (1, 4, 9, 10, 14, 15, 16, 57, 100):
        sizes = np.bincount(TrustRegion(segments, BLOCK).block)
        assert sizes.sum() == segments
        assert len(sizes) == max(1, round(segments / BLOCK))
        assert np.ptp(sizes) <= 1


def test_each_block_adapts_separately() -> None:
    """The radius grows in the first block, shrinks in the second and stays in the third."""
    region, before = TrustRegion(SEGMENTS, BLOCK), np.zeros(SEGMENTS)
    before[:20] = 2.0
    after, step = np.zeros(SEGMENTS), np.full(SEGMENTS, FIRST_RADIUS)
    after[10:20], step[10:20], step[20:] = 4.0, 0.2, 0.1
    region.adapt(before, after, trial(step=step), True)
    np.testing.assert_allclose(region.radius[:10], 1.5 * FIRST_RADIUS)
    np.testing.assert_allclose(region.radius[10:20], 0.4 * 0.2)
    np.testing.assert_allclose(region.radius[20:], FIRST_RADIUS)


def test_rejection_shrinks_the_radius() -> None:
    region = TrustRegion(SEGMENTS, BLOCK)
    region.adapt(np.zeros(SEGMENTS), np.zeros(SEGMENTS), trial(step=0.3), False)
    np.testing.assert_allclose(region.radius, 0.4 * 0.3)


def test_half_of_the_prediction_keeps_the_radius() -> None:
    region = TrustRegion(SEGMENTS, BLOCK)
    region.adapt(np.full(SEGMENTS, 2.0), np.ones(SEGMENTS), trial(step=FIRST_RADIUS), True)
    np.testing.assert_array_equal(region.radius, FIRST_RADIUS)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_radii_stay_positive_and_equal_within_a_block(seed: int) -> None:
    rng, region = (
        np.random.default_rng(seed),
        TrustRegion(SEGMENTS, BLOCK, np.repeat([0.5, 1e-3, 1e-6], 10)),
    )
    for _ in range(20):
        before, predicted_penalty, after, step = rng.uniform(0.0, 2.0, (4, SEGMENTS))
        region.adapt(before, after, trial(predicted_penalty, step=step), bool(rng.integers(2)))
        assert (region.radius >= 1e-6).all()
        assert all(np.ptp(region.radius[region.block == b]) == 0.0 for b in range(3))


def test_region_has_stalled_if_violated_waypoints_do_not_move() -> None:
    region, shortfall = TrustRegion(SEGMENTS, BLOCK), np.zeros(SEGMENTS)
    shortfall[12] = 2 * CLEARANCE_TOLERANCE
    step = np.full(SEGMENTS, 0.1)
    assert not region.has_stalled(trial(step=step), shortfall)
    step[12] = CLEARANCE_TOLERANCE / 2
    assert region.has_stalled(trial(step=step), shortfall)
    shortfall[15] = 2 * CLEARANCE_TOLERANCE  # which moves
    assert not region.has_stalled(trial(step=step), shortfall)
    assert not region.has_stalled(
        trial(step=step), np.zeros(SEGMENTS)
    )  # nothing in the way: all must have stopped
    assert region.has_stalled(trial(step=0.0), np.zeros(SEGMENTS))
    region.limit()
    np.testing.assert_array_equal(region.radius, SETTLE_RADIUS)
    region.reset()
    np.testing.assert_array_equal(region.radius, FIRST_RADIUS)


def test_given_radii_are_copied() -> None:
    given_radii = np.full(SEGMENTS, 0.07)
    region = TrustRegion(SEGMENTS, BLOCK, given_radii)
    region.adapt(np.zeros(SEGMENTS), np.zeros(SEGMENTS), trial(step=0.07), False)
    np.testing.assert_array_equal(given_radii, 0.07)
    assert (region.radius < 0.07).all()
