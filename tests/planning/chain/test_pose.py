"""Residuals and rows of all kinds of goals against numeric Pinocchio."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.memory import growth

from vkc_pin.planning.chain.pose import (
    POSE_OFFSET_SIZE,
    ROW_BOUNDS,
    PoseRow,
    build_pose_residual,
    build_pose_rows,
    compute_pose_offsets,
    flatten_target,
    relax_target,
)

_R, _p, _target = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3), ca.SX.sym("W", 12)
RESIDUAL = ca.Function(
    "residual", [_R, _p, _target], [build_pose_residual("pose", _R, _p, _target)]
)
ROWS = ca.Function("rows", [_R, _p, _target], [build_pose_rows("pose", _R, _p, _target)])
POSE_LOWER, POSE_UPPER = ROW_BOUNDS["pose"]
_turn = ca.SX.sym("w", 3)
_cross = ca.skew(_turn)
# R·exp([w]) to second order: its derivatives at w = 0 are those along the manifold.
_turned = _R @ (ca.SX.eye(3) + _cross + _cross @ _cross / 2)
SLOPE = ca.Function(
    "slope",
    [_R, _p, _target, _turn],
    [ca.jacobian(build_pose_residual("pose", _turned, _p, _target), _turn)],
)


def residual(placement: pin.SE3, target: pin.SE3) -> np.ndarray:
    return np.asarray(
        RESIDUAL(placement.rotation, placement.translation, flatten_target(target))
    ).ravel()


def random_axis(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def turned(target: pin.SE3, angle: float, axis: np.ndarray) -> pin.SE3:
    return target * pin.SE3(pin.AngleAxis(angle, axis).matrix(), np.zeros(3))


def test_target_vector_is_the_rotation_by_columns_then_the_translation() -> None:
    target = pin.SE3.Random()
    vector = flatten_target(target)
    assert vector.shape == (12,)
    for k in range(3):
        np.testing.assert_array_equal(vector[3 * k : 3 * k + 3], target.rotation[:, k])
    np.testing.assert_array_equal(vector[9:], target.translation)


@pytest.mark.parametrize(
    "angle",
    [0.0, 1e-8, 1e-3, 0.5, 1.5, np.pi / 2, 2.5, 3.0, np.pi - 0.05, np.pi - 0.01, np.pi - 2e-3],
)
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
        assert np.linalg.norm(found[3:]) == pytest.approx(
            2 * np.sin(np.linalg.norm(log) / 2), abs=1e-9
        )
        if angle > 1e-6:
            np.testing.assert_allclose(
                found[3:] / np.linalg.norm(found[3:]), log / np.linalg.norm(log), atol=1e-6
            )


def test_it_grows_with_the_angle_up_to_half_a_turn() -> None:
    target, axis = pin.SE3.Random(), random_axis(np.random.default_rng(1))
    norms = [
        np.linalg.norm(residual(turned(target, angle, axis), target)[3:])
        for angle in np.linspace(0.0, np.pi - 2e-3, 400)
    ]
    assert np.all(np.diff(norms) > 0)
    assert norms[-1] == pytest.approx(2.0, abs=1e-5)


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-9, 1e-6, 1e-5, 3e-5, 1e-4, 5e-4, 1e-3, 2e-3])
@pytest.mark.parametrize(
    "axis", [*np.eye(3), *-np.eye(3), None], ids=["x", "y", "z", "-x", "-y", "-z", "random"]
)
def test_half_a_turn_is_no_solution(away: float, axis: np.ndarray | None) -> None:
    """½ vee(E − Eᵀ) vanishes there; a planner using it converged to a half turn."""
    rng = np.random.default_rng(2)
    for sign in (-1.0, 1.0):
        about = random_axis(rng) if axis is None else axis
        placement, target = (
            turned(pin.SE3.Identity(), np.pi + sign * away, about),
            pin.SE3.Identity(),
        )
        error = placement.rotation
        naive = (
            np.array(
                [error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]]
            )
            / 2
        )
        assert np.linalg.norm(naive) < 3e-3
        assert np.linalg.norm(residual(placement, target)[3:]) > (0.1 if axis is None else 0.5)


def test_within_a_thousandth_of_half_a_turn_it_is_twice_the_axis() -> None:
    rng = np.random.default_rng(6)
    for axis in (*np.eye(3), *(random_axis(rng) for _ in range(10))):
        for angle in (np.pi, np.pi - 5e-4):
            target = pin.SE3.Random()
            found = residual(turned(target, angle, axis), target)[3:]
            np.testing.assert_allclose(
                found * np.sign(found @ axis), 2.0 * axis, rtol=0.0, atol=0.02
            )


@pytest.mark.parametrize("axis", np.eye(3), ids="xyz")
def test_newton_steps_lead_away_from_half_a_turn(axis: np.ndarray) -> None:
    target = pin.SE3.Random()
    placement = turned(target, np.pi, axis)
    for _ in range(12):
        at = (placement.rotation, placement.translation, flatten_target(target))
        slope = np.asarray(SLOPE(*at, np.zeros(3)))[3:]
        step = -np.linalg.lstsq(slope, residual(placement, target)[3:], rcond=1e-6)[0]
        step *= min(1.0, 0.5 / max(np.linalg.norm(step), 1e-12))
        placement = placement * pin.SE3(pin.exp3(step), np.zeros(3))
    assert np.linalg.norm(residual(placement, target)[3:]) < 1e-9


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.6, 3.0])
def test_its_slope_is_that_of_finite_differences(angle: float) -> None:
    rng, target = np.random.default_rng(3), pin.SE3.Random()
    placement = turned(target, angle, random_axis(rng))
    slope = np.asarray(
        SLOPE(placement.rotation, placement.translation, flatten_target(target), np.zeros(3))
    )
    for k in range(3):
        change = 1e-5 * np.eye(3)[k]
        ahead, behind = (
            residual(placement * pin.SE3(pin.exp3(s * change), np.zeros(3)), target)
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(slope[:, k], (ahead - behind) / 2e-5, rtol=0.0, atol=1e-7)


# --- rows of the program
# --------------------------------------------------------------------------------------------


def missing(placement: pin.SE3, target: pin.SE3) -> float:
    """Return by how much the worst row is outside its bounds."""
    value = np.asarray(
        ROWS(placement.rotation, placement.translation, flatten_target(target))
    ).ravel()
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
            vector = np.asarray(
                ROWS(placement.rotation, placement.translation, flatten_target(target))
            ).ravel()[3:6]
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
        found = np.asarray(
            ROWS(placement.rotation, placement.translation, flatten_target(target))
        ).ravel()
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


def test_rows_are_linear_in_the_placement() -> None:
    """So that they cost the program nothing in second derivatives."""
    everything = ca.vertcat(ca.vec(_R), _p)
    assert (
        ca.jacobian(
            ca.jacobian(build_pose_rows("pose", _R, _p, _target), everything), everything
        ).nnz()
        == 0
    )


# --- points, and what stands upright
# ----------------------------------------------------------------------------------

KINDS = ("pose", "point", "upright", "level")
RESIDUALS = {
    kind: ca.Function("residual", [_R, _p, _target], [build_pose_residual(kind, _R, _p, _target)])
    for kind in KINDS
}
ALL_ROWS = {
    kind: ca.Function("rows", [_R, _p, _target], [build_pose_rows(kind, _R, _p, _target)])
    for kind in KINDS
}
SLOPES = {
    kind: ca.Function(
        "slope",
        [_R, _p, _target, _turn],
        [ca.jacobian(build_pose_residual(kind, _turned, _p, _target), ca.vertcat(_p, _turn))],
    )
    for kind in KINDS
}


def value(function: ca.Function, placement: pin.SE3, target: pin.SE3) -> np.ndarray:
    return np.asarray(
        function(placement.rotation, placement.translation, flatten_target(target))
    ).ravel()


def outside(kind: str, placement: pin.SE3, target: pin.SE3) -> float:
    """Return by how much the worst row is outside its bounds."""
    lower, upper = ROW_BOUNDS[kind]
    rows = value(ALL_ROWS[kind], placement, target)
    assert rows.shape == lower.shape == upper.shape
    return float(np.maximum(lower - rows, rows - upper).max())


def tilted(target: pin.SE3, heading: float, tilt: float, about: float) -> pin.SE3:
    """Return `target` rotated about its vertical by `heading`, then tilted by `tilt`."""
    level = np.array([np.cos(about), np.sin(about), 0.0])
    turn = pin.exp3(tilt * level) @ pin.exp3(heading * np.array([0.0, 0.0, 1.0]))
    return pin.SE3(turn @ target.rotation, np.array(target.translation))


@pytest.mark.parametrize("kind", ["point", "upright", "level"])
def test_shapes(kind: str) -> None:
    placement = pin.SE3.Random()
    assert value(RESIDUALS[kind], placement, placement).shape == (
        {"point": 3, "upright": 5, "level": 2}[kind],
    )
    assert value(ALL_ROWS[kind], placement, placement).shape == (
        {"point": 3, "upright": 6, "level": 3}[kind],
    )
    assert set(ROW_BOUNDS) == set(KINDS)


def test_a_point_is_reached_at_any_orientation() -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        target, placement = pin.SE3.Random(), pin.SE3.Random()
        shift = placement.translation - target.translation
        np.testing.assert_array_equal(value(RESIDUALS["point"], placement, target), shift)
        np.testing.assert_array_equal(value(ALL_ROWS["point"], placement, target), shift)
        there = pin.SE3(placement.rotation, target.translation)
        assert outside("point", there, target) == 0.0
        there.translation = target.translation + 1e-3 * random_axis(rng)
        assert outside("point", there, target) > 1e-3 / np.sqrt(3) - 1e-12


@pytest.mark.parametrize(
    "tilt", [0.0, 1e-7, 1e-3, 0.5, np.pi / 2, 2.5, 3.0, np.pi - 0.01, np.pi - 2e-3]
)
def test_upright_is_the_distance_and_the_chord_of_the_tilt(tilt: float) -> None:
    """Whatever the heading. The tilt is the angle between the body's vertical and the world's."""
    rng = np.random.default_rng(7)
    for _ in range(20):
        target, shift = pin.SE3.Random(), rng.normal(size=3)
        placement = tilted(target, rng.uniform(-np.pi, np.pi), tilt, rng.uniform(-np.pi, np.pi))
        placement.translation = target.translation + shift
        vertical = target.rotation.T @ np.array(
            [0.0, 0.0, 1.0]
        )  # in the body, when it stands as the target does
        assert np.arccos(np.clip((placement.rotation @ vertical)[2], -1.0, 1.0)) == pytest.approx(
            tilt, abs=1e-6
        )
        found = value(RESIDUALS["upright"], placement, target)
        np.testing.assert_allclose(found[:3], shift, rtol=0.0, atol=1e-12)
        assert np.linalg.norm(found[3:]) == pytest.approx(2 * np.sin(tilt / 2), abs=1e-8)
        rows = value(ALL_ROWS["upright"], placement, target)
        np.testing.assert_allclose(rows[:3], shift, rtol=0.0, atol=1e-12)
        assert np.linalg.norm(rows[3:5]) == pytest.approx(np.sin(tilt), abs=1e-8)
        assert rows[5] == pytest.approx(np.cos(tilt), abs=1e-8)
        np.testing.assert_array_equal(value(RESIDUALS["level"], placement, target), found[3:])
        np.testing.assert_array_equal(value(ALL_ROWS["level"], placement, target), rows[3:])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("off", [0.0, 1e-3, 0.3, 1.6, 3.0, np.pi - 1e-5, np.pi])
def test_residual_and_rows_vanish_if_and_only_if_the_goal_holds(kind: str, off: float) -> None:
    rng = np.random.default_rng(8)
    for _ in range(10):
        target = pin.SE3.Random()
        if kind == "pose":
            placement = turned(target, off, random_axis(rng))
        elif kind in ("upright", "level"):
            placement = tilted(target, rng.uniform(-np.pi, np.pi), off, rng.uniform(-np.pi, np.pi))
            placement.translation += (kind == "level") * rng.normal(size=3)
        else:
            placement = pin.SE3(
                pin.SE3.Random().rotation, target.translation + off * random_axis(rng)
            )
        size = np.linalg.norm(value(RESIDUALS[kind], placement, target))
        if off == 0.0:
            assert size < 1e-9
            assert outside(kind, placement, target) < 1e-12
        else:
            assert size > min(0.5 * off, 0.1)
            assert outside(kind, placement, target) > min(0.3 * off, 0.1)


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-9, 1e-6, 1e-4, 5e-4, 1e-3, 2e-3])
@pytest.mark.parametrize("about", [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi, 1.0])
def test_what_stands_on_its_head_is_not_upright(away: float, about: float) -> None:
    target = pin.SE3.Random()
    for sign in (-1.0, 1.0):
        placement = tilted(target, 0.7, np.pi + sign * away, about)
        assert np.linalg.norm(value(RESIDUALS["upright"], placement, target)[3:]) > 0.5
        assert outside("upright", placement, target) > 0.9  # the row along the vertical


@pytest.mark.parametrize("about", [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi, 1.0, 4.0])
def test_newton_steps_set_upright_what_stands_on_its_head(about: float) -> None:
    target = pin.SE3.Random()
    placement = tilted(target, 0.4, np.pi, about)
    for _ in range(15):
        at = (placement.rotation, placement.translation, flatten_target(target))
        slope = np.asarray(SLOPES["upright"](*at, np.zeros(3)))[3:, 3:]
        step = -np.linalg.lstsq(
            slope, value(RESIDUALS["upright"], placement, target)[3:], rcond=1e-6
        )[0]
        step *= min(1.0, 0.5 / max(np.linalg.norm(step), 1e-12))
        placement = placement * pin.SE3(pin.exp3(step), np.zeros(3))
    assert np.linalg.norm(value(RESIDUALS["upright"], placement, target)) < 1e-9
    assert outside("upright", placement, target) < 1e-9


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tilt", [0.0, 1e-3, 0.3, 1.6, 3.0])
def test_slopes_of_every_kind_are_those_of_finite_differences(kind: str, tilt: float) -> None:
    rng, target = np.random.default_rng(9), pin.SE3.Random()
    placement = tilted(target, 0.6, tilt, 0.9)
    placement.translation = target.translation + rng.normal(size=3)
    slope = np.asarray(
        SLOPES[kind](placement.rotation, placement.translation, flatten_target(target), np.zeros(3))
    )
    for k in range(6):
        change = 1e-5 * np.eye(6)[k]

        def beside(sign: float, change: np.ndarray = change) -> np.ndarray:
            there = pin.SE3(
                placement.rotation @ pin.exp3(sign * change[3:]),
                placement.translation + sign * change[:3],
            )
            return value(RESIDUALS[kind], there, target)

        np.testing.assert_allclose(
            slope[:, k], (beside(1.0) - beside(-1.0)) / 2e-5, rtol=0.0, atol=1e-7
        )


@pytest.mark.parametrize("kind", KINDS)
def test_rows_of_every_kind_are_linear_in_the_placement(kind: str) -> None:
    everything = ca.vertcat(ca.vec(_R), _p)
    assert (
        ca.jacobian(
            ca.jacobian(build_pose_rows(kind, _R, _p, _target), everything), everything
        ).nnz()
        == 0
    )


def test_what_is_bound_to_a_value_and_what_only_from_below() -> None:
    for kind, (lower, upper) in ROW_BOUNDS.items():
        fixed = {"pose": 6, "point": 3, "upright": 5, "level": 2}[kind]
        np.testing.assert_array_equal(lower[:fixed], np.zeros(fixed))
        np.testing.assert_array_equal(upper[:fixed], np.zeros(fixed))
        assert (upper[fixed:] == np.inf).all()
        assert (lower[fixed:] >= 0.0).all()
        assert len(lower) == fixed + (kind != "point")


# --- targets that recede
# ------------------------------------------------------------------------------------------------

_away, _share = ca.SX.sym("D", POSE_OFFSET_SIZE), ca.SX.sym("e")
RECEDED = ca.Function(
    "relax_target", [_target, _away, _share], [relax_target(_target, _away, _share)]
)
TURNS = [
    0.0,
    1e-9,
    1e-6,
    1e-3,
    0.5,
    np.pi / 2,
    2.5,
    np.pi - 0.01,
    np.pi - 1e-3,
    np.pi - 1e-4,
    np.pi - 1e-6,
    np.pi - 1e-9,
    np.pi,
]
SHARES = [0.0, 1e-3, 0.25, 0.5, 0.9, 1.0]


def moved_back(target: pin.SE3, away: np.ndarray, share: float) -> pin.SE3:
    vector = np.asarray(RECEDED(flatten_target(target), away, share)).ravel()
    assert np.isfinite(vector).all()
    return pin.SE3(vector[:9].reshape(3, 3).T, vector[9:])


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle of the turn between two rotations, exact at all of them."""
    quaternion = pin.Quaternion(first.T @ second).coeffs()
    return float(2.0 * np.arctan2(np.linalg.norm(quaternion[:3]), abs(quaternion[3])))


def away_of(kind: str, target: pin.SE3, *placements: pin.SE3) -> np.ndarray:
    rotations, translations = (
        np.array([getattr(p, part) for p in placements]) for part in ("rotation", "translation")
    )
    found = compute_pose_offsets(kind, rotations, translations, target)
    assert found.shape == (len(placements), POSE_OFFSET_SIZE)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:6], axis=1), 1.0, rtol=0.0, atol=1e-12)
    assert ((found[:, 6] >= 0.0) & (found[:, 6] <= np.pi + 1e-12)).all()
    return np.asarray(found)


def test_how_far_away_leaves_nothing_behind() -> None:
    target, placements = pin.SE3.Random(), [pin.SE3.Random() for _ in range(50)]
    left, objects = growth(lambda: away_of("pose", target, *placements))
    assert left <= 50 * 8
    assert objects <= 50 / 2


def some_placement(kind: str, target: pin.SE3, angle: float, rng: np.random.Generator) -> pin.SE3:
    """Return a placement that is off by an angle and by an offset; of a point, by any turn."""
    if kind in ("upright", "level"):
        placement = tilted(target, rng.uniform(-np.pi, np.pi), angle, rng.uniform(-np.pi, np.pi))
    else:
        placement = turned(target, angle, random_axis(rng))
    return pin.SE3(placement.rotation, target.translation + rng.normal(size=3))


@pytest.mark.parametrize(
    "axis", [*np.eye(3), *-np.eye(3), None], ids=["x", "y", "z", "-x", "-y", "-z", "random"]
)
@pytest.mark.parametrize("angle", TURNS)
def test_how_far_a_pose_is_away_is_its_offset_and_its_logarithm(
    angle: float, axis: np.ndarray | None
) -> None:
    rng, target = np.random.default_rng(10), pin.SE3.Random()
    for _ in range(10):
        about, shift = random_axis(rng) if axis is None else axis, rng.normal(size=3)
        placement = turned(target, angle, about)
        placement.translation = target.translation + shift
        (found,) = away_of("pose", target, placement)
        np.testing.assert_allclose(found[:3], shift, rtol=0.0, atol=1e-12)
        assert found[6] == pytest.approx(angle, abs=1e-12 if angle == 0.0 else 1e-9)
        log = pin.log3(target.rotation.T @ placement.rotation)
        if angle < np.pi - 1e-3:
            np.testing.assert_allclose(found[6] * found[3:6], log, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(
            pin.exp3(found[6] * found[3:6]),
            target.rotation.T @ placement.rotation,
            rtol=0.0,
            atol=1e-9,
        )


@pytest.mark.parametrize("angle", TURNS)
def test_how_far_something_upright_is_away_is_its_offset_and_its_tilt(angle: float) -> None:
    """About a level axis, so that it is the shortest turn; the heading counts for nothing."""
    rng, vertical = np.random.default_rng(11), np.array([0.0, 0.0, 1.0])
    for _ in range(20):
        target = pin.SE3.Random()
        placement = some_placement("upright", target, angle, rng)
        (found,) = away_of("upright", target, placement)
        np.testing.assert_allclose(
            found[:3], placement.translation - target.translation, rtol=0.0, atol=1e-12
        )
        assert found[6] == pytest.approx(angle, abs=1e-9)
        if angle > 1e-6:  # where it is all but upright the axis is anything
            assert (target.rotation @ found[3:6])[2] == pytest.approx(0.0, abs=1e-9)
        back = target.rotation @ pin.exp3(found[6] * found[3:6])  # the frame, but for its heading
        np.testing.assert_allclose(
            back.T @ vertical, placement.rotation.T @ vertical, rtol=0.0, atol=1e-9
        )


def test_how_far_a_point_is_away_is_its_offset() -> None:
    target, placements = pin.SE3.Random(), [pin.SE3.Random() for _ in range(5)]
    found = away_of("point", target, *placements)
    np.testing.assert_allclose(
        found[:, :3], [p.translation - target.translation for p in placements], rtol=0.0, atol=1e-15
    )
    np.testing.assert_array_equal(found[:, 6], np.zeros(5))


@pytest.mark.parametrize("kind", KINDS)
def test_how_far_many_are_away_is_how_far_each_is(kind: str) -> None:
    rng, target = np.random.default_rng(12), pin.SE3.Random()
    placements = [some_placement(kind, target, angle, rng) for angle in TURNS]
    each = np.array([away_of(kind, target, placement)[0] for placement in placements])
    found = away_of(kind, target, *placements)
    np.testing.assert_allclose(found[:, [0, 1, 2, 6]], each[:, [0, 1, 2, 6]], rtol=0.0, atol=1e-12)
    axes, axis = (
        np.sin(found[:, 6:]) * found[:, 3:6],
        np.sin(each[:, 6:]) * each[:, 3:6],
    )  # at 0 and π there may be any
    np.testing.assert_allclose(axes, axis, rtol=0.0, atol=1e-12)
    assert compute_pose_offsets(kind, np.zeros((0, 3, 3)), np.zeros((0, 3)), target).shape == (
        0,
        POSE_OFFSET_SIZE,
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", [1e-6, 1e-3, 0.5, 2.5, np.pi - 2e-3])
def test_how_far_they_are_away_agrees_with_the_residual(kind: str, angle: float) -> None:
    rng = np.random.default_rng(13)
    for _ in range(10):
        target = pin.SE3.Random()
        placement = some_placement(kind, target, angle, rng)
        (found,), residual = (
            away_of(kind, target, placement),
            value(RESIDUALS[kind], placement, target),
        )
        offset, turn = (
            ([0.0, 0.0, 0.0], residual) if kind == "level" else (residual[:3], residual[3:])
        )
        np.testing.assert_allclose(found[:3], offset, rtol=0.0, atol=1e-12)
        size = 0.0 if kind == "point" else np.linalg.norm(turn)
        assert 2.0 * np.sin(found[6] / 2.0) == pytest.approx(size, abs=1e-8)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", TURNS)
def test_a_target_that_is_all_the_way_back_holds_where_the_frame_is(
    kind: str, angle: float
) -> None:
    rng, vertical = np.random.default_rng(14), np.array([0.0, 0.0, 1.0])
    for _ in range(10):
        target = pin.SE3.Random()
        placement = some_placement(kind, target, angle, rng)
        (away,) = away_of(kind, target, placement)
        back = moved_back(target, away, 1.0)
        there = target if kind == "level" else placement
        np.testing.assert_allclose(back.translation, there.translation, rtol=0.0, atol=1e-12)
        if kind == "pose":
            np.testing.assert_allclose(back.rotation, placement.rotation, rtol=0.0, atol=1e-9)
        elif kind in ("upright", "level"):
            np.testing.assert_allclose(
                back.rotation.T @ vertical, placement.rotation.T @ vertical, rtol=0.0, atol=1e-9
            )
        else:
            np.testing.assert_allclose(back.rotation, target.rotation, rtol=0.0, atol=1e-12)
        assert outside(kind, placement, back) < 1e-9
        if angle > (1e-9 if kind == "level" else 0.0):
            assert outside(kind, placement, target) > 1e-10
        at_target = moved_back(target, away, 0.0)
        np.testing.assert_array_equal(at_target.translation, target.translation)
        np.testing.assert_allclose(at_target.rotation, target.rotation, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("kind", ["pose", "upright"])
@pytest.mark.parametrize("angle", [1e-3, 0.5, 2.5, np.pi - 1e-4, np.pi])
def test_on_the_way_a_target_goes_straight_and_turns_evenly(kind: str, angle: float) -> None:
    rng, target = np.random.default_rng(15), pin.SE3.Random()
    for _ in range(10):
        placement = some_placement(kind, target, angle, rng)
        (away,) = away_of(kind, target, placement)
        way = [moved_back(target, away, share) for share in SHARES]
        for share, there in zip(SHARES, way, strict=True):
            expected = (1.0 - share) * target.translation + share * placement.translation
            np.testing.assert_allclose(there.translation, expected, rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(
                there.rotation.T @ there.rotation, np.eye(3), rtol=0.0, atol=1e-12
            )
            assert np.linalg.det(there.rotation) > 0.0
            assert angle_between(target.rotation, there.rotation) == pytest.approx(
                share * angle, abs=1e-9
            )
            assert angle_between(there.rotation, way[-1].rotation) == pytest.approx(
                (1.0 - share) * angle, abs=1e-9
            )
        if angle < np.pi - 1e-3 and kind == "pose":
            halfway = target.rotation @ pin.exp3(
                0.5 * pin.log3(target.rotation.T @ placement.rotation)
            )
            np.testing.assert_allclose(way[3].rotation, halfway, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi - 1e-4, np.pi])
def test_slopes_of_rows_with_a_target_that_recedes(kind: str, angle: float) -> None:
    """By finite differences of the share; a half turn is no worse than any other."""
    rng, target = np.random.default_rng(16), pin.SE3.Random()
    rows = build_pose_rows(kind, _R, _p, relax_target(_target, _away, _share))
    function = ca.Function(
        "rows", [_R, _p, _target, _away, _share], [rows, ca.jacobian(rows, _share)]
    )
    placement = some_placement(kind, target, angle, rng)
    (away,) = away_of(kind, target, placement)
    for share in SHARES:
        given = (placement.rotation, placement.translation, flatten_target(target), away)
        slope = np.asarray(function(*given, share)[1]).ravel()
        ahead, behind = (
            np.asarray(function(*given, share + sign * 1e-5)[0]).ravel() for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("shift", [None, (2, (0.1, -0.2, 0.3))], ids=["plain", "shifted"])
def test_frames_are_placed_in_numbers_as_in_symbols(
    shift: tuple[int, tuple[float, float, float]] | None,
) -> None:
    row = PoseRow(3, pin.SE3.Random(), (1,), "pose", shift)
    joints = [[pin.SE3.Identity(), *(pin.SE3.Random() for _ in range(4))] for _ in range(6)]
    found = row.compute_placements(
        np.array([[joint.rotation for joint in each] for each in joints]),
        np.array([[joint.translation for joint in each] for each in joints]),
    )
    assert [part.shape for part in found] == [(6, 3, 3), (6, 3)]
    for k, each in enumerate(joints):
        rotation, translation = row.build_placement(
            ca.DM(np.column_stack([flatten_target(joint) for joint in each[1:]]))
        )
        expected = each[3] * row.local
        offset = np.zeros(3) if shift is None else each[shift[0]].rotation @ np.array(shift[1])
        np.testing.assert_allclose(found[0][k], expected.rotation, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(found[1][k], expected.translation + offset, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(np.asarray(rotation), found[0][k], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(
            np.asarray(translation).ravel(), found[1][k], rtol=0.0, atol=1e-12
        )


@pytest.mark.parametrize("kind", ["upright", "level"])
@pytest.mark.parametrize("heading", [0.0, 1.0])
def test_what_is_upright_has_nothing_to_turn_and_what_stands_on_its_head_half_a_turn(
    kind: str, heading: float
) -> None:
    target = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, heading), np.zeros(3))
    rotations = np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])])
    found = compute_pose_offsets(kind, rotations, np.zeros((2, 3)), target)
    np.testing.assert_allclose(found[:, 6], [0.0, np.pi], rtol=0.0, atol=1e-12)
    assert found[1, 5] == 0.0  # about a level axis
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:6], axis=1), 1.0)
