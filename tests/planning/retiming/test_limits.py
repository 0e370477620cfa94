"""Tests limits of coordinates and the slowdown they require."""

from __future__ import annotations

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.planning.retiming.limits import Limits
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


def test_wheels_have_velocity_limits() -> None:
    limits = Limits.from_scene(SCENE, NAMES, 0.2).with_wheels(
        RollingLimits(track=0.8, wheel_speed=0.9)
    )
    assert limits.velocity[-2:].tolist() == [0.9, 0.9]
    assert np.isinf(limits.jerk[-2:]).all()


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
