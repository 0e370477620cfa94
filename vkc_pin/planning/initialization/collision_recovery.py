"""Moves configurations out of collision while their pose constraint stays satisfied."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.inverse_kinematics import MAX_STEP, PoseSolver
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats

__all__ = ["resolve_collisions"]

_CLEARING_ROUNDS = 10  # maximum number of Gauss-Newton steps
_DAMPING = 3e-4  # added to the diagonal of the normal equations


def resolve_collisions(
    problem: TrajectoryProblem,
    z: Floats,
    waypoint: int,
    solver: PoseSolver,
    target: pin.SE3,
    *,
    lower: Floats,
    upper: Floats,
    weights: Floats,
) -> Floats:
    """Move configurations out of collision with a few damped Gauss-Newton steps.

    Each step drives the residuals of the pose to zero and violated contacts to their margins, both
    linearized: with the witness points fixed in their bodies, the gradient of a distance
    d = n·(b − a) is n·(∂b − ∂a). It aims at `Options.dist_safe` beyond the margins, considers the
    `Options.contact_slots` nearest contacts, and is limited to `MAX_STEP`.

    Args:
        problem: Problem.
        z: Configurations that satisfy the pose, shape (B, n).
        waypoint: Their waypoint.
        solver: Inverse kinematics of the pose.
        target: Target of the pose.
        lower: Lower limits, shape (B, n).
        upper: Upper limits, shape (B, n).
        weights: Weight of each coordinate, shape (n,).

    Returns:
        The configurations, which may still be in collision, shape (B, n).
    """
    z, done, options = z.copy(), np.zeros(len(z), bool), problem.options
    extra, slots = options.dist_safe, options.contact_slots
    free = (upper - lower > 1e-9) / weights
    for _ in range(_CLEARING_ROUNDS):
        at = np.flatnonzero(~done)
        if not len(at):
            break
        contacts = problem.contacts.evaluate(
            z[at], np.full(len(at), waypoint), reach=options.largest_margin + extra, nearest=slots
        )
        short = contacts.compute_shortfall(len(at))
        residual, pose_rows = solver.evaluate(z[at], target)
        done[at] = (short <= 0.0) & (np.abs(residual).max(axis=1) < TOLERANCE)
        # Gradients of the nearest distances, and their required increase [m].
        rows, growth = np.zeros((len(at), slots, z.shape[1])), np.zeros((len(at), slots))
        rows[contacts.waypoint, contacts.slot] = problem.contacts.compute_gradients(z[at], contacts)
        growth[contacts.waypoint, contacts.slot] = np.maximum(
            contacts.margin + extra - contacts.distance, 0.0
        )
        jacobian, wanted = (
            np.concatenate([pose_rows, rows], axis=1),
            np.concatenate([-residual, growth], axis=1),
        )
        scaled = jacobian * free[at][:, None, :]
        system = scaled @ jacobian.transpose(0, 2, 1) + _DAMPING * np.eye(jacobian.shape[1])
        step = np.einsum("bij,bi->bj", scaled, np.linalg.solve(system, wanted[..., None])[..., 0])
        step *= np.minimum(
            1.0, MAX_STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12)
        )
        step[done[at]] = 0.0
        z[at] = np.clip(z[at] + step, lower[at], upper[at])
    return z
