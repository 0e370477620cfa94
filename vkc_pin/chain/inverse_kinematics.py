"""Inverse kinematics of the whole chain for many seeds at once: damped Gauss-Newton on mapped CasADi functions."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Bools, Floats
from vkc_pin.budget import spend
from vkc_pin.cache import Cache
from vkc_pin.chain.kinematics import kinematics_of
from vkc_pin.chain.pose import PoseRow, pose_residual, target_vector
from vkc_pin.cpin.batch import BatchFunction

__all__ = ["LONGEST_STEP", "PoseSolver"]

LONGEST_STEP = 0.5  # [m] or [rad] of a Gauss-Newton step in one coordinate


class PoseSolver:
    """Brings one frame of a model to placements, for a batch of configurations.

    Attributes:
        size: Number of coordinates n.
        rows: Number of residuals m: 6 of a pose, 5 of an upright place, 3 of a point; see `pose`.
    """

    def __init__(self, model: pin.Model, pose: PoseRow, cache: Cache | None = None) -> None:
        self.size = model.nv
        z, target = ca.SX.sym("z", self.size), ca.SX.sym("W", 12)
        placements = kinematics_of(model, cache or Cache()).symbolic(z)
        residual = pose_residual(pose.kind, *pose.placement(placements), target)
        self.rows = int(residual.numel())
        jacobian = ca.densify(ca.jacobian(residual, z))
        self._function = BatchFunction(ca.Function("pose", [z, target], [ca.densify(residual), jacobian], {"cse": True}))

    @property
    def nbytes(self) -> int:
        """Its size in memory, estimated [bytes]."""
        return self._function.nbytes

    def evaluate(self, z: Floats, target: pin.SE3) -> tuple[Floats, Floats]:
        """Return residuals, shape (B, m) ([m], [rad]), and their Jacobians, shape (B, m, n), at `z`, shape (B, n)."""
        return self._evaluate(z, target_vector(target))

    def _evaluate(self, z: Floats, target: Floats) -> tuple[Floats, Floats]:
        spend(len(z))
        residual, jacobian = self._function(z, target)
        return residual, jacobian.reshape(len(z), self.size, self.rows).swapaxes(1, 2)

    def solve(
        self,
        z: Floats,
        target: pin.SE3,
        *,
        lower: Floats,
        upper: Floats,
        weights: Floats,
        iterations: int = 12,
        tolerance: float = 1e-6,
    ) -> tuple[Floats, Bools]:
        """Return configurations that satisfy the pose within limits, near the given ones, and which of them do.

        Args:
            z: Seeds, shape (B, n).
            target: Placement of the frame in the world.
            lower: Lower limits, shape (n,) or (B, n).
            upper: Upper limits, shape (n,) or (B, n); a coordinate whose limits are equal stays there.
            weights: What moving a coordinate costs, shape (n,).
            iterations: At most so many steps.
            tolerance: Largest residual of a solution, [m] and [rad].

        Returns:
            Configurations, shape (B, n), and a mask, shape (B,).
        """
        z, goal = np.clip(z, lower, upper), target_vector(target)
        lower, upper = np.broadcast_to(lower, z.shape), np.broadcast_to(upper, z.shape)
        errors = np.empty(len(z))
        at, rows = np.arange(len(z)), z  # what is not solved yet, with its limits
        for remaining in range(iterations, -1, -1):
            residual, jacobian = self._evaluate(rows, goal)
            errors[at] = error = np.abs(residual).max(axis=1)
            still = error >= tolerance
            if not still.all():
                at, rows, lower, upper, residual, jacobian = (a[still] for a in (at, rows, lower, upper, residual, jacobian))
            if not len(at) or not remaining:
                break
            rows = np.clip(rows + _step(rows, residual, jacobian, weights, (lower, upper)), lower, upper)
            z[at] = rows
        return z, errors < tolerance


def _step(z: Floats, residual: Floats, jacobian: Floats, weights: Floats, limits: tuple[Floats, Floats]) -> Floats:
    """Return damped Gauss-Newton steps, shape (B, n); a coordinate that one pushes beyond its limit is taken out, once."""
    lower, upper = limits
    free = upper - lower > 1e-9
    damping = 1e-8 + 1e-3 * np.minimum(1.0, np.sum(residual**2, axis=1))
    damped = damping[:, None, None] * np.eye(residual.shape[1])
    step = np.zeros_like(z)
    for _ in range(2):
        scaled = jacobian * (free / weights)[:, None, :]
        system = scaled @ jacobian.transpose(0, 2, 1) + damped
        step = -np.einsum("bij,bi->bj", scaled, np.linalg.solve(system, residual[..., None])[..., 0])
        step *= np.minimum(1.0, LONGEST_STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        blocked = free & ((z + step < lower - 1e-12) | (z + step > upper + 1e-12))
        if not blocked.any():
            break
        free &= ~blocked
    return step
