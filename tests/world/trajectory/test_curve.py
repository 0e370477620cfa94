"""Tests curves against SciPy and dense samples."""

from __future__ import annotations

import itertools

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
        for times in (sample_times, sample_times[3]):
            np.testing.assert_allclose(evaluate(times), other(times, order), rtol=0.0, atol=1e-9)
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
    for k, (begin, end) in enumerate(itertools.pairwise(curve.times)):
        sample_times = np.linspace(begin, end, 2001)[:-1]
        positions = np.vstack([curve.at(sample_times), curve.positions[k + 1]])
        lowest, highest = positions.min(axis=0), positions.max(axis=0)
        velocity = np.abs(curve.velocity(sample_times)).max(axis=0)
        acceleration = np.abs(curve.acceleration(sample_times)).max(axis=0)
        for bound, sampled, rounding in (
            (-low[k], -lowest, 1e-12),
            (high[k], highest, 1e-12),
            (fastest[k], velocity, 1e-12),
            (strongest[k], acceleration, 1e-9),
        ):
            assert (bound >= sampled - rounding).all()
        np.testing.assert_allclose([low[k], high[k]], [lowest, highest], atol=1e-5)
        rates = [velocity, acceleration]
        np.testing.assert_allclose([fastest[k], strongest[k]], rates, rtol=2e-2, atol=1e-9)


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


ZEROS = np.zeros((2, 1))


@pytest.mark.parametrize(
    ("arrays", "field"),
    [
        (([0.0, 0.0], ZEROS, ZEROS), "curve.times"),
        (([0.0], ZEROS[:1], ZEROS[:1]), "curve.times"),
        (([0.0, np.nan], ZEROS, ZEROS), "curve.times"),
        (([0.0, 1.0], np.zeros((3, 1)), ZEROS), "curve.positions"),
        (([0.0, 1.0], ZEROS, np.zeros((2, 2))), "curve.rates"),
        (([0.0, 1.0], ZEROS, ZEROS + np.inf), "curve.rates"),
        (([0.0, 1.0], ZEROS + 1e300, ZEROS), "curve.positions"),
        (([0.0, 1.0], "here", ZEROS), "curve.positions"),
    ],
)
def test_invalid_arrays_are_rejected(arrays: tuple[object, object, object], field: str) -> None:
    with expect_error(field=field):
        Curve(*arrays)  # type: ignore[arg-type]


def test_curve_must_pass_through_waypoints() -> None:
    curve = sample_curve(4)
    at = [0, 2, 6]
    times, positions = curve.times[at], curve.positions[at]
    curve.check_through(times, positions)
    for other_times, other_positions, message in (
        (curve.times[[0, 2, 5]], curve.positions[[0, 2, 5]], "a waypoint is none of its knots"),
        (times + np.array([0.0, 1e-3, 0.0]), positions, "a waypoint is none of its knots"),
        (
            times,
            positions + np.array([[0.0], [1e-6], [0.0]]),
            r"positions\[1\]: .*does not lead through a waypoint",
        ),
        (times, positions[:, :2], "wrong number of coordinates"),
    ):
        with expect_error(message):
            curve.check_through(other_times, other_positions)
