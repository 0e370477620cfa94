"""Tests that validation and oracle report torque violations with joint, time and amount."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.door_closers import load_door_with_closer, replace_object_fields
from helpers.executions import make_grasping_scene, make_stationary_motion, plan_door
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.validation.limits import TORQUE_TOLERANCE, MotorLoads
from vkc_pin.validation.report import Report
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.validate import validate

STIFF_SPRING = {"stiffness": 120.0, "springref": -2.0}


def validate_door(scene: vkc.Scene, trajectory: vkc.Trajectory | None = None) -> Report:
    plan = plan_door()
    return validate(
        scene, plan.steps, plan.trajectory if trajectory is None else trajectory, plan.options
    )


def test_torque_violation_of_a_door_with_a_stiff_spring_is_reported(tmp_path: Path) -> None:
    report, plan = validate_door(load_door_with_closer(**STIFF_SPRING)), plan_door()
    assert {violation.constraint for violation in report.violations} == {"torque"}
    worst = max(report.violations, key=lambda violation: violation.amount)
    assert worst.subject == "shoulder_pan_joint"
    assert worst.unit == "N·m"
    assert worst.amount == pytest.approx(150.0 * (report.torque - 1.0))
    assert 6.0 < worst.time <= plan.trajectory.times[-1], "the spring torque is largest there"
    assert "exceeds the motor's 150 N·m" in worst.detail
    assert "even at rest" in worst.detail
    rejected = dataclasses.replace(
        plan, scene=load_door_with_closer(**STIFF_SPRING), report=report, status="rejected"
    )
    verdict = judge(rejected.save(tmp_path / "heavy.npz"))
    assert verdict.agrees
    assert {(found.rule, found.subject) for found in verdict.found} == {
        (v.constraint, v.subject) for v in report.violations
    }


def test_damped_door_must_be_opened_slowly() -> None:
    scene, plan = load_door_with_closer(damping=400.0), plan_door()
    fast = validate_door(scene)
    assert fast.violations
    assert all(
        violation.constraint == "torque" and "N·m at rest" in violation.detail
        for violation in fast.violations
    )
    slower = retime_trajectory(scene, plan.trajectory)
    report = validate_door(scene, slower)
    assert report.ok
    assert 0.9 < report.torque <= 1.0 + TORQUE_TOLERANCE, "the motion is slower than necessary"
    assert 1.0 < slower.times[-1] / plan.trajectory.times[-1] < 1.3
    np.testing.assert_array_equal(slower.positions, plan.trajectory.positions)
    assert any(bound.kind == "torque" for bound in report.bounds)


def test_torque_violation_at_rest_is_reported() -> None:
    heavy = replace_object_fields(vkc.load_scene("init_1"), "stick", mass=60.0).with_held(
        {"stick": "grip"}
    )
    found = MotorLoads(Samples(heavy, make_stationary_motion(heavy))).find_violations()
    assert {violation.constraint for violation in found} == {"torque"}
    assert "shoulder_lift_joint" in {violation.subject for violation in found}
    assert all("even at rest" in violation.detail for violation in found)
    assert (
        MotorLoads(
            Samples(make_grasping_scene(), make_stationary_motion(make_grasping_scene()))
        ).find_violations()
        == []
    )


def test_report_remarks_on_missing_masses() -> None:
    scene = plan_door().scene
    model = pin.Model(scene.robot.model)
    for joint in range(1, model.njoints):
        model.inertias[joint] = pin.Inertia.Zero()
    scene = dataclasses.replace(
        load_door_with_closer(**STIFF_SPRING), robot=dataclasses.replace(scene.robot, model=model)
    )
    report = validate_door(scene)
    assert report.ok
    assert report.torque == 0.0
    assert report.remarks == ("torques not checked: the URDF states no masses of the arm",)


def test_report_remarks_on_massless_payload() -> None:
    scene = replace_object_fields(vkc.load_scene("init_1"), "stick", mass=0.0).with_held(
        {"stick": "grip"}
    )
    (remark,) = MotorLoads(Samples(scene, make_stationary_motion(scene))).summarize()["remarks"]
    assert remark == "carried as massless, since no mass is given: stick"
    assert (
        MotorLoads(
            Samples(make_grasping_scene(), make_stationary_motion(make_grasping_scene()))
        ).summarize()["remarks"]
        == ()
    )


def test_torques_are_reported_and_saved(tmp_path: Path) -> None:
    plan = plan_door()
    assert plan.metrics["torque"] == plan.report.torque > 0.0
    assert (
        f"torques     at most {100.0 * plan.report.torque:.0f} % of the motors' limits"
        in plan.summary()
    )
    assert f"bounded by  {plan.report.bounds[0]}" in plan.summary()
    assert plan.to_dict()["bounds"][0] == dataclasses.asdict(plan.report.bounds[0])
    loaded = vkc.Plan.load(plan.save(tmp_path / "door.npz"))
    assert loaded.claimed == plan.report == loaded.report
