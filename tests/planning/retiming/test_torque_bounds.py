"""Tests how torque limits bound the speed along a path."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.door_closers import load_door_with_closer
from helpers.executions import plan_door
from scipy.interpolate import CubicHermiteSpline

from vkc_pin.planning.retiming.torque_bounds import TorqueBounds
from vkc_pin.world.trajectory.torques import Torques


def make_opening(**resistance: float) -> tuple[TorqueBounds, CubicHermiteSpline]:
    """Return the bounds of the last phase, in which the door opens, and its path over time."""
    plan, scene = plan_door(), load_door_with_closer(**resistance)
    phase = plan.trajectory.phases[-1]
    rows = slice(phase.first + 1, phase.last + 1)
    times, points = plan.trajectory.times[rows], plan.trajectory.positions[rows]
    path = CubicHermiteSpline(times - times[0], points, plan.trajectory.velocity(times))
    bounds = TorqueBounds(
        Torques(scene, plan.trajectory), np.full(len(times) - 1, len(plan.trajectory.phases) - 1)
    )
    return bounds, path


@pytest.mark.parametrize(("speed", "change"), [(0.3, 0.0), (1.0, -0.7), (1.8, 0.4)])
def test_linearized_torques_equal_torques(speed: float, change: float) -> None:
    bounds, path = make_opening(damping=200.0, friction=4.0, stiffness=5.0, springref=-2.0)
    places = np.linspace(path.x[2], path.x[-3], 5)
    push, square, rest = bounds.linearize(path, path.x, np.full(len(path.x), speed), places)
    tangents, bends = path(places, 1), path(places, 2)
    segments = np.searchsorted(path.x, places, side="right") - 1
    direct = bounds._compute_ratios(
        segments,
        len(path.x) - 1,
        path(places),
        speed * tangents,
        speed**2 * bends + change * tangents,
    )
    np.testing.assert_allclose(push * change + square * speed**2 + rest, direct, atol=1e-9)


def test_curve_is_slowed_down_to_the_torque_limit() -> None:
    bounds, _ = make_opening(damping=500.0)
    plan = plan_door()
    phase = plan.trajectory.phases[-1]
    assert plan.trajectory.curve is not None
    curve = plan.trajectory.curve.part(*plan.trajectory.times[[phase.first + 1, phase.last]])
    bounds = TorqueBounds(
        Torques(load_door_with_closer(damping=500.0), plan.trajectory), bounds._phases
    )
    assert np.abs(bounds.evaluate(curve)).max() > 1.01
    slower = bounds.slow_down(curve)
    assert np.abs(bounds.evaluate(slower)).max() == pytest.approx(1.0, abs=1e-6)
    assert slower.times[-1] - slower.times[0] > 1.01 * (curve.times[-1] - curve.times[0])
    assert bounds.slow_down(slower) is slower


def test_curve_beyond_torque_limits_at_rest_is_not_slowed_down() -> None:
    bounds, _ = make_opening()
    plan = plan_door()
    phase = plan.trajectory.phases[-1]
    assert plan.trajectory.curve is not None
    curve = plan.trajectory.curve.part(*plan.trajectory.times[[phase.first + 1, phase.last]])
    heavy = TorqueBounds(
        Torques(load_door_with_closer(stiffness=300.0, springref=-2.0), plan.trajectory),
        bounds._phases,
    )
    assert heavy.slow_down(curve) is curve
