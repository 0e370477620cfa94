"""Tests that the simulated robot executes motions as they come, and measures as stated."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import add_boxes
from helpers.executions import (
    make_grasping_scene,
    make_stationary_motion,
    plan_door,
    replace_mass,
)
from helpers.grippers import write_cheeks_scene, write_gripper

import vkc_pin as vkc
from vkc_pin.execution import Robot, SimulatedRobot, execute
from vkc_pin.simulation.result import GOAL
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import Hold, compute_tool_placement
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory


def make_robot(scene: Scene, **options: object) -> SimulatedRobot:
    return SimulatedRobot(scene, counts_planning=False, **options)


def make_drive(scene: Scene, distance: float, seconds: float) -> Trajectory:
    """Return a straight drive along the world's x axis, from rest to rest."""
    still = make_stationary_motion(scene, seconds)
    positions = np.array(still.positions)
    positions[1, 0] += distance
    curve = Curve(still.times, positions, np.zeros_like(positions))
    return dataclasses.replace(still, positions=positions, curve=curve)


def replace_holds(motion: Trajectory, *holds: Hold) -> Trajectory:
    (phase,) = motion.phases
    return dataclasses.replace(motion, phases=(dataclasses.replace(phase, holds=holds),))


def displace_door(scene: Scene, distance: float) -> Scene:
    shift = pin.SE3(np.eye(3), np.array([distance, 0.0, 0.0]))
    return scene.with_placement("door", shift * scene.objects["door"].placement)


def place_handle(scene: Scene) -> Floats:
    """Return the position of the door's handle [m]."""
    placed = scene.objects["door"]
    handle = placed.object.attachment("handle")
    return (placed.link_placement(handle.link) * handle.placement).translation


def test_closed_loop_opens_the_door_as_the_simulation_does() -> None:
    plan = plan_door()
    robot = make_robot(plan.scene)
    assert isinstance(robot, Robot)
    result = execute(plan, robot)
    assert result.success, result
    assert set(result.count_decisions()) == {"go on"}
    assert robot.object_states()["door"].joints["hinge"] == pytest.approx(1.2, abs=GOAL["rad"])
    simulated = plan.simulate()
    tracking = robot.tracking()
    assert tracking.arm[0] == pytest.approx(simulated.tracking.arm[0], rel=0.2)
    assert tracking.base[0] == pytest.approx(simulated.tracking.base[0], rel=0.2)
    (grip,) = robot.grips
    (expected,) = simulated.grips
    assert grip.problem is None
    assert grip.force == pytest.approx(expected.force, rel=0.2)
    assert robot.contacts() == ()
    # The motion begins one cycle later than in the simulation.
    begin, _ = result.plans[0]
    done = robot.trajectory()
    times = np.linspace(0.0, float(plan.trajectory.times[-1]), 50)
    for name in ("door.hinge", "door.knob", "base_x", "elbow_joint"):
        column = np.interp(times + begin, done.times, done.column(name))
        other = np.interp(times, simulated.trajectory.times, simulated.trajectory.column(name))
        np.testing.assert_allclose(column, other, atol=0.01)


@pytest.mark.parametrize("distance", [np.inf, 1.0], ids=["from the start", "from 1 m on"])
def test_displaced_door_is_opened(distance: float) -> None:
    """The robot sees the door from a distance of its hand to the handle on [m]."""
    plan = plan_door()
    actual = displace_door(plan.scene, 0.02)
    robot = make_robot(plan.scene, actual=actual)
    placement = actual.objects["door"].placement
    handle = place_handle(actual)
    seen: list[float] = []

    def observe(scene: Scene) -> Scene:
        hand = compute_tool_placement(scene.robot, robot.read().positions)
        away = float(np.linalg.norm(hand.translation - handle))
        if not seen and away > distance:
            return scene
        seen.append(away)
        return scene.with_placement("door", placement)

    result = execute(plan, robot, observe=observe, lead=1.0)
    assert result.success, result
    assert result.count_decisions()["replan"] >= 1
    assert robot.object_states()["door"].joints["hinge"] == pytest.approx(1.2, abs=GOAL["rad"])
    last = robot.grips[-1]
    assert last.problem is None
    assert last.distance < 2e-3
    assert all(contact.depth < 1e-3 for contact in robot.contacts(actual))


def test_noise_is_as_stated() -> None:
    scene = vkc.load_scene("door")
    deviations = np.linspace(1e-3, 5e-3, len(scene.start))
    robot = make_robot(scene, noise=deviations, velocity_noise=0.02, seed=3)
    states = [robot.read()]
    assert np.array_equal(robot.read().positions, states[0].positions)
    for _ in range(400):
        robot.wait(robot.time + 0.002)
        states.append(robot.read())
    errors = np.array([state.positions for state in states]) - scene.start
    np.testing.assert_allclose(errors.std(axis=0), deviations, rtol=0.15)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=1e-3)
    velocities = np.array([state.velocities for state in states])
    assert velocities.std() == pytest.approx(0.02, rel=0.1)
    again = make_robot(scene, noise=deviations, velocity_noise=0.02, seed=3)
    other = make_robot(scene, noise=deviations, velocity_noise=0.02, seed=4)
    assert np.array_equal(again.read().positions, states[0].positions)
    assert not np.array_equal(other.read().positions, states[0].positions)


def test_measurements_are_late() -> None:
    scene = vkc.load_scene("door")
    prompt = make_robot(scene)
    late = make_robot(scene, delay=0.1)
    for robot in (prompt, late):
        robot.send(make_drive(scene, 0.3, 1.0), 0.1)
    prompt.wait(0.5)
    late.wait(0.6)
    state = late.read()
    assert state.time == pytest.approx(0.5, abs=1e-9)
    assert state.velocities[0] > 0.3
    np.testing.assert_array_equal(state.positions, prompt.read().positions)
    np.testing.assert_array_equal(state.velocities, prompt.read().velocities)


def test_robot_stops_where_it_is() -> None:
    scene = vkc.load_scene("door")
    robot = make_robot(scene)
    robot.send(make_drive(scene, 0.6, 2.0), 0.1)
    robot.send(make_drive(scene, -0.6, 2.0), 3.0)
    robot.wait(1.1)
    before = robot.read()
    assert before.velocities[0] > 0.4
    robot.stop()
    robot.wait(2.1)
    after = robot.read()
    assert np.abs(after.velocities).max() < 1e-3
    assert after.positions[0] == pytest.approx(before.positions[0], abs=0.01)
    robot.wait(4.0)
    np.testing.assert_allclose(robot.read().positions, after.positions, atol=1e-4)


def test_object_stays_in_the_hand_when_the_robot_stops_while_it_closes() -> None:
    """The fingers close while the robot rests, between the first two waypoints of the phase."""
    held = make_grasping_scene()
    still = make_stationary_motion(held)
    (phase,) = still.phases
    waiting = dataclasses.replace(phase, holds=(), last=1)
    closing = dataclasses.replace(phase, first=1, last=2, opening=0.02)
    motion = dataclasses.replace(
        still,
        times=np.array([0.0, 0.01, 1.01]),
        positions=still.positions[[0, 0, 0]],
        phases=(waiting, closing),
    )
    robot = make_robot(held.with_held({}), physics=vkc.Physics(settle=0.0))
    robot.send(motion, 0.0)
    robot.wait(0.5)
    robot.stop()
    robot.wait(0.8)
    (grip,) = robot.grips
    assert grip.end > 0.8
    assert robot.grasped_poses[-1].time > 0.75


def test_robot_is_off_its_motion_at_an_obstacle_that_was_not_planned() -> None:
    scene = vkc.load_scene("door")
    x, y = scene.start[:2].tolist()
    actual = add_boxes(scene, crate=((0.3, 0.3, 0.4), (x + 0.8, y, 0.2)))
    robot = make_robot(scene, actual=actual)
    robot.send(make_drive(scene, 0.6, 1.0), 0.1)
    robot.wait(2.0)
    assert robot.read().positions[0] < x + 0.5
    (contact,) = robot.contacts()
    assert "crate" in (contact.first, contact.second)
    assert 0.1 < contact.begin < 2.0
    assert contact.depth > 1e-5
    assert robot.contacts(end=contact.begin) == ()
    (later,) = robot.contacts(begin=contact.begin + 0.2)
    assert later.begin >= contact.begin + 0.2
    assert robot.contacts(begin=5.0) == ()


def test_later_motion_takes_over_and_earlier_one_goes_on_until_then() -> None:
    scene = vkc.load_scene("door")
    robot = make_robot(scene)
    robot.send(make_drive(scene, 0.2, 1.0), 0.1)
    robot.send(make_drive(scene, 0.5, 1.0), 5.0)  # is discarded
    robot.send(make_stationary_motion(scene), 2.0)
    robot.wait(1.5)
    assert robot.read().positions[0] - scene.start[0] == pytest.approx(0.2, abs=1e-3)
    robot.wait(3.0)
    np.testing.assert_allclose(robot.read().positions, scene.start, atol=1e-3)
    robot.wait(6.5)
    np.testing.assert_allclose(robot.read().positions, scene.start, atol=1e-3)
    done = robot.trajectory()
    assert [phase.name for phase in done.phases] == ["rest", "stand", "stand"]
    assert np.diff(done.times).max() == pytest.approx(0.01)
    assert done.times[0] == pytest.approx(-0.5)


def test_held_object_stays_in_the_hand_until_it_is_released() -> None:
    scene = make_grasping_scene()
    robot = make_robot(scene)
    (hold,) = scene.holds
    other = dataclasses.replace(hold, deviation=(0.004, 0.0, 0.0, 0.0, 0.0, 0.0))
    robot.wait(0.1)
    robot.send(replace_holds(make_drive(scene, 0.2, 1.0), other), 0.2)
    robot.wait(0.7)
    robot.send(replace_holds(make_stationary_motion(scene), hold), 1.3)
    robot.wait(2.4)
    (grip,) = robot.grips
    assert grip.broken is None
    poses = robot.grasped_poses
    assert {pose.hold for pose in poses} == {hold.nominal}
    grasps = [pose.hand.actInv(pose.link) for pose in poses]
    offsets = [np.abs(pin.log6(grasps[0].actInv(grasp)).vector).max() for grasp in grasps]
    assert max(offsets) < 1e-3
    hands = np.array([pose.hand.translation for pose in poses])
    assert np.ptp(hands[:, 0]) == pytest.approx(0.2, abs=0.01)
    weight = 9.81 * scene.objects["stick"].object.model.inertias[-1].mass
    resting = [force.force for force in robot.grasp_forces if -0.3 < force.time < 0.1]
    np.testing.assert_allclose(resting, weight, rtol=0.05)

    robot.send(replace_holds(make_stationary_motion(scene)), 2.5)
    robot.wait(2.7)
    assert robot.grasped_poses[-1].time < 2.51
    assert robot.grips[0].end == pytest.approx(2.5)
    before, after = (robot.object_states(time)["stick"].placement for time in (0.15, 1.25))
    assert after.translation[0] - before.translation[0] == pytest.approx(0.2, abs=0.01)
    height = robot.object_states()["stick"].placement.translation[2]
    assert height < scene.objects["stick"].placement.translation[2] - 0.05


def test_hand_closes_at_an_object_that_only_a_later_motion_holds() -> None:
    """The stick falls while the hand is open, which takes 10 ms before it closes."""
    held = make_grasping_scene()
    scene = held.with_held({})
    robot = make_robot(scene, physics=vkc.Physics(settle=0.0))
    before = robot.object_states()["stick"].placement
    robot.send(make_stationary_motion(held), 0.01)
    robot.wait(1.0)
    (grip,) = robot.grips
    assert grip.problem is None
    assert grip.begin == pytest.approx(0.01)
    after = robot.object_states()["stick"].placement
    assert np.linalg.norm(before.actInv(after).translation) < 5e-3


def test_new_holds_do_not_disturb_those_that_last() -> None:
    """The model is built again in the middle of a drive, since it has no weld for the end."""
    scene = make_grasping_scene()
    (hold,) = scene.holds
    drive = make_drive(scene, 0.4, 2.0)
    still = make_stationary_motion(scene)
    robots = [make_robot(scene), make_robot(scene)]
    for robot, holds in zip(robots, [(hold,), (hold, Hold("stick", "end"))], strict=True):
        robot.send(drive, 0.1)
        robot.wait(1.0)
        robot.send(replace_holds(still, *holds), 1.5)
        robot.wait(1.49)
    np.testing.assert_allclose(robots[1].rows, robots[0].rows, atol=1e-6)
    forces = [[sample.force for sample in robot.grasp_forces] for robot in robots]
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-3)
    robots[1].wait(1.6)
    kept, added = robots[1].grips
    assert kept.problem is None
    assert kept.end > 1.6
    assert added.what == "stick.end"
    assert added.problem is None


def test_lost_object_is_not_grasped_again_by_a_motion_that_holds_it() -> None:
    scene = make_grasping_scene()
    heavy = replace_mass(scene, "stick", 60.0)
    robot = make_robot(scene, actual=heavy)
    robot.wait(0.1)
    robot.send(make_stationary_motion(scene), 0.2)
    robot.wait(0.5)
    (grip,) = robot.grips
    assert grip.broken is not None


def test_fingers_move_from_one_motion_to_the_next(tmp_path: Path) -> None:
    scene = write_cheeks_scene(write_gripper(tmp_path))
    robot = make_robot(scene)
    motion = make_stationary_motion(scene)
    (phase,) = motion.phases
    finger = len(scene.start)
    openings = (0.02, 0.06)
    for begin, opening in zip((0.1, 1.5), openings, strict=True):
        phases = (dataclasses.replace(phase, opening=opening),)
        robot.send(dataclasses.replace(motion, phases=phases), begin)
        robot.wait(begin + 1.3)
        assert robot.rows[-1, finger] == pytest.approx(opening / 2.0, abs=1e-3)
    speeds = np.diff(robot.rows[:, finger]) / 0.01
    assert np.abs(speeds).max() < 0.06
    robot.stop()
    robot.wait(3.5)
    assert robot.rows[-1, finger] == pytest.approx(openings[-1] / 2.0, abs=1e-3)


def test_execution_loads_the_simulation_on_first_use() -> None:
    script = (
        "import sys, vkc_pin.execution as e; assert 'vkc_pin.simulation' not in sys.modules; "
        "e.SimulatedRobot; assert 'mujoco' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_missing_mujoco_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(vkc.InputError, match="mujoco") as caught:
        SimulatedRobot(vkc.load_scene("door"))
    assert caught.value.expected.startswith('pip install "mujoco')


def test_base_goes_where_its_localisation_places_it() -> None:
    scene = vkc.load_scene("door")
    robot = make_robot(scene, base_offset=(0.0, 0.01, 0.0), base_drift=(0.02, 0.0, 0.01))
    np.testing.assert_allclose(robot.read().positions, scene.start, atol=1e-3)
    robot.send(make_drive(scene, 0.5, 2.0), 0.1)
    robot.wait(3.0)
    measured = robot.read().positions
    np.testing.assert_allclose(measured[:2], scene.start[:2] + np.array([0.5, 0.0]), atol=1e-3)
    bias = measured[:3] - robot.trajectory().positions[-1, :3]
    # The offset is travelled, too.
    np.testing.assert_allclose(bias, [0.0102, 0.01, 0.0051], atol=5e-4)


def test_time_of_the_program_passes_for_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    scene = vkc.load_scene("door")
    counting = SimulatedRobot(scene)
    timeless = make_robot(scene)
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    for robot in (counting, timeless):
        robot.wait(0.1)
    clock[0] += 0.25
    assert counting.read().time == pytest.approx(0.35, abs=0.002)
    assert timeless.read().time == pytest.approx(0.1)
    clock[0] += 0.05
    counting.wait(0.5)
    assert counting.time == pytest.approx(0.5)
    clock[0] += 0.1
    with pytest.raises(vkc.InputError, match="this is over"):
        counting.send(make_stationary_motion(scene), 0.55)


def test_diverged_robot_says_so() -> None:
    unstable = vkc.Physics(base_bandwidth=1e7, arm_bandwidth=1e7)
    scene = vkc.load_scene("door")
    robot = make_robot(scene, physics=unstable)
    with pytest.raises(vkc.InputError, match="the integration diverged"):
        robot.read()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("noise", -1.0),
        ("noise", [0.1, 0.2]),
        ("velocity_noise", np.nan),
        ("delay", -0.1),
        ("seed", -1),
        ("base_offset", [0.0, 0.0]),
        ("base_drift", 0.1),
        ("counts_planning", 2),
        ("physics", 3),
        ("actual", vkc.load_scene("drawer")),
    ],
)
def test_invalid_argument_is_named(field: str, value: object) -> None:
    with pytest.raises(vkc.InputError) as caught:
        SimulatedRobot(vkc.load_scene("door"), **{field: value})
    assert str(caught.value.field).startswith(field)


def test_invalid_motions_are_rejected() -> None:
    scene = vkc.load_scene("door")
    robot = make_robot(scene)
    robot.wait(1.0)
    motion = make_stationary_motion(scene)
    renamed = dataclasses.replace(motion, names=("x", *motion.names[1:]))
    calls: list[tuple[str, Callable[[], None]]] = [
        ("begin", lambda: robot.send(motion, 0.5)),
        ("begin", lambda: robot.send(motion, np.nan)),
        ("motion", lambda: robot.send(renamed, 2.0)),
        ("motion", lambda: robot.send(3, 2.0)),
        ("motion.phases", lambda: robot.send(replace_holds(motion, Hold("cup", "side")), 2.0)),
        ("until", lambda: robot.wait(np.inf)),
    ]
    for field, call in calls:
        with pytest.raises(vkc.InputError) as caught:
            call()
        assert caught.value.field == field
    robot.wait(1.5)
    np.testing.assert_allclose(robot.read().positions, scene.start, atol=1e-6)
