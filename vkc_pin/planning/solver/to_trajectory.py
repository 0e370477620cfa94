"""Converts waypoints to a trajectory over time, with pauses while the gripper opens or closes."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["make_trajectory"]


def make_trajectory(problem: TrajectoryProblem, z: Floats, dt: Floats) -> Trajectory:
    """Convert waypoints to a trajectory with pauses for grasping and releasing.

    Args:
        problem: Problem of the waypoints.
        z: z_1..z_N, shape (N, n).
        dt: Time steps, shape (N,) [s].
    """
    waypoints, wait = problem.waypoints(z), problem.options.grasp_time
    _hold_grasp_coordinates(problem, waypoints)
    rows, times = [0], [0.0]
    phases: list[PhaseSpan] = []
    begin = 0
    for phase, end in zip(problem.task.phases, problem.ends, strict=True):
        first = len(rows) - 1
        if phase.released or (begin and problem.task.phases[len(phases) - 1].grasps):
            rows.append(rows[-1])
            times.append(times[-1] + wait)
        for row in range(begin + 1, int(end) + 1):
            rows.append(row)
            times.append(times[-1] + dt[row - 1])
        phases.append(PhaseSpan(phase.name, first, len(rows) - 1, phase.held, phase.opening))
        begin = int(end)
    last = problem.task.phases[-1]
    if set(problem.task.after) < {*last.held, *last.grasps}:
        rows.append(rows[-1])
        times.append(times[-1] + wait)
        phases.append(
            PhaseSpan("let go", len(rows) - 2, len(rows) - 1, problem.task.after, last.opening)
        )
    robot = problem.chain.robot.coordinates.size
    return Trajectory(problem.chain.names, np.array(times), waypoints[rows], tuple(phases), robot)


def _hold_grasp_coordinates(problem: TrajectoryProblem, waypoints: Floats) -> None:
    """Set grasp coordinates that are inactive to their next active value, or else their last."""
    starts = [0, *problem.ends[:-1]]
    for hold, names in problem.chain.virtual.items():
        active = np.zeros(len(waypoints), bool)
        active[0] = hold in problem.scene.holds
        for phase, first, last in zip(problem.task.phases, starts, problem.ends, strict=True):
            active[first : last + 1] |= hold in phase.held
            active[last] |= hold in phase.grasps
        at = np.flatnonzero(active)
        nearest = at[np.minimum(np.searchsorted(at, np.arange(len(waypoints))), len(at) - 1)]
        for column in map(problem.chain.index, names):
            waypoints[:, column] = waypoints[nearest, column]
