"""Steps as one problem: from seed to seed until validation accepts a motion."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.motion.trajectory import Trajectory
from vkc_pin.planning.diagnosis import explain, impossible
from vkc_pin.planning.outcome import TIMES, outcome, spent
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.settings import Settings
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.scene.scene import Scene
from vkc_pin.seeds.initialization import initialize
from vkc_pin.seeds.seed import PhaseWaypoints, Seed
from vkc_pin.solver.loop import solve
from vkc_pin.solver.solution import Iteration, Solution
from vkc_pin.solver.to_trajectory import as_trajectory
from vkc_pin.task.phases import Task
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate

__all__ = ["OneProblem"]


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


class OneProblem:
    """Plans a task as one nonlinear program.

    Attributes:
        scene: Where it begins.
        task: What is asked for.
        problem: The program, once `run` has begun.
        z: Its best z_1..z_N, shape (N, n), once `run` has ended.
        initialization: The name of the seed that led there.
    """

    def __init__(self, scene: Scene, task: Task, settings: Settings) -> None:
        self.scene, self.task, self.settings = scene, task, settings
        self.times = dict.fromkeys(TIMES, 0.0)
        self.rounds = self.iterations = 0
        self.history: list[dict[str, float]] = []
        self.blocked: list[str] = []  # phases in which there is no way for the base

    def run(self, seed: Callable[[TrajectoryProblem], Seed] | None = None) -> Plan:
        """Try seeds until validation accepts a motion, there are no more, time is up, or Ctrl-C is pressed.

        Args:
            seed: Makes the only seed to try, a motion that is nearly good as it is, so that there is no need of patience with it;
                None: those of the settings' initialization.
        """
        began = time.perf_counter()
        limit, cache = self.settings.time_limit, self.settings.cache
        built = cache.building
        self.settings.progress.begin([phase.name for phase in self.task.phases])
        problem = TrajectoryProblem(self.scene, self.task, self.settings.options, self.settings.terms, cache=cache)
        self.problem = problem
        reasons = impossible(problem)
        if reasons:
            best, status = self._stationary(problem), "infeasible"
            best = dataclasses.replace(best, report=best.report.with_reasons(reasons))
        else:
            deadline = np.inf if limit is None else began + cache.building - built + limit
            seeds = self._seeds(problem) if seed is None else iter([seed(problem)])
            best, status = self._try_seeds(problem, seeds, deadline, searched=seed is None)
        self.z, self.initialization = best.z, best.name
        cache.trim()  # a chore has many problems, whose solvers grow while they are used
        build_time = cache.building - built
        return self._plan(best, status, time.perf_counter() - began - build_time, build_time)

    def piece(self) -> PhaseWaypoints:
        """Return the best waypoints, once `run` has ended, for problems of more phases to start from."""
        phases = tuple(phase.key for phase in self.task.phases)
        path, ends = self.problem.waypoints(self.z), [0, *self.problem.ends.tolist()]
        waypoints = tuple(path[first : last + 1] for first, last in itertools.pairwise(ends))
        return PhaseWaypoints(phases, self.problem.chain.names, waypoints, self.initialization)

    def _try_seeds(
        self, problem: TrajectoryProblem, seeds: Iterator[Seed], deadline: float, *, searched: bool
    ) -> tuple[_Try, str]:
        """Return the best try, with what is in the way of the task if it is no success, and the plan's status."""
        best: _Try | None = None
        notes: list[str] = []
        ended = ""  # why nothing else is to be tried
        for number, seed in enumerate(seeds, start=1):
            solution, found = self._try(problem, seed, deadline)
            best = found if best is None or found.better(best) else best
            ended = self._ended(best, solution)
            if ended:
                break
            if number == 1 and searched and not _ends_free(problem, seed):
                notes = explain(problem, self.settings.random_seed, self.settings.interrupt)
            elif notes:  # two seeds failed, and random configurations find no free one at a goal either
                break
        if best is None:
            best, notes = self._stationary(problem), notes + self.blocked
        if not ended and self.settings.interrupt.pressed:
            ended = "interrupted"
        if not ended:
            ended = "infeasible" if notes else best.status
            best = dataclasses.replace(best, report=dataclasses.replace(best.report, notes=tuple(notes)))
        return best, ended

    def _try(self, problem: TrajectoryProblem, seed: Seed, deadline: float) -> tuple[Solution, _Try]:
        """Return what the solver makes of a seed, and what that is worth."""
        solution = self._solve(problem, seed, deadline)
        return solution, self._judge(problem, solution, seed.name)

    def _ended(self, best: _Try, solution: Solution) -> str:
        """Return the plan's status if nothing else is to be tried after a solution; "" otherwise."""
        if best.status == "success":
            return best.status
        if self.settings.interrupt.pressed:
            return "interrupted"
        return solution.status if solution.status == "time limit" else ""

    def _seeds(self, problem: TrajectoryProblem) -> Iterator[Seed]:
        s = self.settings
        seeds = initialize(
            problem,
            s.initialization,
            s.random_seed,
            count=s.options.max_restarts,
            perturbation=s.perturbation,
            notes=self.blocked,
            interrupt=s.interrupt,
        )
        while not s.interrupt.pressed:
            began = time.perf_counter()
            s.progress.doing("looking for a seed")
            seed = next(seeds, None)
            self.times["initialization"] += time.perf_counter() - began
            if seed is None or s.interrupt.pressed:
                return
            yield seed

    def _solve(self, problem: TrajectoryProblem, seed: Seed, deadline: float) -> Solution:
        solution = solve(
            problem,
            seed.z,
            callback=self._report,
            deadline=deadline,
            radius=seed.radius,
            interrupt=self.settings.interrupt,
        )
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
        began = time.perf_counter()
        self.settings.progress.doing("checking")
        trajectory = as_trajectory(problem, solution.z, solution.dt)
        report = validate(self.scene, self.task.steps, trajectory, self.settings.options, self.settings.terms)
        self.times["validation"] += time.perf_counter() - began
        status = "success" if report.ok else "rejected" if solution.converged else "not converged"
        return _Try(name, solution.z, trajectory, report, status)

    def _stationary(self, problem: TrajectoryProblem) -> _Try:
        return self._judge(problem, Solution(problem.still, problem.timing_for(problem.still).dt), "none")

    def _plan(self, best: _Try, status: str, planning_time: float, build_time: float) -> Plan:
        s = self.settings
        return outcome(
            self.scene,
            self.task.steps,
            s.options,
            best.trajectory,
            best.report,
            status,
            took=spent(planning_time, build_time, iterations=self.iterations, rounds=self.rounds, times=self.times),
            random_seed=s.random_seed,
            initialization=best.name,
            history=self.history,
            terms=s.terms,
        )


def _ends_free(problem: TrajectoryProblem, seed: Seed) -> bool:
    """Return whether a seed's configurations at the ends of the phases are free and what they should be."""
    ends = problem.ends - 1
    free = problem.evaluate_contacts(seed.z, reach=problem.options.dist_safe).shortfall(problem.segments)[ends] <= 0.0
    return bool(free.all()) and problem.pose_error(seed.z) < 1e-2
