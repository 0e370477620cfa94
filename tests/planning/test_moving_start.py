"""Tests plans that begin with the velocity of the scene's start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.judging import check, get_violation_names
from helpers.small_problems import load_door_scene
from oracle.changes import write_changed
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin.planning.planner import Planner
from vkc_pin.world.trajectory.world_model import compute_final_scene

STEPS = [vkc.Actuate("door", {"hinge": 1.2})]
VELOCITY = {"base_x": 0.2, "elbow_joint": 0.1}
SHORT = vkc.Options(reach_waypoints=16, move_waypoints=12)


@pytest.fixture(scope="module")
def moving_plan() -> vkc.Plan:
    """Return the plan of a door from a moving start."""
    return vkc.plan(load_door_scene().with_start(velocity=VELOCITY), STEPS, options=SHORT)


def test_door_is_opened_from_a_moving_start(moving_plan: vkc.Plan, tmp_path: Path) -> None:
    assert moving_plan.success
    start_velocity = moving_plan.scene.start_velocity
    size = len(start_velocity)
    motion = moving_plan.trajectory
    np.testing.assert_allclose(motion.velocity(0.0)[:size], start_velocity, atol=1e-12)
    np.testing.assert_array_equal(motion.velocity(motion.times[-1]), 0.0)
    early = motion.velocity(np.linspace(0.0, 0.2, 50))[:, :size]
    assert np.abs(early).max(axis=1).min() > 0.05, "it brakes first"
    moving_plan.save(tmp_path / "plan.npz")
    verdict = judge(tmp_path / "plan.npz")
    assert verdict.success
    assert not verdict.found


def test_other_start_velocities_are_violations(moving_plan: vkc.Plan) -> None:
    for velocity in ({}, {"base_x": 0.2}, {"base_x": -0.2, "elbow_joint": 0.1}):
        other = moving_plan.scene.with_start(velocity=velocity)
        wrong = {name for name in VELOCITY if velocity.get(name, 0.0) != VELOCITY[name]}
        found = get_violation_names(check(moving_plan, scene=other))
        assert found == {("velocity", name) for name in wrong}


def test_oracle_finds_other_start_velocities(moving_plan: vkc.Plan, tmp_path: Path) -> None:
    moving_plan.save(tmp_path / "plan.npz")

    def change(content: dict[str, Any]) -> None:
        content["scene"]["start"]["velocity"]["base_x"] = 0.1

    changed = write_changed(tmp_path / "plan.npz", tmp_path / "changed.npz", change)
    found = {(one.rule, one.subject) for one in judge(changed).found}
    assert found == {("velocity", "base_x")}


def test_another_velocity_builds_nothing() -> None:
    planner = Planner()
    plans = []
    for velocity in ({}, VELOCITY, {"base_x": 0.1, "base_y": 0.1}):
        scene = load_door_scene().with_start(velocity=velocity)
        plans.append(vkc.plan(scene, STEPS, planner=planner, options=SHORT))
    assert all(plan.success for plan in plans)
    assert plans[0].statistics.build_time > 0.0
    assert [plan.statistics.build_time for plan in plans[1:]] == [0.0, 0.0]


def test_jerk_limits_hold_from_a_moving_start() -> None:
    scene = load_door_scene().with_start(velocity=VELOCITY)
    plan = vkc.plan(scene, STEPS, options=replace(SHORT, jerk_time=0.1))
    assert plan.success
    np.testing.assert_allclose(plan.trajectory.velocity(0.0)[:9], scene.start_velocity)


@pytest.mark.parametrize("jerk_time", [0.0, 0.1])
def test_wheels_begin_with_the_velocity_of_the_start(jerk_time: float) -> None:
    scene = load_door_scene().with_robot("husky_ur5e", base="differential")
    yaw = scene.start[2]
    velocity = {"base_x": 0.3 * np.cos(yaw), "base_y": 0.3 * np.sin(yaw), "base_yaw": 0.2}
    scene = scene.with_start(velocity=velocity)
    x, y = scene.start[:2].tolist()
    options = replace(SHORT, jerk_time=jerk_time)
    plan = vkc.plan(scene, [vkc.GoTo(x - 0.5, y + 0.5)], options=options)
    assert plan.success
    np.testing.assert_allclose(plan.trajectory.velocity(0.0), scene.start_velocity, atol=1e-9)


def test_drawer_in_the_hand_is_pulled_on() -> None:
    scene = vkc.load_scene("drawer")
    first = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.15})], options=SHORT)
    after = compute_final_scene(scene, first.trajectory, first.trajectory.phases[-1].holds)
    moving = after.with_start(velocity={"base_x": -0.1})
    plan = vkc.plan(moving, [vkc.Actuate("drawer", {"slide": 0.3})], options=SHORT)
    assert plan.success
    slide = plan.trajectory.names.index("drawer.slide")
    assert plan.trajectory.velocity(0.0)[slide] == pytest.approx(0.1, abs=1e-3)


def test_planned_steps_continue_from_rest(moving_plan: vkc.Plan) -> None:
    """The state at the end of a motion has no velocity."""
    trajectory = moving_plan.trajectory
    after = compute_final_scene(moving_plan.scene, trajectory, trajectory.phases[-1].holds)
    assert not after.start_velocity.any()
    steps = [*STEPS, vkc.GoTo(-1.0, 0.5)]
    plan = vkc.plan(moving_plan.scene, steps, options=SHORT, simultaneous=False)
    assert plan.success


def test_exports_state_the_velocity(moving_plan: vkc.Plan, tmp_path: Path) -> None:
    moving_plan.save(tmp_path / "plan.npz")
    again = vkc.Plan.load(tmp_path / "plan.npz")
    np.testing.assert_array_equal(again.scene.start_velocity, moving_plan.scene.start_velocity)
    assert again.success
    message = moving_plan.to_ros()
    names = message["joint_names"]
    first = dict(zip(names, message["points"][0]["velocities"], strict=True))
    assert first["elbow_joint"] == pytest.approx(0.1)


def test_wheeled_motions_are_replanned_from_their_own_velocity() -> None:
    """They slip by less than validation accepts."""
    scene = load_door_scene().with_robot("husky_ur5e", base="differential")
    x, y = scene.start[:2].tolist()
    plan = vkc.plan(scene, [vkc.GoTo(x - 0.5, y + 0.5)])
    assert plan.success
    end = float(plan.trajectory.times[-1])
    for time in np.linspace(0.2, 0.8, 7) * end:
        assert plan.scene_at(time).start_velocity.any()
    rest = vkc.replan(plan, 0.4 * end)
    assert rest.success
