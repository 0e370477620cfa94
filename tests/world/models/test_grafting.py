"""Tests that grafted trees move as they did on their own."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import graft, round_placement

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


def make_random_tree(rng: np.random.Generator, joints: int) -> pin.Model:
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


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(0, 5))
def test_grafted_trees_move_as_before(seed: int, below: int, above: int) -> None:
    """The base tree also moves as before, and the total mass is the sum of both masses."""
    pin.seed(seed % 2**31)
    rng = np.random.default_rng(seed)
    trunk, branch = make_random_tree(rng, below), make_random_tree(rng, above)
    model, parent, placement = pin.Model(trunk), int(rng.integers(below + 1)), pin.SE3.Random()
    original = branch.copy()
    joints = graft(model, branch, parent=parent, placement=placement, prefix="b.")
    assert branch == original
    assert joints == [parent, *range(trunk.njoints, trunk.njoints + above)]
    z_trunk, z_branch = rng.normal(size=trunk.nv), rng.normal(size=branch.nv)
    placements = []
    for tree, z in ((model, [*z_trunk, *z_branch]), (trunk, z_trunk), (branch, z_branch)):
        data = tree.createData()
        pin.framesForwardKinematics(tree, data, Coordinates(tree).q(np.array(z)))
        placements.append(data.oMf)
    whole, expected, grown = placements
    for index in range(trunk.nframes):
        assert whole[index].isApprox(expected[index], 1e-11)
    body = trunk.getFrameId(f"l{parent}")
    root = expected[body] * trunk.frames[body].placement.inverse() * placement
    for index, frame in enumerate(branch.frames[1:], 1):
        found = whole[model.getFrameId(f"b.{frame.name}", frame.type)]
        assert found.isApprox(root * grown[index], 1e-10)
    masses = [inertia.mass for tree in (trunk, branch) for inertia in tree.inertias]
    assert sum(inertia.mass for inertia in model.inertias) == pytest.approx(sum(masses))
    for index in range(1, branch.njoints):
        grafted, single = model.joints[joints[index]], branch.joints[index]
        assert model.names[joints[index]] == f"b.{branch.names[index]}"
        assert grafted.shortname() == single.shortname()
    for limit in ("effortLimit", "velocityLimit", "lowerPositionLimit", "upperPositionLimit"):
        limits = [getattr(tree, limit) for tree in (trunk, branch)]
        np.testing.assert_array_equal(getattr(model, limit), np.concatenate(limits))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rounding_removes_only_rounding_errors(seed: int) -> None:
    pin.seed(seed % 2**31)
    placement = pin.SE3.Random()
    np.testing.assert_array_equal(round_placement(placement), placement)
    quarter = pin.SE3(pin.rpy.rpyToMatrix(np.pi / 2, 0.0, np.pi), np.array([1e-14, 0.5, -1e-13]))
    np.testing.assert_array_equal(round_placement(quarter).rotation, np.round(quarter.rotation))
    np.testing.assert_array_equal(round_placement(quarter).translation, [0.0, 0.5, 0.0])
