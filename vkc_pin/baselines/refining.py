"""Moves arm and object out of collision at one waypoint, the base stays: a sequence of quadratic programs."""

from __future__ import annotations

import numpy as np

from vkc_pin.baselines.arm_kinematics import QP
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["CLEAR", "refined"]

CLEAR = CLEARANCE_TOLERANCE
"""By so much [m] a configuration may fall short of its clearances: as much as one of the solver's."""

_ROUNDS = 12
_REACH = 0.05  # [m] beyond the clearance: contacts that are looked at
_LONGEST = 0.2  # [m] and [rad] of one round in one coordinate
# what moving the object's joints away from their time law costs, beside the arm's away from where
# it was
_OBJECT = 10.0
_SLACK = 1e3  # what a metre of clearance costs that there is no room for
_REGULAR = 1e-6  # makes the program strictly convex in the slack


def refined(
    problem: TrajectoryProblem,
    knots: KeyframeSampler,
    z: Floats,
    *,
    wanted: Floats,
    waypoint: int,
    columns: Ints,
) -> tuple[Floats, bool]:
    """Return the configuration near `wanted` that rounds from `z` lead to, and whether the chain is closed there.

    Each round minimises Σ w (z − z*)² + slack over the arm, the freedoms of its grasps and the
    object's joints, so that the linearised closure holds and the linearised distances of close
    pairs keep their margins.

    Args:
        problem: The problem.
        knots: Of it.
        z: Where to begin, shape (n,).
        wanted: z*: the arm at the waypoint before, the object where its time law has it, shape
            (n,).
        waypoint: The waypoint.
        columns: The coordinates of arm and grasps.
    """
    import qpsolvers

    pose = knots.find_pose(waypoint)
    if pose is None:
        return z, True
    solver, target = knots.get_pose_solver(pose)
    lower, upper = problem.lower[waypoint - 1], problem.upper[waypoint - 1]
    free = np.concatenate([columns, knots.object_columns])
    weights = np.where(np.isin(free, columns), 1.0, _OBJECT)
    for _ in range(_ROUNDS):
        residual, jacobian = (part[0] for part in solver.evaluate(z[None], target))
        reach = problem.options.largest_margin + _REACH
        contacts = problem.contacts.evaluate(
            z[None], np.array([waypoint]), reach=reach, nearest=None
        )
        if np.abs(residual).max() < TOLERANCE and contacts.compute_violation() <= CLEAR:
            return z, True
        gradients = problem.contacts.compute_gradients(z[None], contacts)[:, free]
        room = contacts.distance - contacts.margin
        bounds = [np.clip(limit[free] - z[free], -_LONGEST, _LONGEST) for limit in (lower, upper)]
        # The step of the free coordinates, then one slack for all pairs.
        step = qpsolvers.solve_qp(
            np.diag([*weights, _REGULAR]),
            np.append(weights * (z - wanted)[free], _SLACK),
            np.column_stack([-gradients, -np.ones(len(room))]),
            room,
            np.column_stack([jacobian[:, free], np.zeros(len(residual))]),
            -residual,
            np.append(bounds[0], 0.0),
            np.append(bounds[1], np.inf),
            solver=QP,
        )
        if step is None:
            break
        z = z.copy()
        z[free] += step[:-1]
    residual, _ = solver.evaluate(z[None], target)
    return z, bool(np.abs(residual).max() < TOLERANCE)
