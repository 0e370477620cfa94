"""The constraint rows of one waypoint, as SX functions: small, exact to second order, mapped over the waypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin import cpin
from vkc_pin.coordinates import Coordinates
from vkc_pin.pose import PoseRow, pose_rows

__all__ = ["Structure", "WaypointFunctions"]


@dataclass(frozen=True, eq=False)
class Structure:
    """What a symbolic program depends on.

    Attributes:
        model: The chain.
        segments: N, the number of waypoints after the start.
        poses: Frames that must be somewhere.
        slots: K, witness planes per waypoint.
        weights_velocity: Of eq. 1, on the squared differences, shape (N, n).
        weights_acceleration: The same for second differences, per coordinate, shape (n,).
        rests: Waypoints inside the motion at which it comes to rest, as it does at start and end.
        differential: Whether the base must not slip sideways.
        clamped: (column, first, last): coordinates that keep their value from waypoint `first` to `last`, as a hand does
            that clamps.
    """

    model: pin.Model
    segments: int
    poses: tuple[PoseRow, ...]
    slots: int
    weights_velocity: NDArray[np.float64]
    weights_acceleration: NDArray[np.float64]
    rests: tuple[int, ...] = ()
    differential: bool = False
    clamped: tuple[tuple[int, int, int], ...] = ()

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for structures that share one program."""
        poses = tuple((p.joint, p.local.homogeneous.round(12).tobytes(), p.waypoints, p.kind, p.shift) for p in self.poses)
        weights = (self.weights_velocity.tobytes(), self.weights_acceleration.tobytes())
        others = (self.rests, self.differential, self.clamped)
        return (self.model.saveToString(), self.segments, poses, self.slots, *weights, *others)


class WaypointFunctions:
    """The SX functions of one kind of waypoint: which poses it must satisfy."""

    def __init__(self, structure: Structure, poses: Sequence[int]) -> None:
        model, coordinates = structure.model, Coordinates(structure.model)
        n, slots, joints = coordinates.size, structure.slots, model.njoints - 1
        z, s = ca.SX.sym("z", n), ca.SX.sym("s")
        planes, offsets = ca.SX.sym("C", slots, 12 * joints), ca.SX.sym("R", slots)
        targets = ca.SX.sym("W", 12, max(len(poses), 1))
        placements = cpin.joint_placements(model)(coordinates.q_symbolic(z))
        stacked = ca.vec(placements)
        # Every row is linear in the placements: rows = L·vec(M) + const, so one sweep of the kinematics serves them all.
        parts = []
        for k, pose in enumerate(poses):
            row = structure.poses[pose]
            parts.append(pose_rows(row.kind, *row.placement(placements), targets[:, k]))
        pose_values = ca.vertcat(*parts) if parts else ca.SX(0, 1)
        self.pose_rows = [structure.poses[pose].rows for pose in poses]
        self.rows = slots + sum(self.pose_rows)
        rows = ca.vertcat(planes @ stacked - offsets + s, pose_values)
        multipliers = ca.SX.sym("lam", self.rows)
        sweep = ca.jacobian(stacked, z)
        pose_jacobian = ca.jacobian(pose_values, z)
        jacobian = ca.vertcat(
            ca.horzcat(planes @ sweep, ca.SX.ones(slots, 1)), ca.horzcat(pose_jacobian, ca.SX(pose_values.numel(), 1))
        )
        w = ca.SX.sym("w", 12 * joints)
        hessian = ca.triu(ca.hessian(ca.dot(w, stacked) + ca.dot(multipliers[slots:], pose_values), z)[0])
        inner = ca.Function("inner", [z, targets, w, multipliers], [hessian])
        hessian = inner(z, targets, planes.T @ multipliers[:slots], multipliers)
        inputs = [z, s, ca.vec(planes), offsets, ca.vec(targets)]
        options = {"cse": True}
        self.value = ca.Function("g", inputs, [rows], options)
        self.jacobian = ca.Function("rows_jacobian", inputs, [ca.vertcat(*jacobian.nonzeros())], options)
        self.jacobian_pattern = jacobian.sparsity().get_triplet()
        self.hessian = ca.Function("lagrangian_hessian", [*inputs, multipliers], [ca.vertcat(*hessian.nonzeros())], options)
        self.hessian_pattern = hessian.sparsity().get_triplet()
