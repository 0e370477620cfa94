"""Solves inverse kinematics of the whole chain for many guesses at once by damped Gauss-Newton."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.kinematic_tree import KinematicTree, get_kinematics
from vkc_pin.planning.chain.pose import PoseRow, build_pose_residual
from vkc_pin.planning.kinematics.batch import BatchFunction
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.cache import Cache
from vkc_pin.world.collision.solids import flatten_placements

MAX_STEP = 0.5  # [m] or [rad]: maximum Gauss-Newton step of a coordinate


class PoseFunctions:
    """Functions of one pose goal of a tree, evaluated for batches of configurations z.

    Attributes:
        size: Number of coordinates n.
        rows: Number of residuals m: 6 for a pose, 5 for an upright pose, 3 for a point; see `pose`.
        residual: (z, target, placement of the frame on its joint, mounts) → residual and its
            Jacobian.
        step: The same with lower and upper limits and weights of the coordinates → largest
            residual, and z after a Gauss-Newton step.
    """

    def __init__(self, tree: KinematicTree, pose: PoseRow, cache: Cache) -> None:
        self.size = tree.coordinates.size
        z = ca.SX.sym("z", self.size)
        target = ca.SX.sym("W", 12)
        local = ca.SX.sym("L", 12)
        mounts = ca.SX.sym("P", 12, tree.mount_count)
        placements = get_kinematics(tree, cache).build_placements(z, mounts)
        rotation, translation = pose.build_placement(placements, local)
        residual = ca.densify(build_pose_residual(pose.kind, rotation, translation, target))
        self.rows = int(residual.numel())
        jacobian = ca.densify(ca.jacobian(residual, z))
        inputs = [z, target, local, mounts]
        self.residual = BatchFunction(ca.Function("pose", inputs, [residual, jacobian]))
        lower = ca.SX.sym("lower", self.size)
        upper = ca.SX.sym("upper", self.size)
        weights = ca.SX.sym("weights", self.size)
        step = _build_step(z, residual, jacobian, weights, (lower, upper))
        error = ca.mmax(ca.fabs(residual))
        moved = ca.fmin(ca.fmax(z + step, lower), upper)
        inputs += [lower, upper, weights]
        self.step = BatchFunction(ca.Function("moved", inputs, [error, moved]))

    @property
    def nbytes(self) -> int:
        """Estimated size in memory [bytes]."""
        return self.residual.nbytes + self.step.nbytes


def get_pose_functions(tree: KinematicTree, pose: PoseRow, cache: Cache) -> PoseFunctions:
    """Return the functions of a pose goal, built if they are not in the cache."""
    key = ("pose", tree.key, pose.key)
    return cache.get(key, lambda: PoseFunctions(tree, pose, cache))


class PoseSolver:
    """Moves one frame of a tree to a target pose, for a batch of configurations.

    Args:
        tree: The tree.
        pose: Kind of the goal, and the joint of its frame.
        local: Placement of the frame on its joint.
        cache: Cache of its functions.

    Attributes:
        size: Number of coordinates n.
        rows: Number of residuals m; see `PoseFunctions`.
    """

    def __init__(self, tree: KinematicTree, pose: PoseRow, local: pin.SE3, cache: Cache) -> None:
        self._functions = get_pose_functions(tree, pose, cache)
        self.size = self._functions.size
        self.rows = self._functions.rows
        self._data = flatten_placements([local]), tree.mounts.ravel()

    def evaluate(self, z: Floats, target: pin.SE3) -> tuple[Floats, Floats]:
        """Return the pose residuals and their Jacobians at `z`.

        Args:
            z: Configurations, shape (B, n).
            target: Target placement of the frame in the world.

        Returns:
            Residuals, shape (B, m), [m] and [rad], and Jacobians, shape (B, m, n).
        """
        residual, jacobian = self._functions.residual(z, flatten_placements([target]), *self._data)
        columns = jacobian.reshape(len(z), self.size, self.rows)
        return residual, columns.swapaxes(1, 2)

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
        """Return configurations near `z` that satisfy the pose within limits.

        Args:
            z: Initial guesses, shape (B, n).
            target: Target placement of the frame in the world.
            lower: Lower limits, shape (n,) or (B, n).
            upper: Upper limits, shape (n,) or (B, n); a coordinate with equal limits is fixed.
            weights: Cost of moving each coordinate, shape (n,).
            iterations: Maximum number of steps.
            tolerance: Largest residual of a solution, [m] and [rad].

        Returns:
            Configurations, shape (B, n), and a mask of those that satisfy the pose, shape (B,).
        """
        z = np.clip(z, lower, upper)
        data = (flatten_placements([target]), *self._data)
        errors = np.empty(len(z))
        # Indices of unsolved configurations; their values and limits.
        unsolved = np.arange(len(z))
        rows = z
        lower = np.broadcast_to(lower, z.shape)
        upper = np.broadcast_to(upper, z.shape)
        for remaining in range(iterations, -1, -1):
            record_evaluations(len(rows))
            error, moved = self._functions.step(rows, *data, lower, upper, weights)
            errors[unsolved] = error[:, 0]
            is_unsolved = error[:, 0] >= tolerance
            if not is_unsolved.all():
                unsolved = unsolved[is_unsolved]
                moved = moved[is_unsolved]
                lower = lower[is_unsolved]
                upper = upper[is_unsolved]
            if not len(unsolved) or not remaining:
                break
            rows = moved
            z[unsolved] = rows
        return z, errors < tolerance


def _build_step(
    z: ca.SX, residual: ca.SX, jacobian: ca.SX, weights: ca.SX, limits: tuple[ca.SX, ca.SX]
) -> ca.SX:
    """Return the damped Gauss-Newton step, shape (n,).

    With the residual r, its Jacobian J, the damping λ and the costs W = diag(weights), the minimum
    of |r + J δ|² + λ δᵀWδ is

        δ = −W⁻¹Jᵀ (J W⁻¹Jᵀ + λI)⁻¹ r

    The damping shrinks with the residual, so that convergence is fast at the end. Coordinates that
    the step would move beyond their limits are fixed, and the step is solved once more without
    them.
    """
    lower, upper = limits
    free = upper - lower > 1e-9
    damping = 1e-8 + 1e-3 * ca.fmin(1.0, ca.sumsqr(residual))
    step = ca.SX.zeros(z.numel())
    for _ in range(2):
        scaled = jacobian @ ca.diag(free / weights)  # J W⁻¹, zero for fixed coordinates
        system = scaled @ jacobian.T + damping * ca.SX.eye(residual.numel())
        step = -scaled.T @ ca.ldl_solve(residual, *ca.ldl(system))
        largest = ca.mmax(ca.fabs(step))
        step *= ca.fmin(1.0, MAX_STEP / ca.fmax(largest, 1e-12))
        is_blocked = ca.logic_or(z + step < lower - 1e-12, z + step > upper + 1e-12)
        free = ca.logic_and(free, ca.logic_not(is_blocked))
    return step
