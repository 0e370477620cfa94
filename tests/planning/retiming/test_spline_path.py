"""Tests paths through waypoints."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from vkc_pin.planning.retiming.spline_path import fit_path

NOWHERE = (np.full(3, -np.inf), np.full(3, np.inf))


def sample_points(seed: int, count: int = 8) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=(count, 3)), axis=0)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 12))
def test_path_without_limits_is_a_natural_spline(seed: int, count: int) -> None:
    waypoints, scale = sample_points(seed, count), np.array([1.0, 0.5, 2.0])
    path = fit_path(waypoints, scale, NOWHERE)
    lengths = np.linalg.norm(scale * np.diff(waypoints, axis=0), axis=1)
    np.testing.assert_allclose(np.diff(path.x), lengths)
    spline = CubicSpline(path.x, waypoints, bc_type="natural")
    along = np.linspace(0.0, path.x[-1], 200)
    np.testing.assert_allclose(path(along), spline(along), atol=1e-9)


def test_linear_constraints_of_waypoints_hold_along_the_path() -> None:
    """The path is linear in the waypoints: zero combinations of coordinates stay zero."""
    waypoints = sample_points(5)
    waypoints[:, 2] = 2.0 * waypoints[:, 0] - waypoints[:, 1]
    path = fit_path(waypoints, np.ones(3), NOWHERE)
    found = path(np.linspace(path.x[0], path.x[-1], 300))
    np.testing.assert_allclose(found[:, 2], 2.0 * found[:, 0] - found[:, 1], atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_path_stays_within_limits(seed: int) -> None:
    waypoints = sample_points(seed)
    lower, upper = waypoints.min(axis=0), waypoints.max(axis=0)
    path = fit_path(waypoints, np.ones(3), (lower, upper))
    found = path(np.linspace(path.x[0], path.x[-1], 500))
    assert (found >= lower - 1e-9).all()
    assert (found <= upper + 1e-9).all()
    np.testing.assert_allclose(path(path.x), waypoints, atol=1e-12)
    outside = fit_path(waypoints, np.ones(3), (lower + 0.1, upper))  # like some starts
    assert outside(np.linspace(path.x[0], path.x[-1], 500)).min() >= waypoints.min() - 1e-9


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.001, 1.0))
def test_coordinates_that_move_together_stay_together_within_limits(
    seed: int, ratio: float
) -> None:
    """The limits of one coordinate must not bend it away from another that it is coupled to."""
    waypoints = sample_points(seed)
    waypoints[1] = waypoints[0] + 1e-3 * (waypoints[1] - waypoints[0])  # tiny, then long steps
    waypoints[:, 2] = -ratio * waypoints[:, 0]
    lower, upper = waypoints.min(axis=0), waypoints.max(axis=0)
    for limits in ((lower, upper), (np.append(lower[:2], -np.inf), np.append(upper[:2], np.inf))):
        path = fit_path(waypoints, np.ones(3), limits)
        found = path(np.linspace(path.x[0], path.x[-1], 300))
        np.testing.assert_allclose(found[:, 2], -ratio * found[:, 0], atol=1e-9)
