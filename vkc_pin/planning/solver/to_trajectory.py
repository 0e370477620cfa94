"""Converts waypoints to a trajectory over time, with pauses while the gripper opens or closes."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.pose_goals import find_phase_spans
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory


def make_trajectory(problem: KinematicProblem, z: Floats, dt: Floats) -> Trajectory:
    """Convert z_1..z_N, shape (N, n), with step durations dt, shape (N,) [s], to a trajectory.

    It pauses for grasping and releasing.
    """
    waypoints = problem.waypoints(z)
    _hold_grasp_coordinates(problem, waypoints)
    rows, phases = _list_rows(problem)
    waits = np.diff(rows) == 0
    steps = np.where(waits, problem.options.grasp_time, dt[rows[1:] - 1])
    times = np.concatenate([[0.0], np.cumsum(steps)])
    robot = problem.chain.robot.coordinates.size
    return Trajectory(problem.chain.names, times, waypoints[rows], tuple(phases), robot)


def _list_rows(problem: KinematicProblem) -> tuple[Ints, list[PhaseSpan]]:
    """Return the waypoint of each row of the trajectory, repeated in pauses, and its phases."""
    task = problem.task
    rows = [0]
    phases = list[PhaseSpan]()
    for phase, begin, end in find_phase_spans(task):
        first = len(rows) - 1
        if phase.released or (phases and task.phases[len(phases) - 1].grasps):
            rows.append(rows[-1])
        rows += range(begin + 1, end + 1)
        phases.append(PhaseSpan(phase.name, first, len(rows) - 1, phase.held, phase.opening))
    last = task.phases[-1]
    if set(task.after) < {*last.held, *last.grasps}:
        rows.append(rows[-1])
        phases.append(PhaseSpan("let go", len(rows) - 2, len(rows) - 1, task.after, last.opening))
    return np.array(rows), phases


def close_chains(problem: KinematicProblem, points: Floats, at: Floats) -> Floats:
    """Close the chain at points between the rows of a trajectory of `make_trajectory`.

    Only the arm moves: base and object joints stay, as do points where the arm cannot follow.

    Args:
        problem: Problem that the trajectory solves.
        points: Configurations, shape (M, n).
        at: Row of each plus the fraction of the step to the next one, shape (M,).

    Returns:
        Configurations that satisfy eq. 2 where both adjacent waypoints do, shape (M, n).
    """
    rows, _ = _list_rows(problem)
    before = rows[np.floor(at).astype(int)]
    after = rows[np.ceil(at).astype(int)]
    robot = problem.chain.robot.coordinates.size
    closed = points.copy()
    solvers = problem.pose_solvers
    for goal, solver in zip(problem.pose_goals, solvers, strict=True):
        if goal.kind != "closure":
            continue
        waypoints = goal.row.waypoints
        between = np.flatnonzero(np.isin(before, waypoints) & np.isin(after, waypoints))
        if not len(between):
            continue
        limits = []
        for limit in (problem.lower, problem.upper):
            fixed = points[between].copy()
            fixed[:, 3:robot] = limit[after[between] - 1, 3:robot]
            limits.append(fixed)
        lower, upper = limits
        found, is_closed = solver.solve(
            points[between], goal.target, lower=lower, upper=upper, weights=problem.chain.metric
        )
        closed[between[is_closed]] = found[is_closed]
    return closed


def _hold_grasp_coordinates(problem: KinematicProblem, waypoints: Floats) -> None:
    """Set grasp coordinates that are inactive to their next active value, or else their last."""
    for hold, names in problem.chain.virtual.items():
        active = np.zeros(len(waypoints), bool)
        active[0] = hold in problem.scene.holds
        for phase, first, last in find_phase_spans(problem.task):
            active[first : last + 1] |= hold in phase.held
            active[last] |= hold in phase.grasps
        active_waypoints = np.flatnonzero(active)
        following = np.searchsorted(active_waypoints, np.arange(len(waypoints)))
        source = active_waypoints[np.minimum(following, len(active_waypoints) - 1)]
        for name in names:
            column = problem.chain.index(name)
            waypoints[:, column] = waypoints[source, column]
