"""Residuals between placements, symbolically: h_chain of eq. 2 and f_task of eq. 3.

Three kinds of goal: "pose" is a whole placement; "point" only its translation; "upright" the translation, and the world's
vertical as the target has it, at any heading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats

__all__ = ["ROW_BOUNDS", "PoseRow", "pose_residual", "pose_rows", "target_vector"]

ROW_BOUNDS: Mapping[str, tuple[Floats, Floats]] = {
    "pose": (np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf])),
    "point": (np.zeros(3), np.zeros(3)),
    "upright": (np.zeros(6), np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.inf])),
}
"""For every kind of goal, the bounds between which `pose_rows` must lie."""


@dataclass(frozen=True)
class PoseRow:
    """A frame that must be at a parametric placement at some waypoints.

    Attributes:
        joint: Joint of the model that carries it.
        local: Its placement in the joint's frame.
        waypoints: At which waypoints, counted from 1.
        kind: "pose", "point" or "upright"; see `pose`.
        shift: (joint, vector): what is added to the frame's translation, a vector that is fixed in another joint's frame [m].
            With it a hand can be asked to be short of a grasp by so much along its approach, wherever in the grasp that is.
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


_HALF_TURN = 1e-6  # of (2 cos(θ/2))²
_GENERIC = ca.DM([0.3, 0.55, 0.78])  # perpendicular to no axis that anybody turns about


def pose_residual(kind: str, rotation: Any, translation: Any, target: Any) -> Any:
    """Return (p − p*, 2 sin(θ/2)·a) of a placement to `target` = (R* by columns, p*), shape (12, 1).

    Of a "pose" it has shape (6, 1): θ and a are angle and axis of E = R*ᵀR. Unlike ½ vee(E − Eᵀ), which vanishes at θ = π
    too, this grows up to π, where the axis, and so every residual, has two signs. Within 1e-3 of π it comes from
    E + I = 2aaᵀ instead, with a slope that leads away from there. Of a "point" it is p − p*, shape (3, 1). Of "upright",
    shape (5, 1), θ is the angle between the two verticals, and a has two components.
    """
    offset = translation - target[9:]
    if kind == "point":
        return offset
    if kind == "upright":
        sideways, along = _tilt(rotation, target)
        squared = 2.0 + 2.0 * along  # (2 cos(θ/2))²
        upside_down = ca.DM([2.0, 0.0])
        tilt = ca.if_else(squared > _HALF_TURN, 2.0 * sideways / ca.sqrt(ca.fmax(squared, _HALF_TURN)), upside_down + sideways)
        return ca.vertcat(offset, tilt)
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = ca.vertcat(error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1])
    squared = 1.0 + error[0, 0] + error[1, 1] + error[2, 2]  # (2 cos(θ/2))²
    turned = error @ _GENERIC + _GENERIC + vee
    angle = ca.if_else(squared > _HALF_TURN, vee / ca.sqrt(ca.fmax(squared, _HALF_TURN)), turned)
    return ca.vertcat(offset, angle)


def pose_rows(kind: str, rotation: Any, translation: Any, target: Any) -> Any:
    """Return constraints that are linear in the placement, and lie between `ROW_BOUNDS` where, and only where, the goal holds.

    A "pose" gives (p − p*, ½ vee(E − Eᵀ), trace E) with E = R*ᵀR, shape (7, 1): the trace keeps out the half turns, where
    the antisymmetric part vanishes too. "upright" gives (p − p*, sideways, along), shape (6, 1): the vertical's components
    across the target's vertical and along it, of which the last keeps out what stands on its head. Being linear in (R, p)
    they add nothing to the second derivatives of the kinematics, as `pose_residual` would.
    """
    offset = translation - target[9:]
    if kind == "point":
        return offset
    if kind == "upright":
        return ca.vertcat(offset, *_tilt(rotation, target))
    error = ca.reshape(target[:9], 3, 3).T @ rotation
    vee = ca.vertcat(error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]) / 2
    return ca.vertcat(offset, vee, error[0, 0] + error[1, 1] + error[2, 2])


def _tilt(rotation: Any, target: Any) -> tuple[Any, Any]:
    """Return the world's vertical, seen from the body, across the target's (2 components) and along it."""
    vertical = ca.reshape(target[:9], 3, 3) @ rotation[2, :].T
    return vertical[:2], vertical[2]


def target_vector(placement: pin.SE3) -> Floats:
    """Return `placement` as the 12 numbers that targets are."""
    return np.concatenate([placement.rotation.T.ravel(), placement.translation])
