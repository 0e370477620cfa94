"""Tests that welds carry the load of grasped objects while the plan holds them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_table, make_carrying_motion, make_room, solve_reach
from helpers.executions import make_grasping_scene, make_stationary_motion, plan_door, replace_mass
from helpers.robots import compute_placement

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.robot import SimulatedRobot
from vkc_pin.simulation.welds import find_hold_spans
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World


def test_load_of_a_grip_is_the_object_weight() -> None:
    mass = 3.0
    scene = replace_mass(make_grasping_scene(), "stick", mass)
    result = simulate(scene, [vkc.Grasp("stick")], make_stationary_motion(scene, 2.0))
    (grip,) = result.grips
    world = World(scene)
    stick = world.get_placement("stick", result.rows[-1])
    joint = world.model.getJointId("stick.placement")
    center = stick.act(world.model.inertias[joint].lever)
    robot = scene.robot
    hand = compute_placement(robot, robot.tool_frame, result.rows[-1, : len(scene.start)])
    weight = np.array([0.0, 0.0, -9.81 * mass])
    torque = np.linalg.norm(np.cross(center - hand.translation, weight))
    assert grip.force == pytest.approx(9.81 * mass, rel=0.02)
    assert grip.torque == pytest.approx(torque, rel=0.05)
    before = scene.objects["stick"].placement.translation
    assert np.linalg.norm(stick.translation - before) < 0.02


def test_hold_spans_follow_the_plan() -> None:
    """Pushes have none."""
    plan = plan_door()
    ((hold, begin, end),) = find_hold_spans(plan.scene, plan.trajectory)
    first = next(phase for phase in plan.trajectory.phases if phase.holds)
    assert (str(hold), begin, end) == ("door.handle", plan.trajectory.times[first.first], np.inf)
    scene = make_grasping_scene()
    ((hold, begin, _),) = find_hold_spans(scene, make_stationary_motion(scene))
    assert (hold.object, begin) == ("stick", -np.inf)
    pushing = vkc.load_scene("door").with_held({"door": "push"})
    assert find_hold_spans(pushing, make_stationary_motion(pushing)) == []


@pytest.mark.parametrize(("slide", "held"), [(0.094, True), (0.13, False), (0.3, False)])
def test_hand_beyond_the_limits_of_a_grasp_holds_nothing(slide: float, held: bool) -> None:
    """The plan says that the hand grasps the stick there, up to 0.1 m beyond its end."""
    scene = make_room(describe_table())
    motion = make_carrying_motion(scene, values=(slide, 0.0)).motion()
    result = simulate(scene, [vkc.Release("stick")], motion)
    (grip,) = result.grips
    assert grip.missed is not held
    assert grip.distance == pytest.approx(0.0 if held else slide - 0.095, abs=2e-3)
    start = scene.objects["stick"].placement.translation
    stick = World(scene).get_placement("stick", result.rows[-1]).translation
    moved = float(np.linalg.norm(stick - start))
    assert (moved > 0.4) is held
    assert held or not result.ok


def turn_hand(scene: Scene, angle: float) -> Trajectory:
    """Return a motion of 3 s in which the hand turns about the bar of the drawer that it holds."""
    placement = scene.objects["drawer"].link_placement("tray").translation
    bar = pin.SE3(np.eye(3), placement + np.array([-0.115, 0.0, 0.0]))
    tool, row = scene.tool_placement(), scene.start
    rest = make_stationary_motion(scene, 3.0)
    rows = []
    for fraction in np.linspace(0.0, 1.0, 41):
        turned = angle * fraction**2 * (3.0 - 2.0 * fraction)
        turn = pin.SE3(pin.utils.rotate("y", turned), np.zeros(3))
        row = solve_reach(bar * turn * bar.inverse() * tool, row)
        rows.append([*row, *rest.positions[0, len(row) :]])
    phase = dataclasses.replace(rest.phases[0], last=40)
    times = np.linspace(0.0, 3.0, 41)
    return Trajectory(rest.names, times, np.array(rows), (phase,), rest.robot_size)


@pytest.mark.parametrize(("angle", "held"), [(-0.5, True), (0.9, False)])
def test_freedom_of_a_grasp_ends_at_its_limits(angle: float, held: bool) -> None:
    """A hand that may tilt about the bar by 0.6 rad is turned further, and loses it."""
    steps = [vkc.Actuate("drawer", {"slide": 0.1}, "handle_free")]
    scene = vkc.plan(vkc.load_scene("drawer"), steps).simulate().end_scene()
    (hold,) = scene.holds
    lower, upper = -0.6, 0.6
    assert (lower <= hold.at[0] - angle <= upper) is held
    result = simulate(scene, steps, turn_hand(scene, angle))
    (grip,) = result.grips
    assert (grip.broken is None) is held
    assert result.ok is held
    assert grip.torque < 1.0 if held else grip.torque > 20.0


@pytest.mark.parametrize("stiffness", [(1e6, 1e4), (1e5, 500.0), (3e4, 2e4)])
@pytest.mark.parametrize("mass", [0.2, 3.0])
def test_hand_yields_by_its_stiffness(stiffness: tuple[float, float], mass: float) -> None:
    """Under a force and a torque, by as much as a spring does, whatever the mass of the object."""
    scene = replace_mass(make_grasping_scene(), "stick", mass)
    shift_stiffness, turning_stiffness = stiffness
    physics = Physics(grasp_stiffness=shift_stiffness, grasp_turning_stiffness=turning_stiffness)
    robot = SimulatedRobot(scene, physics=physics, counts_planning=False)
    stepper = robot._stepper
    physical, data = stepper.physical, stepper.data

    def measure() -> pin.SE3:
        robot.wait(robot.time + 1.0)
        hand = physical.place_frame(data, scene.robot.tool_frame)
        return hand.actInv(physical.place_frame(data, "stick.stick"))

    before = measure()
    (hold,) = scene.holds
    held = physical.model.eq_obj2id[0]
    hand = physical.place_frame(data, scene.robot.tool_frame)
    force, torque = np.array([0.0, 4.0, 0.0]), np.array([0.0, 0.0, 0.8])
    lever = hand.translation - data.xipos[held]  # the wrench acts at the hand
    data.xfrc_applied[held] = [*force, *(torque + np.cross(lever, force))]
    after = measure()
    turned = hand.rotation @ pin.log3(after.rotation @ before.rotation.T)
    np.testing.assert_allclose(turned, torque / turning_stiffness, rtol=0.1, atol=2e-6)
    shift = hand.rotation @ (after.translation - before.translation)
    arm = hand.rotation @ before.translation
    at_hand = shift - np.cross(turned, arm)
    np.testing.assert_allclose(at_hand, force / shift_stiffness, rtol=0.1, atol=2e-7)
    assert str(hold).startswith("stick.")
