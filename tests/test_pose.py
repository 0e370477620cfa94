"""The pose residual against numeric Pinocchio."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.pose import ROW_BOUNDS, pose_residual, pose_rows, target_vector

_R, _p, _target = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3), ca.SX.sym("W", 12)
RESIDUAL = ca.Function("residual", [_R, _p, _target], [pose_residual("pose", _R, _p, _target)])
ROWS = ca.Function("rows", [_R, _p, _target], [pose_rows("pose", _R, _p, _target)])
POSE_LOWER, POSE_UPPER = ROW_BOUNDS["pose"]
_turn = ca.SX.sym("w", 3)
_cross = ca.skew(_turn)
# R·exp([w]) to second order: its derivatives at w = 0 are those along the manifold.
_turned = _R @ (ca.SX.eye(3) + _cross + _cross @ _cross / 2)
SLOPE = ca.Function("slope", [_R, _p, _target, _turn], [ca.jacobian(pose_residual("pose", _turned, _p, _target), _turn)])


def residual(placement: pin.SE3, target: pin.SE3) -> np.ndarray:
    return np.asarray(RESIDUAL(placement.rotation, placement.translation, target_vector(target))).ravel()


def random_axis(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def turned(target: pin.SE3, angle: float, axis: np.ndarray) -> pin.SE3:
    return target * pin.SE3(pin.AngleAxis(angle, axis).matrix(), np.zeros(3))


def test_target_vector_is_the_rotation_by_columns_then_the_translation() -> None:
    target = pin.SE3.Random()
    vector = target_vector(target)
    assert vector.shape == (12,)
    for k in range(3):
        np.testing.assert_array_equal(vector[3 * k : 3 * k + 3], target.rotation[:, k])
    np.testing.assert_array_equal(vector[9:], target.translation)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.5, 1.5, np.pi / 2, 2.5, 3.0, np.pi - 0.05, np.pi - 0.01, np.pi - 2e-3])
def test_it_is_the_distance_and_the_chord_of_the_angle_about_the_axis(angle: float) -> None:
    rng, target = np.random.default_rng(0), pin.SE3.Random()
    for _ in range(20):
        axis, shift = random_axis(rng), rng.normal(size=3)
        placement = turned(target, angle, axis)
        placement.translation = target.translation + shift
        found = residual(placement, target)
        np.testing.assert_allclose(found[:3], shift, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(found[3:], 2 * np.sin(angle / 2) * axis, rtol=0.0, atol=1e-9)
        log = pin.log3(target.rotation.T @ placement.rotation)
        assert np.linalg.norm(found[3:]) == pytest.approx(2 * np.sin(np.linalg.norm(log) / 2), abs=1e-9)
        if angle > 1e-6:
            np.testing.assert_allclose(found[3:] / np.linalg.norm(found[3:]), log / np.linalg.norm(log), atol=1e-6)


def test_it_grows_with_the_angle_up_to_half_a_turn() -> None:
    target, axis = pin.SE3.Random(), random_axis(np.random.default_rng(1))
    norms = [np.linalg.norm(residual(turned(target, angle, axis), target)[3:]) for angle in np.linspace(0.0, np.pi - 2e-3, 400)]
    assert np.all(np.diff(norms) > 0)
    assert norms[-1] == pytest.approx(2.0, abs=1e-5)


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-9, 1e-6, 1e-5, 3e-5, 1e-4, 5e-4, 1e-3, 2e-3])
@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3), None], ids=["x", "y", "z", "-x", "-y", "-z", "random"])
def test_half_a_turn_is_no_solution(away: float, axis: np.ndarray | None) -> None:
    """½ vee(E − Eᵀ) vanishes there: a planner built on it converged to a pose turned half round."""
    rng = np.random.default_rng(2)
    for sign in (-1.0, 1.0):
        about = random_axis(rng) if axis is None else axis
        placement, target = turned(pin.SE3.Identity(), np.pi + sign * away, about), pin.SE3.Identity()
        error = placement.rotation
        naive = np.array([error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]) / 2
        assert np.linalg.norm(naive) < 3e-3
        assert np.linalg.norm(residual(placement, target)[3:]) > (0.1 if axis is None else 0.5)


@pytest.mark.parametrize("axis", np.eye(3), ids="xyz")
def test_newton_steps_lead_away_from_half_a_turn(axis: np.ndarray) -> None:
    target = pin.SE3.Random()
    placement = turned(target, np.pi, axis)
    for _ in range(12):
        at = (placement.rotation, placement.translation, target_vector(target))
        slope = np.asarray(SLOPE(*at, np.zeros(3)))[3:]
        step = -np.linalg.lstsq(slope, residual(placement, target)[3:], rcond=1e-6)[0]
        step *= min(1.0, 0.5 / max(np.linalg.norm(step), 1e-12))
        placement = placement * pin.SE3(pin.exp3(step), np.zeros(3))
    assert np.linalg.norm(residual(placement, target)[3:]) < 1e-9


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.6, 3.0])
def test_its_slope_is_that_of_finite_differences(angle: float) -> None:
    rng, target = np.random.default_rng(3), pin.SE3.Random()
    placement = turned(target, angle, random_axis(rng))
    slope = np.asarray(SLOPE(placement.rotation, placement.translation, target_vector(target), np.zeros(3)))
    for k in range(3):
        change = 1e-5 * np.eye(3)[k]
        ahead, behind = (residual(placement * pin.SE3(pin.exp3(s * change), np.zeros(3)), target) for s in (1.0, -1.0))
        np.testing.assert_allclose(slope[:, k], (ahead - behind) / 2e-5, rtol=0.0, atol=1e-7)


# --- rows of the program --------------------------------------------------------------------------------------------


def missing(placement: pin.SE3, target: pin.SE3) -> float:
    """Return by how much the worst row is outside its bounds."""
    value = np.asarray(ROWS(placement.rotation, placement.translation, target_vector(target))).ravel()
    assert value.shape == POSE_LOWER.shape == POSE_UPPER.shape
    return float(np.maximum(POSE_LOWER - value, value - POSE_UPPER).max())


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.5, 1.5, 1.6, 2.5, 3.0, np.pi - 1e-4, np.pi])
def test_rows_hold_at_the_target_and_nowhere_else(angle: float) -> None:
    rng, target = np.random.default_rng(4), pin.SE3.Random()
    for axis in (*np.eye(3), random_axis(rng), random_axis(rng)):
        placement = turned(target, angle, axis)
        if angle == 0.0:
            assert missing(placement, target) < 1e-12
        elif angle < np.pi / 2:  # every row of the vector is bound from both sides
            vector = np.asarray(ROWS(placement.rotation, placement.translation, target_vector(target))).ravel()[3:6]
            assert np.abs(vector).max() >= np.sin(angle) / np.sqrt(3) - 1e-9
        else:
            assert missing(placement, target) >= -2.0 * np.cos(angle) - 1e-9  # the trace
    np.testing.assert_array_equal(POSE_LOWER[:6], np.zeros(6))
    np.testing.assert_array_equal(POSE_UPPER[:6], np.zeros(6))


def test_rows_are_position_half_vee_and_trace() -> None:
    rng, target = np.random.default_rng(5), pin.SE3.Random()
    for angle in (0.2, 1.0, 2.9):
        axis, shift = random_axis(rng), rng.normal(size=3)
        placement = turned(target, angle, axis)
        placement.translation = target.translation + shift
        expected = np.r_[shift, np.sin(angle) * axis, 1.0 + 2.0 * np.cos(angle)]
        found = np.asarray(ROWS(placement.rotation, placement.translation, target_vector(target))).ravel()
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


def test_rows_are_linear_in_the_placement() -> None:
    """So that they cost the program nothing in second derivatives."""
    everything = ca.vertcat(ca.vec(_R), _p)
    assert ca.jacobian(ca.jacobian(pose_rows("pose", _R, _p, _target), everything), everything).nnz() == 0
