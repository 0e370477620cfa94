"""Tests minimal coordinates: one per degree of freedom, and seven per free joint."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.models.coordinates import Coordinates, wrap_angle

FREE = ("thing_x", "thing_y", "thing_z", "thing_qx", "thing_qy", "thing_qz", "thing_qw")


def make_mixed_model() -> pin.Model:
    """Return a planar base with a wheel, a free body with a lid, and a lift."""
    model = pin.Model()
    base = model.addJoint(0, pin.JointModelPlanar(), pin.SE3.Identity(), "base")
    model.addJoint(base, pin.JointModelRUBZ(), pin.SE3.Identity(), "wheel")
    body = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "thing")
    limits = [np.array([value]) for value in (1.0, 2.0, -0.5, 0.7)]
    model.addJoint(body, pin.JointModelRX(), pin.SE3.Identity(), "lid", *limits)
    model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "lift", *limits)
    return model


def sample_z(rng: np.random.Generator, *shape: int) -> np.ndarray:
    coordinates = Coordinates(make_mixed_model())
    z = rng.uniform(-3.0, 3.0, (*shape, coordinates.size))
    z[..., 7:11] /= np.linalg.norm(z[..., 7:11], axis=-1, keepdims=True)
    return z


def test_names_joints_and_limits_of_coordinates() -> None:
    coordinates = Coordinates(make_mixed_model())
    assert coordinates.names == ("base_x", "base_y", "base_yaw", "wheel", *FREE, "lid", "lift")
    assert coordinates.joints == (1, 1, 1, 2, *[3] * 7, 4, 5)
    assert coordinates.units == ("m", "m", "rad", "rad", *"mmm1111", "rad", "m")
    assert (coordinates.size, coordinates.nq) == (13, 4 + 2 + 7 + 1 + 1)
    ends = [-0.5] * 2, [0.7] * 2
    for limits, infinite, finite in zip(
        (coordinates.lower, coordinates.upper), (-np.inf, np.inf), ends, strict=True
    ):
        np.testing.assert_array_equal(limits[2:], [infinite] * 9 + finite)
    assert [coordinates.index(name) for name in coordinates.names] == list(range(13))
    with expect_error(nearest="thing_qw"):
        coordinates.index("thing_quw")


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_configurations_round_trip(seed: int) -> None:
    model, rng = make_mixed_model(), np.random.default_rng(seed)
    coordinates, data = Coordinates(model), model.createData()
    z = sample_z(rng, 4, 3)
    q = coordinates.q(z)
    np.testing.assert_allclose(coordinates.z(q), z, atol=1e-12)
    np.testing.assert_array_equal(coordinates.q(z[0, 0]), q[0, 0])
    longer = z.copy()  # the length of a quaternion has no effect
    longer[..., 7:11] *= rng.uniform(0.1, 9.0, (4, 3, 1))
    np.testing.assert_allclose(coordinates.q(longer), q, atol=1e-12)
    z, q = z[0, 0], q[0, 0]
    pin.forwardKinematics(model, data, q)
    base, body, lid = data.oMi[1], data.oMi[3], data.oMi[4]
    assert body.isApprox(pin.XYZQUATToSE3(z[4:11]), 1e-12)
    np.testing.assert_allclose(base.translation, [*z[:2], 0.0])
    np.testing.assert_allclose(base.rotation, pin.utils.rotate("z", z[2]), atol=1e-12)
    expected = pin.utils.rotate("x", z[11])
    np.testing.assert_allclose((body.inverse() * lid).rotation, expected, atol=1e-12)


def test_invalid_arguments_raise() -> None:
    coordinates = Coordinates(make_mixed_model())
    with expect_error("coordinates"):
        coordinates.q(np.zeros(12))
    with expect_error("configuration"):
        coordinates.z(np.zeros((2, 13)))
    ball = pin.Model()
    ball.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "ball")
    with expect_error("not supported", field="ball", got="JointModelSpherical"):
        Coordinates(ball)


@given(st.floats(-50.0, 50.0))
def test_angles_are_wrapped(angle: float) -> None:
    assert -np.pi <= wrap_angle(angle) <= np.pi
    assert np.exp(1j * wrap_angle(angle)) == pytest.approx(np.exp(1j * angle), abs=1e-9)
