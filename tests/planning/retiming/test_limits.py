"""Tests limits of coordinates and of jerk, and the slowdown they require."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.planning.retiming.limits import Limits, limit_jerk
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.wheels import RollingLimits

SCENE = vkc.load_scene("drawer")
NAMES = (*SCENE.robot.coordinates.names, "drawer.slide", "drawer.handle")


def test_limits_are_those_of_robot_and_objects() -> None:
    limits = Limits.from_scene(SCENE, NAMES, 0.2)
    size = len(SCENE.robot.coordinates.names)
    np.testing.assert_array_equal(limits.velocity[:size], SCENE.robot.velocity)
    drawer = SCENE.objects["drawer"].object
    assert limits.acceleration[size] == drawer.acceleration[0]
    assert np.isinf(limits.velocity[-1])
    np.testing.assert_allclose(limits.jerk, limits.acceleration / 0.2)
    assert Limits.from_scene(SCENE, NAMES, 0.0).has_unlimited_jerk
    assert not limits.has_unlimited_jerk
    with_wheels = limits.with_wheels(RollingLimits(track=0.8, wheel_speed=0.9))
    assert with_wheels.velocity[-2:].tolist() == [0.9, 0.9]
    assert np.isinf(with_wheels.jerk[-2:]).all()


@pytest.mark.parametrize(
    ("velocity", "acceleration", "jerk", "factor"),
    [
        (0.5, 100.0, np.inf, 3.0),
        (9.0, 1.5, np.inf, 2.0),
        (9.0, 99.0, 1.5, 2.0),
        (9.0, 99.0, 99.0, 1.0),
    ],
)
def test_curves_are_slowed_down_to_their_limits(
    velocity: float, acceleration: float, jerk: float, factor: float
) -> None:
    """The curve is 3s² − 2s³: a velocity of 1.5, an acceleration of 6 and a jerk of 12."""
    curve = Curve(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]), np.zeros((2, 1)))
    wide = np.array([np.inf])
    limits = Limits(-wide, wide, *(np.array([value]) for value in (velocity, acceleration, jerk)))
    assert limits.slow_down(curve).times[-1] == pytest.approx(factor, rel=1e-8)


def make_path(points: np.ndarray, jerk: float) -> tuple[CubicPath, Curve, Limits]:
    """Return a path through points, the fastest pace along it, and the limits."""
    wide = np.full(points.shape[1], 10.0)
    limits = Limits(-wide, wide, 0.1 * wide, 0.2 * wide, np.full(len(wide), jerk))
    path = fit_path(points, np.ones(len(wide)), (-wide, wide))
    places = np.unique(np.concatenate([np.linspace(0.0, path.x[-1], 60), path.x]))
    speeds = compute_speeds(path, places, limits.velocity, limits.acceleration)
    assert speeds is not None
    times = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(places) / (speeds[1:] + speeds[:-1]))])
    return path, Curve(times, places[:, None], speeds[:, None]), limits


def sample_points(count: int, size: int, *, lowest: float = 0.1) -> np.ndarray:
    steps = np.random.default_rng(4).uniform(lowest, 0.4, (count, size))
    return np.cumsum(steps, axis=0)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.floats(2.0, 200.0))
def test_limits_are_kept_exactly_and_acceleration_is_continuous(
    seed: int, count: int, jerk: float
) -> None:
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3))
    path, pace, limits = make_path(points, jerk)
    curve = limit_jerk(path, pace, count - 1, limits)
    fastest, strongest = curve.compute_max_rates()
    jerks, jumps = curve.compute_jerks()
    assert 0.9 <= max(fastest.max(), strongest.max() / 2.0, jerks.max() / jerk) <= 1.0 + 1e-6
    assert jumps.max() < 1e-5
    assert not curve.rates[[0, -1]].any()
    step = (len(curve.times) - 1) // (count - 1)
    np.testing.assert_allclose(curve.positions[::step], points, atol=1e-8)


def test_large_jerk_limits_cost_little_time() -> None:
    path, pace, limits = make_path(sample_points(12, 3), 2000.0)
    fast, slower, slowest = (
        limit_jerk(path, pace, 11, limits._replace(jerk=np.full(3, jerk))).times[-1]
        for jerk in (2000.0, 40.0, 10.0)
    )
    assert fast <= slower <= slowest
    assert fast <= 1.03 * pace.times[-1]


def test_coordinates_without_limits_cause_no_warning() -> None:
    """Wheeled bases have coordinates whose accelerations and jerks are unlimited."""
    path, pace, limits = make_path(sample_points(5, 2), 20.0)
    unlimited = np.array([1.0, np.inf])
    free = limits._replace(
        acceleration=limits.acceleration * unlimited, jerk=limits.jerk * unlimited
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        curve = limit_jerk(path, pace, 4, free)
    assert curve.compute_jerks()[0][:, 0].max() <= 20.0 * (1.0 + 1e-6)


def test_curve_stays_on_the_path() -> None:
    path, pace, limits = make_path(sample_points(10, 2, lowest=-0.3), 20.0)
    curve = limit_jerk(path, pace, 9, limits)
    along = path(np.linspace(0.0, path.x[-1], 20_000))
    for point in curve.at(np.linspace(0.0, curve.times[-1], 300)):
        assert np.linalg.norm(along - point, axis=1).min() < 2e-3
