"""Residuals between placements, symbolically: h_chain of eq. 2 and f_task of eq. 3.

Four kinds of goal: "pose" is a whole placement; "point" only its translation; "level" the world's
vertical as the target has it, anywhere and at any heading; "upright" that and the translation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats

__all__ = [
    "POSE_OFFSET_SIZE",
    "ROW_BOUNDS",
    "PoseRow",
    "compute_pose_offsets",
    "pose_residual",
    "pose_rows",
    "relax_target",
    "target_vector",
]

ROW_BOUNDS: Mapping[str, tuple[Floats, Floats]] = {
    "pose": (
        np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
        np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf]),
    ),
    "point": (np.zeros(3), np.zeros(3)),
    "upright": (np.zeros(6), np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.inf])),
    "level": (np.zeros(3), np.array([0.0, 0.0, np.inf])),
}
"""For every kind of goal, the bounds between which `pose_rows` must lie."""


@dataclass(frozen=True)
class PoseRow:
    """A frame that must be at a parametric placement at some waypoints.

    Attributes:
        joint: Joint of the model that carries it.
        local: Its placement in the joint's frame.
        waypoints: At which waypoints, counted from 1.
        kind: "pose", "point", "upright" or "level"; see `pose`.
        shift: (joint, vector): what is added to the frame's translation, a vector that is fixed in
            another joint's frame [m]. With it a hand can be asked to be short of a grasp by so much
            along its approach, wherever in the grasp that is.
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

    def placement(self, placements: Any) -> tuple[Any, Any]:
        """Return rotation, shape (3, 3), and translation, shape (3, 1), of the frame, given those of all joints (`cpin`)."""
        column = placements[:, self.joint - 1]
        rotation = ca.reshape(column[:9], 3, 3)
        translation = rotation @ self.local.translation + column[9:]
        if self.shift is not None:
            joint, vector = self.shift
            translation = translation + ca.reshape(placements[:9, joint - 1], 3, 3) @ ca.DM(vector)
        return rotation @ self.local.rotation, translation

    def placed(self, rotations: Floats, translations: Floats) -> tuple[Floats, Floats]:
        """Return rotations, shape (B, 3, 3), and translations, shape (B, 3), of the frame, given those of all joints."""
        rotation = rotations[:, self.joint]
        translation = rotation @ self.local.translation + translations[:, self.joint]
        if self.shift is not None:
            joint, vector = self.shift
            translation = translation + rotations[:, joint] @ np.array(vector)
        return rotation @ self.local.rotation, translation


_VERTICAL = ("upright", "level")
_HALF_TURN = 1e-6  # of (2 cos(θ/2))²
_GENERIC = ca.DM([0.3, 0.55, 0.78])  # perpendicular to no axis that anybody turns about


def pose_residual(kind: str, rotation: Any, translation: Any, target: Any) -> Any:
    """Return (p − p*, 2 sin(θ/2)·a) of a placement to `target` = (R* by columns, p*), shape (12, 1).

    Of a "pose" it has shape (6, 1): θ and a are angle and axis of E = R*ᵀR. Unlike ½ vee(E − Eᵀ),
    which vanishes at θ = π too, this grows up to π, where the axis, and so every residual, has two
    signs. Within 1e-3 of π it comes from E + I = 2aaᵀ instead, with a slope that leads away from
    there. Of a "point" it is p − p*, shape (3, 1). Of "upright", shape (5, 1), θ is the angle
    between the two verticals, and a has two components; "level", shape (2, 1), is the latter.
    """
    offset = translation - target[9:]
    if kind == "point":
        return offset
    if kind in _VERTICAL:
        sideways, along = _tilt(rotation, target)
        squared = 2.0 + 2.0 * along  # (2 cos(θ/2))²
        upside_down = ca.DM([2.0, 0.0])
        tilt = ca.if_else(
            squared > _HALF_TURN,
            2.0 * sideways / ca.sqrt(ca.fmax(squared, _HALF_TURN)),
            upside_down + sideways,
        )
        return ca.vertcat(offset, tilt) if kind == "upright" else tilt
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = ca.vertcat(
        error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]
    )
    squared = 1.0 + error[0, 0] + error[1, 1] + error[2, 2]  # (2 cos(θ/2))²
    turned = error @ _GENERIC + _GENERIC  # 2(a·g)a
    turned = 2.0 * turned / ca.sqrt(ca.fmax(ca.sumsqr(turned), _HALF_TURN)) + vee
    angle = ca.if_else(squared > _HALF_TURN, vee / ca.sqrt(ca.fmax(squared, _HALF_TURN)), turned)
    return ca.vertcat(offset, angle)


def pose_rows(kind: str, rotation: Any, translation: Any, target: Any) -> Any:
    """Return constraints that are linear in the placement, and lie between `ROW_BOUNDS` where, and only where, the goal holds.

    A "pose" gives (p − p*, ½ vee(E − Eᵀ), trace E) with E = R*ᵀR, shape (7, 1): the trace keeps out
    the half turns, where the antisymmetric part vanishes too. "level" gives (sideways, along),
    shape (3, 1): the vertical's components across the target's vertical and along it, of which the
    last keeps out what stands on its head. "upright" gives (p − p*, sideways, along), shape (6, 1).
    Being linear in (R, p) they add nothing to the second derivatives of the kinematics, as
    `pose_residual` would.
    """
    offset = translation - target[9:]
    if kind == "point":
        return offset
    if kind in _VERTICAL:
        return ca.vertcat(*([offset] if kind == "upright" else []), *_tilt(rotation, target))
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = (
        ca.vertcat(error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1])
        / 2
    )
    return ca.vertcat(offset, vee, error[0, 0] + error[1, 1] + error[2, 2])


# numbers that say how far a frame is from its target: offset [m], axis and angle [rad] of the turn
POSE_OFFSET_SIZE = 7


def compute_pose_offsets(
    kind: str, rotations: Floats, translations: Floats, target: pin.SE3
) -> Floats:
    """Return how far frames are from their target, shape (B, 7): p − p* [m], and axis a and angle θ [rad] of exp(θa) = R*ᵀR.

    For "upright" and "level" the turn is the shortest that makes the vertical the target's, for
    "point" there is none, and no offset for "level"; see `relax_target`. It is as exact next to half
    turns as anywhere else, which `pose_residual` is not.

    Args:
        kind: Of the goal.
        rotations: Of the frames, shape (B, 3, 3).
        translations: Theirs, shape (B, 3).
        target: Where they are to be.
    """
    turn, along = (
        np.zeros((len(rotations), 3)),
        np.ones(len(rotations)),
    )  # a·sin and cos of θ, or of θ/2
    if (
        kind in _VERTICAL
        # the vertical leans over by θ, as the world sees it; what stands on its head, about any level
        # axis
    ):
        vertical = rotations[:, 2] @ target.rotation.T
        turn = np.column_stack([vertical[:, 1], -vertical[:, 0], np.zeros(len(turn))])
        turn, along = (
            np.where(turn.any(axis=1, keepdims=True), turn, [1e-99, 0.0, 0.0]) @ target.rotation,
            vertical[:, 2],
        )
    elif kind == "pose":
        errors = map(
            np.asfortranarray, target.rotation.T @ rotations
        )  # eigenpy never frees its copies of rows-first matrices
        quaternions = np.array([pin.Quaternion(error).coeffs() for error in errors]).reshape(-1, 4)
        turn, along = (
            quaternions[:, :3] * np.where(quaternions[:, 3:] < 0.0, -1.0, 1.0),
            np.abs(quaternions[:, 3]),
        )
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = np.where(size > 0.0, turn / np.maximum(size, np.finfo(float).tiny), [0.0, 0.0, 1.0])
    angle = (2.0 if kind == "pose" else 1.0) * np.arctan2(size[:, 0], along)
    return np.column_stack([(kind != "level") * (translations - target.translation), axis, angle])


def relax_target(target: Any, away: Any, share: Any) -> Any:
    """Return a target moved back along the way to it, R*·exp(share·θ·a) and p* + share·(p − p*), shape (12, 1).

    At a share of 1 it is where the frame was from which `away`, shape (7, 1), was taken, see
    `compute_pose_offsets`; at 0 the target itself. On the way orientations turn about one axis (a geodesic),
    so that a half turn is as good as any other.
    """
    skew = ca.skew(away[3:6])
    turn = (
        ca.DM.eye(3)
        + ca.sin(share * away[6]) * skew
        + (1.0 - ca.cos(share * away[6])) * (skew @ skew)
    )
    return ca.vertcat(ca.vec(ca.reshape(target[:9], 3, 3) @ turn), target[9:] + share * away[:3])


def _tilt(rotation: Any, target: Any) -> tuple[Any, Any]:
    """Return the world's vertical, seen from the body, across the target's (2 components) and along it."""
    vertical = ca.reshape(target[:9], 3, 3) @ rotation[2, :].T
    return vertical[:2], vertical[2]


def target_vector(placement: pin.SE3) -> Floats:
    """Return `placement` as the 12 numbers that targets are."""
    return np.concatenate([placement.rotation.T.ravel(), placement.translation])
