"""Tests the steps of wheeled bases against numerically integrated arcs."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.drives import make_hall
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.trajectory.wheels import OMNIDIRECTIONAL, RollingLimits, make_rolling_limits

SPEEDS = st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.6, 0.6)), min_size=1, max_size=8)


def integrate_arcs(speeds: list[tuple[float, float]]) -> np.ndarray:
    """Return poses after arcs of lengths [m] and turns [rad], by small steps."""
    poses = [np.array([0.3, -0.2, 0.9])]
    for length, turn in speeds:
        heading = poses[-1][2] + turn * (np.arange(2000) + 0.5) / 2000
        poses.append(
            poses[-1]
            + np.array([np.cos(heading).mean() * length, np.sin(heading).mean() * length, turn])
        )
    return np.array(poses)


@settings(deadline=None)
@given(SPEEDS)
def test_arcs_do_not_slip_sideways(speeds: list[tuple[float, float]]) -> None:
    """The length of a chord is 2·radius·sin(turn / 2)."""
    along, sideways, turn = RollingLimits.compute_steps(integrate_arcs(speeds))
    lengths, turns = np.array(speeds).T
    np.testing.assert_allclose(sideways, 0.0, atol=1e-6)
    np.testing.assert_allclose(turn, turns, atol=1e-9)
    np.testing.assert_allclose(along, lengths * np.sinc(turns / (2 * np.pi)), atol=1e-6)
    assert RollingLimits().compute_error(integrate_arcs(speeds)) < 1e-6


def test_error_is_the_larger_of_slip_and_turn() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.03, 0.0], [1.1, 0.03, 0.2]])
    assert RollingLimits().compute_error(path) == pytest.approx(0.03)
    assert RollingLimits(turning_radius=0.8).compute_error(path) == pytest.approx(
        0.8 * 0.2 - 0.1 * np.cos(0.1)
    )
    assert OMNIDIRECTIONAL.compute_error(path) == 0.0


def test_gears_persist_at_rest() -> None:
    x = np.cumsum([0.0, 0.0, 0.2, 0.1, 0.0, -0.1, 0.0, 0.00005, 0.3])
    path = np.column_stack([x, 0.0 * x, 0.0 * x])
    car = RollingLimits(turning_radius=1.0)
    for limits, poses, gears in (
        (car, path, [1, 1, 1, 1, -1, -1, -1, 1]),
        (car, -path, [-1, -1, -1, -1, 1, 1, 1, -1]),
        (RollingLimits(), 0.0 * path, [1] * 8),
        (OMNIDIRECTIONAL, -path, [1] * 8),
    ):
        assert limits.compute_gears(poses).tolist() == gears


def test_times_follow_the_faster_wheel() -> None:
    rolling = RollingLimits(track=0.6, wheel_speed=0.5)
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [1.0, 0.0, -1.0]])
    np.testing.assert_allclose(rolling.compute_min_times(path), [2.0, 0.6, 0.0])
    assert rolling.has_wheel_limit
    assert not RollingLimits().has_wheel_limit
    assert not RollingLimits().compute_min_times(path).any()
    assert not OMNIDIRECTIONAL.compute_min_times(path).any()


def test_limits_follow_from_the_robot() -> None:
    assert make_rolling_limits(make_hall().robot) is OMNIDIRECTIONAL
    assert make_rolling_limits(make_hall(base="fixed").robot) is OMNIDIRECTIONAL
    tank, car = (
        make_rolling_limits(make_hall(**robot).robot)
        for robot in ({"base": "differential"}, {"base": "ackermann", "turning_radius": 0.8})
    )
    assert (tank.turning_radius, car.turning_radius) == (0.0, 0.8)
    for limits in (tank, car):
        assert limits.track == pytest.approx(0.5708 * 1.875, abs=1e-3)
        assert limits.wheel_speed == pytest.approx(1.0, rel=1e-3)
