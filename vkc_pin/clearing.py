"""Pushes single configurations out of collision while what must hold there goes on holding, many at once."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.chain import VirtualKinematicChain
from vkc_pin.contact import Contacts
from vkc_pin.inverse_kinematics import PoseSolver
from vkc_pin.problem import TrajectoryProblem

__all__ = ["clear_out", "distance_gradients", "point_jacobians"]

_ROUNDS = 10
_ROWS = 6  # contacts of a configuration that are looked at in one round
_SPARE = 1e-2  # [m] further than the margin
_LONGEST = 0.25  # [m] and [rad], of one round's step in one coordinate
_DAMPING = 3e-4


def clear_out(
    problem: TrajectoryProblem,
    z: NDArray[np.float64],
    waypoint: int,
    solver: PoseSolver,
    target: pin.SE3,
    *,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return configurations that are further from collision than `z`, as far as a few damped Gauss-Newton steps get them.

    Each step asks for the residuals of the pose to vanish and for the contacts that fall short of their margins to keep them,
    linearised: with the witness points fixed in their bodies the gradient of a distance d = n·(b − a) is n·(∂b − ∂a).

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
    z, done = z.copy(), np.zeros(len(z), bool)
    free = (upper - lower > 1e-9) / weights
    for _ in range(_ROUNDS):
        at = np.flatnonzero(~done)
        if not len(at):
            break
        reach = problem.options.dist_safe + _SPARE
        contacts = problem.contacts.evaluate(z[at], np.full(len(at), waypoint), reach=reach, nearest=_ROWS)
        short = contacts.shortfall(len(at))
        residual, pose_rows = solver.evaluate(z[at], target)
        done[at] = (short <= 0.0) & (np.abs(residual).max(axis=1) < 1e-4)
        rows, wanted = _contact_rows(problem, z[at], contacts)
        jacobian = np.concatenate([pose_rows, rows], axis=1)
        wanted = np.concatenate([-residual, wanted], axis=1)
        scaled = jacobian * free[at][:, None, :]
        system = scaled @ jacobian.transpose(0, 2, 1) + _DAMPING * np.eye(jacobian.shape[1])
        step = np.einsum("bij,bi->bj", scaled, np.linalg.solve(system, wanted[..., None])[..., 0])
        step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        step[done[at]] = 0.0
        z[at] = np.clip(z[at] + step, lower[at], upper[at])
    return z


def _contact_rows(
    problem: TrajectoryProblem, z: NDArray[np.float64], contacts: Contacts
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gradients of the nearest distances, shape (B, rows, n), and by how much they should grow, shape (B, rows) [m]."""
    order = np.arange(len(contacts.waypoint)) - np.searchsorted(contacts.waypoint, contacts.waypoint)
    rows, wanted = np.zeros((len(z), _ROWS, z.shape[1])), np.zeros((len(z), _ROWS))
    rows[contacts.waypoint, order] = distance_gradients(problem, z, contacts)
    wanted[contacts.waypoint, order] = np.maximum(contacts.margin + _SPARE - contacts.distance, 0.0)
    return rows, wanted


def distance_gradients(problem: TrajectoryProblem, z: NDArray[np.float64], contacts: Contacts) -> NDArray[np.float64]:
    """Return the gradients of the distances of contacts at configurations `z`, shape (B, n): n·(∂b − ∂a), shape (C, n)."""
    joints = problem.contacts.joints_of(contacts.pair)
    which, points = np.tile(contacts.waypoint, 2), np.concatenate([contacts.first, contacts.second])
    first, second = np.split(point_jacobians(problem.chain, z, which, joints.T.ravel(), points), 2)
    return np.asarray(np.einsum("ci,cij->cj", contacts.normal, second - first))


def point_jacobians(
    chain: VirtualKinematicChain,
    z: NDArray[np.float64],
    which: NDArray[np.int_],
    joint: NDArray[np.int_],
    point: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how points that are fixed in joints' frames move, shape (C, 3, n).

    Args:
        chain: The chain.
        z: Configurations, shape (B, n).
        which: The configuration of each point, shape (C,).
        joint: The joint that carries it, shape (C,); 0 stands still.
        point: Where it is in the world, shape (C, 3) [m].
    """
    owner, linear, angular, fixed = chain.motions
    rotations, translations = chain.joint_placements(z)
    axes = rotations[:, owner]
    turned = np.where(fixed[:, None], linear, np.einsum("bnij,nj->bni", axes, linear))[which]
    about = np.einsum("bnij,nj->bni", axes, angular)[which]
    moved = turned + np.cross(about, point[:, None] - translations[:, owner][which])
    return np.asarray((moved * chain.carries[joint][:, owner, None]).swapaxes(1, 2))
