from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import PchipInterpolator

from vkc_pin.motion.ros import along, rates

COLUMNS = arrays(float, st.tuples(st.integers(2, 8), st.integers(1, 3)), elements=st.floats(-10.0, 10.0))


def some(rng: np.random.Generator, n: int = 9) -> tuple[np.ndarray, np.ndarray]:
    return np.cumsum(rng.uniform(0.1, 0.5, n)), np.cumsum(rng.uniform(-0.2, 0.5, (n, 4)), axis=0)


def test_velocities_inside_are_those_of_scipys_monotone_cubic() -> None:
    times, positions = some(np.random.default_rng(0))
    velocities, _ = rates(times, positions)
    np.testing.assert_allclose(velocities[1:-1], PchipInterpolator(times, positions).derivative()(times)[1:-1], atol=1e-12)
    assert (velocities[[0, -1]] == 0.0).all()


def test_velocities_and_accelerations_are_the_derivatives_of_a_smooth_motion() -> None:
    times = np.linspace(0.2, 1.2, 101)
    velocities, accelerations = rates(times, np.sin(times)[:, None])
    np.testing.assert_allclose(velocities[1:-1, 0], np.cos(times)[1:-1], atol=1e-4)
    np.testing.assert_allclose(accelerations[1:-1, 0], -np.sin(times)[1:-1], atol=1e-4)


def test_between_waypoints_the_derivatives_belong_to_the_positions() -> None:
    times, positions = some(np.random.default_rng(1))
    velocities, _ = rates(times, positions)
    moments = np.linspace(times[0] + 0.01, times[-1] - 0.01, 57)
    moments = moments[np.abs(moments[:, None] - times).min(axis=1) > 1e-4]
    step = 1e-5
    before, here, after = (along(times, positions, velocities, moments + d) for d in (-step, 0.0, step))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), here[1], atol=1e-6)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * step), here[2], atol=1e-4)


def test_it_passes_the_waypoints_with_their_velocities() -> None:
    times, positions = some(np.random.default_rng(2))
    velocities, _ = rates(times, positions)
    place, speed, _ = along(times, positions, velocities, times)
    np.testing.assert_array_equal(place, positions)
    np.testing.assert_allclose(speed, velocities, atol=1e-12)


@given(COLUMNS, st.integers(0, 1000))
def test_no_coordinate_leaves_the_range_between_two_waypoints(positions: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 2.0, len(positions)))
    velocities, accelerations = rates(times, positions)
    assert np.isfinite(velocities).all()
    assert np.isfinite(accelerations).all()
    moments = np.sort(rng.uniform(times[0], times[-1], 50))
    place, _, _ = along(times, positions, velocities, moments)
    at = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    assert (place >= np.minimum(positions[at], positions[at + 1])).all()
    assert (place <= np.maximum(positions[at], positions[at + 1])).all()


def test_what_rests_stays_at_rest() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    positions = np.array([[0.0], [1.0], [1.0], [1.0], [0.5]])
    velocities, accelerations = rates(times, positions)
    assert (velocities == 0.0).all()
    assert (accelerations == 0.0).all(), "it turns round where it rests"
    place, speed, change = along(times, positions, velocities, np.linspace(1.0, 2.99, 20))
    assert (place == 1.0).all()
    assert (speed == 0.0).all()
    assert (change == 0.0).all()


def test_a_turn_without_a_rest_has_an_acceleration() -> None:
    velocities, accelerations = rates(np.array([0.0, 1.0, 2.0]), np.array([[0.0], [1.0], [0.0]]))
    assert velocities[1, 0] == 0.0
    assert accelerations[1, 0] == pytest.approx(-2.0)
