"""Residuals between placements, symbolically."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["POSE_LOWER", "POSE_UPPER", "pose_residual", "pose_rows", "target_vector"]

POSE_LOWER = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
POSE_UPPER = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf])

_HALF_TURN = 1e-6  # of (2 cos(θ/2))²
_GENERIC = ca.DM([0.3, 0.55, 0.78])  # perpendicular to no axis that anybody turns about


def pose_residual(rotation: Any, translation: Any, target: Any) -> Any:
    """Return (p − p*, 2 sin(θ/2)·a), shape (6, 1), of a placement to `target` = (R* by columns, p*), shape (12, 1).

    θ and a are angle and axis of E = R*ᵀR. Unlike ½ vee(E − Eᵀ), which vanishes at θ = π too, this grows up to π, where
    the axis, and so every residual, has two signs. Within 1e-3 of π it comes from E + I = 2aaᵀ instead, with a slope that
    leads away from there.
    """
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = ca.vertcat(error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1])
    squared = 1.0 + error[0, 0] + error[1, 1] + error[2, 2]  # (2 cos(θ/2))²
    turned = error @ _GENERIC + _GENERIC + vee
    angle = ca.if_else(squared > _HALF_TURN, vee / ca.sqrt(ca.fmax(squared, _HALF_TURN)), turned)
    return ca.vertcat(translation - target[9:], angle)


def pose_rows(rotation: Any, translation: Any, target: Any) -> Any:
    """Return (p − p*, ½ vee(E − Eᵀ), trace E), shape (7, 1): constraints that are linear in the placement.

    With E = R*ᵀR they lie between `POSE_LOWER` and `POSE_UPPER` where, and only where, the placement is the target: the
    trace keeps out the half turns, where the antisymmetric part vanishes too. Being linear in (R, p) they add nothing to
    the second derivatives of the kinematics, as `pose_residual` would.
    """
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = ca.vertcat(error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]) / 2
    return ca.vertcat(translation - target[9:], vee, error[0, 0] + error[1, 1] + error[2, 2])


def target_vector(placement: pin.SE3) -> NDArray[np.float64]:
    """Return `placement` as the 12 numbers `pose_residual` takes."""
    return np.concatenate([placement.rotation.T.ravel(), placement.translation])
