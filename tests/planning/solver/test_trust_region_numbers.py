"""Tests of the trust region on either side of every threshold."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from vkc_pin.planning.solver.trust_region import (
    ACTIVE_FRACTION,
    CLEARANCE_TOLERANCE,
    FIRST_RADIUS,
    NEGLIGIBLE_CHANGE,
    SETTLE_RADIUS,
    SHRINK,
    Trial,
    TrustRegion,
    is_step_acceptable,
)


def adapted(
    promised: list[float],
    actual: list[float],
    step: list[float],
    *,
    accepted: bool = True,
    radius: float = 0.5,
) -> list[float]:
    """Return the adapted radii of two blocks, in units of the radius."""
    region = TrustRegion(4, 2, np.full(4, radius))
    before, predicted_penalty, after = np.full(4, 100.0), np.full(4, 100.0), np.full(4, 100.0)
    predicted_penalty[::2] -= np.array(promised)  # all of it at one waypoint of a block
    after[1::2] -= np.array(actual)  # and what came of it at the other
    fields: dict[str, Any] = dict.fromkeys(field.name for field in dataclasses.fields(Trial))
    steps = np.zeros(4)
    steps[1::2] = radius * np.array(step)
    region.adapt(
        before,
        after,
        Trial(**{**fields, "predicted_penalty": predicted_penalty, "step": steps}),
        accepted,
    )
    assert region.radius[0] == region.radius[1]
    assert region.radius[2] == region.radius[3]
    return [float(value) / radius for value in region.radius[::2]]


def test_good_prediction_at_the_boundary_widens_the_block() -> None:
    for step, wider in (
        (1.0, True),
        (1.01 * ACTIVE_FRACTION, True),
        (0.99 * ACTIVE_FRACTION, False),
        (0.1, False),
    ):
        assert adapted([10.0, 10.0], [10.0, 10.0], [step, 0.0]) == [
            pytest.approx(1.5 if wider else 1.0),
            1.0,
        ]


def test_seven_tenths_of_the_prediction_are_good() -> None:
    """Negligible changes are ignored."""
    for share, wider in (
        (7.1, True),
        (7.0 - 0.9 * NEGLIGIBLE_CHANGE, True),
        (7.0 - 1.1 * NEGLIGIBLE_CHANGE, False),
        (12.0, True),
    ):
        assert adapted([10.0, 10.0], [share, 5.0], [1.0, 1.0]) == [
            pytest.approx(1.5 if wider else 1.0),
            1.0,
        ]


def test_less_than_a_quarter_of_the_prediction_shrinks_the_block() -> None:
    for share, narrower in ((2.4, True), (2.6, False), (-3.0, True)):
        expected = SHRINK * 0.8 if narrower else 1.0
        assert adapted([10.0, 10.0], [share, 5.0], [0.8, 0.8]) == [pytest.approx(expected), 1.0]
    for missing, narrower in ((0.9 * NEGLIGIBLE_CHANGE, False), (1.1 * NEGLIGIBLE_CHANGE, True)):
        expected = SHRINK * 0.8 if narrower else 1.0
        assert adapted([0.1, 0.0], [0.1 - missing, 0.0], [0.8, 0.8]) == [
            pytest.approx(expected),
            1.0,
        ]


def test_step_longer_than_the_radius_counts_as_the_radius() -> None:
    assert adapted([10.0, 10.0], [0.0, 10.0], [1.2, 0.5]) == [pytest.approx(SHRINK), 1.0]


def test_rejection_shrinks_all_blocks_unless_one_is_poor() -> None:
    assert adapted([10.0, 10.0], [10.0, 10.0], [1.0, 0.5], accepted=False) == pytest.approx(
        [SHRINK, 0.5 * SHRINK]
    )
    assert adapted([10.0, 10.0], [10.0, 0.0], [1.0, 0.5], accepted=False) == pytest.approx(
        [1.0, 0.5 * SHRINK]
    )
    assert adapted([10.0, 10.0], [10.0, 0.0], [1.0, 0.5], accepted=True) == pytest.approx(
        [1.5, 0.5 * SHRINK]
    )
    assert adapted([10.0, 10.0], [0.0, 0.0], [1.0, 0.5], accepted=False) == pytest.approx(
        [SHRINK, 0.5 * SHRINK]
    )


def test_radii_stay_positive() -> None:
    assert adapted([10.0, 10.0], [0.0, 0.0], [0.0, 1.0]) == pytest.approx([1e-6 / 0.5, SHRINK])


@pytest.mark.parametrize(
    ("promised", "actual", "merit", "accepted"),
    [
        (1.0, 0.051, 5.0, True),
        (1.0, 0.049, 5.0, False),
        (1.0, -1.0, 5.0, False),
        (0.9e-4, -0.9e-4, 0.5, True),  # nothing was to be had, and nothing lost
        (0.9e-4, -1.1e-4, 0.5, False),
        (1.1e-4, 0.0, 0.5, False),
        (0.9e-2, -0.9e-2, 100.0, True),
        (0.9e-2, -0.9e-2, -100.0, True),
        (0.9e-2, -1.1e-2, 100.0, False),
        (1.1e-2, 0.0, 100.0, False),
        (-1.0, 0.0, 1.0, True),
    ],
)
def test_step_acceptance(promised: float, actual: float, merit: float, accepted: bool) -> None:
    assert is_step_acceptable(promised, actual, merit) == accepted


def test_stalling() -> None:
    """The region has stalled if radius or step is small at all violated waypoints."""
    fields: dict[str, Any] = dict.fromkeys(field.name for field in dataclasses.fields(Trial))

    def has_stalled(radius: list[float], step: list[float], short: list[float]) -> bool:
        region = TrustRegion(3, 1, CLEARANCE_TOLERANCE * np.array(radius))
        trial = Trial(**{**fields, "step": CLEARANCE_TOLERANCE * np.array(step)})
        return region.has_stalled(trial, CLEARANCE_TOLERANCE * np.array(short))

    assert has_stalled([9.0, 0.9, 9.0], [9.0, 9.0, 9.0], [0.0, 1.1, 0.0])
    assert has_stalled([9.0, 9.0, 9.0], [9.0, 0.9, 9.0], [0.0, 1.1, 0.0])
    assert not has_stalled([9.0, 1.1, 9.0], [9.0, 1.1, 9.0], [0.0, 1.1, 0.0])
    assert not has_stalled([9.0, 0.9, 9.0], [9.0, 9.0, 9.0], [0.0, 1.1, 1.1])
    assert not has_stalled([9.0, 0.9, 9.0], [9.0, 9.0, 9.0], [0.0, 0.9, 0.0])
    assert has_stalled([0.9, 0.9, 0.9], [9.0, 9.0, 9.0], [0.0, 0.9, 0.0])


def test_limit_and_reset() -> None:
    region = TrustRegion(3, 1, np.array([0.01, SETTLE_RADIUS, 0.3]))
    region.limit()
    np.testing.assert_array_equal(region.radius, [0.01, SETTLE_RADIUS, SETTLE_RADIUS])
    region.reset()
    np.testing.assert_array_equal(region.radius, [FIRST_RADIUS] * 3)


@pytest.mark.parametrize(
    ("segments", "length", "blocks"),
    [
        (1, 10, [1]),
        (4, 10, [4]),
        (14, 10, [14]),
        (16, 10, [8, 8]),
        (6, 2, [2, 2, 2]),
        (7, 2, [2, 2, 2, 1]),
        (5, 1, [1] * 5),
    ],
)
def test_block_sizes(segments: int, length: int, blocks: list[int]) -> None:
    found = TrustRegion(segments, length).block
    assert sorted(np.bincount(found).tolist()) == sorted(blocks)
    assert (np.diff(found) >= 0).all()
    assert found[0] == 0
