"""Tests that grafted trees move as they did on their own."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import graft, graft_geometry, round_placement

KINDS = (
    pin.JointModelRX,
    pin.JointModelRY,
    pin.JointModelRZ,
    pin.JointModelPX,
    pin.JointModelPY,
    pin.JointModelPZ,
    pin.JointModelRUBX,
    pin.JointModelRUBZ,
    lambda: pin.JointModelRevoluteUnaligned(np.array([0.6, 0.0, 0.8])),
    lambda: pin.JointModelPrismaticUnaligned(np.array([0.0, -0.8, 0.6])),
    pin.JointModelPlanar,
)


def random_tree(rng: np.random.Generator, joints: int) -> pin.Model:
    """Return a random tree with a body, frame and limits at every joint, and fixed bodies."""
    model = pin.Model()
    for k in range(joints + 1):
        if k:
            joint, parent = KINDS[rng.integers(len(KINDS))](), int(rng.integers(k))
            effort, velocity = rng.uniform(1, 2, joint.nv), rng.uniform(1, 2, joint.nv)
            lower, upper = -rng.uniform(1, 2, joint.nq), rng.uniform(1, 2, joint.nq)
            model.addJoint(parent, joint, pin.SE3.Random(), f"j{k}", effort, velocity, lower, upper)
            model.addJointFrame(k)
        model.appendBodyToJoint(k, pin.Inertia.Random(), pin.SE3.Random())
        model.addFrame(pin.Frame(f"l{k}", k, 0, pin.SE3.Random(), pin.FrameType.BODY), False)
        model.addFrame(
            pin.Frame(
                f"j{k}" if k == 0 else f"x{k}", k, 0, pin.SE3.Random(), pin.FrameType.FIXED_JOINT
            )
        )
    return model


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(0, 5))
def test_grafted_trees_move_as_before(seed: int, below: int, above: int) -> None:
    """The tree that carries it also moves as before."""
    pin.seed(seed % 2**31)
    rng = np.random.default_rng(seed)
    trunk, branch = random_tree(rng, below), random_tree(rng, above)
    model, parent, placement = pin.Model(trunk), int(rng.integers(below + 1)), pin.SE3.Random()
    joints = graft(model, branch, parent=parent, placement=placement, prefix="b.")
    assert joints == [parent, *range(trunk.njoints, trunk.njoints + above)]
    assert model.nframes == trunk.nframes + branch.nframes - 1
    z_trunk, z_branch = rng.normal(size=trunk.nv), rng.normal(size=branch.nv)
    q = Coordinates(model).q(np.concatenate([z_trunk, z_branch]))
    data, below_alone, above_alone = model.createData(), trunk.createData(), branch.createData()
    pin.framesForwardKinematics(model, data, q)
    pin.framesForwardKinematics(trunk, below_alone, Coordinates(trunk).q(z_trunk))
    pin.framesForwardKinematics(branch, above_alone, Coordinates(branch).q(z_branch))
    for index in range(trunk.nframes):
        np.testing.assert_allclose(
            data.oMf[index].homogeneous, below_alone.oMf[index].homogeneous, atol=1e-12
        )
    root = below_alone.oMi[parent] * placement
    for index, frame in enumerate(branch.frames[1:], 1):
        there = data.oMf[model.getFrameId(f"b.{frame.name}", frame.type)]
        np.testing.assert_allclose(
            there.homogeneous, (root * above_alone.oMf[index]).homogeneous, atol=1e-11
        )
    for index in range(1, branch.njoints):
        there, alone = model.joints[joints[index]], branch.joints[index]
        assert model.names[joints[index]] == f"b.{branch.names[index]}"
        assert there.shortname() == alone.shortname()
        for limit in ("effortLimit", "velocityLimit"):
            mine, its = getattr(model, limit), getattr(branch, limit)
            np.testing.assert_array_equal(
                mine[there.idx_v : there.idx_v + there.nv],
                its[alone.idx_v : alone.idx_v + alone.nv],
            )
        for limit in ("lowerPositionLimit", "upperPositionLimit"):
            mine, its = getattr(model, limit), getattr(branch, limit)
            np.testing.assert_array_equal(
                mine[there.idx_q : there.idx_q + there.nq],
                its[alone.idx_q : alone.idx_q + alone.nq],
            )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_grafting_preserves_mass(seed: int) -> None:
    """The centre of mass is that of both trees, including bodies fixed to the roots."""
    pin.seed(seed % 2**31)
    rng = np.random.default_rng(seed)
    trunk, branch = random_tree(rng, 3), random_tree(rng, 3)
    model, placement = pin.Model(trunk), pin.SE3.Random()
    graft(model, branch, parent=2, placement=placement)
    z_trunk, z_branch = rng.normal(size=trunk.nv), rng.normal(size=branch.nv)
    data, below, above = model.createData(), trunk.createData(), branch.createData()
    centre = pin.centerOfMass(
        model, data, Coordinates(model).q(np.concatenate([z_trunk, z_branch]))
    )
    first = pin.centerOfMass(trunk, below, Coordinates(trunk).q(z_trunk))
    second = pin.centerOfMass(branch, above, Coordinates(branch).q(z_branch))
    root = below.oMi[2] * placement
    parts = [
        (pin.computeTotalMass(trunk), first),
        (pin.computeTotalMass(branch), root.act(second)),
        (branch.inertias[0].mass, root.act(branch.inertias[0].lever)),
    ]
    assert pin.computeTotalMass(model) == pytest.approx(sum(mass for mass, _ in parts))
    np.testing.assert_allclose(
        centre,
        sum(mass * point for mass, point in parts) / sum(mass for mass, _ in parts),
        atol=1e-9,
    )


def test_grafting_does_not_change_the_grafted_tree() -> None:
    rng = np.random.default_rng(1)
    branch = random_tree(rng, 3)
    before = branch.copy()
    graft(pin.Model(), branch, parent=0, placement=pin.SE3.Random(), prefix="b.")
    assert branch == before


def test_joint_and_link_of_the_same_name() -> None:
    """URDFs may have them; a frame look-up finds the link."""
    branch = pin.Model()
    branch.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), "lid")
    branch.addJointFrame(1)
    branch.addFrame(pin.Frame("lid", 1, 0, pin.SE3.Random(), pin.FrameType.BODY))
    model = pin.Model()
    graft(model, branch, parent=0, placement=pin.SE3.Identity(), prefix="box.")
    frame = model.frames[model.getFrameId("box.lid")]
    assert frame.type == pin.FrameType.BODY
    assert frame.placement == branch.frames[2].placement


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_shapes_move_with_the_grafted_tree(seed: int) -> None:
    pin.seed(seed % 2**31)
    rng = np.random.default_rng(seed)
    branch, trunk = random_tree(rng, 3), random_tree(rng, 2)
    shapes = pin.GeometryModel()
    for k in range(5):
        shape = pin.GeometryObject(
            f"s{k}", int(rng.integers(4)), pin.SE3.Random(), coal.Box(*rng.uniform(0.1, 1.0, 3))
        )
        shape.meshColor, shape.meshScale, shape.meshPath = (
            rng.uniform(size=4),
            rng.uniform(1.0, 2.0, 3),
            f"mesh{k}.stl",
        )
        shape.overrideMaterial = bool(k % 2)
        shapes.addGeometryObject(shape)
    model, placement, geometry = pin.Model(trunk), pin.SE3.Random(), pin.GeometryModel()
    geometry.addGeometryObject(pin.GeometryObject("first", 0, pin.SE3.Identity(), coal.Sphere(0.1)))
    joints = graft(model, branch, parent=1, placement=placement, prefix="b.")
    added = graft_geometry(
        geometry, shapes.geometryObjects, joints=joints, placement=placement, prefix="b."
    )
    assert added == [1, 2, 3, 4, 5]
    z_trunk, z_branch = rng.normal(size=trunk.nv), rng.normal(size=branch.nv)
    data, below, above = model.createData(), trunk.createData(), branch.createData()
    there, alone = geometry.createData(), shapes.createData()
    pin.updateGeometryPlacements(
        model, data, geometry, there, Coordinates(model).q(np.concatenate([z_trunk, z_branch]))
    )
    pin.forwardKinematics(trunk, below, Coordinates(trunk).q(z_trunk))
    pin.updateGeometryPlacements(branch, above, shapes, alone, Coordinates(branch).q(z_branch))
    for index, (original, where) in zip(
        added, zip(shapes.geometryObjects, alone.oMg, strict=True), strict=True
    ):
        twin = geometry.geometryObjects[index]
        expected = below.oMi[1] * placement * where
        np.testing.assert_allclose(there.oMg[index].homogeneous, expected.homogeneous, atol=1e-11)
        assert twin.name == f"b.{original.name}"
        assert (twin.meshPath, twin.overrideMaterial) == (
            original.meshPath,
            original.overrideMaterial,
        )
        np.testing.assert_array_equal(twin.meshColor, original.meshColor)
        np.testing.assert_array_equal(twin.meshScale, original.meshScale)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rounding_preserves_placements(seed: int) -> None:
    pin.seed(seed % 2**31)
    placement = pin.SE3.Random()
    np.testing.assert_array_equal(round_placement(placement).homogeneous, placement.homogeneous)
    quarter = pin.SE3(pin.rpy.rpyToMatrix(np.pi / 2, 0.0, np.pi), np.array([1e-14, 0.5, -1e-13]))
    np.testing.assert_array_equal(round_placement(quarter).rotation, np.round(quarter.rotation))
    np.testing.assert_array_equal(round_placement(quarter).translation, [0.0, 0.5, 0.0])
