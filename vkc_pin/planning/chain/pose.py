"""Builds symbolic residuals between placements: h_chain of eq. 2 and f_task of eq. 3.

There are four kinds of goals: "pose" prescribes the placement; "point" only the translation;
"level" the direction of the world's vertical seen from the frame; "upright" that and the
translation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats

ROW_BOUNDS: Mapping[str, tuple[Floats, Floats]] = {
    "pose": (
        np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf]),
    ),
    "point": (np.zeros(3), np.zeros(3)),
    "upright": (np.zeros(6), np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.inf])),
    "level": (np.zeros(3), np.array([0.0, 0.0, np.inf])),
}
"""For every kind of goal, the bounds between which `build_pose_rows` must lie."""


@dataclass(frozen=True)
class PoseRow:
    """The constraint rows of a frame that must attain a placement at some waypoints.

    The placement, and that of the frame on its joint, are arguments of the rows.

    Attributes:
        joint: Joint of the model that carries the frame.
        waypoints: Waypoints at which the goal applies, counted from 1.
        kind: "pose", "point", "upright" or "level"; see `pose`.
        shift: (joint, vector): vector [m] in that joint's frame that is added to the translation.
            It keeps a hand at a distance from a grasp along its approach direction.
    """

    joint: int
    waypoints: tuple[int, ...]
    kind: str = "pose"
    shift: tuple[int, tuple[float, float, float]] | None = None

    @property
    def rows(self) -> int:
        """Number of constraint rows."""
        return len(ROW_BOUNDS[self.kind][0])

    @property
    def key(self) -> tuple[Any, ...]:
        """Cache key of the rows at one waypoint."""
        return self.joint, self.kind, self.shift

    def build_placement(self, placements: Any, local: Any) -> tuple[Any, Any]:
        """Return the frame's rotation and translation.

        Args:
            placements: Placements of all joints, (12, J − 1).
            local: Placement of the frame on its joint, (12, 1).
        """
        column = placements[:, self.joint - 1]
        rotation = ca.reshape(column[:9], 3, 3)
        translation = rotation @ local[9:] + column[9:]
        if self.shift is not None:
            joint, vector = self.shift
            shift_rotation = ca.reshape(placements[:9, joint - 1], 3, 3)
            translation = translation + shift_rotation @ ca.DM(vector)
        return rotation @ ca.reshape(local[:9], 3, 3), translation

    def compute_placements(
        self, rotations: Floats, translations: Floats, local: pin.SE3
    ) -> tuple[Floats, Floats]:
        """Return rotations and translations of the frame, (B, ...), given those of all joints."""
        rotation = rotations[:, self.joint]
        translation = rotation @ local.translation + translations[:, self.joint]
        if self.shift is not None:
            joint, vector = self.shift
            translation = translation + rotations[:, joint] @ np.array(vector)
        return rotation @ local.rotation, translation


_VERTICAL = ("upright", "level")
_MIN_SQUARED_COSINE = 1e-6  # of (2 cos(θ/2))²
_GENERIC_VECTOR = ca.DM([0.3, 0.55, 0.78])  # not perpendicular to any axis that occurs in practice


def build_pose_residual(kind: str, rotation: Any, translation: Any, target: Any) -> Any:
    """Return the residual (p − p*, 2 sin(θ/2)·a) of a placement to `target` = (R*, p*), (12, 1).

    For a "pose", shape (6, 1), θ and a are angle and axis of E = R*ᵀR. Unlike ½ vee(E − Eᵀ), which
    vanishes at θ = π too, it increases up to π; within 1e-3 of π, where the axis is ambiguous, it
    is computed from E + I = 2aaᵀ, with a gradient that leads away. A "point" has only p − p*; for
    "upright", shape (5, 1), θ is the angle between the verticals; "level", (2, 1), has only this
    part.
    """
    offset = translation - target[9:]
    if kind == "point":
        return offset
    if kind == "upright":
        return ca.vertcat(offset, _build_tilt_residual(rotation, target))
    if kind == "level":
        return _build_tilt_residual(rotation, target)
    return ca.vertcat(offset, _build_rotation_residual(rotation, target))


def _build_tilt_residual(rotation: Any, target: Any) -> Any:
    """Return 2 sin(θ/2)·(u_x, u_y)/sin θ for the angle θ between the verticals, shape (2, 1).

    With the vertical u of the world, of which u_x and u_y are across the target's and u_z = cos θ
    is along it, this is 2 (u_x, u_y) / (2 cos(θ/2)), where (2 cos(θ/2))² = 2 + 2 cos θ. Near
    θ = π, where the direction is ambiguous, it is 2 in any direction, with the gradient of u.
    """
    across, along = _compute_tilt(rotation, target)
    squared_cosine = 2.0 + 2.0 * along  # (2 cos(θ/2))²
    double_cosine = ca.sqrt(ca.fmax(squared_cosine, _MIN_SQUARED_COSINE))
    upside_down = ca.DM([2.0, 0.0])
    return ca.if_else(
        squared_cosine > _MIN_SQUARED_COSINE,
        2.0 * across / double_cosine,
        upside_down + across,
    )


def _build_rotation_residual(rotation: Any, target: Any) -> Any:
    """Return 2 sin(θ/2)·a for angle θ and axis a of E = R*ᵀR, shape (3, 1).

    vee(E − Eᵀ) is 2 sin θ·a = 4 sin(θ/2) cos(θ/2)·a, and the trace of E is 1 + 2 cos θ, so that
    (2 cos(θ/2))² = 1 + trace E. Near θ = π, where E + I = 2aaᵀ, the residual is twice the unit
    vector along (E + I) g = 2(a·g)a for some g; adding vee leads away from π.
    """
    error = _compute_rotation_error(rotation, target)
    vee = _build_vee(error)
    squared_cosine = 1.0 + error[0, 0] + error[1, 1] + error[2, 2]  # (2 cos(θ/2))²
    double_cosine = ca.sqrt(ca.fmax(squared_cosine, _MIN_SQUARED_COSINE))
    along_axis = error @ _GENERIC_VECTOR + _GENERIC_VECTOR
    size = ca.sqrt(ca.fmax(ca.sumsqr(along_axis), _MIN_SQUARED_COSINE))
    half_turn = 2.0 * along_axis / size + vee
    return ca.if_else(squared_cosine > _MIN_SQUARED_COSINE, vee / double_cosine, half_turn)


def _compute_rotation_error(rotation: Any, target: Any) -> Any:
    """Return E = R*ᵀR, shape (3, 3)."""
    return ca.reshape(target[:9], 3, 3).T @ rotation


def _build_vee(error: Any) -> Any:
    """Return vee(E − Eᵀ) = 2 sin(θ)·a of a rotation by θ about a, shape (3, 1)."""
    return ca.vertcat(
        error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]
    )


def build_pose_rows(kind: str, rotation: Any, translation: Any, target: Any) -> Any:
    """Return constraint rows that lie within `ROW_BOUNDS` if and only if the goal holds.

    A "pose" gives (p − p*, ½ vee(E − Eᵀ), trace E) with E = R*ᵀR, shape (7, 1); the trace excludes
    half turns. "level" gives the vertical across the target's and along it, shape (3, 1); "upright"
    p − p* and these. The rows are linear in (R, p) and add nothing to the kinematics' second
    derivatives.
    """
    offset = translation - target[9:]
    if kind == "point":
        return offset
    if kind in _VERTICAL:
        across, along = _compute_tilt(rotation, target)
        if kind == "upright":
            return ca.vertcat(offset, across, along)
        return ca.vertcat(across, along)
    error = _compute_rotation_error(rotation, target)
    vee = _build_vee(error) / 2
    trace = error[0, 0] + error[1, 1] + error[2, 2]
    return ca.vertcat(offset, vee, trace)


# Size of a pose offset: translation [m], rotation axis and rotation angle [rad].
POSE_OFFSET_SIZE = 7


def compute_pose_offsets(
    kind: str, rotations: Floats, translations: Floats, target: pin.SE3
) -> Floats:
    """Return the offsets of frames from their target, shape (B, 7): p − p*, axis a and angle θ.

    exp(θa) = R*ᵀR; for "upright" and "level" it is the shortest rotation that aligns the verticals.
    A "point" has none, and "level" no translation. Offsets are accurate near half turns, too.

    Args:
        kind: Kind of the goal.
        rotations: Rotations of the frames, shape (B, 3, 3).
        translations: Translations of the frames, shape (B, 3) [m].
        target: Target placement.
    """
    # Axis times sine, and cosine, of the angle θ, or of θ/2 for a pose.
    axis_sine = np.zeros((len(rotations), 3))
    cosine = np.ones(len(rotations))
    if kind in _VERTICAL:
        # With u = R*Rᵀe_z the frame is tilted by θ about (u_y, −u_x, 0) in the world; if it is
        # upside down, about any level axis.
        vertical = rotations[:, 2] @ target.rotation.T
        axis_sine = np.column_stack([vertical[:, 1], -vertical[:, 0], np.zeros(len(axis_sine))])
        has_axis = axis_sine.any(axis=1, keepdims=True)
        axis_sine = np.where(has_axis, axis_sine, [1e-99, 0.0, 0.0]) @ target.rotation
        cosine = vertical[:, 2]
    elif kind == "pose":
        # A unit quaternion is (sin(θ/2) a, cos(θ/2)), and its negative the same rotation: take the
        # one with θ ≤ π.
        errors = target.rotation.T @ rotations
        quaternions = np.zeros((len(errors), 4))
        for quaternion, error in zip(quaternions, errors, strict=True):
            # eigenpy never frees its copies of row-major matrices.
            quaternion[:] = pin.Quaternion(np.asfortranarray(error)).coeffs()
        axis_sine = quaternions[:, :3] * np.where(quaternions[:, 3:] < 0.0, -1.0, 1.0)
        cosine = np.abs(quaternions[:, 3])
    sine = np.linalg.norm(axis_sine, axis=1, keepdims=True)
    axis = np.where(sine > 0.0, axis_sine / np.maximum(sine, np.finfo(float).tiny), [0.0, 0.0, 1.0])
    angle = np.arctan2(sine[:, 0], cosine)
    if kind == "pose":
        angle = 2.0 * angle
    offsets = translations - target.translation
    if kind == "level":
        offsets = 0.0 * offsets
    return np.column_stack([offsets, axis, angle])


def relax_target(target: Any, pose_offset: Any, relaxation: Any) -> Any:
    """Return a target moved towards a frame: R*·exp(e·θ·a) and p* + e·(p − p*), shape (12, 1).

    With relaxation e = 1 it is where the frame was at `compute_pose_offsets`, with e = 0 the
    target. By Rodrigues' formula, with the matrix K of the cross product with a,

        exp(e·θ·a) = I + sin(e·θ) K + (1 − cos(e·θ)) K²
    """
    offset = pose_offset[:3]
    cross = ca.skew(pose_offset[3:6])
    angle = pose_offset[6]
    turn = (
        ca.DM.eye(3)
        + ca.sin(relaxation * angle) * cross
        + (1.0 - ca.cos(relaxation * angle)) * (cross @ cross)
    )
    rotation = ca.reshape(target[:9], 3, 3) @ turn
    return ca.vertcat(ca.vec(rotation), target[9:] + relaxation * offset)


def _compute_tilt(rotation: Any, target: Any) -> tuple[Any, Any]:
    """Return the components of u = R*Rᵀe_z across (x, y) and along (z) the vertical.

    It is the world's vertical as seen from the frame, turned by the target.
    """
    vertical = ca.reshape(target[:9], 3, 3) @ rotation[2, :].T
    return vertical[:2], vertical[2]
