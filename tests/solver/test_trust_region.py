"""What is accepted, and how far planes are believed after that."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.chain.contacts import Contacts
from vkc_pin.solver.trust_region import (
    CLOSE_ENOUGH,
    FAR,
    FIRST_RADIUS,
    MIN_RADIUS,
    SETTLE_RADIUS,
    Trial,
    TrustRegion,
    judge,
)

SEGMENTS, BLOCK = 30, 10  # three blocks


def trial(slack: Any = 0.0, shortfall: Any = 0.0, *, objective: float = 1.0, step: Any = 0.1) -> Trial:
    """Return where a round led: what the planes promised, and what is there."""
    rows = [np.broadcast_to(np.asarray(values, float), (SEGMENTS,)).copy() for values in (slack, shortfall, step)]
    return Trial(
        z=np.zeros((SEGMENTS, 3)),
        slack=rows[0],
        objective=objective,
        pose_error=0.0,
        contacts=cast(Contacts, None),
        shortfall=rows[1],
        clear=False,
        between=False,
        rate=0.0,
        step=rows[2],
        satisfied=True,
    )


def merit(objective: float, shortfall: np.ndarray) -> float:
    return objective + 10.0 * float(shortfall.sum())


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_step_is_accepted_that_keeps_enough_of_its_promise(seed: int) -> None:
    """The ratio is that of the decreases of f + penalty · shortfall, worked out here once more."""
    rng = np.random.default_rng(seed)
    before, slack, after = rng.uniform(0.0, 0.1, (3, SEGMENTS))
    at = trial(slack, after, objective=float(rng.uniform(0.0, 2.0)))
    accepted, ratio = judge(at, 1.0, before, penalty=10.0, pose_error=0.0)
    promised = merit(1.0, before) - merit(at.objective, slack)
    actual = merit(1.0, before) - merit(at.objective, after)
    if promised > 0.01:
        assert ratio == pytest.approx(actual / promised)
        assert accepted == (actual > 0.05 * promised)
    elif promised < 0.0:
        assert accepted == (actual >= -1e-4 * max(1.0, merit(1.0, before)))


def test_off_the_manifold_every_step_is_accepted() -> None:
    worse = trial(0.0, 1.0, objective=99.0)
    nothing = np.zeros(SEGMENTS)
    assert judge(worse, 1.0, nothing, penalty=10.0, pose_error=2 * FAR)[0]
    assert not judge(worse, 1.0, nothing, penalty=10.0, pose_error=FAR / 2)[0]


def test_blocks_are_alike_in_size() -> None:
    for segments in (1, 4, 9, 10, 14, 15, 16, 57, 100):
        sizes = np.bincount(TrustRegion(segments, BLOCK).block)
        assert sizes.sum() == segments
        assert len(sizes) == max(1, round(segments / BLOCK))
        assert np.ptp(sizes) <= 1


def test_each_block_learns_from_what_happened_in_it() -> None:
    """The first kept its promise, the second broke it, in the third nothing was to be done."""
    region, before = TrustRegion(SEGMENTS, BLOCK), np.zeros(SEGMENTS)
    before[:20] = 0.01
    slack, shortfall, step = np.zeros((3, SEGMENTS))
    shortfall[10:20], step[:] = 0.02, 0.2
    region.adapt(before, trial(slack, shortfall, step=step), True, 0.9)
    np.testing.assert_allclose(region.radius[:10], 1.5 * FIRST_RADIUS)
    np.testing.assert_allclose(region.radius[10:20], 0.4 * 0.2)
    np.testing.assert_allclose(region.radius[20:], 1.5 * FIRST_RADIUS)


def test_what_is_rejected_makes_steps_smaller() -> None:
    region = TrustRegion(SEGMENTS, BLOCK)
    region.adapt(np.zeros(SEGMENTS), trial(step=0.3), False, -1.0)
    np.testing.assert_allclose(region.radius, 0.4 * 0.3)


def test_what_is_accepted_but_bad_keeps_the_radius() -> None:
    region = TrustRegion(SEGMENTS, BLOCK)
    region.adapt(np.zeros(SEGMENTS), trial(), True, 0.2)
    np.testing.assert_array_equal(region.radius, FIRST_RADIUS)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_radii_stay_positive_and_one_to_a_block(seed: int) -> None:
    rng, region = np.random.default_rng(seed), TrustRegion(SEGMENTS, BLOCK, np.repeat([0.5, 1e-3, 1e-6], 10))
    for _ in range(20):
        before, slack, after, step = rng.uniform(0.0, 0.02, (4, SEGMENTS))
        region.adapt(before, trial(slack, after, step=step), bool(rng.integers(2)), float(rng.uniform(-1.0, 1.0)))
        assert (region.radius >= 1e-6).all()
        assert all(np.ptp(region.radius[region.block == b]) == 0.0 for b in range(3))


def test_stuck_is_where_something_is_in_the_way_and_does_not_move() -> None:
    region, shortfall = TrustRegion(SEGMENTS, BLOCK), np.zeros(SEGMENTS)
    shortfall[12] = 2 * CLOSE_ENOUGH
    step = np.full(SEGMENTS, 0.1)
    assert not region.stuck(trial(step=step), shortfall)
    step[12] = MIN_RADIUS / 2
    assert region.stuck(trial(step=step), shortfall)
    shortfall[15] = 2 * CLOSE_ENOUGH  # which moves
    assert not region.stuck(trial(step=step), shortfall)
    assert not region.stuck(trial(step=step), np.zeros(SEGMENTS))  # nothing in the way: all must have stopped
    assert region.stuck(trial(step=0.0), np.zeros(SEGMENTS))
    region.settle()
    np.testing.assert_array_equal(region.radius, SETTLE_RADIUS)
    region.restart()
    assert (region.radius > SETTLE_RADIUS).all()


def test_the_radii_of_another_solution_are_taken_over_and_left_alone() -> None:
    given_radii = np.full(SEGMENTS, 0.07)
    region = TrustRegion(SEGMENTS, BLOCK, given_radii)
    region.adapt(np.zeros(SEGMENTS), trial(), False, 0.0)
    np.testing.assert_array_equal(given_radii, 0.07)
    assert (region.radius < 0.07).all()
