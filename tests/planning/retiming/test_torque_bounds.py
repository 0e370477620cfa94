"""Tests how torque limits bound the speed along a path."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.door_closers import load_door_with_closer
from helpers.executions import plan_door

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.planning.retiming.topp_ra import PathSamples
from vkc_pin.planning.retiming.torque_bounds import TorqueBounds
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.torques import Torques


def make_opening(**resistance: float) -> tuple[Torques, TorqueBounds, Curve]:
    """Return torques and bounds of the last phase, in which the door opens, and its curve."""
    motion = plan_door().trajectory
    first, last = motion.phases[-1].first + 1, motion.phases[-1].last
    assert motion.curve is not None
    torques = Torques(load_door_with_closer(**resistance), motion)
    bounds = TorqueBounds(torques, np.full(last - first, len(motion.phases) - 1))
    return torques, bounds, motion.curve.part(*motion.times[[first, last]])


@pytest.mark.parametrize(("speed", "change"), [(0.3, 0.0), (1.0, -0.7), (1.8, 0.4)])
def test_linearized_torques_equal_torques(speed: float, change: float) -> None:
    torques, bounds, curve = make_opening(
        damping=200.0, friction=4.0, stiffness=5.0, springref=-2.0
    )
    path = CubicPath(curve.times - curve.times[0], curve.positions, curve.rates)
    samples = PathSamples.from_positions(path, path.x)
    count = len(samples.positions)
    path_torques = bounds.evaluate_along_path(path, samples)
    push, square, rest = path_torques.linearize(np.full(count, speed))
    points, tangents, bends = (path(samples.positions, order, samples.cubics) for order in range(3))
    phases = np.full(count, len(torques.trajectory.phases) - 1)
    accelerations = speed**2 * bends + change * tangents
    direct = torques.at(phases, points, speed * tangents, accelerations)
    limits = torques.torque_limits.limits
    expected = (direct / limits)[:, np.isfinite(limits)]
    np.testing.assert_allclose(push * change + square * speed**2 + rest, expected, atol=1e-9)


def test_curve_is_slowed_down_to_the_torque_limit() -> None:
    _, bounds, curve = make_opening(damping=500.0)
    assert np.abs(bounds.evaluate(curve)).max() > 1.01
    slower = bounds.slow_down(curve)
    assert np.abs(bounds.evaluate(slower)).max() == pytest.approx(1.0, abs=1e-6)
    assert np.ptp(slower.times) > 1.01 * np.ptp(curve.times)
    assert bounds.slow_down(slower) is slower


def test_curve_beyond_torque_limits_at_rest_is_not_slowed_down() -> None:
    _, bounds, curve = make_opening(stiffness=300.0, springref=-2.0)
    assert bounds.slow_down(curve) is curve
