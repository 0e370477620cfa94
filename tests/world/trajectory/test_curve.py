"""Tests curves against SciPy and dense samples."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from vkc_pin.world.trajectory.curve import Curve, concatenate_curves


def sample_curve(seed: int, knots: int = 7, size: int = 3) -> Curve:
    rng = np.random.default_rng(seed)
    times = 2.0 + np.cumsum(rng.uniform(0.1, 1.0, knots))
    return Curve(times, rng.normal(size=(knots, size)), rng.normal(size=(knots, size)))


@given(st.integers(0, 10**6), st.integers(2, 9))
def test_values_and_derivatives_match_scipy(seed: int, knots: int) -> None:
    curve = sample_curve(seed, knots)
    other = CubicHermiteSpline(curve.times, curve.positions, curve.rates)
    sample_times = np.random.default_rng(seed).uniform(curve.times[0], curve.times[-1], 40)
    for order, evaluate in enumerate((curve.at, curve.velocity, curve.acceleration)):
        np.testing.assert_allclose(
            evaluate(sample_times), other(sample_times, order), rtol=0.0, atol=1e-9
        )
        np.testing.assert_allclose(
            evaluate(sample_times[3]), other(sample_times[3], order), rtol=0.0, atol=1e-9
        )
        assert evaluate(sample_times.reshape(8, 5)).shape == (8, 5, 3)


def test_curve_is_at_rest_outside_its_span() -> None:
    curve = sample_curve(1)
    sample_times = np.array([curve.times[0] - 1.0, curve.times[-1] + 1.0])
    np.testing.assert_array_equal(curve.at(sample_times), curve.positions[[0, -1]])
    np.testing.assert_array_equal(curve.velocity(sample_times), 0.0)
    np.testing.assert_array_equal(curve.acceleration(sample_times), 0.0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_extrema_and_rates_bound_dense_samples(seed: int, even: bool) -> None:
    curve = sample_curve(seed)
    if even:  # includes parabolas and straight lines
        chords = np.diff(curve.positions, axis=0) / np.diff(curve.times)[:, None]
        curve = Curve(curve.times, curve.positions, np.vstack([chords, chords[-1:]]))
    low, high = curve.compute_extrema()
    fastest, strongest = curve.compute_max_rates()
    for k, (begin, end) in enumerate(zip(curve.times, curve.times[1:], strict=False)):
        sample_times = np.linspace(begin, end, 2001)[:-1]
        positions, velocities, accelerations = (
            curve.at(sample_times),
            np.abs(curve.velocity(sample_times)),
            np.abs(curve.acceleration(sample_times)),
        )
        np.testing.assert_allclose(
            low[k], np.minimum(positions.min(axis=0), curve.positions[k + 1]), atol=1e-5
        )
        np.testing.assert_allclose(
            high[k], np.maximum(positions.max(axis=0), curve.positions[k + 1]), atol=1e-5
        )
        assert (low[k] <= positions.min(axis=0) + 1e-12).all()
        assert (high[k] >= positions.max(axis=0) - 1e-12).all()
        np.testing.assert_allclose(fastest[k], velocities.max(axis=0), rtol=2e-2, atol=1e-9)
        assert (fastest[k] >= velocities.max(axis=0) - 1e-12).all()
        np.testing.assert_allclose(strongest[k], accelerations.max(axis=0), rtol=2e-2, atol=1e-9)
        assert (strongest[k] >= accelerations.max(axis=0) - 1e-9).all()


def test_concatenated_parts_equal_the_whole() -> None:
    curve = sample_curve(3)
    middle = float(curve.times[3])
    whole = concatenate_curves(
        [curve.part(curve.times[0], middle), curve.part(middle, curve.times[-1]).shift_time(5.0)]
    )
    np.testing.assert_allclose(whole.times, curve.times, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(whole.positions, curve.positions)
    np.testing.assert_array_equal(whole.rates, curve.rates)
    np.testing.assert_array_equal(
        curve.part(curve.times[1], middle, [2, 0]).positions, curve.positions[1:4][:, [2, 0]]
    )


@pytest.mark.parametrize(
    ("arrays", "field"),
    [
        (([0.0, 0.0], np.zeros((2, 1)), np.zeros((2, 1))), "curve.times"),
        (([0.0], np.zeros((1, 1)), np.zeros((1, 1))), "curve.times"),
        (([0.0, np.nan], np.zeros((2, 1)), np.zeros((2, 1))), "curve.times"),
        (([0.0, 1.0], np.zeros((3, 1)), np.zeros((2, 1))), "curve.positions"),
        (([0.0, 1.0], np.zeros((2, 1)), np.zeros((2, 2))), "curve.rates"),
        (([0.0, 1.0], np.zeros((2, 1)), np.full((2, 1), np.inf)), "curve.rates"),
        (([0.0, 1.0], np.full((2, 1), 1e300), np.zeros((2, 1))), "curve.positions"),
        (([0.0, 1.0], "here", np.zeros((2, 1))), "curve.positions"),
    ],
)
def test_invalid_arrays_are_rejected(arrays: tuple[object, object, object], field: str) -> None:
    with expect_error(field=field):
        Curve(*arrays)  # type: ignore[arg-type]


def test_curve_must_pass_through_waypoints() -> None:
    curve = sample_curve(4)
    at = [0, 2, 6]
    curve.check_through(curve.times[at], curve.positions[at])
    with expect_error("a waypoint is none of its knots"):
        curve.check_through(curve.times[[0, 2, 5]], curve.positions[[0, 2, 5]])
    with expect_error("a waypoint is none of its knots"):
        curve.check_through(curve.times[at] + [0.0, 1e-3, 0.0], curve.positions[at])
    with expect_error("does not lead through a waypoint", field="positions[1]"):
        curve.check_through(curve.times[at], curve.positions[at] + [[0.0], [1e-6], [0.0]])
    with expect_error("wrong number of coordinates"):
        curve.check_through(curve.times[at], curve.positions[at][:, :2])
