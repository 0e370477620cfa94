"""Tests retimed trajectories against their limits, at a thousand samples per second."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from helpers.small_problems import load_door_scene

import vkc_pin as vkc
from vkc_pin.planning.retiming.limits import Limits
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.world.trajectory.trajectory import Trajectory

SCENE = load_door_scene()


def check_limits(motion: Trajectory, *, scene: vkc.Scene = SCENE, tolerance: float = 1e-5) -> None:
    times = np.arange(motion.times[0], motion.times[-1], 1e-3)
    lower, upper, velocity, acceleration, _ = Limits.from_scene(scene, motion.names, 0.0)
    places, rates = motion(times), motion.velocity(times + 5e-4)[:-1]
    assert (places >= lower - tolerance).all()
    assert (places <= upper + tolerance).all()
    assert (np.abs(motion.velocity(times)) <= velocity * (1 + 1e-6)).all()
    assert (np.abs(motion.acceleration(times)) <= acceleration * (1 + 1e-6)).all()
    np.testing.assert_allclose(np.diff(places, axis=0) / 1e-3, rates, atol=1e-3)
    np.testing.assert_array_equal(motion.velocity(motion.times[[0, -1]]), 0.0)


def sample_trajectory(seed: int = 0, count: int = 12) -> Trajectory:
    """Return a trajectory of the robot through random waypoints near its start."""
    start, robot = np.asarray(SCENE.start), SCENE.robot
    steps = 0.2 * np.random.default_rng(seed).normal(size=(count, len(start)))
    rows = start + np.vstack([np.zeros(len(start)), np.cumsum(steps, axis=0)])
    rows = np.clip(rows, robot.lower, robot.upper)
    phases = (vkc.PhaseSpan("go", 0, count),)
    return Trajectory(robot.coordinates.names, np.arange(count + 1.0), rows, phases, len(start))


@pytest.mark.parametrize("seed", range(3))
def test_limits_hold_between_random_waypoints(seed: int) -> None:
    """Sharp turns near position limits may exceed them slightly."""
    slow = sample_trajectory(seed)
    motion = retime_trajectory(SCENE, slow)
    np.testing.assert_array_equal(motion.positions, slow.positions)
    np.testing.assert_allclose(motion(motion.times), slow.positions, atol=1e-12)
    check_limits(motion, tolerance=1e-3)


def test_steps_without_motion_are_waits() -> None:
    slow = sample_trajectory()
    rows = np.insert(slow.positions, 6, slow.positions[6], axis=0)
    spans = (vkc.PhaseSpan("reach", 0, 6), vkc.PhaseSpan("hold", 6, 13))
    times = np.concatenate([np.arange(7.0), [6.7], np.arange(7.7, 13.0)])
    slow = dataclasses.replace(slow, times=times, positions=rows, phases=spans)
    motion = retime_trajectory(SCENE, slow)
    assert motion.times[7] - motion.times[6] == pytest.approx(0.7)
    inside = np.linspace(motion.times[6], motion.times[7], 50)
    np.testing.assert_allclose(motion.velocity(inside), 0.0, atol=1e-12)
    check_limits(motion)
    one = retime_trajectory(SCENE, dataclasses.replace(slow, phases=(vkc.PhaseSpan("go", 0, 13),)))
    assert one.times[7] - one.times[6] < 0.01


def test_stationary_trajectory_is_kept() -> None:
    still = sample_trajectory()
    still = dataclasses.replace(still, positions=np.tile(still.positions[:1], (13, 1)))
    motion = retime_trajectory(SCENE, still)
    assert motion.times[-1] == pytest.approx(1.0, abs=0.05)
    places = motion(np.linspace(0.0, 1.0, 30))
    np.testing.assert_allclose(places - still.positions[0], 0.0, atol=1e-12)


def test_more_parts_keep_the_path_straighter() -> None:
    slow = sample_trajectory(5)
    deviations = []
    for parts in (1, 8):
        motion = retime_trajectory(SCENE, slow, np.full(12, parts))
        np.testing.assert_array_equal(motion.positions, slow.positions)
        fine = motion(np.linspace(motion.times[4], motion.times[5], 200))
        step = slow.positions[5] - slow.positions[4]
        along = np.clip((fine - slow.positions[4]) @ step / (step @ step), 0.0, 1.0)
        deviations.append(np.abs(fine - slow.positions[4] - along[:, None] * step).max())
        check_limits(motion)
    assert deviations[-1] < 0.2 * deviations[0]


def test_planned_motion_keeps_its_limits(door_plan: vkc.Plan) -> None:
    """The hinge rests while the knob turns, and the arm stops between the two."""
    motion = door_plan.trajectory
    check_limits(motion, scene=door_plan.scene)
    assert door_plan.success
    assert door_plan.report.closure_error < 1e-3
    turn = next(phase for phase in motion.phases if phase.name.startswith("turn"))
    inside = np.linspace(motion.times[turn.first], motion.times[turn.last], 200)
    hinge = motion(inside)[:, motion.names.index("door.hinge")]
    assert np.ptp(hinge) < 1e-9
    assert np.abs(motion.velocity(motion.times[turn.last])).max() < 1e-6


def test_velocity_constraints_prevent_retiming() -> None:
    limit = vkc.Constraint("gently", lambda s: ca.norm_2(s.velocity("base_link")), upper=0.3)
    plan = vkc.plan(load_door_scene(), [vkc.GoTo(0.5, 0.2)], terms=[limit])
    assert plan.success, plan.summary()
    assert plan.trajectory.curve is None


@pytest.mark.parametrize("jerk_time", [0.02, 0.5])
@pytest.mark.parametrize("gap", [0.0, 1e-6, 2e-6, 1e-5, 3e-4])
def test_tiny_step_costs_no_more_than_a_stop(gap: float, jerk_time: float) -> None:
    """A waypoint beside another does not slow down the motion, even with small jerk limits."""
    slow = sample_trajectory()
    rows = np.insert(slow.positions, 6, slow.positions[6], axis=0)
    rows[7, 5] += gap
    phases = (vkc.PhaseSpan("go", 0, 13),)
    twice = dataclasses.replace(slow, times=np.arange(14.0), positions=rows, phases=phases)
    once = retime_trajectory(SCENE, slow, jerk_time=jerk_time)
    motion = retime_trajectory(SCENE, twice, jerk_time=jerk_time)
    np.testing.assert_array_equal(motion.positions, rows)
    assert motion.times[-1] <= once.times[-1] + 2.0 + 2.0 * jerk_time
    limits = Limits.from_scene(SCENE, motion.names, jerk_time)
    assert limits.compute_slowdown(motion.curve) <= 1.0 + 1e-6  # type: ignore[arg-type]


@pytest.mark.parametrize("jerk_time", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_motion_has_the_given_velocities_at_its_ends(seed: int, jerk_time: float) -> None:
    slow = sample_trajectory(seed)
    robot = SCENE.robot
    velocities = np.random.default_rng(seed).uniform(-0.2, 0.2, (2, len(slow.names)))
    motion = retime_trajectory(SCENE, slow, jerk_time=jerk_time, end_velocities=velocities)
    np.testing.assert_array_equal(motion.positions, slow.positions)
    assert motion.curve is not None
    np.testing.assert_allclose(motion.curve.rates[[0, -1]], velocities, atol=1e-12)
    speeds, accelerations = motion.curve.compute_max_rates()
    assert (speeds <= robot.velocity * (1.0 + 1e-6)).all()
    assert (accelerations <= robot.acceleration * (1.0 + 1e-6)).all()
    if jerk_time:
        jerks, jumps = motion.curve.compute_jerks()
        assert (jerks <= robot.acceleration / jerk_time * (1.0 + 1e-6)).all()
        assert (jumps < 1e-4 * robot.acceleration).all()


def test_moving_start_along_the_path_needs_no_stop() -> None:
    """A motion that continues one of constant velocity does not brake first."""
    start = np.asarray(SCENE.start)
    velocity = np.zeros((2, len(start)))
    velocity[:, 0] = 0.5
    rows = start + np.outer(np.linspace(0.0, 1.0, 9), np.eye(len(start))[0])
    phases = (vkc.PhaseSpan("go", 0, 8),)
    slow = Trajectory(SCENE.robot.coordinates.names, np.arange(9.0), rows, phases, len(start))
    motion = retime_trajectory(SCENE, slow, end_velocities=velocity)
    assert motion.velocity(np.linspace(0.0, motion.times[-1], 100))[:, 0].min() > 0.49


def test_moving_start_of_a_stationary_trajectory_brakes_and_returns() -> None:
    still = sample_trajectory()
    still = dataclasses.replace(still, positions=np.tile(still.positions[:1], (13, 1)))
    velocities = np.zeros((2, len(still.names)))
    velocities[0, 0] = 0.3
    motion = retime_trajectory(SCENE, still, end_velocities=velocities)
    np.testing.assert_allclose(motion.velocity(0.0), velocities[0], atol=1e-12)
    reach = motion(np.linspace(0.0, 1.0, 400))[:, 0].max() - still.positions[0, 0]
    assert reach == pytest.approx(0.3**2 / 2.0 / SCENE.robot.acceleration[0], rel=1e-2)
