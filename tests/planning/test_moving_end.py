"""Tests plans that end with the velocity that their last step asks for."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.judging import check, get_violation_names
from helpers.small_problems import load_door_scene
from oracle.changes import write_changed
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin.execution.loop import execute
from vkc_pin.execution.robots import IdealRobot

GOAL = {"base_x": -0.5, "base_y": 0.3}
STEP = vkc.Configure(GOAL, velocities={"base_x": 0.3, "base_y": -0.1})


@pytest.fixture(scope="module")
def plan() -> vkc.Plan:
    """Return a plan that passes a place without stopping."""
    return vkc.plan(load_door_scene(), [STEP])


def test_motion_passes_its_goal_with_the_velocity(plan: vkc.Plan, tmp_path: Path) -> None:
    assert plan.success
    motion = plan.trajectory
    end = float(motion.times[-1])
    np.testing.assert_allclose(motion.at(end)[:2], list(GOAL.values()), atol=1e-6)
    np.testing.assert_allclose(motion.velocity(end)[:2], [0.3, -0.1], atol=1e-9)
    np.testing.assert_array_equal(motion.velocity(end)[2:], 0.0)
    plan.save(tmp_path / "plan.npz")
    again = vkc.Plan.load(tmp_path / "plan.npz")
    assert again.success
    assert again.steps == plan.steps
    verdict = judge(tmp_path / "plan.npz")
    assert verdict.success
    assert not verdict.found


def test_next_motion_begins_with_it(plan: vkc.Plan) -> None:
    scene = plan.end_scene()
    np.testing.assert_allclose(scene.start_velocity[:2], [0.3, -0.1], atol=1e-9)
    after = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})])
    assert after.success
    np.testing.assert_allclose(after.trajectory.velocity(0.0)[:2], [0.3, -0.1], atol=1e-9)


def test_other_end_velocities_are_violations(plan: vkc.Plan, tmp_path: Path) -> None:
    for velocities in ({}, {"base_x": 0.3}, {"base_x": 0.3, "base_y": 0.1}):
        other = dataclasses.replace(plan, steps=(vkc.Configure(GOAL, velocities=velocities),))
        wrong = {
            name for name in GOAL if velocities.get(name, 0.0) != STEP.velocities.get(name, 0.0)
        }
        assert get_violation_names(check(other)) == {("velocity", name) for name in wrong}
    plan.save(tmp_path / "plan.npz")

    def change(content: dict[str, Any]) -> None:
        content["steps"][-1]["velocities"]["base_y"] = -0.2

    changed = write_changed(tmp_path / "plan.npz", tmp_path / "changed.npz", change)
    found = {(one.rule, one.subject) for one in judge(changed).found}
    assert found == {("velocity", "base_y")}


def test_jerk_limits_hold_up_to_a_moving_end() -> None:
    step = vkc.Configure(GOAL, velocities={"base_x": 0.2})
    plan = vkc.plan(load_door_scene(), [step], options=vkc.Options(jerk_time=0.1))
    assert plan.success
    motion = plan.trajectory
    assert motion.velocity(motion.times[-1])[0] == pytest.approx(0.2, abs=1e-9)


def test_steps_before_the_last_keep_their_ends(plan: vkc.Plan) -> None:
    """Velocities are those of the whole, planned as one problem or step by step."""
    steps = [vkc.GoTo(-1.0, 0.3), STEP]
    for simultaneous in (True, False):
        found = vkc.plan(load_door_scene(), steps, simultaneous=simultaneous)
        assert found.success
        velocity = found.trajectory.velocity(found.trajectory.times[-1])
        np.testing.assert_allclose(velocity[:2], [0.3, -0.1], atol=1e-9)


def test_wrong_velocities_are_refused(plan: vkc.Plan) -> None:
    scene = load_door_scene()
    with pytest.raises(vkc.UnknownNameError, match="base_z"):
        vkc.Configure(GOAL, velocities={"base_z": 0.1})
    with pytest.raises(vkc.InputError, match="velocit"):
        vkc.Configure(GOAL, velocities={"base_x": float("nan")})
    with pytest.raises(vkc.InputError, match="only the last step may end in motion"):
        vkc.plan(scene, [STEP, vkc.GoTo(0.0, 0.0)])
    with pytest.raises(vkc.InputError, match="faster than the joint's limit"):
        vkc.plan(scene, [vkc.Configure(GOAL, velocities={"base_x": 30.0})])
    wheeled = scene.with_robot("husky_ur5e", base="differential")
    with pytest.raises(vkc.InputError, match="along its heading"):
        vkc.plan(wheeled, [STEP])
    with pytest.raises(vkc.InputError, match="ends in motion"):
        execute(plan, IdealRobot(plan.scene, is_simulated=True))
