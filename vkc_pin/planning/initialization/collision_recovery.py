"""Pushes single configurations out of collision while what must hold there goes on holding, many at once."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.inverse_kinematics import MAX_STEP, PoseSolver
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats

__all__ = ["clear_out"]

_CLEARING_ROUNDS = 10  # Gauss-Newton steps at most
_DAMPING = 3e-4  # added to the diagonal of the normal equations


def clear_out(
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
    """Return configurations that are further from collision than `z`, as far as a few damped Gauss-Newton steps get them.

    Each step asks for the residuals of the pose to vanish and for the contacts that fall short of
    their margins to keep them, linearised: with the witness points fixed in their bodies the
    gradient of a distance d = n·(b − a) is n·(∂b − ∂a). It aims at `Options.dist_safe` more than
    the margins, looks at `Options.contact_slots` contacts, the nearest, and is no longer than
    `MAX_STEP`.

    Args:
        problem: Whose contacts count.
        z: Configurations that satisfy the pose, shape (B, n).
        waypoint: The waypoint they are for.
        solver: Of the pose.
        target: Of the pose.
        lower: Limits, shape (B, n).
        upper: Limits, shape (B, n).
        weights: What moving a coordinate costs, shape (n,).
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
        # Gradients of the nearest distances, and by how much they should grow [m].
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
