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
    """A frame that must attain a parametric placement at some waypoints.

    Attributes:
        joint: Joint of the model that carries the frame.
        local: Placement of the frame on the joint.
        waypoints: Waypoints at which the goal applies, counted from 1.
        kind: "pose", "point", "upright" or "level"; see `pose`.
        shift: (joint, vector): vector [m] in that joint's frame that is added to the translation.
            It keeps a hand at a distance from a grasp along its approach direction.
    """

    joint: int
    local: pin.SE3
    waypoints: tuple[int, ...]
    kind: str = "pose"
    shift: tuple[int, tuple[float, float, float]] | None = None

    @property
    def rows(self) -> int:
        """Number of constraint rows."""
        return len(ROW_BOUNDS[self.kind][0])

    def build_placement(self, placements: Any) -> tuple[Any, Any]:
        """Return the frame's rotation and translation, given all joint placements, (12, J − 1)."""
        column = placements[:, self.joint - 1]
        rotation = ca.reshape(column[:9], 3, 3)
        translation = rotation @ self.local.translation + column[9:]
        if self.shift is not None:
            joint, vector = self.shift
            translation = translation + ca.reshape(placements[:9, joint - 1], 3, 3) @ ca.DM(vector)
        return rotation @ self.local.rotation, translation

    def compute_placements(self, rotations: Floats, translations: Floats) -> tuple[Floats, Floats]:
        """Return rotations and translations of the frame, (B, ...), given those of all joints."""
        rotation = rotations[:, self.joint]
        translation = rotation @ self.local.translation + translations[:, self.joint]
        if self.shift is not None:
            joint, vector = self.shift
            translation = translation + rotations[:, joint] @ np.array(vector)
        return rotation @ self.local.rotation, translation


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
    if kind in _VERTICAL:
        tilt_components, along = _compute_tilt(rotation, target)
        squared = 2.0 + 2.0 * along  # (2 cos(θ/2))²
        upside_down = ca.DM([2.0, 0.0])
        tilt = ca.if_else(
            squared > _MIN_SQUARED_COSINE,
            2.0 * tilt_components / ca.sqrt(ca.fmax(squared, _MIN_SQUARED_COSINE)),
            upside_down + tilt_components,
        )
        return ca.vertcat(offset, tilt) if kind == "upright" else tilt
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = ca.vertcat(
        error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]
    )
    squared = 1.0 + error[0, 0] + error[1, 1] + error[2, 2]  # (2 cos(θ/2))²
    flipped = error @ _GENERIC_VECTOR + _GENERIC_VECTOR  # 2(a·g)a
    flipped = 2.0 * flipped / ca.sqrt(ca.fmax(ca.sumsqr(flipped), _MIN_SQUARED_COSINE)) + vee
    angle = ca.if_else(
        squared > _MIN_SQUARED_COSINE, vee / ca.sqrt(ca.fmax(squared, _MIN_SQUARED_COSINE)), flipped
    )
    return ca.vertcat(offset, angle)


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
        return ca.vertcat(
            *([offset] if kind == "upright" else []), *_compute_tilt(rotation, target)
        )
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = (
        ca.vertcat(error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1])
        / 2
    )
    return ca.vertcat(offset, vee, error[0, 0] + error[1, 1] + error[2, 2])


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
    if (
        kind in _VERTICAL
        # θ is the tilt of the vertical in the world; an upside-down frame tilts about any level
        # axis
    ):
        vertical = rotations[:, 2] @ target.rotation.T
        axis_sine = np.column_stack([vertical[:, 1], -vertical[:, 0], np.zeros(len(axis_sine))])
        axis_sine = (
            np.where(axis_sine.any(axis=1, keepdims=True), axis_sine, [1e-99, 0.0, 0.0])
            @ target.rotation
        )
        cosine = vertical[:, 2]
    elif kind == "pose":
        # eigenpy never frees its copies of row-major matrices.
        errors = map(np.asfortranarray, target.rotation.T @ rotations)
        quaternions = np.array([pin.Quaternion(error).coeffs() for error in errors]).reshape(-1, 4)
        axis_sine = quaternions[:, :3] * np.where(quaternions[:, 3:] < 0.0, -1.0, 1.0)
        cosine = np.abs(quaternions[:, 3])
    size = np.linalg.norm(axis_sine, axis=1, keepdims=True)
    axis = np.where(size > 0.0, axis_sine / np.maximum(size, np.finfo(float).tiny), [0.0, 0.0, 1.0])
    angle = (2.0 if kind == "pose" else 1.0) * np.arctan2(size[:, 0], cosine)
    return np.column_stack([(kind != "level") * (translations - target.translation), axis, angle])


def relax_target(target: Any, pose_offset: Any, relaxation: Any) -> Any:
    """Return a target moved towards a frame: R*·exp(e·θ·a) and p* + e·(p − p*), shape (12, 1).

    With relaxation e = 1 it is where the frame was at `compute_pose_offsets`, with e = 0 the
    target.
    """
    skew = ca.skew(pose_offset[3:6])
    turn = (
        ca.DM.eye(3)
        + ca.sin(relaxation * pose_offset[6]) * skew
        + (1.0 - ca.cos(relaxation * pose_offset[6])) * (skew @ skew)
    )
    return ca.vertcat(
        ca.vec(ca.reshape(target[:9], 3, 3) @ turn), target[9:] + relaxation * pose_offset[:3]
    )


def _compute_tilt(rotation: Any, target: Any) -> tuple[Any, Any]:
    """Return the components of the vertical across and along the target's, in the frame."""
    vertical = ca.reshape(target[:9], 3, 3) @ rotation[2, :].T
    return vertical[:2], vertical[2]


def flatten_target(placement: pin.SE3) -> Floats:
    """Return `placement` as the 12 numbers of a target."""
    return np.concatenate([placement.rotation.T.ravel(), placement.translation])
