"""Tests plans to goals in joint space."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.drawers import replace_scene_fields
from helpers.drives import make_hall

import vkc_pin as vkc
from vkc_pin.planning.plan import Plan
from vkc_pin.simulation.goals import measure_goal_errors
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.world_model import World

ARM = {
    "shoulder_pan_joint": 0.5,
    "shoulder_lift_joint": -1.2,
    "elbow_joint": 1.5,
    "wrist_1_joint": -1.0,
    "wrist_2_joint": 1.5,
    "wrist_3_joint": 0.3,
}
BOX = {"name": "box", "type": "box", "size": [0.4, 0.4, 0.8], "position": [1.6, 0.0, 0.4]}


def end_values(plan: Plan) -> dict[str, float]:
    names = plan.scene.robot.coordinates.names
    return dict(zip(names, plan.trajectory.positions[-1].tolist(), strict=False))


@pytest.mark.parametrize("base", ["omni", "differential", "fixed"])
def test_the_arm_reaches_its_goal(base: str) -> None:
    plan = vkc.plan(make_hall(base=base), [vkc.Configure(ARM)])
    assert plan.success, plan.summary()
    found = end_values(plan)
    assert {name: found[name] for name in ARM} == pytest.approx(ARM, abs=1e-6)


def test_base_and_arm_reach_their_goals_together() -> None:
    """A heading of 7 rad is one of 7 − 2π rad; joints that are not named are free."""
    goal = {"base_x": 0.8, "base_y": -0.5, "base_yaw": 7.0, "elbow_joint": 1.0}
    plan = vkc.plan(make_hall(), [vkc.Configure(goal)])
    assert plan.success, plan.summary()
    found = end_values(plan)
    assert found["base_yaw"] == pytest.approx(7.0 - 2.0 * np.pi, abs=1e-6)
    del goal["base_yaw"]
    assert {name: found[name] for name in goal} == pytest.approx(goal, abs=1e-6)
    assert plan.trajectory.phases[-1].name == "configure"


def test_tolerances_are_used_and_judged() -> None:
    start = make_hall().start[3:]
    step = vkc.Configure({"elbow_joint": float(start[2]) + 0.5}, 0.2)
    plan = vkc.plan(make_hall(), [step])
    assert plan.success, plan.summary()
    assert end_values(plan)["elbow_joint"] - start[2] == pytest.approx(0.3, abs=2e-3)
    narrow = vkc.Configure(step.joints, 0.1)
    report = vkc.validate(plan.scene, [narrow], plan.trajectory)
    assert [one.subject for one in report.violations] == ["elbow_joint"]
    assert report.violations[0].amount == pytest.approx(0.1, abs=5e-3)


def test_executions_are_measured_at_joint_goals() -> None:
    plan = vkc.plan(make_hall(), [vkc.Configure(ARM, {"elbow_joint": 0.05})])
    world = World(plan.scene)
    rows = world.compute_positions(plan.trajectory, plan.trajectory.times)
    rows[:, world.coordinates.index("elbow_joint")] = ARM["elbow_joint"] + 0.07
    rows[:, world.coordinates.index("wrist_3_joint")] = ARM["wrist_3_joint"] + 0.01
    times = plan.trajectory.times
    misses = measure_goal_errors(plan.scene, plan.steps, plan.trajectory, world, times, rows)
    found = {one.subject: one.amount for one in misses}
    wanted = {**dict.fromkeys(ARM, 0.0), "elbow_joint": 0.02, "wrist_3_joint": 0.01}
    assert found == pytest.approx(wanted, abs=1e-6)


def test_goals_that_collide_are_named_at_once() -> None:
    """The base is free, but the arm ends in its own base, wherever that is."""
    folded = {**ARM, "shoulder_lift_joint": 1.5, "elbow_joint": 1.0}
    plan = vkc.plan(make_hall(), [vkc.Configure(folded)])
    assert (plan.status, plan.statistics.rounds) == ("infeasible", 0)
    pairs = {one.subject for one in plan.report.violations}
    assert "base_link – upper_arm_link" in pairs
    assert all("at the goal" in one.detail for one in plan.report.violations)


def test_depths_at_colliding_goals_are_coals() -> None:
    scene = replace_scene_fields(make_hall(), obstacles=[BOX])
    half = 1.4 - 0.05  # the box begins at x = 1.4
    plan = vkc.plan(scene, [vkc.Configure({"base_x": half, "base_y": 0.0, "base_yaw": 0.0})])
    assert plan.status == "infeasible"
    violation = plan.report.violations[0]
    assert "box" in violation.subject
    there = scene.with_start(base=(half, 0.0, 0.0))
    depth = -there.start_clearance()
    assert violation.detail == f"overlap by {1e3 * depth:.1f} mm at the goal"


def test_held_objects_are_carried_to_joint_goals(tmp_path: Path) -> None:
    scene = vkc.load_scene("init_1")
    steps = [vkc.Grasp("stick"), vkc.Configure({"base_x": 0.0, "base_y": 0.0})]
    plan = vkc.plan(scene, steps)
    assert plan.success, plan.summary()
    assert "stick" in plan.end_scene().held
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert loaded.steps == plan.steps


def test_inverse_kinematics_reaches_the_pose_without_collision() -> None:
    scene = replace_scene_fields(make_hall(), obstacles=[BOX])
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.0, np.pi / 2, 0.0), np.array([1.3, 0.1, 0.7]))
    found = vkc.inverse_kinematics(scene, pose, count=4)
    assert found.shape == (4, scene.robot.coordinates.size)
    for z in found:
        there = scene.with_start(base=z[:3], arm=z[3:])
        error = pin.log6(there.tool_placement().actInv(pose)).vector
        assert np.abs(error).max() < 1e-3
        assert there.start_clearance() >= vkc.Options().dist_safe - 1e-3
    assert (np.abs(found[:, None] - found).max(axis=2) + np.eye(4) > 0.1).all()
    distances = np.abs(found - scene.start).max(axis=1)
    assert distances[0] < 2.0


def test_inverse_kinematics_with_a_fixed_base() -> None:
    scene = make_hall()
    found = vkc.inverse_kinematics(scene, scene.tool_placement(), fix_base=True)
    np.testing.assert_array_equal(found[:, :3], scene.start[None, :3])
    far = pin.SE3(np.eye(3), np.array([4.0, 0.0, 0.8]))
    assert vkc.inverse_kinematics(scene, far, fix_base=True).shape == (0, scene.start.size)
    assert len(vkc.inverse_kinematics(scene, far)) == 1


def test_joint_goals_of_scenes_with_named_starts() -> None:
    start = {"elbow_joint": 1.0}
    scene = make_hall().with_start(arm=start)
    assert scene.start[scene.robot.coordinates.index("elbow_joint")] == 1.0
    again = Scene.from_document({**scene.document, "start": {"base": [0, 0, 0], "arm": start}})
    np.testing.assert_array_equal(again.start, scene.start)
