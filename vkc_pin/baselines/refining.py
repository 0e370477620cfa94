"""Moves arm and object out of collision at one waypoint by sequential quadratic programming."""

from __future__ import annotations

import numpy as np

from vkc_pin.baselines.arm_kinematics import QP
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["CLEAR", "refine_configuration"]

CLEAR = CLEARANCE_TOLERANCE
"""Accepted shortfall of clearances [m], as in the solver."""

_ROUNDS = 12
_REACH = 0.05  # distance beyond the clearance up to which contacts are considered [m]
_LONGEST = 0.2  # largest step of a coordinate in one round [m] or [rad]
_OBJECT = 10.0  # weight of the object's deviation from its time law; that of the arm is 1
_SLACK = 1e3  # weight of the slack
_REGULAR = 1e-6  # makes the program strictly convex in the slack


def refine_configuration(
    problem: TrajectoryProblem,
    sampler: KeyframeSampler,
    z: Floats,
    *,
    wanted: Floats,
    waypoint: int,
    columns: Ints,
) -> tuple[Floats, bool]:
    """Return a configuration near `wanted`, found from `z`, and whether the chain is closed.

    Each round minimises Σ w (z − z*)² + slack over the arm, the freedoms of its grasps and the
    object's joints, so that the linearised closure holds and the linearised distances of close
    pairs keep their margins. z* is `wanted`: the arm at the waypoint before, and the object by its
    time law. `columns` are the coordinates of arm and grasps.
    """
    import qpsolvers

    pose = sampler.find_pose(waypoint)
    if pose is None:
        return z, True
    solver, target = sampler.get_pose_solver(pose)
    lower, upper = problem.lower[waypoint - 1], problem.upper[waypoint - 1]
    free = np.concatenate([columns, sampler.object_columns])
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
