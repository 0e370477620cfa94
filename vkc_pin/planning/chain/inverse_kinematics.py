"""Inverse kinematics of the whole chain for many seeds at once: damped Gauss-Newton on mapped CasADi functions."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.kinematics import get_kinematics
from vkc_pin.planning.chain.pose import PoseRow, pose_residual, target_vector
from vkc_pin.planning.kinematics.batch import BatchFunction
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.utils.budget import spend
from vkc_pin.utils.cache import Cache

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
        placements = get_kinematics(model, cache or Cache()).symbolic(z)
        residual = ca.densify(pose_residual(pose.kind, *pose.placement(placements), target))
        self.rows = int(residual.numel())
        jacobian = ca.densify(ca.jacobian(residual, z))
        self._function = BatchFunction(ca.Function("pose", [z, target], [residual, jacobian]))
        lower, upper, weights = (
            ca.SX.sym(name, self.size) for name in ("lower", "upper", "weights")
        )
        step = _step(z, residual, jacobian, weights, (lower, upper))
        moved = [ca.mmax(ca.fabs(residual)), ca.fmin(ca.fmax(z + step, lower), upper)]
        self._moved = BatchFunction(ca.Function("moved", [z, target, lower, upper, weights], moved))

    @property
    def nbytes(self) -> int:
        """Its size in memory, estimated [bytes]."""
        return self._function.nbytes + self._moved.nbytes

    def evaluate(self, z: Floats, target: pin.SE3) -> tuple[Floats, Floats]:
        """Return residuals, shape (B, m) ([m], [rad]), and their Jacobians, shape (B, m, n), at `z`, shape (B, n)."""
        residual, jacobian = self._function(z, target_vector(target))
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
            upper: Upper limits, shape (n,) or (B, n); a coordinate whose limits are equal stays
                there.
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
            spend(len(rows))
            error, moved = self._moved(rows, goal, lower, upper, weights)
            errors[at] = error[:, 0]
            still = error[:, 0] >= tolerance
            if not still.all():
                at, moved, lower, upper = at[still], moved[still], lower[still], upper[still]
            if not len(at) or not remaining:
                break
            z[at] = rows = moved
        return z, errors < tolerance


def _step(
    z: ca.SX, residual: ca.SX, jacobian: ca.SX, weights: ca.SX, limits: tuple[ca.SX, ca.SX]
) -> ca.SX:
    """Return the damped Gauss-Newton step, shape (n,); a coordinate that it pushes beyond its limit is taken out, once."""
    lower, upper = limits
    free = upper - lower > 1e-9
    damping = 1e-8 + 1e-3 * ca.fmin(1.0, ca.sumsqr(residual))
    step = ca.SX.zeros(z.numel())
    for _ in range(2):
        scaled = jacobian @ ca.diag(free / weights)
        system = scaled @ jacobian.T + damping * ca.SX.eye(residual.numel())
        step = -scaled.T @ ca.ldl_solve(residual, *ca.ldl(system))
        step *= ca.fmin(1.0, LONGEST_STEP / ca.fmax(ca.mmax(ca.fabs(step)), 1e-12))
        blocked = ca.logic_or(z + step < lower - 1e-12, z + step > upper + 1e-12)
        free = ca.logic_and(free, ca.logic_not(blocked))
    return step
