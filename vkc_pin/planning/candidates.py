"""Makes candidates for a task's trajectory: solutions that are retimed and validated."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import STAGES, PlanningStatistics, PlanStatus
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import (
    CURVELESS,
    MAX_REPAIRS,
    make_stationary_trajectory,
    retime_validated,
)
from vkc_pin.planning.solver.solution import Solution
from vkc_pin.planning.solver.to_trajectory import close_chains, make_trajectory
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import reserve_time, suspend_budget
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task
from vkc_pin.world.trajectory.trajectory import Trajectory

_NEARLY_FREE = 0.02
"""Missing clearance [m] up to which a trajectory is described as nearly collision-free."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Trajectory found from one initial guess.

    Attributes:
        name: Name of the initial guess.
        problem: The nonlinear program; None for a stationary trajectory without one.
        z: Waypoints z_1..z_N, shape (N, n).
        trajectory: The trajectory; of a draft the waypoints alone, with the program's own times.
        report: Its validation; of a draft without any violation.
        status: Status of planning if this is the result.
        is_draft: Whether it is neither retimed nor validated.
        is_optimized: Whether it is a solution of the program, or the initial guess itself.
    """

    name: str
    problem: TrajectoryProblem | None
    z: Floats
    trajectory: Trajectory
    report: Report
    status: PlanStatus
    is_draft: bool = False
    is_optimized: bool = True

    @property
    def violation(self) -> float:
        """Sum of all violations."""
        return sum(violation.amount for violation in self.report.violations)

    @property
    def only_falls(self) -> bool:
        """Whether it is valid, except that an object falls where no step says where to put it."""
        kinds = {violation.constraint for violation in self.report.violations}
        return kinds == {"support"}

    def is_better(self, other: Candidate) -> bool:
        """Return whether it is valid, or violates less than another candidate."""
        return self.report.ok or self.violation < other.violation

    def find_coarse_phases(self) -> set[int]:
        """Return the numbers of phases that are valid at their waypoints, but not in between.

        Torques do not depend on how far waypoints are apart, for example.
        """
        if self.status != "rejected" or self.problem is None:
            return set()
        waypoints = []
        for violation in self.report.violations:
            if violation.constraint not in CURVELESS:
                waypoints.append(violation.waypoint)
        count = len(self.problem.ends)
        coarse = set[int]()
        for number, phase in enumerate(self.trajectory.phases[:count]):
            if any(phase.first <= waypoint <= phase.last for waypoint in waypoints):
                coarse.add(number)
        return coarse

    def with_notes(self, notes: Iterable[str]) -> Candidate:
        """Return the candidate with these notes in its report."""
        report = dataclasses.replace(self.report, notes=tuple(notes))
        return dataclasses.replace(self, report=report)

    def describe_shortfall(self) -> list[str]:
        """Return a note on what obstructs a trajectory that lacks only a little clearance."""
        violations = self.report.violations
        kinds = {violation.constraint for violation in violations}
        if not kinds or not kinds <= {"clearance", "penetration"}:
            return []
        worst = max(violations, key=lambda violation: violation.amount)
        if worst.amount >= _NEARLY_FREE:
            return []
        return [
            f"the best trajectory lacks {1e3 * worst.amount:.1f} mm of clearance between "
            f"{worst.subject}: another attachment or start may be needed rather than more time"
        ]


@dataclass
class SearchCounts:
    """Times and counts of a search.

    Attributes:
        times: Stage, see `STAGES`, → time [s].
        rounds, iterations: Numbers of the solver's rounds and of Ipopt's iterations.
    """

    times: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    rounds: int = 0
    iterations: int = 0

    def add(self, solution: Solution) -> None:
        """Add those of a solution."""
        self.rounds += solution.rounds
        self.iterations += solution.iterations
        for stage, seconds in solution.timings.items():
            self.times[stage] += seconds

    def take(self) -> PlanningStatistics:
        """Return all as statistics, and count from zero again."""
        counts = PlanningStatistics(iterations=self.iterations, rounds=self.rounds)
        statistics = counts.with_times(self.times)
        self.times = dict.fromkeys(STAGES, 0.0)
        self.rounds = 0
        self.iterations = 0
        return statistics


class CandidateMaker:
    """Makes the candidates of one task.

    Args:
        scene: Scene in which the task starts.
        task: The task.
        request: Arguments of planning.
        counts: Counts to which the times of retiming and validation are added.

    Attributes:
        check_time: Time of the last validation [s]; of a draft, the one that it may take.
    """

    def __init__(
        self, scene: Scene, task: Task, request: PlanningRequest, counts: SearchCounts
    ) -> None:
        self.check_time = 0.0
        self._scene = scene
        self._task = task
        self._request = request
        self._counts = counts

    def evaluate(
        self,
        problem: TrajectoryProblem,
        solution: Solution,
        name: str,
        *,
        is_optimized: bool = True,
    ) -> Candidate:
        """Retime and validate a solution; around violations the curve is refined.

        If a draft is wanted, a converged solution is left as it is, unless it is an initial guess.

        Args:
            problem: The nonlinear program.
            solution: Its solution.
            name: Name of the initial guess.
            is_optimized: Whether the solution is not the initial guess itself.
        """
        request = self._request
        with suspend_budget():
            waypoints = make_trajectory(problem, solution.z, solution.dt)
        if request.wants_draft and solution.converged and is_optimized:
            self.check_time = request.cache.check_time * problem.segments
            return Candidate(
                name, problem, solution.z, waypoints, Report(), "success", is_draft=True
            )
        times = self._counts.times
        began = time.perf_counter()
        validated = times["validation"]
        # Violations of solutions that have not converged are not the curve's.
        repairs = MAX_REPAIRS if solution.converged else 0
        trajectory, report = retime_validated(
            self._scene,
            waypoints,
            self._validate,
            repairs=repairs,
            jerk_time=request.options.jerk_time,
            terms=request.terms,
            close=partial(close_chains, problem),
            end_velocities=problem.end_velocities,
        )
        took = time.perf_counter() - began
        times["retiming"] += took - (times["validation"] - validated)
        status: PlanStatus = "success"
        if not report.ok:
            status = "rejected" if solution.converged else "not converged"
        return Candidate(
            name, problem, solution.z, trajectory, report, status, is_optimized=is_optimized
        )

    def make_stationary(self, problem: TrajectoryProblem) -> Candidate:
        """Return a trajectory that is stationary for the duration of the task."""
        timing = problem.timing_for(problem.still)
        return self.evaluate(problem, Solution(problem.still, timing.dt), "none")

    def make_standing(self) -> Candidate:
        """Return a stationary trajectory of one time step, the result before any initial guess."""
        trajectory = make_stationary_trajectory(self._scene, self._request.options)
        report = self._validate(trajectory)
        z = np.zeros((0, 0))
        return Candidate("none", None, z, trajectory, report, "not converged")

    def _validate(self, trajectory: Trajectory) -> Report:
        request = self._request
        began = time.perf_counter()
        request.progress.set_activity("checking")
        report = validate(self._scene, self._task.steps, trajectory, request.options, request.terms)
        self.check_time = time.perf_counter() - began
        request.cache.check_time = self.check_time / len(trajectory.times)
        reserve_time("validation", self.check_time)
        self._counts.times["validation"] += self.check_time
        return report
