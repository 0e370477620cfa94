"""Solves a task as one nonlinear program, from one initial guess after the other."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from vkc_pin.planning.diagnosis.diagnosis import (
    BlockedGoal,
    describe_free_range,
    diagnose_goal,
    find_impossible_conditions,
)
from vkc_pin.planning.diagnosis.paths import diagnose_paths
from vkc_pin.planning.diagnosis.proofs import find_proofs, find_swept_collisions
from vkc_pin.planning.initialization.initial_guess import (
    InitialGuess,
    PhaseWaypoints,
    extract_phase_waypoints,
    make_initial_guess,
)
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import STAGES, Plan, PlanningStatistics, PlanStatus
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import (
    CURVELESS,
    MAX_REPAIRS,
    Draft,
    make_stationary_trajectory,
    retime_validated,
)
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.solution import Iteration, Solution
from vkc_pin.planning.solver.to_trajectory import close_chains, make_trajectory
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import (
    STOP_STATUSES,
    BudgetExhaustedError,
    count_evaluations,
    enforce_share,
    record_evaluations,
    reserve_time,
    suspend_budget,
)
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task
from vkc_pin.world.trajectory.trajectory import Trajectory

_NEARLY_FREE = 0.02
"""Missing clearance [m] up to which a trajectory is described as nearly collision-free."""

Guess = Callable[[TrajectoryProblem], InitialGuess]
"""Makes an initial guess for a problem."""


@dataclass(frozen=True, eq=False)
class TaskResult:
    """Result of one task, solved as one nonlinear program.

    Attributes:
        scene: Scene in which it starts.
        found: The best plan found; a draft if the request wanted one and it converged.
        problem: The nonlinear program; None if the budget ended before it was built.
        z: Its best waypoints z_1..z_N, shape (N, n).
        check_time: Time of the last validation [s]; of a draft, the one that it may take.
        is_grasp_independent: Whether the task fails for certain whatever the grasp.
        is_goal_blocked: Whether all configurations found at one of its goals are blocked.
    """

    scene: Scene
    task: Task
    found: Plan | Draft
    problem: TrajectoryProblem | None
    z: Floats
    check_time: float
    is_grasp_independent: bool
    is_goal_blocked: bool

    @property
    def is_solved(self) -> bool:
        """Whether it is a draft, or a plan that is a success."""
        return isinstance(self.found, Draft) or self.found.success

    @property
    def plan(self) -> Plan:
        """The plan; a draft is retimed and validated for it."""
        return self.found.complete() if isinstance(self.found, Draft) else self.found

    def is_blocked_after(self, start: Scene) -> bool:
        """Return whether a goal is blocked however the steps from `start` to the task are done.

        They decide on grasps that the task keeps, and on where free objects are placed.
        """
        kept = {hold for phase in self.task.phases for hold in phase.held} & {*self.scene.holds}
        moved = any(
            placed.object.free and not placed.placement.isApprox(start.objects[name].placement)
            for name, placed in self.scene.objects.items()
        )
        return self.is_goal_blocked and not kept and not moved

    def phase_waypoints(self) -> PhaseWaypoints:
        """Return the best waypoints, as an initial guess of problems with more phases."""
        assert self.problem is not None
        return extract_phase_waypoints(self.problem, self.z, self.found.initialization)


def solve_task(
    scene: Scene,
    task: Task,
    request: PlanningRequest,
    *,
    guess: Guess | None = None,
    check_goals_first: bool = False,
) -> TaskResult:
    """Solve a task as one nonlinear program; see `TaskSearch`."""
    result = TaskSearch(scene, task, request, guess, check_goals_first=check_goals_first).run()
    assert result is not None
    return result


class TaskSearch:
    """Searches for the solution of a task as one nonlinear program.

    Args:
        scene: Scene in which it starts.
        task: The task.
        request: Arguments of planning.
        guess: Makes the only initial guess; None: those of the request's initialization.
        check_goals_first: Whether to look for collision-free goal configurations before any initial
            guess, since there are probably none.
    """

    def __init__(
        self,
        scene: Scene,
        task: Task,
        request: PlanningRequest,
        guess: Guess | None = None,
        *,
        check_goals_first: bool = False,
    ) -> None:
        self.statistics = PlanningStatistics()
        self._scene, self._task, self._request = scene, task, request
        self._search = _Search(scene, task, request, guess, check_goals_first=check_goals_first)

    def run(self, *, pauses: bool = False) -> TaskResult | None:
        """Search for a solution, from the last pause on.

        Args:
            pauses: Whether to pause after the first initial guess if it fails and its goal
                configurations are not free of collisions, so that others may be cheaper.

        Returns:
            The result; None at a pause.
        """
        request, search = self._request, self._search
        began, cache = time.perf_counter(), request.cache
        built, evaluated = cache.build_time, count_evaluations()
        request.progress.begin([phase.name for phase in self._task.phases])
        try:
            outcome = search.run(pauses=pauses)
        except BudgetExhaustedError as end:
            nearest = search.find_nearest() if request.explains else None
            outcome = nearest or search.make_standing(), end.status
        cache.trim()  # a chore has many problems, whose solvers grow while they are used
        build_time = cache.build_time - built
        self.statistics += PlanningStatistics(
            planning_time=time.perf_counter() - began - build_time,
            build_time=build_time,
            iterations=search.iterations,
            rounds=search.rounds,
            evaluations=count_evaluations() - evaluated,
        ).with_times(search.times)
        search.reset_statistics()
        return None if outcome is None else self._make_result(*outcome)

    def _make_result(self, best: _Candidate, status: PlanStatus) -> TaskResult:
        request, search = self._request, self._search
        if status in STOP_STATUSES:
            best = best.with_notes(_describe_shortfall(best.report))
        history = tuple(search.history)
        plan: Plan | Draft
        if best.is_draft:
            plan = Draft(
                self._scene,
                self._task.steps,
                request.options,
                best.trajectory,
                self.statistics,
                request.random_seed,
                best.name,
                history,
                request.terms,
                None if best.problem is None else best.problem.end_velocities,
            )
        else:
            plan = Plan(
                self._scene,
                self._task.steps,
                request.options,
                best.trajectory,
                best.report,
                status,
                statistics=self.statistics,
                seed=request.random_seed,
                initialization=best.name,
                is_optimized=best.is_optimized,
                history=history,
                terms=request.terms,
            )
        found = best.problem, best.z, search.check_time
        causes = search.is_grasp_independent, search.is_goal_blocked
        return TaskResult(self._scene, self._task, plan, *found, *causes)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Trajectory found from one initial guess, with its problem and z_1..z_N, shape (N, n)."""

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
        return sum(violation.amount for violation in self.report.violations)

    @property
    def only_falls(self) -> bool:
        """Whether it is valid, except that an object falls where no step says where to put it."""
        kinds = {violation.constraint for violation in self.report.violations}
        return kinds == {"support"}

    def is_better(self, other: _Candidate) -> bool:
        return self.report.ok or self.violation < other.violation

    def find_coarse_phases(self) -> set[int]:
        """Return the numbers of phases that are valid at their waypoints, but not in between.

        Torques do not depend on how far waypoints are apart, for example.
        """
        if self.status != "rejected" or self.problem is None:
            return set()
        found = self.report.violations
        wrong = [each.waypoint for each in found if each.constraint not in CURVELESS]
        return {
            number
            for number, phase in enumerate(self.trajectory.phases[: len(self.problem.ends)])
            if any(phase.first <= waypoint <= phase.last for waypoint in wrong)
        }

    def with_notes(self, notes: Iterable[str]) -> _Candidate:
        report = dataclasses.replace(self.report, notes=tuple(notes))
        return dataclasses.replace(self, report=report)


class _Search:
    """State of solving one task."""

    def __init__(
        self,
        scene: Scene,
        task: Task,
        request: PlanningRequest,
        guess: Guess | None,
        *,
        check_goals_first: bool,
    ) -> None:
        self.scene, self.task, self.request = scene, task, request
        self.problem: TrajectoryProblem | None = None
        self.reset_statistics()
        self.check_time, self.is_grasp_independent, self.is_goal_blocked = 0.0, False, False
        self.history: list[dict[str, float]] = []
        self._guess, self._check_goals_first = guess, check_goals_first
        self._guesses: Iterator[InitialGuess] = iter(())
        self._tried: list[InitialGuess] = []
        self._blocked_goals: list[BlockedGoal] = []
        self._blocked_phases: list[str] = []  # phases without a path of the base
        self._best: _Candidate | None = None
        # The solution nearest to feasibility of those that are too far from it to be validated.
        self._infeasible: tuple[TrajectoryProblem, Solution, str] | None = None
        self._goals: dict[int, BlockedGoal | None] = {}
        self._proofs: list[str] | None = None

    def reset_statistics(self) -> None:
        """Set times and counts to zero."""
        self.times = dict.fromkeys(STAGES, 0.0)
        self.rounds = self.iterations = 0

    def run(self, *, pauses: bool) -> tuple[_Candidate, PlanStatus] | None:
        """Return the best candidate and the status of the plan; None at a pause.

        See `TaskSearch.run`.
        """
        if self.problem is None:
            self.problem = self._build_problem(self.task)
            outcome = self._check_problem(self.problem)
            if outcome is not None:
                return outcome
            guess = self._guess
            given = None if guess is None else iter([guess(self.problem)])
            self._guesses = self._generate_guesses(self.problem) if given is None else given
        problem = self.problem
        while not self._is_hopeless(problem):
            start = next(self._guesses, None)
            if start is None:
                break
            self._tried.append(start)
            outcome = self._try_guess(problem, start)
            if outcome is not None:
                return outcome
            if pauses and self._is_first_guess_blocked(problem):
                return None
        record_evaluations()
        return self._explain_failure(problem, self._blocked_goals)

    def _check_problem(self, problem: TrajectoryProblem) -> tuple[_Candidate, PlanStatus] | None:
        """Return the outcome if the problem has no solution, as far as is known at once."""
        if reasons := find_impossible_conditions(problem):
            self.is_grasp_independent = True
            best = self._make_stationary(problem)
            times = best.trajectory.times.tolist()
            timed = [dataclasses.replace(one, time=times[one.waypoint]) for one in reasons]
            return dataclasses.replace(best, report=best.report.with_reasons(timed)), "infeasible"
        if self._check_goals_first and (goals := self._find_blocked_goals(problem)):
            self.is_goal_blocked = True
            best = self._make_stationary(problem)
            return best.with_notes(goal.text for goal in goals), "infeasible"
        return None

    def _try_guess(
        self, problem: TrajectoryProblem, start: InitialGuess
    ) -> tuple[_Candidate, PlanStatus] | None:
        """Return the outcome if a guess leads to a solution, or if the budget ended there."""
        solution = self._solve_from(problem, start)
        if self._best is None or self._best.status != "success":
            self._add_guess(problem, start)
        if self._best is not None and self._best.status == "success":
            return self._best, "success"
        if self._best is not None and solution.status in STOP_STATUSES and not solution.shortfall:
            return self._best, solution.status
        if self._best is not None and self._best.only_falls:
            return self._best, self._best.status
        enforce_share()  # where the first guess suffices, it may use the whole budget
        record_evaluations()
        return None

    def _is_hopeless(self, problem: TrajectoryProblem) -> bool:
        """Return whether no further guess is worth trying, after those that failed."""
        if not self._tried or self._guess is not None:
            return False
        if self._find_proofs(problem):
            return True
        if self._is_first_guess_blocked(problem):
            self._blocked_goals = self._find_blocked_goals(problem)
            is_deep = any(goal.is_deep for goal in self._blocked_goals)
            return is_deep or (self.request.is_tentative and bool(self._blocked_goals))
        # Two guesses failed, and sampling finds no free goal configuration either.
        return bool(self._blocked_goals)

    def _is_first_guess_blocked(self, problem: TrajectoryProblem) -> bool:
        """Return whether one guess was tried whose goal configurations are not free."""
        if len(self._tried) != 1 or self._guess is not None or self._find_proofs(problem):
            return False
        return not _has_free_ends(problem, self._tried[0])

    def _build_problem(self, task: Task) -> TrajectoryProblem:
        request = self.request
        problem = TrajectoryProblem(
            self.scene, task, request.options, request.terms, cache=request.cache
        )
        check_time = request.cache.check_time * problem.segments
        reserve_time("validation", check_time, default=True)
        return problem

    def _solve_from(self, problem: TrajectoryProblem, guess: InitialGuess) -> Solution:
        """Solve a problem from a guess, and again with more waypoints where they are too coarse."""
        most = problem.options.max_refinements
        for refinement in range(most + 1):
            solution = solve(problem, guess.z, callback=self._report_round, radius=guess.radius)
            candidate = self._add_solution(problem, solution, guess.name)
            coarse = set() if candidate is None else candidate.find_coarse_phases()
            if not coarse or refinement == most:
                break
            part = extract_phase_waypoints(problem, solution.z, guess.name)
            problem = self._build_problem(problem.task.refine(coarse))
            guess = dataclasses.replace(make_initial_guess(problem, [part]), name=guess.name)
        return solution

    def _add_solution(
        self, problem: TrajectoryProblem, solution: Solution, name: str
    ) -> _Candidate | None:
        """Record a solution, and keep it if it is the best, or the nearest to feasibility.

        Returns:
            Its trajectory; None if it is too far from feasibility.
        """
        self.rounds += solution.rounds
        self.iterations += solution.iterations
        for key, value in solution.timings.items():
            self.times[key] += value
        self.history += [dataclasses.asdict(row) for row in solution.history]
        if not (solution.converged or self.request.explains):
            return None
        if solution.shortfall:
            if self._infeasible is None or solution.shortfall < self._infeasible[1].shortfall:
                self._infeasible = (problem, solution, name)
            return None
        candidate = self._evaluate(problem, solution, name)
        if self._best is None or candidate.is_better(self._best):
            self._best = candidate
        return candidate

    def _add_guess(self, problem: TrajectoryProblem, guess: InitialGuess) -> None:
        """Keep an initial guess itself if it is valid, though the solver found no solution from it.

        The solver may leave a corridor that a search has found.
        """
        z = problem.clip(guess.z)
        timing = problem.timing_for(z)
        with suspend_budget():
            contacts = problem.evaluate_contacts(z, reach=problem.options.largest_margin, nearest=1)
        is_free = contacts.compute_violation() <= ACCEPTED_SHORTFALL
        if is_free and problem.row_error(z, timing.dt) <= TOLERANCE:
            solution = Solution(z, timing.dt, converged=True)
            found = self._evaluate(problem, solution, guess.name, is_optimized=False)
            if found.status == "success":
                self._best = found

    def _explain_failure(
        self, problem: TrajectoryProblem, goals: list[BlockedGoal]
    ) -> tuple[_Candidate, PlanStatus]:
        """Return the best candidate and the status of a failure, with notes on its causes."""
        if not self.request.explains:
            return self._best or self.make_standing(), "not converged"
        is_search = self._guess is None
        if is_search and self._find_proofs(problem):
            best = self._make_stationary(problem)
            return best.with_notes(self._find_proofs(problem)), "infeasible"
        if self.request.wants_draft and not goals:  # deep guesses were not tried
            goals = [goal for goal in self._find_blocked_goals(problem) if goal.is_deep]
        lines = [self._describe_goal(problem, goal) for goal in goals]
        self.is_goal_blocked = bool(lines)
        nearest = self.find_nearest()
        best = nearest or self._make_stationary(problem)
        status = "infeasible" if lines else best.status
        if lines and nearest is None:
            lines = [*lines, *self._blocked_phases]
        elif is_search and not lines and not self.request.wants_draft:
            seed = self.request.random_seed
            lines, is_cut_off = diagnose_paths(
                best.problem or problem, best.z, best.report, self._blocked_phases, seed
            )
            status = "infeasible" if is_cut_off else status
        return best.with_notes(lines), status

    def _describe_goal(self, problem: TrajectoryProblem, goal: BlockedGoal) -> str:
        """Return why a goal is blocked, and how far it is free, within the budget."""
        free = ""
        with contextlib.suppress(BudgetExhaustedError):
            free = describe_free_range(problem, goal.phase, self.request.random_seed)
        return f"{goal.text}; free configurations were found up to {free}" if free else goal.text

    def find_nearest(self) -> _Candidate | None:
        """Return the best candidate, else the nearest infeasible solution; None without any."""
        if self._best is None and self._infeasible:
            return self._evaluate(*self._infeasible)
        return self._best

    def _find_proofs(self, problem: TrajectoryProblem) -> list[str]:
        """Return proofs of infeasibility, computed once and only after a failure."""
        if self._proofs is None:
            hits = find_swept_collisions(problem)
            self.is_grasp_independent, self._proofs = bool(hits), hits or find_proofs(problem)
        return self._proofs

    def _find_blocked_goals(
        self, problem: TrajectoryProblem, numbers: Iterable[int] | None = None
    ) -> list[BlockedGoal]:
        """Return the goals of phases (None: all) without a known collision-free configuration."""
        found = []
        for number in range(len(problem.task.phases)) if numbers is None else numbers:
            if number not in self._goals:
                self._goals[number] = diagnose_goal(problem, number, self.request.random_seed)
            found.append(self._goals[number])
        return [goal for goal in found if goal is not None]

    def _generate_guesses(self, problem: TrajectoryProblem) -> Iterator[InitialGuess]:
        request = self.request
        # Where a step has only deep guesses, "auto" rather searches guesses for all steps together.
        skips_deep = request.wants_draft and request.initialization == "auto"
        guesses = initialize(
            problem,
            request.initialization,
            request.random_seed,
            count=request.options.max_restarts,
            effort=request.effort,
            perturbation=request.perturbation,
            notes=self._blocked_phases,
            is_infeasible=lambda phases: (
                bool(self._find_proofs(problem))
                or any(goal.is_deep for goal in self._find_blocked_goals(problem, phases))
            ),
        )
        while True:
            began, built = time.perf_counter(), request.cache.build_time
            request.progress.set_activity("looking for an initial guess")
            try:
                guess = next(guesses, None)
            finally:
                took = time.perf_counter() - began
                self.times["initialization"] += took - (request.cache.build_time - built)
            if guess is None or self._proofs:
                return
            if not (skips_deep and guess.is_deep):
                yield guess

    def _report_round(self, row: Iteration) -> None:
        self.request.progress(row)
        if self.request.callback is not None:
            self.request.callback(row)

    def _evaluate(
        self,
        problem: TrajectoryProblem,
        solution: Solution,
        name: str,
        *,
        is_optimized: bool = True,
    ) -> _Candidate:
        """Retime and validate a solution; around violations the curve is refined.

        If a draft is wanted, a converged solution is left as it is, unless it is an initial guess.
        """
        with suspend_budget():
            waypoints = make_trajectory(problem, solution.z, solution.dt)
        if self.request.wants_draft and solution.converged and is_optimized:
            self.check_time = self.request.cache.check_time * problem.segments
            return _Candidate(
                name, problem, solution.z, waypoints, Report(), "success", is_draft=True
            )
        began, validated = time.perf_counter(), self.times["validation"]
        # Violations of solutions that have not converged are not the curve's.
        trajectory, report = retime_validated(
            self.scene,
            waypoints,
            self._validate,
            repairs=MAX_REPAIRS if solution.converged else 0,
            jerk_time=self.request.options.jerk_time,
            terms=self.request.terms,
            close=partial(close_chains, problem),
            end_velocities=problem.end_velocities,
        )
        took = time.perf_counter() - began
        self.times["retiming"] += took - (self.times["validation"] - validated)
        failure: PlanStatus = "rejected" if solution.converged else "not converged"
        status = "success" if report.ok else failure
        return _Candidate(
            name, problem, solution.z, trajectory, report, status, is_optimized=is_optimized
        )

    def _validate(self, trajectory: Trajectory) -> Report:
        began, request = time.perf_counter(), self.request
        request.progress.set_activity("checking")
        report = validate(self.scene, self.task.steps, trajectory, request.options, request.terms)
        self.check_time = time.perf_counter() - began
        request.cache.check_time = self.check_time / len(trajectory.times)
        reserve_time("validation", self.check_time)
        self.times["validation"] += self.check_time
        return report

    def _make_stationary(self, problem: TrajectoryProblem) -> _Candidate:
        """Return a trajectory that is stationary for the duration of the task."""
        timing = problem.timing_for(problem.still)
        return self._evaluate(problem, Solution(problem.still, timing.dt), "none")

    def make_standing(self) -> _Candidate:
        """Return a stationary trajectory, the result before the first initial guess."""
        trajectory = make_stationary_trajectory(self.scene, self.request.options)
        report = self._validate(trajectory)
        z = np.zeros((0, 0))
        return _Candidate("none", self.problem, z, trajectory, report, "not converged")


def _describe_shortfall(report: Report) -> list[str]:
    """Return a note on what obstructs a trajectory that lacks only a little clearance."""
    worst = max(report.violations, key=lambda violation: violation.amount, default=None)
    if worst is None or any(
        violation.constraint not in ("clearance", "penetration") for violation in report.violations
    ):
        return []
    return [
        f"the best trajectory lacks {1e3 * worst.amount:.1f} mm of clearance between "
        f"{worst.subject}: another attachment or start may be needed rather than more time"
    ] * (worst.amount < _NEARLY_FREE)


def _has_free_ends(problem: TrajectoryProblem, guess: InitialGuess) -> bool:
    """Return whether a guess is feasible at the ends of the phases."""
    contacts = problem.evaluate_contacts(guess.z, reach=problem.options.largest_margin)
    shortfall = contacts.compute_shortfall(problem.segments)[problem.ends - 1]
    return bool((shortfall <= ACCEPTED_SHORTFALL).all()) and problem.pose_error(guess.z) < 1e-2
