"""Tests retimed trajectories against their limits, at a thousand samples per second."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from helpers.small_problems import door_scene

import vkc_pin as vkc
from vkc_pin.planning.retiming import retime
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.world.trajectory.trajectory import Trajectory


def limits(scene: vkc.Scene, names: tuple[str, ...]) -> np.ndarray:
    """Return lower, upper, velocity and acceleration limits, shape (n, 4)."""
    robot = scene.robot
    known = dict(
        zip(
            robot.coordinates.names,
            zip(robot.lower, robot.upper, robot.velocity, robot.acceleration, strict=True),
            strict=True,
        )
    )
    for owner, placed in scene.objects.items():
        item = placed.object
        rows = zip(item.lower, item.upper, item.velocity, item.acceleration, strict=True)
        known |= {
            f"{owner}.{name}": row for name, row in zip(item.coordinates.names, rows, strict=True)
        }
    return np.array([known.get(name, (-np.inf, np.inf, np.inf, np.inf)) for name in names], float)


def check_limits(scene: vkc.Scene, motion: Trajectory, *, within: float = 1e-5) -> None:
    times = np.arange(motion.times[0], motion.times[-1], 1e-3)
    lower, upper, velocity, acceleration = limits(scene, motion.names).T
    places = motion(times)
    assert (places >= lower - within).all()
    assert (places <= upper + within).all()
    assert (np.abs(motion.velocity(times)) <= velocity * (1 + 1e-6)).all()
    assert (np.abs(motion.acceleration(times)) <= acceleration * (1 + 1e-6)).all()
    np.testing.assert_allclose(
        np.diff(places, axis=0) / 1e-3, motion.velocity(times + 5e-4)[:-1], atol=1e-3
    )
    np.testing.assert_array_equal(motion.velocity(motion.times[[0, -1]]), 0.0)


def straight(scene: vkc.Scene, seed: int = 0, count: int = 12) -> Trajectory:
    """Return a motion of the robot alone through random waypoints near its start."""
    steps = np.random.default_rng(seed).normal(size=(count, len(scene.start))) * 0.2
    rows = np.asarray(scene.start) + np.concatenate(
        [np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)]
    )
    rows = np.clip(rows, scene.robot.lower, scene.robot.upper)
    phases = (vkc.PhaseSpan("go", 0, count),)
    return Trajectory(
        scene.robot.coordinates.names, np.arange(count + 1.0), rows, phases, rows.shape[1]
    )


@pytest.mark.parametrize("seed", range(8))
def test_any_waypoints(seed: int) -> None:
    scene = vkc.load_scene("door")
    slow = straight(scene, seed)
    motion = retime_trajectory(scene, slow)
    np.testing.assert_array_equal(motion.positions, slow.positions)
    np.testing.assert_allclose(motion(motion.times), slow.positions, atol=1e-12)
    check_limits(
        scene, motion, within=1e-3
    )  # where it turns sharply at a limit, before anything is repaired


def test_it_is_nearly_as_fast_as_any_motion_along_its_path() -> None:
    """With four times as many places at which the speed is known it takes hardly less time."""
    scene = vkc.load_scene("door")
    slow, share = straight(scene, 3), np.linspace(0.0, 1.0, 13)[:, None]
    ways = np.random.default_rng(3).normal(size=(3, slow.positions.shape[1])) * np.array(
        [[0.5], [0.2], [0.1]]
    )
    bends = np.concatenate(
        [share**2 * (3.0 - 2.0 * share), np.sin(np.pi * share) ** 2, np.sin(2.0 * np.pi * share)],
        axis=1,
    )
    slow = dataclasses.replace(slow, positions=slow.positions[:1] + bends @ ways)
    usual = retime_trajectory(scene, slow).times[-1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(retime, "_MIN_PIECES", 4 * retime._MIN_PIECES)
        best = retime_trajectory(scene, slow).times[-1]
    assert usual <= 1.1 * best


def test_it_rests_where_nothing_moves() -> None:
    scene = vkc.load_scene("door")
    slow = straight(scene)
    rows = np.insert(slow.positions, 6, slow.positions[6], axis=0)
    spans = (vkc.PhaseSpan("reach", 0, 6), vkc.PhaseSpan("hold", 6, 13))
    times = np.concatenate([np.arange(7.0), [6.7], np.arange(7.7, 13.0)])
    motion = retime_trajectory(
        scene, dataclasses.replace(slow, times=times, positions=rows, phases=spans)
    )
    assert motion.times[7] - motion.times[6] == pytest.approx(
        0.7
    )  # as long as it did, where a phase begins
    inside = np.linspace(motion.times[6], motion.times[7], 50)
    np.testing.assert_allclose(motion.velocity(inside), 0.0, atol=1e-12)
    check_limits(scene, motion)
    one = retime_trajectory(
        scene,
        dataclasses.replace(
            slow, times=times, positions=rows, phases=(vkc.PhaseSpan("go", 0, 13),)
        ),
    )
    assert one.times[7] - one.times[6] < 0.01


def test_stationary_trajectory_is_kept() -> None:
    scene = vkc.load_scene("door")
    still = straight(scene)
    still = dataclasses.replace(still, positions=np.tile(still.positions[:1], (13, 1)))
    motion = retime_trajectory(scene, still)
    assert motion.times[-1] == pytest.approx(1.0, abs=0.05)  # its first step, and hardly more
    np.testing.assert_allclose(
        motion(np.linspace(0.0, 1.0, 30)), np.tile(still.positions[0], (30, 1)), atol=1e-12
    )


def test_without_speeds_it_goes_from_stop_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retime, "compute_speeds", lambda *_: None)
    scene = vkc.load_scene("door")
    slow = straight(scene, 2)
    motion = retime_trajectory(scene, slow)
    np.testing.assert_array_equal(motion.velocity(motion.times), 0.0)
    middle = motion((motion.times[1:] + motion.times[:-1]) / 2)
    np.testing.assert_allclose(middle, (slow.positions[1:] + slow.positions[:-1]) / 2, atol=1e-12)
    check_limits(scene, motion)


def test_the_more_parts_the_straighter() -> None:
    scene = vkc.load_scene("door")
    slow = straight(scene, 5)
    off = []
    for parts in (1, 2, 4, 8):
        motion = retime_trajectory(scene, slow, np.full(12, parts))
        np.testing.assert_array_equal(motion.positions, slow.positions)
        fine = motion(np.linspace(motion.times[4], motion.times[5], 200))
        share = np.clip(
            ((fine - slow.positions[4]) @ (d := slow.positions[5] - slow.positions[4])) / (d @ d),
            0.0,
            1.0,
        )
        off.append(np.abs(fine - slow.positions[4] - share[:, None] * d).max())
        check_limits(scene, motion)
    assert off == sorted(off, reverse=True)
    assert off[-1] < 0.2 * off[0]


def test_a_planned_motion_keeps_its_limits_and_its_grasp(door_plan: vkc.Plan) -> None:
    """The hinge stands still while the knob turns, and the arm stops between the two."""
    motion = door_plan.trajectory
    check_limits(door_plan.scene, motion)
    assert door_plan.success
    assert door_plan.report.closure_error < 1e-3
    turn = next(phase for phase in motion.phases if phase.name.startswith("turn"))
    inside = np.linspace(motion.times[turn.first], motion.times[turn.last], 200)
    hinge = motion(inside)[:, motion.names.index("door.hinge")]
    assert np.ptp(hinge) < 1e-9
    assert np.abs(motion.velocity(motion.times[turn.last])).max() < 1e-6


def test_own_constraints_on_velocities_keep_the_programs_time() -> None:
    limit = vkc.Constraint("gently", lambda s: ca.norm_2(s.velocity("base_link")), upper=0.3)
    plan = vkc.plan(door_scene(), [vkc.GoTo(0.5, 0.2)], terms=[limit])
    assert plan.success, plan.summary()
    assert plan.trajectory.curve is None
