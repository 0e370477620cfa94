"""Tests the torque limits of robots, and the removal of implausible ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.world.models.dynamics import TorqueLimits, compute_torque_limits
from vkc_pin.world.models.robot import Robot


@pytest.fixture(scope="module")
def husky() -> Robot:
    return vkc.load_robot("husky_ur5e")


def compute_limits(robot: Robot, model: pin.Model) -> TorqueLimits:
    return compute_torque_limits(model, robot.coordinates, robot.lower, robot.upper)


def test_limits_are_those_of_the_urdf(husky: Robot) -> None:
    assert husky.efforts.is_known
    assert husky.efforts.notes == ()
    np.testing.assert_array_equal(husky.efforts.limits, [np.inf] * 3 + [150.0] * 3 + [28.0] * 3)


def test_limits_are_unknown_without_masses(husky: Robot) -> None:
    model = pin.Model(husky.model)
    for joint in range(2, model.njoints):
        model.inertias[joint] = pin.Inertia.Zero()
    found = compute_limits(husky, model)
    assert not found.is_known
    assert found.notes == ("the URDF states no masses of the arm",)


@pytest.mark.parametrize("stated", [0.0, np.inf, np.finfo(float).max])
def test_joints_without_effort_limit_are_noted(husky: Robot, stated: float) -> None:
    model = pin.Model(husky.model)
    limits = np.array(model.effortLimit)
    limits[5] = stated
    model.effortLimit = limits
    found = compute_limits(husky, model)
    assert np.isinf(found.limits[5])
    assert np.isfinite(found.limits[[3, 4, 6, 7, 8]]).all()
    assert found.notes == ("the URDF states no effort of elbow_joint",)


def test_limits_that_cannot_hold_the_arm_are_discarded(husky: Robot) -> None:
    model, data = pin.Model(husky.model), husky.model.createData()
    outstretched = husky.coordinates.q(np.zeros(9))
    gravity = abs(pin.computeGeneralizedGravity(husky.model, data, outstretched)[4])
    limits = np.array(model.effortLimit)
    limits[4] = 0.5 * gravity
    model.effortLimit = limits
    found = compute_limits(husky, model)
    assert np.isinf(found.limits[4])
    assert len(found.notes) == 1
    assert "shoulder_lift_joint" in found.notes[0]
    assert "cannot hold the arm" in found.notes[0]
    limits[4] = 1.2 * gravity
    model.effortLimit = limits
    assert compute_limits(husky, model).limits[4] == pytest.approx(1.2 * gravity)


def write_robot(folder: Path, effort: object) -> Path:
    source = vkc.load_robot("husky_ur5e").urdf.parent
    description = yaml.safe_load((source / "robot.yaml").read_text(encoding="utf-8"))
    description["urdf"] = str(source / description["urdf"])
    description["srdf"] = str(next(source.glob("*.srdf")))
    description["joints"] = {**description.get("joints", {}), "elbow_joint": {"effort": effort}}
    (folder / "robot.yaml").write_text(yaml.safe_dump(description), encoding="utf-8")
    return folder / "robot.yaml"


@pytest.mark.parametrize(("effort", "limit"), [(90.0, 90.0), (0, np.inf)])
def test_robot_yaml_overrides_the_urdf(tmp_path: Path, effort: float, limit: float) -> None:
    robot = vkc.load_robot(write_robot(tmp_path, effort))
    assert robot.efforts.limits[5] == limit
    assert robot.efforts.limits[4] == 150.0


@pytest.mark.parametrize("effort", [-1.0, "strong", float("nan")])
def test_invalid_effort_limits_raise(tmp_path: Path, effort: object) -> None:
    with pytest.raises(InputError) as caught:
        vkc.load_robot(write_robot(tmp_path, effort))
    assert caught.value.field == "joints.elbow_joint.effort"
