"""Solves a task as one nonlinear program, from one initial guess after the other."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from vkc_pin.planning.candidates import Candidate, CandidateMaker, SearchCounts
from vkc_pin.planning.diagnosis.diagnosis import BlockedGoal
from vkc_pin.planning.diagnosis.paths import diagnose_paths
from vkc_pin.planning.diagnosis.task_diagnosis import TaskDiagnosis
from vkc_pin.planning.initialization.initial_guess import (
    InitialGuess,
    PhaseWaypoints,
    extract_phase_waypoints,
    make_initial_guess,
)
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import Plan, PlanningStatistics, PlanStatus
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import Draft
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.solution import Iteration, Solution
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
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task

# [m], [rad] residual of pose goals up to which an initial guess counts as at its goals
_GOAL_TOLERANCE = 1e-2

Guess = Callable[[TrajectoryProblem], InitialGuess]
"""Makes an initial guess for a problem."""


@dataclass(frozen=True, eq=False)
class TaskResult:
    """Result of one task, solved as one nonlinear program.

    Attributes:
        scene: Scene in which it starts.
        task: The task.
        found: The best plan found; a draft if the request wanted one and it converged.
        problem: The nonlinear program; None if the budget ended before there was any candidate.
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
        if not self.is_goal_blocked:
            return False
        holds = {*self.scene.holds}
        if any(not holds.isdisjoint(phase.held) for phase in self.task.phases):
            return False
        for name, placed in self.scene.objects.items():
            before = start.objects[name].placement
            if placed.object.free and not placed.placement.isApprox(before):
                return False
        return True

    def phase_waypoints(self) -> PhaseWaypoints:
        """Return the best waypoints, as an initial guess of problems with more phases."""
        assert self.problem is not None
        return extract_phase_waypoints(self.problem, self.z, self.found.initialization)


@dataclass(frozen=True, eq=False)
class _Attempt:
    """Initial guess of a problem, and how often the phases of the problem have been refined."""

    problem: TrajectoryProblem
    guess: InitialGuess
    refinements: int = 0


# The best candidate, and the status of planning.
_Outcome = tuple[Candidate, PlanStatus]


class TaskSearch:
    """Searches for the solution of a task as one nonlinear program.

    Args:
        scene: Scene in which it starts.
        task: The task.
        request: Arguments of planning.
        guess: Makes the only initial guess; None: those of the request's initialization.
        check_goals_first: Whether to look for collision-free goal configurations before any initial
            guess, since there are probably none.
        pauses: Whether to pause after the first initial guess if it fails and its goal
            configurations are not free of collisions, so that others may be cheaper.

    Attributes:
        statistics: Statistics so far; `run` also adds them to the request's log.
    """

    def __init__(
        self,
        scene: Scene,
        task: Task,
        request: PlanningRequest,
        guess: Guess | None = None,
        *,
        check_goals_first: bool = False,
        pauses: bool = False,
    ) -> None:
        self.statistics = PlanningStatistics()
        self._scene = scene
        self._task = task
        self._request = request
        self._guess = guess
        self._check_goals_first = check_goals_first
        self._pauses = pauses
        self._counts = SearchCounts()
        self._candidates = CandidateMaker(scene, task, request, self._counts)
        self._diagnosis = TaskDiagnosis(request.random_seed)
        self._history: list[dict[str, float]] = []
        self._problem: TrajectoryProblem | None = None
        self._guesses: Iterator[InitialGuess] = iter(())
        self._tried: list[InitialGuess] = []
        self._refined: _Attempt | None = None  # goes on with the last guess
        self._best: Candidate | None = None
        # The solution nearest to feasibility of those that are too far from it to be validated.
        self._infeasible: tuple[TrajectoryProblem, Solution, str] | None = None
        self._blocked_goals: list[BlockedGoal] = []
        self._blocked_phases: list[str] = []  # explanations of phases without a path of the base
        self._is_goal_blocked = False

    def run(self) -> TaskResult | None:
        """Search for a solution, or go on with it after the pause.

        Returns:
            The result; None at the pause.
        """
        outcome: _Outcome | None = None
        with self._count_statistics():
            try:
                problem = self._problem
                if problem is None:
                    problem = self._build_problem(self._task)
                    self._problem = problem
                    outcome = self._begin(problem)
                while outcome is None:
                    if self._pauses and self._is_first_guess_blocked(problem):
                        self._pauses = False
                        break
                    attempt = self._choose_attempt(problem)
                    if attempt is None:
                        outcome = self._explain_failure(problem)
                    else:
                        guess = attempt.guess
                        solution = solve(
                            attempt.problem,
                            guess.z,
                            callback=self._report_round,
                            radius=guess.radius,
                        )
                        outcome = self._conclude(attempt, solution)
            except BudgetExhaustedError as end:
                outcome = self._find_last_candidate(), end.status
        return None if outcome is None else self._make_result(*outcome)

    @contextlib.contextmanager
    def _count_statistics(self) -> Iterator[None]:
        """Add the times and counts of the search in the meantime to its statistics."""
        request = self._request
        cache = request.cache
        began = time.perf_counter()
        built = cache.build_time
        evaluated = count_evaluations()
        request.progress.begin([phase.name for phase in self._task.phases])
        yield
        # A chore has many problems, whose solvers grow while they are used.
        cache.trim()
        build_time = cache.build_time - built
        took = PlanningStatistics(
            planning_time=time.perf_counter() - began - build_time,
            build_time=build_time,
            evaluations=count_evaluations() - evaluated,
        )
        took += self._counts.take()
        self.statistics += took
        request.log.add(took)

    def _begin(self, problem: TrajectoryProblem) -> _Outcome | None:
        """Return the outcome if the problem has no solution, as far as is known at once."""
        conditions = self._diagnosis.find_conditions(problem)
        if conditions:
            best = self._candidates.make_stationary(problem)
            times = best.trajectory.times.tolist()
            reasons = []
            for condition in conditions:
                reasons.append(dataclasses.replace(condition, time=times[condition.waypoint]))
            report = best.report.with_reasons(reasons)
            return dataclasses.replace(best, report=report), "infeasible"
        if self._check_goals_first:
            goals = self._diagnosis.find_blocked_goals(problem)
            if goals:
                self._is_goal_blocked = True
                best = self._candidates.make_stationary(problem)
                return best.with_notes(goal.text for goal in goals), "infeasible"
        if self._guess is None:
            self._guesses = self._generate_guesses(problem)
        else:
            self._guesses = iter([self._guess(problem)])
        return None

    def _build_problem(self, task: Task) -> TrajectoryProblem:
        request = self._request
        problem = TrajectoryProblem(
            self._scene, task, request.options, request.terms, cache=request.cache
        )
        check_time = request.cache.check_time * problem.segments
        reserve_time("validation", check_time, default=True)
        return problem

    def _generate_guesses(self, problem: TrajectoryProblem) -> Iterator[InitialGuess]:
        request = self._request
        # Where a step has only deep guesses, "auto" rather searches guesses for all steps together.
        skips_deep = request.wants_draft and request.initialization == "auto"
        guesses = initialize(
            problem,
            request.initialization,
            request.random_seed,
            count=request.options.max_restarts,
            check_factor=request.check_factor,
            perturbation=request.perturbation,
            notes=self._blocked_phases,
            is_infeasible=functools.partial(self._diagnosis.is_infeasible, problem),
        )
        while True:
            began = time.perf_counter()
            built = request.cache.build_time
            request.progress.set_activity("looking for an initial guess")
            try:
                guess = next(guesses, None)
            finally:
                took = time.perf_counter() - began
                build_time = request.cache.build_time - built
                self._counts.times["initialization"] += took - build_time
            if guess is None or self._diagnosis.proofs:
                return
            if not (skips_deep and guess.is_deep):
                yield guess

    def _choose_attempt(self, problem: TrajectoryProblem) -> _Attempt | None:
        """Return the next guess to try; None if no further one is worth trying."""
        if self._refined is not None:
            attempt = self._refined
            self._refined = None
            return attempt
        if self._is_hopeless(problem):
            return None
        guess = next(self._guesses, None)
        if guess is None:
            return None
        self._tried.append(guess)
        return _Attempt(problem, guess)

    def _is_hopeless(self, problem: TrajectoryProblem) -> bool:
        """Return whether no further guess is worth trying, after those that failed."""
        if not self._tried or self._guess is not None:
            return False
        if self._diagnosis.find_proofs(problem):
            return True
        if self._is_first_guess_blocked(problem):
            self._blocked_goals = self._diagnosis.find_blocked_goals(problem)
            is_deep = any(goal.is_deep for goal in self._blocked_goals)
            return is_deep or (self._request.is_tentative and bool(self._blocked_goals))
        # Two guesses failed, and sampling finds no free goal configuration either.
        return bool(self._blocked_goals)

    def _is_first_guess_blocked(self, problem: TrajectoryProblem) -> bool:
        """Return whether one guess was tried whose goal configurations are not free."""
        if self._guess is not None or len(self._tried) != 1 or self._refined is not None:
            return False
        if self._diagnosis.find_proofs(problem):
            return False
        return not _has_free_ends(problem, self._tried[0])

    def _report_round(self, row: Iteration) -> None:
        self._request.progress(row)
        if self._request.callback is not None:
            self._request.callback(row)

    def _conclude(self, attempt: _Attempt, solution: Solution) -> _Outcome | None:
        """Return the outcome if a solution is one, or if the budget ended there.

        Where the waypoints are too coarse, the attempt goes on with more of them.
        """
        candidate = self._add_solution(attempt, solution)
        if candidate is not None and attempt.refinements < attempt.problem.options.max_refinements:
            coarse = candidate.find_coarse_phases()
            if coarse:
                self._refined = self._refine(attempt, solution, coarse)
                return None
        if self._best is None or self._best.status != "success":
            self._add_guess()
        best = self._best
        if best is not None:
            if best.status == "success":
                return best, "success"
            if solution.status in STOP_STATUSES and not solution.shortfall:
                return best, solution.status
            if best.only_falls:
                return best, best.status
        # Where the first guess suffices, it may use the whole budget.
        enforce_share()
        record_evaluations()
        return None

    def _add_solution(self, attempt: _Attempt, solution: Solution) -> Candidate | None:
        """Record a solution, and keep it if it is the best, or the nearest to feasibility.

        Returns:
            Its candidate; None if it is too far from feasibility.
        """
        self._counts.add(solution)
        self._history += [dataclasses.asdict(row) for row in solution.history]
        if not (solution.converged or self._request.explains):
            return None
        if solution.shortfall:
            if self._infeasible is None or solution.shortfall < self._infeasible[1].shortfall:
                self._infeasible = (attempt.problem, solution, attempt.guess.name)
            return None
        candidate = self._candidates.evaluate(attempt.problem, solution, attempt.guess.name)
        if self._best is None or candidate.is_better(self._best):
            self._best = candidate
        return candidate

    def _refine(self, attempt: _Attempt, solution: Solution, coarse: set[int]) -> _Attempt:
        """Return the attempt that goes on from a solution with more waypoints in some phases."""
        name = attempt.guess.name
        waypoints = extract_phase_waypoints(attempt.problem, solution.z, name)
        problem = self._build_problem(attempt.problem.task.refine(coarse))
        guess = make_initial_guess(problem, [waypoints])
        return _Attempt(problem, dataclasses.replace(guess, name=name), attempt.refinements + 1)

    def _add_guess(self) -> None:
        """Keep the last initial guess if it is valid, though the solver found no solution from it.

        The solver may leave a corridor that a search has found.
        """
        problem = self._problem
        guess = self._tried[-1]
        assert problem is not None
        z = problem.clip(guess.z)
        timing = problem.timing_for(z)
        with suspend_budget():
            contacts = problem.evaluate_contacts(z, reach=problem.options.largest_margin, nearest=1)
        if contacts.compute_violation() > ACCEPTED_SHORTFALL:
            return
        if problem.row_error(z, timing.dt) > TOLERANCE:
            return
        solution = Solution(z, timing.dt, converged=True)
        found = self._candidates.evaluate(problem, solution, guess.name, is_optimized=False)
        if found.status == "success":
            self._best = found

    def _explain_failure(self, problem: TrajectoryProblem) -> _Outcome:
        """Return the best candidate and the status of a failure, with notes on its causes."""
        record_evaluations()
        request = self._request
        diagnosis = self._diagnosis
        if not request.explains:
            return self._best or self._candidates.make_standing(), "not converged"
        is_search = self._guess is None
        if is_search and diagnosis.find_proofs(problem):
            best = self._candidates.make_stationary(problem)
            return best.with_notes(diagnosis.find_proofs(problem)), "infeasible"
        goals = self._blocked_goals
        if request.wants_draft and not goals:  # deep guesses were not tried
            goals = [goal for goal in diagnosis.find_blocked_goals(problem) if goal.is_deep]
        notes = [diagnosis.describe_goal(problem, goal) for goal in goals]
        self._is_goal_blocked = bool(goals)
        nearest = self._find_nearest()
        best = nearest or self._candidates.make_stationary(problem)
        if goals:
            if nearest is None:
                notes += self._blocked_phases
            return best.with_notes(notes), "infeasible"
        status = best.status
        if is_search and not request.wants_draft:
            notes, is_cut_off = diagnose_paths(
                best.problem or problem,
                best.z,
                best.report,
                self._blocked_phases,
                request.random_seed,
            )
            if is_cut_off:
                status = "infeasible"
        return best.with_notes(notes), status

    def _find_nearest(self) -> Candidate | None:
        """Return the best candidate, else the nearest infeasible solution; None without any."""
        if self._best is None and self._infeasible is not None:
            return self._candidates.evaluate(*self._infeasible)
        return self._best

    def _find_last_candidate(self) -> Candidate:
        """Return the candidate with which the search ends when the budget is exhausted."""
        nearest = self._find_nearest() if self._request.explains else None
        return nearest or self._candidates.make_standing()

    def _make_result(self, best: Candidate, status: PlanStatus) -> TaskResult:
        request = self._request
        if status in STOP_STATUSES:
            best = best.with_notes(best.describe_shortfall())
        history = tuple(self._history)
        request.log.history += history
        found: Plan | Draft
        if best.is_draft:
            found = Draft(
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
            found = Plan(
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
        return TaskResult(
            scene=self._scene,
            task=self._task,
            found=found,
            problem=best.problem,
            z=best.z,
            check_time=self._candidates.check_time,
            is_grasp_independent=self._diagnosis.is_grasp_independent,
            is_goal_blocked=self._is_goal_blocked,
        )


def _has_free_ends(problem: TrajectoryProblem, guess: InitialGuess) -> bool:
    """Return whether a guess is feasible at the ends of the phases."""
    contacts = problem.evaluate_contacts(guess.z, reach=problem.options.largest_margin)
    shortfalls = contacts.compute_shortfall(problem.segments)[problem.ends - 1]
    is_free = bool((shortfalls <= ACCEPTED_SHORTFALL).all())
    return is_free and problem.pose_error(guess.z) < _GOAL_TOLERANCE
