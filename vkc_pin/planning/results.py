"""Defines drafts, retimes and validates trajectories, and concatenates plans of steps."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.retiming.retime import Close, retime_trajectory
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import STOP_STATUSES, current_ending
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.contact_rules import compute_start_opening
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.task.terms import Term
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.splicing import concatenate_trajectories
from vkc_pin.world.trajectory.trajectory import Trajectory

FINAL = (*STOP_STATUSES, "infeasible")
"""Statuses after which no alternative is tried."""

CURVELESS = ("torque", "support", "payload")
"""Constraints that do not depend on the curve between waypoints."""

MAX_REPAIRS = 3
"""Largest number of refinements; each brings the curve four times as close to the segments."""


@dataclass(frozen=True, eq=False)
class Draft:
    """A solution of the nonlinear program of some steps, neither retimed nor validated.

    It is an initial guess for a larger problem, whose solution is validated.

    Attributes:
        scene, steps, options: Scene, steps and options of planning.
        trajectory: The waypoints of the solution, with the program's own times.
        statistics: Times and counts of planning.
        seed: Random seed.
        initialization: Name of the initial guess it came from.
        history: One row per round of the solver.
        terms: Constraints and costs of the user.
        end_velocities: Velocities at start and end, shape (2, n); see `retime_trajectory`.
    """

    scene: Scene
    steps: tuple[Step, ...]
    options: Options
    trajectory: Trajectory
    statistics: PlanningStatistics
    seed: int
    initialization: str
    history: Sequence[Mapping[str, float]]
    terms: tuple[Term, ...]
    end_velocities: Floats | None = None

    def complete(self) -> Plan:
        """Return the plan: the trajectory retimed and validated."""
        began = time.perf_counter()

        def check(trajectory: Trajectory) -> Report:
            return validate(self.scene, self.steps, trajectory, self.options, self.terms)

        trajectory, report = retime_validated(
            self.scene,
            self.trajectory,
            check,
            jerk_time=self.options.jerk_time,
            terms=self.terms,
            end_velocities=self.end_velocities,
        )
        took = PlanningStatistics(planning_time=time.perf_counter() - began)
        return Plan(
            self.scene,
            self.steps,
            self.options,
            trajectory,
            report,
            "success" if report.ok else "rejected",
            statistics=self.statistics + took,
            seed=self.seed,
            initialization=self.initialization,
            history=self.history,
            terms=self.terms,
        )


def concatenate_plans(
    scene: Scene,
    steps: Sequence[Step],
    request: PlanningRequest,
    parts: Sequence[Plan],
    *,
    statistics: Sequence[PlanningStatistics] | None = None,
    notes: Sequence[str] = (),
    history: Sequence[Mapping[str, float]] | None = None,
) -> Plan:
    """Return the plans of consecutive steps as one plan, validated as a whole.

    Without any part the trajectory is stationary.

    Args:
        scene: Scene in which the first part starts.
        steps: Steps of all parts.
        request: Arguments of planning; its log receives the time of the validation.
        parts: The plans, each from the end of the one before.
        statistics: Statistics of the parts; None: taken from them. The validation is added.
        notes: Notes for the report, before those of the last part.
        history: One row per round of the solver; None: taken from the parts.
    """
    if statistics is None:
        statistics = [part.statistics for part in parts]
    if history is None:
        history = [row for part in parts for row in part.history]
    total = sum(statistics, start=PlanningStatistics())
    if parts:
        request.progress.set_activity("checking all of it")
        trajectory = concatenate_trajectories(
            [part.trajectory for part in parts], pause=request.options.grasp_time
        )
        status: str = "rejected" if parts[-1].success else parts[-1].status
        initialization = ", ".join(part.initialization for part in parts)
    else:
        trajectory = make_stationary_trajectory(scene, request.options)
        status = "interrupted"
        initialization = "none"
    status = current_ending() or status
    began = time.perf_counter()
    report = validate(scene, steps, trajectory, request.options, request.terms)
    took = time.perf_counter() - began
    if parts:
        validation = PlanningStatistics(planning_time=took, validation_time=took)
        request.log.add(validation)
        total += validation
        report = dataclasses.replace(report, notes=(*notes, *_list_reasons(parts[-1])))
        if report.ok:
            status = "success"
    return Plan(
        scene,
        tuple(steps),
        request.options,
        trajectory,
        report,
        status,
        statistics=total,
        seed=request.random_seed,
        initialization=initialization,
        is_optimized=all(part.is_optimized for part in parts),
        history=tuple(history),
        terms=request.terms,
    )


def _list_reasons(plan: Plan) -> tuple[str, ...]:
    """Return the notes of a plan, or the impossible conditions that ended planning at once.

    Validation of a whole motion does not find conditions of one step, as a goal beyond a limit.
    """
    if plan.report.notes or plan.status != "infeasible":
        return plan.report.notes
    return tuple(violation.text for violation in plan.report.violations)


def make_stationary_trajectory(scene: Scene, options: Options) -> Trajectory:
    """Return a trajectory of one time step in which robot and objects stay at their start."""
    values = dict(zip(scene.robot.coordinates.names, scene.start.tolist(), strict=True))
    for name, placed in scene.objects.items():
        joints = zip(placed.object.coordinates.names, placed.state.tolist(), strict=True)
        values |= {f"{name}.{joint}": value for joint, value in joints}
    for hold in scene.holds:
        names = scene.objects[hold.object].object.attachment(hold.attachment).coordinates
        freedoms = zip(names, hold.at, strict=True)
        values |= {f"{hold.object}.{name}": value for name, value in freedoms}
    row = list(values.values())
    phases = (PhaseSpan("stand", 0, 1, scene.holds, compute_start_opening(scene)),)
    times, positions = np.array([0.0, options.dt]), np.array([row, row])
    return Trajectory(tuple(values), times, positions, phases, len(scene.start))


def retime_validated(
    scene: Scene,
    waypoints: Trajectory,
    check: Callable[[Trajectory], Report],
    *,
    repairs: int = MAX_REPAIRS,
    jerk_time: float = 0.0,
    terms: Sequence[Term] = (),
    close: Close | None = None,
    end_velocities: Floats | None = None,
) -> tuple[Trajectory, Report]:
    """Return a trajectory through waypoints and its report; the last one if none is valid.

    Around a violation the curve is made to pass through the middles of the straight segments too,
    which the program has checked, with chains closed by `close`. Violations that depend on no curve
    are left alone. `check` validates a trajectory, and `repairs` is the largest number of
    refinements. If one of the user's traced `terms` depends on velocities, the program's own times
    are kept. For `end_velocities` see `retime_trajectory`.
    """
    retime = partial(
        retime_trajectory, scene, waypoints, jerk_time=jerk_time, end_velocities=end_velocities
    )
    if any(term.formula.uses_previous for term in terms):
        return waypoints, check(waypoints)
    parts = np.ones(len(waypoints.times) - 1, int)
    trajectory = retime()
    report = check(trajectory)
    for _ in range(repairs):
        wrong = [one.waypoint for one in report.violations if one.constraint not in CURVELESS]
        near = {waypoint + k for waypoint in wrong for k in (-1, 0, 1)}
        if not near:
            break
        parts[[k for k in near if 0 <= k < len(parts)]] *= 2
        trajectory = retime(parts, close=close)
        report = check(trajectory)
    return trajectory, report
