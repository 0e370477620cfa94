"""Tests curves that brake from a velocity, and that accelerate to one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.retiming.braking import make_accelerating_curve, make_braking_curve
from vkc_pin.planning.retiming.limits import Limits
from vkc_pin.planning.retiming.wheeled_paths import compute_slip
from vkc_pin.world.trajectory.wheels import OMNIDIRECTIONAL, RollingLimits

WHEELS = RollingLimits(track=0.5, wheel_speed=2.0)
FAR = np.full(4, 1e3)
ACCELERATION = np.array([3.0, 3.0, 6.0, 1.4])


def make_limits(jerk_time: float) -> Limits:
    jerk = ACCELERATION / jerk_time if jerk_time else np.full(4, np.inf)
    return Limits(-FAR, FAR, np.full(4, 2.0), ACCELERATION, jerk)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1]))
def test_robot_brakes_within_its_limits(seed: int, jerk_time: float) -> None:
    rng = np.random.default_rng(seed)
    position, velocity = rng.normal(size=4), rng.uniform(-1.0, 1.0, 4)
    limits = make_limits(jerk_time)
    curve = make_braking_curve(position, velocity, limits, OMNIDIRECTIONAL)
    np.testing.assert_array_equal(curve.positions[0], position)
    np.testing.assert_array_equal(curve.rates[0], velocity)
    np.testing.assert_array_equal(curve.rates[-1], 0.0)
    assert limits.compute_slowdown(curve) <= 1.0 + 1e-8
    np.testing.assert_allclose(curve.positions[-1] - position, velocity * curve.times[-1] / 2.0)
    if jerk_time:
        _, jumps = curve.compute_jerks()
        assert jumps.max() < 1e-9
    else:  # as fast as possible
        assert limits.compute_slowdown(curve) == pytest.approx(1.0)
        assert curve.compute_max_rates()[1].max() > 0.99 * (ACCELERATION.min())


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1]))
def test_wheels_brake_along_an_arc(seed: int, jerk_time: float) -> None:
    rng = np.random.default_rng(seed)
    yaw, along = rng.uniform(-3.0, 3.0), rng.uniform(-0.8, 0.8)
    position = np.array([1.0, 2.0, yaw, 0.3])
    velocity = np.array([along * np.cos(yaw), along * np.sin(yaw), rng.uniform(-1.0, 1.0), 0.2])
    limits = make_limits(jerk_time)
    curve = make_braking_curve(position, velocity, limits, WHEELS)
    np.testing.assert_allclose(curve.rates[0], velocity, atol=1e-12)
    np.testing.assert_array_equal(curve.rates[-1], 0.0)
    assert limits.compute_slowdown(curve) <= 1.0 + 1e-7
    assert compute_slip(curve) < 1e-4
    np.testing.assert_allclose(curve.velocity(curve.times), curve.rates, atol=1e-12)


def test_acceleration_is_reversed_braking() -> None:
    position, velocity = np.arange(4.0), np.array([0.2, -0.1, 0.0, 0.3])
    curve = make_accelerating_curve(position, velocity, make_limits(0.1), OMNIDIRECTIONAL)
    assert curve.times[0] == 0.0
    np.testing.assert_array_equal(curve.positions[-1], position)
    np.testing.assert_array_equal(curve.rates[-1], velocity)
    np.testing.assert_array_equal(curve.rates[0], 0.0)
    middle = curve.at(0.5 * (curve.times[1:] + curve.times[:-1]))
    assert (np.diff(middle @ velocity) > 0.0).all()
