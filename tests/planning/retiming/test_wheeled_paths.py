"""Tests that a base rolls along fitted paths without slip."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from helpers.drives import make_hall, make_trajectory
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.wheeled_paths import fit_rolling_paths
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import RollingLimits

FAR = np.full(4, -np.inf), np.full(4, np.inf)
STEPS = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.4, 0.4)), min_size=1, max_size=8)
SCALE = np.array([1.0, 1.0, 0.5, 0.3])
TANK = RollingLimits(track=1.0, wheel_speed=1.0)


def make_arcs(
    steps: list[tuple[float, float]], *, start: Sequence[float] = (0.3, -0.2, 0.9)
) -> np.ndarray:
    """Return poses reached by arcs of given lengths [m] and turns [rad], and another coordinate."""
    poses = [np.array([*start, 0.0])]
    for length, turn in steps:
        displacement = length * np.sinc(turn / (2 * np.pi)) * np.exp(1j * (poses[-1][2] + turn / 2))
        poses.append(poses[-1] + [displacement.real, displacement.imag, turn, 0.1])
    return np.array(poses)


def compute_slip(path: np.ndarray, slopes: np.ndarray) -> float:
    """Return the largest lateral displacement per path length."""
    aside = np.cos(path[:, 2]) * slopes[:, 1] - np.sin(path[:, 2]) * slopes[:, 0]
    return float(np.abs(aside).max())


@settings(deadline=None)
@given(STEPS)
def test_base_rolls_through_waypoints_on_arcs(steps: list[tuple[float, float]]) -> None:
    points = make_arcs(steps)
    passed = [points[:1]]
    for path, own in fit_rolling_paths(points, SCALE, FAR, TANK):
        knots = (len(path.x) - 1) // (len(own) - 1)
        np.testing.assert_allclose(path(path.x[::knots])[:, :4], own, atol=2e-5)
        at_knots = path(path.x)
        assert compute_slip(at_knots, path(path.x, 1)) < 1e-9
        wheels = at_knots[:, 5] - at_knots[:, 4]
        np.testing.assert_allclose(wheels, 1.0 * at_knots[:, 2], atol=1e-9)
        np.testing.assert_array_equal(own[0], passed[-1][-1])
        passed.append(own[1:])
    np.testing.assert_array_equal(np.concatenate(passed), points)


@pytest.mark.parametrize("size", [5e-4, 1e-3, 2e-3, 5e-3])
def test_short_steps_do_not_sway(size: float) -> None:
    """A millimetre of base motion must not turn a hand at 1 m by more than a grasp may drift."""
    lengths = size * np.array([0.7, 1.0, 1.4, 1.7, 2.0, 2.1])
    turns = np.array([3.3, 4.4, 4.4, 3.9, 4.0, 5.5]) * 1e-3
    points = make_arcs(list(zip(lengths.tolist(), turns.tolist(), strict=True)))
    points[:, 3] = np.cumsum([0.0, 0.006, 0.077, 0.117, 0.129, 0.117, 0.08])  # the arm's
    for path, own in fit_rolling_paths(points, SCALE, FAR, TANK):
        along = np.linspace(path.x[0], path.x[-1], 400)
        ends = path.x[:: (len(path.x) - 1) // (len(own) - 1)]
        step = np.clip(np.searchsorted(ends, along, side="right") - 1, 0, len(own) - 2)
        low = np.minimum(own[step, 2], own[step + 1, 2])
        high = np.maximum(own[step, 2], own[step + 1, 2])
        yaw = path(along)[:, 2]
        assert np.maximum(yaw - high, low - yaw).max() < 1e-3


def make_smooth_drive(count: int) -> np.ndarray:
    """Return poses on a winding curve of small arcs that turns in place and reverses."""
    s = np.linspace(0.0, 1.0, 3000 * count + 1)
    speed, turn = 2.0 * np.cos(1.5 * np.pi * s), 2.0 * np.sin(4.0 * s)
    yaw = np.concatenate([[0.0], np.cumsum((turn[1:] + turn[:-1]) / 2 * np.diff(s))])
    moving = speed * np.exp(1j * yaw)
    place = np.concatenate([[0.0], np.cumsum((moving[1:] + moving[:-1]) / 2 * np.diff(s))])
    return np.column_stack([place.real, place.imag, yaw, s])[::3000]


def test_paths_between_waypoints_roll() -> None:
    """A path through every second waypoint passes the others closely; splines would slip."""
    fine = make_smooth_drive(40)
    ((path, own),) = fit_rolling_paths(fine[::2], SCALE, FAR, TANK)
    assert len(own) == 21
    dense = np.linspace(0.0, path.x[-1], 4000)
    found, slopes = path(dense), path(dense, 1)
    away = np.abs(found[:, None, :3] - fine[None, 1::2, :3]).max(axis=2).min(axis=0)
    assert away.max() < 3e-3
    spline = fit_path(fine[::2], SCALE, FAR)
    assert compute_slip(found, slopes) < 1e-3
    assert compute_slip(spline(dense), spline(dense, 1)) > 5.0 * compute_slip(found, slopes)


@pytest.mark.parametrize(
    ("steps", "stops"),
    [
        ([(0.2, -0.1998)] * 5 + [(0.2, 0.1998)] * 5, 1),  # between opposite smallest circles
        ([(0.2, 0.0)] * 5 + [(0.2, 0.1998)] * 5, 0),
        ([(0.2, -0.111)] * 5 + [(0.2, 0.111)] * 5, 0),
        ([(k, k) for k in (0.02, 0.06, 0.1, 0.12, 0.12, 0.1, 0.05, 0.02)], 0),
        ([(1.2e-3, 1.05e-3)] * 6, 0),
    ],
)
def test_steered_base_stops_only_where_turns_would_be_too_tight(
    steps: list[tuple[float, float]], stops: int
) -> None:
    """Errors of a micrometre are no reason to stop."""
    points = make_arcs(steps)
    noise = np.random.default_rng(0).uniform(-3e-7, 3e-7, (len(points) - 2, 2))
    points[1:-1, :2] += noise if len(points) == 7 else 0.0
    paths = fit_rolling_paths(points, SCALE, FAR, RollingLimits(turning_radius=1.0))
    assert len(paths) == 1 + stops
    for path, _ in paths:
        dense = np.linspace(0.0, path.x[-1], 3000)
        rates, yaw = path(dense, 1), path(dense)[:, 2]
        along = np.cos(yaw) * rates[:, 0] + np.sin(yaw) * rates[:, 1]
        assert (np.abs(rates[:, 2]) <= np.abs(along) * (1.02 if len(points) == 7 else 1.001)).all()


SCENES = {
    "differential": make_hall(base="differential"),
    "ackermann": make_hall(base="ackermann", turning_radius=0.8),
}


def make_drive(base: str) -> Trajectory:
    scene = SCENES[base]
    steps = [(0.2, 0.0), (0.25, 0.1), (0.25, 0.2), (0.25, 0.25), (-0.1, 0.05), (-0.25, -0.2)]
    rows = np.tile(scene.start, (len(steps) + 1, 1))
    rows[:, :3] = make_arcs(steps, start=[0.0, 0.0, 0.0])[:, :3]
    rows[:, 3] += np.linspace(0.0, 0.4, len(rows))
    return retime_trajectory(scene, make_trajectory(scene, rows, dt=1.0))


@pytest.mark.parametrize("base", ["differential", "ackermann"])
def test_trajectories_roll_within_wheel_limits(base: str) -> None:
    """The limits also hold with points added on the arcs between waypoints."""
    motion, wheels = make_drive(base), vkc.load_robot("husky_ur5e", base="differential").wheels
    assert wheels is not None
    for trajectory in (
        motion,
        retime_trajectory(SCENES[base], motion, np.array([1, 2, 4, 1, 1, 2])),
    ):
        times = np.arange(trajectory.times[0], trajectory.times[-1], 1e-3)
        (vx, vy, turn), yaw = trajectory.velocity(times)[:, :3].T, trajectory(times)[:, 2]
        along, aside = np.cos(yaw) * vx + np.sin(yaw) * vy, np.cos(yaw) * vy - np.sin(yaw) * vx
        assert np.abs(aside).max() < 3e-4
        speeds = np.abs(along) + wheels.track / 2 * np.abs(turn)
        assert speeds.max() <= wheels.rim_speed * (1.0 + 1e-4)
        np.testing.assert_allclose(trajectory(trajectory.times), motion.positions, atol=1e-12)
        if base == "ackermann":
            assert (0.8 * np.abs(turn) - np.abs(along)).max() < 1e-3
