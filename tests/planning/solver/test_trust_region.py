"""What is accepted, and how far planes are believed after that."""

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
    """Return where a round led: what the planes promised would be left, and how far it went."""
    rows = [
        np.broadcast_to(np.asarray(values, float), (SEGMENTS,)).copy()
        for values in (predicted_penalty, step)
    ]
    fields = dict.fromkeys(field.name for field in dataclasses.fields(Trial))
    return Trial(**{**fields, "predicted_penalty": rows[0], "step": rows[1]})  # type: ignore[arg-type]


@settings(max_examples=100, deadline=None)
@given(st.floats(-1.0, 10.0), st.floats(-10.0, 10.0), st.floats(0.0, 100.0))
def test_a_step_is_accepted_that_keeps_enough_of_its_promise(
    promised: float, actual: float, merit: float
) -> None:
    accepted = is_step_acceptable(promised, actual, merit)
    if promised >= 1e-4 * max(1.0, merit):
        assert accepted == (actual > 0.05 * promised)
    else:  # nothing was to be had: it may not become worse
        assert accepted == (actual >= -1e-4 * max(1.0, merit))


def test_blocks_are_alike_in_size() -> None:
    for segments in (1, 4, 9, 10, 14, 15, 16, 57, 100):
        sizes = np.bincount(TrustRegion(segments, BLOCK).block)
        assert sizes.sum() == segments
        assert len(sizes) == max(1, round(segments / BLOCK))
        assert np.ptp(sizes) <= 1


def test_each_block_learns_from_what_happened_in_it() -> None:
    """The radius grows in the first block, shrinks in the second and stays in the third."""
    region, before = TrustRegion(SEGMENTS, BLOCK), np.zeros(SEGMENTS)
    before[:20] = 2.0
    after, step = np.zeros(SEGMENTS), np.full(SEGMENTS, FIRST_RADIUS)
    after[10:20], step[10:20], step[20:] = 4.0, 0.2, 0.1
    region.adapt(before, after, trial(step=step), True)
    np.testing.assert_allclose(region.radius[:10], 1.5 * FIRST_RADIUS)
    np.testing.assert_allclose(region.radius[10:20], 0.4 * 0.2)
    np.testing.assert_allclose(region.radius[20:], FIRST_RADIUS)


def test_what_is_rejected_makes_steps_smaller() -> None:
    region = TrustRegion(SEGMENTS, BLOCK)
    region.adapt(np.zeros(SEGMENTS), np.zeros(SEGMENTS), trial(step=0.3), False)
    np.testing.assert_allclose(region.radius, 0.4 * 0.3)


def test_what_half_keeps_its_promise_keeps_the_radius() -> None:
    region = TrustRegion(SEGMENTS, BLOCK)
    region.adapt(np.full(SEGMENTS, 2.0), np.ones(SEGMENTS), trial(step=FIRST_RADIUS), True)
    np.testing.assert_array_equal(region.radius, FIRST_RADIUS)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_radii_stay_positive_and_one_to_a_block(seed: int) -> None:
    rng, region = (
        np.random.default_rng(seed),
        TrustRegion(SEGMENTS, BLOCK, np.repeat([0.5, 1e-3, 1e-6], 10)),
    )
    for _ in range(20):
        before, predicted_penalty, after, step = rng.uniform(0.0, 2.0, (4, SEGMENTS))
        region.adapt(before, after, trial(predicted_penalty, step=step), bool(rng.integers(2)))
        assert (region.radius >= 1e-6).all()
        assert all(np.ptp(region.radius[region.block == b]) == 0.0 for b in range(3))


def test_stuck_is_where_something_is_in_the_way_and_does_not_move() -> None:
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


def test_the_radii_of_another_solution_are_taken_over_and_left_alone() -> None:
    given_radii = np.full(SEGMENTS, 0.07)
    region = TrustRegion(SEGMENTS, BLOCK, given_radii)
    region.adapt(np.zeros(SEGMENTS), np.zeros(SEGMENTS), trial(step=0.07), False)
    np.testing.assert_array_equal(given_radii, 0.07)
    assert (region.radius < 0.07).all()
