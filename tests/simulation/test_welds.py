"""Tests that welds carry the load of grasped objects while the plan holds them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.executions import make_grasping_scene, make_stationary_motion, plan_door, replace_mass

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
    model, data = world.model, world.model.createData()
    pin.framesForwardKinematics(model, data, world.coordinates.q(result.rows[-1]))
    joint = model.getJointId("stick.placement")
    lever = (
        data.oMi[joint].act(model.inertias[joint].lever)
        - data.oMf[model.getFrameId(scene.robot.tool_frame)].translation
    )
    weight = np.array([0.0, 0.0, -9.81 * mass])
    assert grip.force == pytest.approx(9.81 * mass, rel=0.02)
    assert grip.torque == pytest.approx(np.linalg.norm(np.cross(lever, weight)), rel=0.05)
    assert (
        np.linalg.norm(data.oMi[joint].translation - scene.objects["stick"].placement.translation)
        < 0.02
    )


def test_hold_spans_follow_the_plan() -> None:
    plan = plan_door()
    ((hold, begin, end),) = find_hold_spans(plan.scene, plan.trajectory)
    first = next(phase for phase in plan.trajectory.phases if phase.holds)
    assert str(hold) == "door.handle"
    assert begin == plan.trajectory.times[first.first]
    assert end == np.inf
    scene = make_grasping_scene()
    ((hold, begin, _),) = find_hold_spans(scene, make_stationary_motion(scene))
    assert hold.object == "stick"
    assert begin == -np.inf


def test_pushes_have_no_hold_spans() -> None:
    scene = vkc.load_scene("door").with_held({"door": "push"})
    assert find_hold_spans(scene, make_stationary_motion(scene)) == []
