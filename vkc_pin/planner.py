"""plan(): from steps to a checked motion."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vkc_pin.diagnosis import explain, impossible
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.goal import compile_task
from vkc_pin.hold import as_mappings
from vkc_pin.initialization import METHODS, initialize
from vkc_pin.options import Options
from vkc_pin.plan import Plan
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.report import Report
from vkc_pin.scene import Scene
from vkc_pin.solution import Iteration, Solution
from vkc_pin.solver import solve
from vkc_pin.steps import Step
from vkc_pin.trajectory import PhaseSpan, Trajectory
from vkc_pin.validation import validate

__all__ = ["plan"]


def plan(
    scene: Scene,
    steps: Sequence[Step],
    *,
    initialization: str = "auto",
    options: Options | None = None,
    callback: Callable[[Iteration], None] | None = None,
    time_limit: float | None = None,
    seed: int = 0,
) -> Plan:
    """Plan one coordinated motion of base, arm and objects that brings about `steps`.

    Args:
        scene: Robot, objects and obstacles; the motion starts at the scene's start.
        steps: What should change in the world, in this order: `Reach`, `Grasp`, `Actuate`, `GoTo`.
        initialization: "auto", "interpolated", "astar" or "stationary"; see `initialization.initialize`.
        options: How to plan; `Options()` if left out.
        callback: Called after every round of the solver with an `Iteration`, whose fields are named columns.
        time_limit: Seconds of planning after which the best iterate is returned, with status "time limit".
        seed: Of the random numbers. The same seed gives the same trajectory on the same machine.

    Returns:
        A plan, in every case: `plan.success` is true only if the independent `validation` found nothing wrong, and
        `plan.report()` names what is violated otherwise. Ctrl-C ends planning with the best iterate so far.

    Raises:
        InputError: The steps name something that is not there or cannot be done, or an argument is wrong.
    """
    options = Options() if options is None else options
    for field, value, kind in (("scene", scene, Scene), ("options", options, Options)):
        if not isinstance(value, kind):
            raise InputError("wrong kind of argument", field=field, expected=f"a {kind.__name__}", got=repr(value))
    if initialization not in METHODS:
        raise UnknownNameError("initialization", str(initialization), METHODS, field="initialization")
    if time_limit is not None and not (_is_number(time_limit) and 0 < time_limit < np.inf):
        raise InputError("out of range", field="time_limit", expected="seconds, more than 0", got=repr(time_limit))
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise InputError("out of range", field="seed", expected="a whole number of at least 0", got=repr(seed))
    return _Planner(scene, steps, initialization, options, callback, time_limit, int(seed)).run()


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


class _Planner:
    def __init__(
        self,
        scene: Scene,
        steps: Sequence[Step],
        initialization: str,
        options: Options,
        callback: Callable[[Iteration], None] | None,
        time_limit: float | None,
        seed: int,
    ) -> None:
        self.scene, self.steps, self.initialization = scene, steps, initialization
        self.options, self.callback, self.time_limit, self.seed = options, callback, time_limit, seed
        self.times = dict.fromkeys(("initialization", "coal", "casadi", "ipopt", "validation"), 0.0)
        self.rounds = self.iterations = 0
        self.history: list[dict[str, float]] = []

    def run(self) -> Plan:
        """Try seeds until validation accepts a motion, there are no more, or time is up."""
        began = time.perf_counter()
        task = compile_task(self.scene, self.steps, self.options)
        self.steps = task.steps
        problem = TrajectoryProblem(self.scene, task, self.options)
        build_time = problem.transcription.take_build_time()
        deadline = np.inf if self.time_limit is None else began + build_time + self.time_limit
        best: tuple[float, str, Trajectory, Report, str] | None = None
        reasons = impossible(problem)
        status = "infeasible" if reasons else ""
        notes: list[str] = []
        try:
            for number, (name, seed) in enumerate([] if reasons else self._seeds(problem), start=1):
                solution = self._solve(problem, seed, deadline)
                best = self._better(best, problem, solution, name)
                if best[1] == "success" or solution.status in ("time limit", "interrupted"):
                    status = "" if best[1] == "success" else solution.status
                    break
                if number == 1:
                    notes = explain(problem, self.seed)
                elif notes:  # two seeds failed, and random configurations find no free one at a goal either
                    break
        except KeyboardInterrupt:
            status = "interrupted"
        if best is None:
            stationary = Solution(np.tile(problem.start, (problem.segments, 1)))
            best = self._better(None, problem, stationary, "none")
        _, verdict, trajectory, report, name = best
        if reasons:
            report = report.with_reasons(reasons)
        elif verdict != "success" and not status:
            report, status = dataclasses.replace(report, notes=tuple(notes)), "infeasible" if notes else ""
        build_time += problem.transcription.take_build_time()
        metrics = {
            "planning_time": time.perf_counter() - began - build_time,
            "build_time": build_time,
            "duration": float(trajectory.times[-1]),
            "base_effort": trajectory.base_effort(),
            "base_effort_l1": trajectory.base_effort_l1(),
            "arm_effort": trajectory.arm_effort(),
            "clearance": report.clearance,
            "closure_error": report.closure_error,
            "iterations": float(self.iterations),
            "rounds": float(self.rounds),
            **{f"time_{key}": value for key, value in self.times.items()},
        }
        return Plan(
            scene=self.scene,
            steps=self.steps,
            options=self.options,
            trajectory=trajectory,
            validation=report,
            status=status or verdict,
            metrics=metrics,
            seed=self.seed,
            initialization=name,
            history=tuple(self.history),
        )

    def _seeds(self, problem: TrajectoryProblem) -> Iterator[tuple[str, NDArray[np.float64]]]:
        seeds = initialize(problem, self.initialization, self.seed, count=self.options.max_restarts)
        while True:
            began = time.perf_counter()
            seed = next(seeds, None)
            self.times["initialization"] += time.perf_counter() - began
            if seed is None:
                return
            yield seed.name, seed.z

    def _solve(self, problem: TrajectoryProblem, seed: NDArray[np.float64], deadline: float) -> Solution:
        solution = solve(problem, seed, callback=self.callback, deadline=deadline)
        self.rounds += solution.rounds
        self.iterations += solution.iterations
        for key, value in solution.timings.items():
            self.times[key] += value
        self.history += [dataclasses.asdict(row) for row in solution.history]
        return solution

    def _better(
        self, best: tuple[float, str, Trajectory, Report, str] | None, problem: TrajectoryProblem, solution: Solution, name: str
    ) -> tuple[float, str, Trajectory, Report, str]:
        began = time.perf_counter()
        trajectory = as_trajectory(problem, solution.z)
        report = validate(self.scene, self.steps, trajectory, self.options)
        self.times["validation"] += time.perf_counter() - began
        status = "success" if report.ok else "rejected" if solution.converged else "not converged"
        amount = sum(violation.amount for violation in report.violations)
        if best is None or report.ok or amount < best[0]:
            return amount, status, trajectory, report, name
        return best


def as_trajectory(problem: TrajectoryProblem, z: NDArray[np.float64]) -> Trajectory:
    """Return z_1..z_N, shape (N, n), as a trajectory; where something is grasped or let go, the robot waits for the gripper."""
    waypoints, wait = problem.waypoints(z), problem.options.grasp_time
    _settle_choices(problem, waypoints)
    rows, times = [0], [0.0]
    phases: list[PhaseSpan] = []
    begin = 0
    for phase, end in zip(problem.task.phases, problem.ends, strict=True):
        first = len(rows) - 1
        if begin and (problem.task.phases[len(phases) - 1].grasps or phase.leaves):
            rows.append(rows[-1])
            times.append(times[-1] + wait)
        for row in range(begin + 1, int(end) + 1):
            rows.append(row)
            times.append(times[-1] + problem.dt[row - 1])
        phases.append(PhaseSpan(phase.name, first, len(rows) - 1, *as_mappings(phase.held)))
        begin = int(end)
    last = problem.task.phases[-1]
    if set(problem.task.after) < {*last.held, *last.grasps}:
        rows.append(rows[-1])
        times.append(times[-1] + wait)
        phases.append(PhaseSpan("let go", len(rows) - 2, len(rows) - 1, *as_mappings(problem.task.after)))
    robot = problem.chain.robot.coordinates.size
    return Trajectory(problem.chain.names, np.array(times), waypoints[rows], tuple(phases), robot)


def _settle_choices(problem: TrajectoryProblem, waypoints: NDArray[np.float64]) -> None:
    """Give the freedom of a grasp, which means nothing while nothing is held, the value it has next, or else had last."""
    starts = [0, *problem.ends[:-1]]
    for hold, names in problem.chain.virtual.items():
        active = np.zeros(len(waypoints), bool)
        for phase, first, last in zip(problem.task.phases, starts, problem.ends, strict=True):
            active[first : last + 1] |= hold in phase.held
            active[last] |= hold in phase.grasps
        at = np.flatnonzero(active)
        nearest = at[np.minimum(np.searchsorted(at, np.arange(len(waypoints))), len(at) - 1)]
        for column in map(problem.chain.index, names):
            waypoints[:, column] = waypoints[nearest, column]
