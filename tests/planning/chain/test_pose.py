"""Compares pose residuals, constraint rows and relaxed targets with numeric Pinocchio."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.memory import measure_growth

from vkc_pin.planning.chain.pose import (
    POSE_OFFSET_SIZE,
    ROW_BOUNDS,
    build_pose_residual,
    build_pose_rows,
    compute_pose_offsets,
    relax_target,
)
from vkc_pin.world.collision.solids import flatten_placements

KINDS = ("pose", "point", "upright", "level")
ANGLES = [0.0, 1e-9, 1e-6, 1e-3, 0.5, np.pi / 2, 2.5, *(np.pi - x for x in (1e-2, 1e-3, 1e-6, 0))]

_R, _p, _target = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3), ca.SX.sym("W", 12)
_twist = ca.SX.sym("w", 3)
_cross = ca.skew(_twist)
# R·exp([w]) to second order: its derivatives at w = 0 are those along the manifold.
_turned = _R @ (ca.SX.eye(3) + _cross + _cross @ _cross / 2)
RESIDUALS = {
    kind: ca.Function("residual", [_R, _p, _target], [build_pose_residual(kind, _R, _p, _target)])
    for kind in KINDS
}
ROWS = {
    kind: ca.Function("rows", [_R, _p, _target], [build_pose_rows(kind, _R, _p, _target)])
    for kind in KINDS
}
SLOPES = {
    kind: ca.Function(
        "slope",
        [_R, _p, _target, _twist],
        [ca.jacobian(build_pose_residual(kind, _turned, _p, _target), ca.vertcat(_p, _twist))],
    )
    for kind in KINDS
}


def evaluate(function: ca.Function, placement: pin.SE3, target: pin.SE3) -> np.ndarray:
    found = function(placement.rotation, placement.translation, flatten_placements([target])[0])
    return np.asarray(found).ravel()


def compute_violation(kind: str, placement: pin.SE3, target: pin.SE3) -> float:
    """Return the largest bound violation of the rows."""
    lower, upper = ROW_BOUNDS[kind]
    rows = evaluate(ROWS[kind], placement, target)
    assert rows.shape == lower.shape == upper.shape
    return float(np.maximum(lower - rows, rows - upper).max())


def compute_rotation_size(kind: str, placement: pin.SE3, target: pin.SE3) -> float:
    """Return the norm of the rows that belong to the rotation."""
    return float(np.linalg.norm(evaluate(RESIDUALS[kind], placement, target)[3:]))


def sample_axis(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def turn(
    kind: str, target: pin.SE3, angle: float, rng: np.random.Generator, axis: np.ndarray | None
) -> pin.SE3:
    """Return `target` turned by an angle; "upright" and "level": tilted, at a random heading."""
    if kind in ("upright", "level"):
        heading, about = rng.uniform(-np.pi, np.pi, 2)
        level = np.array([np.cos(about), np.sin(about), 0.0]) if axis is None else axis
        rotation = pin.exp3(angle * level) @ pin.utils.rotate("z", heading) @ target.rotation
    else:
        rotation = target.rotation @ pin.exp3(angle * (sample_axis(rng) if axis is None else axis))
    return pin.SE3(rotation, target.translation.copy())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "angle", [0.0, 1e-3, 0.3, 1.6, 3.0, *(np.pi - x for x in (2e-3, 5e-4, 1e-6, 1e-12, 0, -1e-4))]
)
def test_residuals_and_violations_vanish_only_at_the_target(kind: str, angle: float) -> None:
    """A residual ½ vee(E − Eᵀ) would vanish at half turns, too."""
    rng = np.random.default_rng(8)
    for axis in (*np.eye(3)[: 2 if kind in ("upright", "level") else 3], *[None] * 5):
        target = pin.SE3.Random()
        placement = turn(kind, target, angle, rng, axis)
        if kind == "point":
            placement.translation += angle * sample_axis(rng)
        elif kind == "level":
            placement.translation += rng.normal(size=3)
        size = np.linalg.norm(evaluate(RESIDUALS[kind], placement, target))
        if angle == 0.0:
            assert size < 1e-9
            assert compute_violation(kind, placement, target) < 1e-12
        else:
            assert size > min(0.5 * angle, 0.1)
            if kind != "point":
                of_rotation = (
                    size if kind == "level" else compute_rotation_size(kind, placement, target)
                )
                expected = 2.0 * np.sin(abs(angle) / 2.0)
                assert of_rotation == pytest.approx(expected, rel=1e-3, abs=1e-5)
            assert compute_violation(kind, placement, target) > min(0.3 * angle, 0.1)


@pytest.mark.parametrize("kind", ["pose", "upright"])
@pytest.mark.parametrize("axis", range(3))
def test_newton_steps_lead_away_from_half_turns(kind: str, axis: int) -> None:
    target, rng = pin.SE3.Random(), np.random.default_rng(2)
    placement = turn(kind, target, np.pi, rng, np.eye(3)[axis] if kind == "pose" else None)
    for _ in range(15):
        at = (placement.rotation, placement.translation, flatten_placements([target])[0])
        slope = np.asarray(SLOPES[kind](*at, np.zeros(3)))[3:, 3:]
        residual = evaluate(RESIDUALS[kind], placement, target)[3:]
        step = -np.linalg.lstsq(slope, residual, rcond=1e-6)[0]
        step *= min(1.0, 0.5 / max(np.linalg.norm(step), 1e-12))
        placement = placement * pin.SE3(pin.exp3(step), np.zeros(3))
    assert np.linalg.norm(evaluate(RESIDUALS[kind], placement, target)) < 1e-9
    assert compute_violation(kind, placement, target) < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_linear_in_the_placement(kind: str) -> None:
    """Therefore they add nothing to the program's second derivatives."""
    placement = ca.vertcat(ca.vec(_R), _p)
    gradient = ca.jacobian(build_pose_rows(kind, _R, _p, _target), placement)
    assert ca.jacobian(gradient, placement).nnz() == 0


# --- relaxed targets

_offset, _relaxation = ca.SX.sym("D", POSE_OFFSET_SIZE), ca.SX.sym("e")
RELAX = ca.Function(
    "relax", [_target, _offset, _relaxation], [relax_target(_target, _offset, _relaxation)]
)


def relax(target: pin.SE3, offset: np.ndarray, relaxation: float) -> pin.SE3:
    vector = np.asarray(RELAX(flatten_placements([target])[0], offset, relaxation)).ravel()
    return pin.SE3(vector[:9].reshape(3, 3).T, vector[9:])


def compute_offsets(kind: str, target: pin.SE3, placements: list[pin.SE3]) -> np.ndarray:
    rotations, translations = (
        np.array([getattr(p, part) for p in placements]) for part in ("rotation", "translation")
    )
    found = compute_pose_offsets(kind, rotations, translations, target)
    assert found.shape == (len(placements), POSE_OFFSET_SIZE)
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:6], axis=1), 1.0, rtol=0.0, atol=1e-12)
    return found


def sample_placements(kind: str, target: pin.SE3, angle: float) -> list[pin.SE3]:
    """Return placements that differ from `target` by an angle and random offsets."""
    rng = np.random.default_rng(14)
    axes = np.eye(3) if kind == "pose" else ()
    placements = [turn(kind, target, angle, rng, axis) for axis in (*axes, *[None] * 8)]
    return [pin.SE3(p.rotation, p.translation + rng.normal(size=3)) for p in placements]


@pytest.mark.long
def test_pose_offsets_leak_no_memory() -> None:
    target, placements = pin.SE3.Random(), [pin.SE3.Random() for _ in range(50)]
    size, objects = measure_growth(lambda: compute_offsets("pose", target, placements))
    assert size <= 50 * 8
    assert objects <= 50 / 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", ANGLES)
def test_pose_offsets_are_translation_and_shortest_rotation(kind: str, angle: float) -> None:
    """A fully relaxed target is the frame's pose; tilts are corrected about horizontal axes."""
    target = pin.SE3.Random()
    placements = sample_placements(kind, target, angle)
    offsets = compute_offsets(kind, target, placements)
    np.testing.assert_allclose(offsets[:, 6], 0.0 if kind == "point" else angle, atol=1e-9)
    for placement, offset in zip(placements, offsets, strict=True):
        relaxed = relax(target, offset, 1.0)
        translation = target.translation if kind == "level" else placement.translation
        np.testing.assert_allclose(relaxed.translation, translation, rtol=0.0, atol=1e-12)
        if kind == "pose":
            np.testing.assert_allclose(relaxed.rotation, placement.rotation, rtol=0.0, atol=1e-9)
        elif kind == "point":
            np.testing.assert_allclose(relaxed.rotation, target.rotation, rtol=0.0, atol=1e-12)
        elif angle > 1e-6:
            assert (target.rotation @ offset[3:6])[2] == pytest.approx(0.0, abs=1e-9)
        assert compute_violation(kind, placement, relaxed) < 1e-9
        unrelaxed = relax(target, offset, 0.0)
        np.testing.assert_allclose(unrelaxed.homogeneous, target.homogeneous, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("kind", ["upright", "level"])
def test_offsets_of_exactly_upright_and_upside_down_frames(kind: str) -> None:
    rotations = np.stack([np.eye(3), np.diag([1.0, -1.0, -1.0])])
    for heading in (0.0, 1.0):
        target = pin.SE3(pin.utils.rotate("z", heading), np.zeros(3))
        found = compute_pose_offsets(kind, rotations, np.zeros((2, 3)), target)
        np.testing.assert_allclose(found[:, 6], [0.0, np.pi], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(found[:, 3:6], axis=1), 1.0)
        assert found[1, 5] == 0.0  # about a horizontal axis
    assert len(compute_pose_offsets(kind, rotations[:0], np.zeros((0, 3)), target)) == 0
