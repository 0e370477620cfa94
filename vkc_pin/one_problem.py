"""Steps as one problem: from seed to seed until validation accepts a motion."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vkc_pin.diagnosis import explain, impossible
from vkc_pin.goal import compile_task
from vkc_pin.initialization import initialize
from vkc_pin.monitor import Interrupt, interruptible
from vkc_pin.options import Options
from vkc_pin.plan import Plan
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.progress import Progress
from vkc_pin.report import Report
from vkc_pin.scene import Scene
from vkc_pin.seed import PhaseWaypoints, Seed
from vkc_pin.solution import Iteration, Solution
from vkc_pin.solver import solve
from vkc_pin.standing import TIMES, standing
from vkc_pin.steps import Step
from vkc_pin.terms import Term
from vkc_pin.trajectory import Trajectory
from vkc_pin.unfold import as_trajectory
from vkc_pin.validation import validate

__all__ = ["TIMES", "OneProblem", "Settings"]

_RACING = 3  # seeds of which the one to begin with is chosen


@dataclass(frozen=True)
class Settings:
    """How to plan; see `planner.plan`.

    Attributes:
        rough: Whether what comes out only starts a problem of more steps, after which nobody sees any more what is good about it.
            Then seeds do not race, and the first good motion will do.
        progress: Is told what is being done.
        interrupt: Whether Ctrl-C was pressed; then nothing new is begun. Copies for parts of a task share it.
    """

    initialization: str
    options: Options
    callback: Callable[[Iteration], None] | None
    time_limit: float | None
    seed: int
    perturbation: float
    terms: tuple[Term, ...] = ()
    rough: bool = False
    progress: Progress = field(default_factory=Progress)
    interrupt: Interrupt = field(default_factory=Interrupt)


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
    z: NDArray[np.float64]
    trajectory: Trajectory
    report: Report
    status: str

    @property
    def amount(self) -> float:
        """By how much everything is violated, summed over all units."""
        return sum(violation.amount for violation in self.report.violations)


class OneProblem:
    """Plans steps as one nonlinear program.

    Attributes:
        task: What the steps ask for.
        problem: The program, once `run` has begun.
        z: Its best z_1..z_N, shape (N, n), once `run` has ended.
        initialization: The name of the seed that led there.
    """

    def __init__(self, scene: Scene, steps: Sequence[Step], settings: Settings) -> None:
        self.scene, self.settings = scene, settings
        self.task = compile_task(scene, steps, settings.options)
        self.times = dict.fromkeys(TIMES, 0.0)
        self.rounds = self.iterations = 0
        self.history: list[dict[str, float]] = []
        self.blocked: list[str] = []  # phases in which there is no way for the base
        self._leading: Seed | None = None

    def run(self, seed: Callable[[TrajectoryProblem], Seed] | None = None) -> Plan:
        """Try seeds until validation accepts a motion, there are no more, or time is up.

        Args:
            seed: Makes the only seed to try, a motion that is nearly good as it is, so that there is no need of patience with it;
                None: those of the settings' initialization.
        """
        began = time.perf_counter()
        try:
            return self._run(seed, began)
        except KeyboardInterrupt:  # before there was a motion
            self.settings.interrupt.pressed = True
            spent = time.perf_counter() - began
            s = self.settings
            return standing(self.scene, self.task.steps, s.options, seed=s.seed, spent=spent, terms=s.terms)

    def _run(self, seed: Callable[[TrajectoryProblem], Seed] | None, began: float) -> Plan:
        limit = self.settings.time_limit
        self.settings.progress.begin([phase.name for phase in self.task.phases])
        problem = self.problem = TrajectoryProblem(self.scene, self.task, self.settings.options, self.settings.terms)
        build_time = problem.transcription.take_build_time()
        reasons = impossible(problem)
        if reasons:
            best, status = self._stationary(problem), "infeasible"
            best = dataclasses.replace(best, report=best.report.with_reasons(reasons))
        else:
            deadline = np.inf if limit is None else began + build_time + limit
            seeds = self._raced(problem, deadline) if seed is None else iter([seed(problem)])
            best, status = self._try_seeds(problem, seeds, deadline, searched=seed is None)
        self.z, self.initialization = best.z, best.name
        build_time += problem.transcription.take_build_time()
        return self._plan(best, status, time.perf_counter() - began - build_time, build_time)

    def piece(self) -> PhaseWaypoints:
        """Return the best waypoints, once `run` has ended, for problems of more phases to start from."""
        phases = tuple(phase.name for phase in self.task.phases)
        path, ends = self.problem.waypoints(self.z), [0, *self.problem.ends.tolist()]
        waypoints = tuple(path[first : last + 1] for first, last in itertools.pairwise(ends))
        return PhaseWaypoints(phases, self.problem.chain.names, waypoints, self.initialization)

    def _try_seeds(
        self, problem: TrajectoryProblem, seeds: Iterator[Seed], deadline: float, *, searched: bool
    ) -> tuple[_Try, str]:
        """Return the best try, with what is in the way of the task if it is no success, and the plan's status."""
        best: _Try | None = None
        notes: list[str] = []
        stuck: list[tuple[float, int, Seed]] = []
        status = ""
        try:
            for number, seed in enumerate(itertools.chain(seeds, _least(stuck)), start=1):
                solution = self._solve(problem, seed, deadline, patient=seed.penalty is not None)
                found = self._judge(problem, solution, seed.name)
                if searched and solution.penalty is not None:
                    again = Seed(seed.name, solution.z, radius=solution.radius, penalty=solution.penalty)
                    stuck.append((found.amount, number, again))
                best = found if best is None or found.report.ok or found.amount < best.amount else best
                if best.status == "success":
                    return best, "success"
                if self.settings.interrupt.pressed:
                    status = "interrupted"
                    break
                if solution.status == "time limit":
                    status = solution.status
                    break
                if number == 1 and searched and not _ends_free(problem, seed):
                    notes = explain(problem, self.settings.seed)
                elif notes:  # two seeds failed, and random configurations find no free one at a goal either
                    break
        except KeyboardInterrupt:
            self.settings.interrupt.pressed = True
            status = "interrupted"
        if best is None and self._leading is not None:
            problem.take_time_for(self._leading.z)
            best = self._judge(problem, Solution(self._leading.z), self._leading.name)
        if best is None:
            best, notes = self._stationary(problem), notes + self.blocked
        if not status:
            status = "infeasible" if notes else best.status
            best = dataclasses.replace(best, report=dataclasses.replace(best.report, notes=tuple(notes)))
        return best, status

    def _seeds(self, problem: TrajectoryProblem) -> Iterator[Seed]:
        s = self.settings
        seeds = initialize(
            problem, s.initialization, s.seed, count=s.options.max_restarts, perturbation=s.perturbation, notes=self.blocked
        )
        while True:
            began = time.perf_counter()
            s.progress.doing("looking for a seed")
            seed = next(seeds, None)
            self.times["initialization"] += time.perf_counter() - began
            if seed is None:
                return
            yield seed

    def _raced(self, problem: TrajectoryProblem, deadline: float) -> Iterator[Seed]:
        """Yield seeds; where a grasp is chosen with what follows in mind, first those that look best after one round."""
        seeds = self._seeds(problem)
        if not self.settings.rough and any(phase.grasps for phase in problem.task.phases[:-1]):
            scored: list[tuple[float, int, Seed]] = []
            for number, seed in enumerate(itertools.islice(seeds, _RACING)):
                if not seed.races:  # a round would not tell
                    scored.append((np.inf, number, seed))
                    continue
                solution = self._solve(problem, seed, deadline, rounds=1)
                if solution.status == "time limit" and self._leading is not None:
                    break
                scored.append(
                    (problem.objective(solution.z), number, dataclasses.replace(seed, z=solution.z, radius=solution.radius))
                )
                self._leading = min(scored)[-1]
                if solution.status == "interrupted":
                    raise KeyboardInterrupt
            yield from (seed for _, _, seed in sorted(scored))
        yield from seeds

    def _solve(
        self, problem: TrajectoryProblem, seed: Seed, deadline: float, *, rounds: int | None = None, patient: bool = True
    ) -> Solution:
        solution = solve(
            problem,
            seed.z,
            callback=self._report,
            deadline=deadline,
            rounds=rounds,
            radius=seed.radius,
            penalty=seed.penalty,
            patient=patient,
            thorough=not self.settings.rough,
        )
        self.rounds += solution.rounds
        self.iterations += solution.iterations
        for key, value in solution.timings.items():
            self.times[key] += value
        self.history += [dataclasses.asdict(row) for row in solution.history]
        if solution.status == "interrupted":
            self.settings.interrupt.pressed = True
        return solution

    def _report(self, row: Iteration) -> None:
        self.settings.progress(row)
        if self.settings.callback is not None:
            self.settings.callback(row)

    def _judge(self, problem: TrajectoryProblem, solution: Solution, name: str) -> _Try:
        began = time.perf_counter()
        self.settings.progress.doing("checking")
        with interruptible() as interrupt:  # what was found is checked all the same
            trajectory = as_trajectory(problem, solution.z)
            report = validate(self.scene, self.task.steps, trajectory, self.settings.options, self.settings.terms)
        self.settings.interrupt.pressed |= interrupt.pressed
        self.times["validation"] += time.perf_counter() - began
        status = "success" if report.ok else "rejected" if solution.converged else "not converged"
        return _Try(name, solution.z, trajectory, report, status)

    def _stationary(self, problem: TrajectoryProblem) -> _Try:
        return self._judge(problem, Solution(np.tile(problem.start, (problem.segments, 1))), "none")

    def _plan(self, best: _Try, status: str, planning_time: float, build_time: float) -> Plan:
        metrics = {
            "planning_time": planning_time,
            "build_time": build_time,
            **best.trajectory.metrics(),
            "clearance": best.report.clearance,
            "closure_error": best.report.closure_error,
            "iterations": float(self.iterations),
            "rounds": float(self.rounds),
            **{f"time_{key}": value for key, value in self.times.items()},
        }
        return Plan(
            scene=self.scene,
            steps=self.task.steps,
            options=self.settings.options,
            trajectory=best.trajectory,
            validation=best.report,
            status=status,
            metrics=metrics,
            seed=self.settings.seed,
            initialization=best.name,
            history=tuple(self.history),
            terms=self.settings.terms,
        )


def _least(stuck: list[tuple[float, int, Seed]]) -> Iterator[Seed]:
    """Yield, of what got stuck by the time this is asked, what violates least."""
    for _, _, seed in sorted(stuck)[:1]:
        yield seed


def _ends_free(problem: TrajectoryProblem, seed: Seed) -> bool:
    """Return whether a seed's configurations at the ends of the phases are free and what they should be."""
    ends = problem.ends - 1
    free = problem.evaluate_contacts(seed.z, reach=problem.options.dist_safe).shortfall(problem.segments)[ends] <= 0.0
    return bool(free.all()) and problem.pose_error(seed.z) < 1e-2
