from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.scene.joint_estimation import (
    DECISIVE,
    _compute_rotation_vectors,
    estimate_joint,
    fit_joint,
)

POSITION_NOISE = 0.001  # [m]
ROTATION_NOISE = np.radians(0.3)


def make_hinge(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, pin.SE3]:
    """Return axis, a point of it, and the pose of a link 0.3 to 0.9 m beside it."""
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    point = rng.uniform(-1.0, 1.0, 3)
    across = np.cross(axis, rng.standard_normal(3))
    across /= np.linalg.norm(across)
    rotation = pin.exp3(rng.uniform(-2.0, 2.0, 3))
    return axis, point, pin.SE3(rotation, point + rng.uniform(0.3, 0.9) * across)


def move(axis: np.ndarray, point: np.ndarray | None, link: pin.SE3, position: float) -> pin.SE3:
    """Return the link after it turned about an axis, or slid along it if there is no point."""
    if point is None:
        return pin.SE3(np.eye(3), position * axis) * link
    turn = pin.exp3(position * axis)
    return pin.SE3(turn, point - turn @ point) * link


def measure_angle(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between two lines [rad]."""
    return float(np.arccos(min(1.0, abs(one @ other))))


def measure(pose: pin.SE3, rng: np.random.Generator) -> pin.SE3:
    """Return a pose with the noise of a measurement."""
    turn = pin.exp3(rng.normal(0.0, ROTATION_NOISE, 3))
    return pin.SE3(pose.rotation @ turn, pose.translation + rng.normal(0.0, POSITION_NOISE, 3))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_hinge_is_found_after_15_degrees(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axis, point, link = make_hinge(rng)
    angles = np.linspace(0.0, np.radians(15.0), 30)
    found = estimate_joint([measure(move(axis, point, link, q), rng) for q in angles])
    assert found.kind == "revolute"
    sign = np.sign(found.axis @ axis)
    foot = point + axis * (axis @ (link.translation - point))
    np.testing.assert_allclose(found.positions * sign, angles, atol=0.02)
    # Errors are those that the estimate expects.
    assert measure_angle(found.axis, axis) < 6.0 * found.axis_deviation
    assert np.linalg.norm(found.point - foot) < 6.0 * found.point_deviation
    assert found.axis_deviation < np.radians(1.5)
    assert found.point_deviation < 0.02
    predicted = found.compute_placement(sign * np.radians(40.0))
    true = move(axis, point, link, np.radians(40.0))
    assert np.linalg.norm(predicted.translation - true.translation) < 0.02


def test_sixty_poses_of_15_degrees_tell_an_axis_to_5_millimetres_and_1_degree() -> None:
    """The medians; a camera of 30 Hz takes them in 2 s."""
    angles = np.linspace(0.0, np.radians(15.0), 60)
    turns, distances = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        axis, point, link = make_hinge(rng)
        poses = [measure(move(axis, point, link, q), rng) for q in angles]
        found = estimate_joint(poses, position_noise=POSITION_NOISE, rotation_noise=ROTATION_NOISE)
        turns.append(measure_angle(found.axis, axis))
        distances.append(np.linalg.norm(np.cross(axis, found.point - point)))
    assert np.median(turns) < np.radians(1.0)
    assert np.median(distances) < 0.005


def test_known_axis_is_contradicted_only_where_it_is_wrong() -> None:
    rng = np.random.default_rng(5)
    axis, point, link = make_hinge(rng)
    poses = [measure(move(axis, point, link, q), rng) for q in np.linspace(0.0, 0.3, 40)]
    noise = {"position_noise": POSITION_NOISE, "rotation_noise": ROTATION_NOISE}
    found = estimate_joint(poses, **noise)
    across = np.cross(axis, link.translation - point)
    tilted = pin.exp3(0.08 * across / np.linalg.norm(across)) @ axis
    for known, expected in (((axis, point), False), ((tilted, point), True)):
        fit = fit_joint(poses, "revolute", known, **noise)
        is_contradicted = fit.information - found.information["revolute"] >= DECISIVE
        assert is_contradicted == expected
        assert fit.is_plausible != expected
    turned = found.align(-found.axis)
    np.testing.assert_array_equal(turned.positions, -found.positions)
    for position in (0.0, 0.2):
        one, other = found.compute_placement(position), turned.compute_placement(-position)
        assert one.isApprox(other, 1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_slide_is_found_after_80_millimetres(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axis, _, link = make_hinge(rng)
    travels = np.linspace(0.0, 0.08, 30)
    found = estimate_joint([measure(move(axis, None, link, q), rng) for q in travels])
    assert found.kind == "prismatic"
    assert measure_angle(found.axis, axis) < 6.0 * found.axis_deviation
    assert found.axis_deviation < np.radians(1.0)
    np.testing.assert_allclose(found.positions * np.sign(found.axis @ axis), travels, atol=0.005)
    assert found.point_deviation == 0.0


def test_exact_poses_give_the_exact_joint() -> None:
    axis, point, link = make_hinge(np.random.default_rng(4))
    poses = [move(axis, point, link, q) for q in (0.0, 0.4, 0.9, 1.5, 2.2)]
    found = estimate_joint([pin.SE3ToXYZQUAT(pose)[:3].tolist() + rpy(pose) for pose in poses])
    assert found.axis == pytest.approx(axis, abs=1e-9)
    foot = point + axis * (axis @ (link.translation - point))
    assert found.point == pytest.approx(foot, abs=1e-9)
    assert found.positions == pytest.approx([0.0, 0.4, 0.9, 1.5, 2.2], abs=1e-9)


def rpy(pose: pin.SE3) -> list[float]:
    return list(pin.rpy.matrixToRpy(pose.rotation))


@pytest.mark.parametrize(
    ("turned", "slid", "message"),
    [
        (0.0, 0.0, r"too short .* got \d mm and [01]\.\d°: it may stay"),
        (0.6, 0.0, r"too short .*: it may turn or slide"),
        (0.0, 0.002, "too short"),
    ],
)
def test_short_motions_are_refused(turned: float, slid: float, message: str) -> None:
    rng = np.random.default_rng(2)
    axis = np.array([0.0, 0.0, 1.0])
    point = np.zeros(3)
    link = pin.SE3(np.eye(3), np.array([1.2, 0.0, 0.0]))
    poses = list[pin.SE3]()
    for share in np.linspace(0.0, 1.0, 30):
        pose = move(axis, point, link, share * np.radians(turned))
        poses.append(measure(move(axis, None, pose, share * slid), rng))
    with pytest.raises(vkc.InputError, match=message):
        estimate_joint(poses)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"poses": [pin.SE3.Identity()] * 3}, "too few poses .*4 or more, got 3"),
        ({"poses": [pin.SE3.Identity()] * 4 + [[0.0, 1.0]]}, r"poses\[4\]"),
        ({"poses": [pin.SE3.Identity()] * 4 + [pin.SE3(np.eye(3), np.full(3, np.nan))]}, r"\[4\]"),
        ({"poses": [pin.SE3.Identity()] * 4, "position_noise": 0.0}, "position_noise"),
    ],
)
def test_invalid_arguments_are_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(vkc.InputError, match=message):
        estimate_joint(**arguments)  # type: ignore[arg-type]


def test_rotation_vectors_are_those_of_pinocchio() -> None:
    rng = np.random.default_rng(4)
    for angle in (0.0, 1e-9, 1e-3, 0.5, 2.0, 3.0, np.pi - 1e-6):
        axes = rng.normal(size=(6, 3))
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        rotations = np.array([pin.exp3(angle * axis) for axis in axes])
        expected = np.array([pin.log3(rotation) for rotation in rotations])
        found = _compute_rotation_vectors(rotations.reshape(2, 3, 3, 3))
        np.testing.assert_allclose(found.reshape(6, 3), expected, atol=1e-9)
