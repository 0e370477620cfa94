"""Tests Pinocchio's algorithms at many configurations at once."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.world.collision.batched_model import BatchedModel

JOINTS = [
    *(getattr(pin, f"JointModel{kind}{axis}") for kind in ("R", "P", "RUB") for axis in "XYZ"),
    lambda: pin.JointModelRevoluteUnaligned(np.array([0.6, 0.0, 0.8])),
    lambda: pin.JointModelPrismaticUnaligned(np.array([0.0, -0.6, 0.8])),
    pin.JointModelPlanar,
    pin.JointModelFreeFlyer,
    pin.JointModelSpherical,
]


def make_model_of_all_joints() -> tuple[pin.Model, pin.GeometryModel]:
    """Return a chain of all types of joints, with masses and a sphere on each."""
    pin.seed(0)
    model = pin.Model()
    geometry = pin.GeometryModel()
    parent = 0
    for k, joint in enumerate(JOINTS):
        parent = model.addJoint(parent, joint(), pin.SE3.Random(), f"j{k}")
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Random())
        shape = pin.GeometryObject(f"s{k}", parent, 0, pin.SE3.Random(), coal.Sphere(0.1))
        geometry.addGeometryObject(shape)
    geometry.addGeometryObject(
        pin.GeometryObject("stands", 0, 0, pin.SE3.Random(), coal.Sphere(0.1))
    )
    return model, geometry


def sample_configurations(model: pin.Model, rng: np.random.Generator) -> np.ndarray:
    """Return four random configurations, shape (4, nq)."""
    neutral = pin.neutral(model)
    return np.array([pin.integrate(model, neutral, rng.normal(size=model.nv)) for _ in range(4)])


def test_all_joint_types_are_supported() -> None:
    model, geometry = make_model_of_all_joints()
    q = sample_configurations(model, np.random.default_rng(3))
    shape_placements = BatchedModel.of_shapes(model, geometry)
    found = shape_placements.compute_placements(q)
    data, placed = model.createData(), pin.GeometryData(geometry)
    for row, configuration in zip(found, q, strict=True):
        pin.updateGeometryPlacements(model, data, geometry, placed, configuration)
        for numbers, placement in zip(row, placed.oMg, strict=True):
            np.testing.assert_array_equal(numbers[:9].reshape(3, 3).T, placement.rotation)
            np.testing.assert_array_equal(numbers[9:], placement.translation)
    first = found[:1].copy()
    np.testing.assert_array_equal(shape_placements.compute_placements(q[1:2]), found[1:2])
    np.testing.assert_array_equal(found[:1], first)  # later calls leave earlier results alone


def test_jacobians_and_torques_equal_those_of_single_configurations() -> None:
    model, _ = make_model_of_all_joints()
    frames = []
    for joint in (0, 3, model.njoints - 1):
        frame = pin.Frame(f"f{joint}", joint, pin.SE3.Random(), pin.FrameType.OP_FRAME)
        frames.append(model.addFrame(frame, False))
    rng = np.random.default_rng(4)
    q = sample_configurations(model, rng)
    v, a = rng.normal(size=(2, len(q), model.nv))
    batch = BatchedModel.of_frames(model, frames)
    jacobians = batch.compute_jacobians(q)
    rotations, origins = batch.compute_poses(q)
    torques = batch.compute_inverse_dynamics(q, v, a)
    data = model.createData()
    for k in range(len(q)):
        np.testing.assert_array_equal(torques[k], pin.rnea(model, data, q[k], v[k], a[k]))
        pin.computeJointJacobians(model, data, q[k])
        pin.updateFramePlacements(model, data)
        for f, frame in enumerate(frames):
            expected = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            np.testing.assert_allclose(jacobians[k, f], expected, rtol=0.0, atol=1e-12)
            np.testing.assert_array_equal(rotations[k, f], data.oMf[frame].rotation)
            np.testing.assert_array_equal(origins[k, f], data.oMf[frame].translation)
    with pytest.raises(ValueError, match="shape"):
        batch.compute_inverse_dynamics(q, v[1:], a)
    with pytest.raises(ValueError, match="shape"):
        batch.compute_jacobians(q[:, 1:])
