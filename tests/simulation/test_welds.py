"""Tests that welds carry the load of grasped objects while the plan holds them."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.executions import make_grasping_scene, make_stationary_motion, plan_door, replace_mass
from helpers.robots import compute_placement

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.welds import find_hold_spans
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
