"""What a hand holds pulls with its weight; holds begin and end when the plan says so."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.executions import door_plan, holding, still, with_mass

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.welds import spans
from vkc_pin.world.trajectory.world_model import World


@pytest.mark.parametrize("mass", [0.4, 3.0])
def test_what_is_held_pulls_with_its_weight(mass: float) -> None:
    scene = with_mass(holding(), "stick", mass)
    result = simulate(scene, [vkc.Grasp("stick")], still(scene, 2.0))
    (grip,) = result.grips
    world = World(scene)
    model, data = world.model, world.model.createData()
    pin.framesForwardKinematics(model, data, world.coordinates.q(result.rows[-1]))
    joint = model.getJointId("stick.placement")
    arm = (
        data.oMi[joint].act(model.inertias[joint].lever)
        - data.oMf[model.getFrameId(scene.robot.tool_frame)].translation
    )
    weight = np.array([0.0, 0.0, -9.81 * mass])
    assert grip.force == pytest.approx(9.81 * mass, rel=0.02)
    assert grip.torque == pytest.approx(np.linalg.norm(np.cross(arm, weight)), rel=0.05)
    assert (
        np.linalg.norm(data.oMi[joint].translation - scene.objects["stick"].placement.translation)
        < 0.02
    )


def test_holds_last_as_long_as_the_plan_says() -> None:
    plan = door_plan()
    ((hold, begin, end),) = spans(plan.scene, plan.trajectory)
    first = next(phase for phase in plan.trajectory.phases if phase.holds)
    assert str(hold) == "door.handle"
    assert begin == plan.trajectory.times[first.first]
    assert end == np.inf
    scene = holding()
    ((hold, begin, _),) = spans(scene, still(scene))
    assert hold.object == "stick"
    assert begin == -np.inf


def test_a_push_is_no_grip() -> None:
    scene = vkc.load_scene("door").with_held({"door": "push"})
    assert spans(scene, still(scene)) == []
