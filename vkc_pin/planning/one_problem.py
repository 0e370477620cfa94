"""Steps as one problem: from seed to seed until validation accepts a motion."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from vkc_pin.planning.diagnosis.diagnosis import (
    BlockedGoal,
    diagnose_goal,
    find_impossible_conditions,
)
from vkc_pin.planning.diagnosis.paths import diagnose_paths
from vkc_pin.planning.diagnosis.proofs import find_proofs
from vkc_pin.planning.diagnosis.swept_volumes import find_swept_collisions
from vkc_pin.planning.initialization.initial_guess import InitialGuess, PhaseWaypoints
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.outcome import TIMES, outcome, spent, still
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.retiming.repair import retime_and_repair
from vkc_pin.planning.settings import Settings
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.solution import Iteration, Solution
from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import ENDINGS, SpentError, spend, unlimited
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.terms import trace_terms
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["OneProblem"]

# [s] a waypoint that checking a motion takes, rather more than less; counts until it was done once
_CHECK = 2e-3


@dataclass(frozen=True, eq=False)
class _Try:
    """Where one seed led.

    Attributes:
        name: The seed's name.
        z: z_1..z_N, shape (N, n).
        trajectory: The motion.
        report: What validation says of it.
        status: "success", "rejected" or "not converged".
    """

    name: str
    z: Floats
    trajectory: Trajectory
    report: Report
    status: str

    @property
    def amount(self) -> float:
        """By how much everything is violated, summed over all units."""
        return sum(violation.amount for violation in self.report.violations)

    def better(self, other: _Try) -> bool:
        """Return whether it is a success, or violates less."""
        return self.report.ok or self.amount < other.amount

    def noted(self, notes: Iterable[str]) -> _Try:
        """Return the same with notes in its report."""
        return dataclasses.replace(
            self, report=dataclasses.replace(self.report, notes=tuple(notes))
        )


class OneProblem:
    """Plans a task as one nonlinear program.

    Attributes:
        scene: Where it begins.
        task: What is asked for.
        goals_first: Whether free configurations are looked for at the goals before any seed, since
            most likely there are none.
        problem: The program, once it is built.
        z: Its best z_1..z_N, shape (N, n), once `run` has found something.
        initialization: The name of the seed that led there.
        checking: How long the last check of a motion took [s].
        hindered: Whether it is certain that no grasp helps: it is wrong before anything moves, or a
            joint's own way leads into something.
    """

    def __init__(
        self, scene: Scene, task: Task, settings: Settings, *, goals_first: bool = False
    ) -> None:
        self.scene, self.task, self.settings, self.goals_first = scene, task, settings, goals_first
        self.times = dict.fromkeys(TIMES, 0.0)
        self.rounds = self.iterations = 0
        self.checking, self.hindered = 0.0, False
        self.history: list[dict[str, float]] = []
        self.blocked: list[str] = []  # phases without a base path
        self._best: _Try | None = None
        self._astray: tuple[Solution, str] | None = (
            None  # the nearest of those that nobody need check
        )
        self._explained: dict[int, BlockedGoal | None] = {}
        self._proven: list[str] | None = None

    def run(self, seed: Callable[[TrajectoryProblem], InitialGuess] | None = None) -> Plan:
        """Try seeds until validation accepts a motion, there are no more, or the budget is at its end.

        Args:
            seed: Makes the only seed to try, a motion that is nearly good as it is, so that there
                is no need of patience with it; None: those of the settings' initialization.
        """
        began = time.perf_counter()
        cache, budget = self.settings.cache, self.settings.budget
        built, used, self._best, self._astray = cache.building, budget.used, None, None
        self.settings.progress.begin([phase.name for phase in self.task.phases])
        try:
            best, status = self._planned(seed)
        except SpentError as end:
            best, status = self._nearest() or self._standing(), str(end)
        self.z, self.initialization = best.z, best.name
        cache.trim()  # a chore has many problems, whose solvers grow while they are used
        build_time, took = cache.building - built, time.perf_counter() - began
        return self._plan(
            best,
            status,
            spent(took - build_time, build_time, effort=budget.used - used, **self._counts()),
        )

    def _planned(
        self, seed: Callable[[TrajectoryProblem], InitialGuess] | None
    ) -> tuple[_Try, str]:
        """Return the best try and the plan's status; see `run`."""
        s = self.settings
        problem = self.problem = TrajectoryProblem(
            self.scene, self.task, s.options, s.terms, cache=s.cache
        )
        s.budget.checking = s.budget.checking or _CHECK * problem.segments
        reasons = find_impossible_conditions(problem)
        if reasons:
            self.hindered = True
            best = self._stationary(problem)
            return dataclasses.replace(best, report=best.report.with_reasons(reasons)), "infeasible"
        if self.goals_first and (blocked := self._goals(problem)):
            return self._stationary(problem).noted(goal.text for goal in blocked), "infeasible"
        seeds = self._seeds(problem) if seed is None else iter([seed(problem)])
        return self._try_seeds(problem, seeds, searched=seed is None)

    def piece(self) -> PhaseWaypoints:
        """Return the best waypoints, once `run` has ended, for problems of more phases to start from."""
        phases = tuple(phase.key for phase in self.task.phases)
        path, ends = self.problem.waypoints(self.z), [0, *self.problem.ends.tolist()]
        waypoints = tuple(path[first : last + 1] for first, last in itertools.pairwise(ends))
        return PhaseWaypoints(phases, self.problem.chain.names, waypoints, self.initialization)

    def _try_seeds(
        self, problem: TrajectoryProblem, seeds: Iterator[InitialGuess], *, searched: bool
    ) -> tuple[_Try, str]:
        """Return the best try, with what is in the way of the task if it is no success, and the plan's status."""
        notes: list[BlockedGoal] = []
        for number, seed in enumerate(seeds, start=1):
            solution = self._solve(problem, seed)
            if solution.shortfall:
                self._astray = min(
                    self._astray or (solution, seed.name),
                    (solution, seed.name),
                    key=lambda one: one[0].shortfall,
                )
            else:
                found = self._judge(problem, solution, seed.name)
                if self._best is None or found.better(self._best):
                    self._best = found
                if self._best.status == "success":
                    return self._best, "success"
                if solution.status in ENDINGS:
                    return self._best, solution.status
            spend()
            if searched and self._proofs(problem):
                break
            if number == 1 and searched and not _ends_free(problem, seed):
                notes = self._goals(problem)
            elif (
                notes
            ):  # two seeds failed, and random configurations find no free one at a goal either
                break
            if any(goal.is_deep for goal in notes):
                break
        spend()
        if searched and self._proofs(problem):
            return self._stationary(problem).noted(self._proofs(problem)), "infeasible"
        best = (nearest := self._nearest()) or self._stationary(problem)
        lines = [goal.text for goal in notes]
        status = "infeasible" if lines or (nearest is None and self.blocked) else best.status
        if nearest is None:
            lines += self.blocked
        elif searched and not lines:
            lines, cut_off = diagnose_paths(
                problem, best.z, best.report, self.blocked, self.settings.random_seed
            )
            status = "infeasible" if cut_off else status
        return best.noted(lines), status

    def _nearest(self) -> _Try | None:
        """Return the best try, one that is astray if there is no other; None: there is none."""
        return (
            self._judge(self.problem, *self._astray)
            if self._best is None and self._astray
            else self._best
        )

    def _proofs(self, problem: TrajectoryProblem) -> list[str]:
        """Return what is certain, looked for once, and only when something has failed: most tasks can be done."""
        if self._proven is None:
            hindered = find_swept_collisions(problem)
            self.hindered, self._proven = bool(hindered), hindered or find_proofs(problem)
        return self._proven

    def _goals(
        self, problem: TrajectoryProblem, numbers: Iterable[int] | None = None
    ) -> list[BlockedGoal]:
        """Return the goals of some phases, None: of all, for which no free configuration is found, each looked for once."""
        found = []
        for number in range(len(problem.task.phases)) if numbers is None else numbers:
            if number not in self._explained:
                self._explained[number] = diagnose_goal(problem, number, self.settings.random_seed)
            found.append(self._explained[number])
        return [goal for goal in found if goal is not None]

    def _seeds(self, problem: TrajectoryProblem) -> Iterator[InitialGuess]:
        s = self.settings
        seeds = initialize(
            problem,
            s.initialization,
            s.random_seed,
            count=s.options.max_restarts,
            perturbation=s.perturbation,
            notes=self.blocked,
            is_infeasible=lambda phases: (
                bool(self._proofs(problem))
                or any(goal.is_deep for goal in self._goals(problem, phases))
            ),
        )
        while True:
            began, built = time.perf_counter(), s.cache.building
            s.progress.doing("looking for a seed")
            try:
                seed = next(seeds, None)
            finally:
                self.times["initialization"] += (
                    time.perf_counter() - began - (s.cache.building - built)
                )
            if seed is None or self._proven:
                return
            yield seed

    def _solve(self, problem: TrajectoryProblem, seed: InitialGuess) -> Solution:
        """Return what the solver makes of a seed."""
        solution = solve(problem, seed.z, callback=self._report, radius=seed.radius)
        self.rounds += solution.rounds
        self.iterations += solution.iterations
        for key, value in solution.timings.items():
            self.times[key] += value
        self.history += [dataclasses.asdict(row) for row in solution.history]
        return solution

    def _report(self, row: Iteration) -> None:
        self.settings.progress(row)
        if self.settings.callback is not None:
            self.settings.callback(row)

    def _judge(self, problem: TrajectoryProblem, solution: Solution, name: str) -> _Try:
        """Return what a solution is worth."""
        with unlimited():
            waypoints = make_trajectory(problem, solution.z, solution.dt)
        began, checked = time.perf_counter(), self.times["validation"]
        if self._paced:
            trajectory, report = waypoints, self._check(waypoints)
        else:
            repairs = (
                {} if solution.converged else {"repairs": 0}
            )  # what is wrong with others is not the curve's fault
            jerk_time = self.settings.options.jerk_time
            trajectory, report = retime_and_repair(
                self.scene, waypoints, self._check, jerk_time=jerk_time, **repairs
            )
        self.times["retiming"] += time.perf_counter() - began - (self.times["validation"] - checked)
        status = "success" if report.ok else "rejected" if solution.converged else "not converged"
        return _Try(name, solution.z, trajectory, report, status)

    @cached_property
    def _paced(self) -> bool:
        """Whether own constraints say something of velocities, which are those of the program's own time then."""
        return any(
            term.formula.uses_previous for term in trace_terms(self.scene, self.settings.terms)
        )

    def _check(self, trajectory: Trajectory) -> Report:
        """Check a motion, and note how long that takes."""
        began = time.perf_counter()
        self.settings.progress.doing("checking")
        report = validate(
            self.scene, self.task.steps, trajectory, self.settings.options, self.settings.terms
        )
        self.checking = self.settings.budget.checking = time.perf_counter() - began
        self.times["validation"] += self.checking
        return report

    def _stationary(self, problem: TrajectoryProblem) -> _Try:
        """Return a motion in which all stands still for as long as the task takes."""
        return self._judge(
            problem, Solution(problem.still, problem.timing_for(problem.still).dt), "none"
        )

    def _standing(self) -> _Try:
        """Return one in which all stands still for a moment: what there is before the first seed."""
        trajectory = still(self.scene, self.settings.options)
        return _Try("none", np.zeros((0, 0)), trajectory, self._check(trajectory), "not converged")

    def _counts(self) -> dict[str, Any]:
        return {"iterations": self.iterations, "rounds": self.rounds, "times": self.times}

    def _plan(self, best: _Try, status: str, took: Mapping[str, float]) -> Plan:
        s = self.settings
        return outcome(
            self.scene,
            self.task.steps,
            s.options,
            best.trajectory,
            best.report,
            status,
            took=took,
            random_seed=s.random_seed,
            initialization=best.name,
            history=self.history,
            terms=s.terms,
        )


def _ends_free(problem: TrajectoryProblem, seed: InitialGuess) -> bool:
    """Return whether a seed's configurations at the ends of the phases are free and what they should be."""
    ends = problem.ends - 1
    free = (
        problem.evaluate_contacts(seed.z, reach=problem.options.largest_margin).compute_shortfall(
            problem.segments
        )[ends]
        <= 0.0
    )
    return bool(free.all()) and problem.pose_error(seed.z) < 1e-2
