"""Converts waypoints to a trajectory over time, with pauses while the gripper opens or closes."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.nlp.pose_goals import find_phase_spans
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["make_trajectory"]


def make_trajectory(problem: TrajectoryProblem, z: Floats, dt: Floats) -> Trajectory:
    """Convert z_1..z_N, shape (N, n), with step durations dt, shape (N,) [s], to a trajectory.

    It pauses for grasping and releasing.
    """
    task, waypoints, wait = problem.task, problem.waypoints(z), problem.options.grasp_time
    _hold_grasp_coordinates(problem, waypoints)
    rows, steps, phases = [0], [0.0], list[PhaseSpan]()
    for phase, begin, end in find_phase_spans(task):
        first = len(rows) - 1
        if phase.released or (phases and task.phases[len(phases) - 1].grasps):
            rows.append(rows[-1])
            steps.append(wait)
        rows += range(begin + 1, end + 1)
        steps += dt[begin:end].tolist()
        phases.append(PhaseSpan(phase.name, first, len(rows) - 1, phase.held, phase.opening))
    last = task.phases[-1]
    if set(task.after) < {*last.held, *last.grasps}:
        rows.append(rows[-1])
        steps.append(wait)
        span = len(rows) - 2, len(rows) - 1
        phases.append(PhaseSpan("let go", *span, task.after, last.opening))
    robot = problem.chain.robot.coordinates.size
    times = np.cumsum(steps)
    return Trajectory(problem.chain.names, times, waypoints[rows], tuple(phases), robot)


def _hold_grasp_coordinates(problem: TrajectoryProblem, waypoints: Floats) -> None:
    """Set grasp coordinates that are inactive to their next active value, or else their last."""
    for hold, names in problem.chain.virtual.items():
        active = np.zeros(len(waypoints), bool)
        active[0] = hold in problem.scene.holds
        for phase, first, last in find_phase_spans(problem.task):
            active[first : last + 1] |= hold in phase.held
            active[last] |= hold in phase.grasps
        at = np.flatnonzero(active)
        nearest = at[np.minimum(np.searchsorted(at, np.arange(len(waypoints))), len(at) - 1)]
        for column in map(problem.chain.index, names):
            waypoints[:, column] = waypoints[nearest, column]
