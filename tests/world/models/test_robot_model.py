"""Tests robot models with locked joints."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot


@pytest.fixture(scope="module")
def husky() -> Robot:
    return load_robot("husky_ur5e")


def test_joint_placements_are_rounded(husky: Robot) -> None:
    for joint in husky.model.jointPlacements:
        for entry in np.asarray(joint.homogeneous).ravel():
            assert entry in (0.0, 1.0, -1.0) or abs(entry) > 1e-3


def test_visual_geometry_is_simplified_and_coloured(husky: Robot) -> None:
    shapes = husky.visual.geometryObjects
    triangles = sum(
        shape.geometry.num_tris for shape in shapes if isinstance(shape.geometry, coal.BVHModelBase)
    )
    assert 10_000 < triangles < 100_000
    assert all(shape.meshPath == "" for shape in shapes)
    assert len({tuple(shape.meshColor.round(3)) for shape in shapes}) > 5
    assert husky.visual is husky.visual


def test_locked_models_match_the_full_model() -> None:
    robot = load_robot("panda")
    full = pin.buildModelFromUrdf(str(robot.urdf), pin.JointModelPlanar())
    rng = np.random.default_rng(2)
    z = np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(robot.lower[3:], robot.upper[3:])])
    q = pin.neutral(full)
    q[: robot.model.nq] = robot.coordinates.q(z)
    data, whole = robot.model.createData(), full.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    pin.framesForwardKinematics(full, whole, q)
    for index, frame in enumerate(robot.model.frames):
        kinds = [
            i
            for i, other in enumerate(full.frames)
            if other.name == frame.name and other.type == frame.type
        ]
        if kinds:
            assert data.oMf[index].isApprox(whole.oMf[kinds[0]], 1e-9), frame.name
    assert pin.computeTotalMass(robot.model) == pytest.approx(pin.computeTotalMass(full))
    pin.centerOfMass(robot.model, data, robot.coordinates.q(z))
    pin.centerOfMass(full, whole, q)
    np.testing.assert_allclose(data.com[0], whole.com[0], atol=1e-9)
