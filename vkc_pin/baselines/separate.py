"""Plans base and arm one after the other, with the base poses found beforehand: the baselines B1 and B2 of the paper.

After section IV-C of Jiao et al. (IROS 2021) and its authors' code. For a step that moves joints of an object:

1. Base poses from which the arm reaches the handle (`base_poses`), the nearest first, that the base can drive to.
2. The base drives there, the arm as it is: A*, then optimisation.
3. The base stands, the arm reaches the handle: optimisation.
4. Base poses from which the arm reaches the handle when all is done, the nearest first; the base's path to there.
5. The object's joints run to their goals, the base along its path, and the arm follows (`following`): B1 by inverse
   kinematics, B2 moving arm and object out of collision at each waypoint.

What fails is tried again with other random numbers. Scene, limits, steps of time, clearances and validation are those of
`planner.plan`, and so is the solver of the optimisations.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vkc_pin.baselines.base_poses import base_poses
from vkc_pin.baselines.base_ways import BaseWays
from vkc_pin.baselines.following import follow
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.goal import compile_task
from vkc_pin.initialization import Seed, initialize
from vkc_pin.knots import Knots, smooth
from vkc_pin.one_problem import TIMES
from vkc_pin.options import Options
from vkc_pin.plan import Plan
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.scene import Scene
from vkc_pin.solver import RATE_TOLERANCE, solve
from vkc_pin.step_by_step import scene_after
from vkc_pin.steps import Actuate, GoTo, Grasp, Step
from vkc_pin.trajectory import Trajectory, join
from vkc_pin.unfold import as_trajectory
from vkc_pin.validation import validate

__all__ = ["METHODS", "RETRIES", "plan_separately"]

METHODS = ("B1", "B2")
RETRIES = 5
"""How often all is tried."""
FINER = 2
"""How many times more waypoints than elsewhere objects are moved in: an arm that only follows needs smaller steps, and time."""
_STANDS, _ENDS = 4, 10  # base poses that are tried in turn, the nearest first, at the handle and at the end
_ROUNDS = 8  # of the solver: what takes more is mostly in vain


class _FailedError(Exception):
    """A stage failed; its text is the cause, what becomes the plan's status."""

    def __init__(self, cause: str, trajectory: Trajectory | None = None) -> None:
        super().__init__(cause)
        self.trajectory = trajectory
        self.parts: list[Trajectory] = []  # what was done before


def plan_separately(
    scene: Scene,
    steps: Sequence[Step],
    *,
    method: str = "B1",
    options: Options | None = None,
    seed: int = 0,
    time_limit: float | None = None,
    retries: int = RETRIES,
) -> Plan:
    """Plan as the baselines do.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change: `Actuate`, any number.
        method: "B1" or "B2".
        options: As for `planner.plan`.
        seed: Of the random numbers.
        time_limit: Seconds of planning after which nothing more is begun.
        retries: How often all is tried, with other random numbers, until validation accepts a motion.

    Returns:
        The plan of the first try that validation accepts, else the one that came furthest. Its status is then the cause:
        "no base pose", "no base path", "arm does not reach", "no inverse kinematics", "collision", "too fast", "closure", or
        "rejected" by validation. Planning time is that of all tries.

    Raises:
        InputError: Steps that cannot be done or are of another kind, or an argument is wrong.
    """
    options = Options() if options is None else options
    if method not in METHODS:
        raise UnknownNameError("method", str(method), METHODS, field="method")
    if not isinstance(retries, int) or retries < 1:
        raise InputError("out of range", field="retries", expected="a whole number of at least 1", got=repr(retries))
    task = compile_task(scene, steps, options)
    for number, step in enumerate(task.steps):
        if not isinstance(step, Actuate):
            raise InputError("the baselines know no such step", field=f"steps[{number}]", expected="Actuate", got=repr(step))
    began, best, spent = time.perf_counter(), None, dict.fromkeys(["build_time", *(f"time_{key}" for key in TIMES)], 0.0)
    iterations = 0
    for attempt in range(retries):
        tried = _Attempt(scene, task.steps, options, method, [seed, attempt])
        trajectory, done, status = tried.run()
        checked = time.perf_counter()
        report = validate(scene, task.steps, trajectory, options)
        tried.times["validation"] += time.perf_counter() - checked
        status = "success" if report.ok else status or "rejected"
        iterations += tried.iterations
        spent["build_time"] += tried.build_time
        for key, value in tried.times.items():
            spent[f"time_{key}"] += value
        if best is None or status == "success" or done > best[1]:
            best = (trajectory, done, status, report, attempt)
        planning_time = time.perf_counter() - began - spent["build_time"]
        if status == "success" or (time_limit is not None and planning_time > time_limit):
            break
    assert best is not None
    trajectory, _, status, report, attempt = best
    return Plan(
        scene=scene,
        steps=task.steps,
        options=options,
        trajectory=trajectory,
        validation=report,
        status=status,
        metrics={
            "planning_time": planning_time,
            **spent,
            **trajectory.metrics(),
            "clearance": report.clearance,
            "closure_error": report.closure_error,
            "iterations": float(iterations),
            "rounds": float(attempt + 1),
        },
        seed=seed,
        initialization=f"{method}, try {attempt + 1}",
    )


class _Attempt:
    """One try; collects the motion stage by stage.

    Attributes:
        times: What it spent on the parts of `one_problem.TIMES` [s].
        build_time: On symbolic programs that were built for the first time [s].
    """

    def __init__(self, scene: Scene, steps: Sequence[Step], options: Options, method: str, seed: Sequence[int]) -> None:
        self.scene, self.steps, self.options, self.method = scene, steps, options, method
        self.rng = np.random.default_rng(seed)
        self.parts: list[Trajectory] = []
        self.times = dict.fromkeys(TIMES, 0.0)
        self.build_time, self.iterations = 0.0, 0

    def run(self) -> tuple[Trajectory, float, str]:
        """Return the motion, how many stages of it are done, and the cause if it is not all."""
        cause, done = "", 0.0
        try:
            for step in self.steps:
                assert isinstance(step, Actuate)
                self._actuate(step)
        except _FailedError as error:
            cause, done = str(error), len(self.parts)
            if error.trajectory is not None:
                self.parts.append(error.trajectory)
            elif not self.parts:
                problem = self._problem([GoTo(*self.scene.start[:3])])
                self.parts.append(as_trajectory(problem, np.tile(problem.start, (problem.segments, 1))))
        return join(self.parts, pause=self.options.grasp_time), done if cause else np.inf, cause

    def _actuate(self, step: Actuate) -> None:
        """Move joints of an object: drive to its handle, reach for it, move it."""
        steps = [Grasp(step.object, step.attachment)]
        poses = self._free(self._poses(self._problem(steps)))
        begun, failure = (self.scene, len(self.parts)), _FailedError("no base pose")
        for pose in poses[:_STANDS]:
            try:
                self._drive(pose)
                self._reach(steps, pose)
                break
            except _FailedError as error:
                failure = error if failure.trajectory is None else failure  # the first that came anywhere
                failure.parts = failure.parts or self.parts[begun[1] :]
                self.scene, self.parts = begun[0], self.parts[: begun[1]]
        else:
            self.parts += failure.parts
            raise failure
        self._move(step)

    def _poses(self, problem: TrajectoryProblem) -> NDArray[np.float64]:
        """Return configurations for the end of a problem, the nearest first."""
        began = time.perf_counter()
        poses = base_poses(problem, problem.segments, problem.start, self.rng)
        self.times["initialization"] += time.perf_counter() - began
        if not len(poses):
            raise _FailedError("no base pose")
        return poses

    def _free(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return those whose base may stand there while the arm is still as it is."""
        stay = self._problem([GoTo(*self.scene.start[:3].tolist())])
        ends = np.tile(stay.start, (len(poses), 1))
        ends[:, :3] = poses[:, :3]
        return np.asarray(poses[Knots(stay, self.rng).depth(ends, stay.segments) <= 0.0])

    def _drive(self, pose: NDArray[np.float64]) -> None:
        """Drive to where the base has to stand, the arm as it is."""
        problem = self._problem([GoTo(*pose[:3].tolist())])
        arm = slice(3, problem.chain.robot.coordinates.size)
        problem.lower[:, arm] = problem.upper[:, arm] = problem.start[arm]
        self._take(problem, self._solve(problem, initialize(problem, "astar", self._seed()), "no base path"))

    def _reach(self, steps: Sequence[Step], pose: NDArray[np.float64]) -> None:
        """Take hold of the object, the base stands."""
        problem = self._problem(steps)
        problem.lower[:, :3] = problem.upper[:, :3] = problem.start[:3]
        last = np.append(problem.start[:3], pose[3:])
        straight = problem.start + smooth(problem.segments)[:, None] * (last - problem.start)
        seeds = initialize(problem, "interpolated", self._seed())
        self._take(problem, self._solve(problem, itertools.chain([Seed("straight", straight)], seeds), "arm does not reach"))

    def _move(self, step: Actuate) -> None:
        """Move the object's joints: the base goes to the nearest pose to which the arm can follow."""
        finer = replace(self.options, move_waypoints=FINER * self.options.move_waypoints)
        problem = self._problem([step], finer)
        ways = BaseWays(problem)
        failure, share = _FailedError("no base path"), -1.0
        for pose in self._poses(problem)[:_ENDS]:
            base = self._path(problem, ways, pose[:3])
            if base is None:
                continue
            followed = follow(problem, base, self.rng, refine=self.method == "B2")
            problem.take_time_for(followed.z)
            problem.stretch(followed.z)
            cause = followed.cause
            if not cause and problem.rate_violation(followed.z) > RATE_TOLERANCE:
                cause = "too fast"
            if not cause and problem.drift(followed.z) > 1.0:
                cause = "closure"
            if not cause:
                self._take(problem, followed.z)
                return
            if followed.share > share:
                failure, share = _FailedError(cause, as_trajectory(problem, followed.z)), followed.share
        raise failure

    def _path(self, problem: TrajectoryProblem, ways: BaseWays, goal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the base at every waypoint, shape (N, 3): it stands while a latch is released; None: there is no way."""
        base, begin = [], 0
        moving = [phase.name.startswith("move") for phase in problem.task.phases]
        now = problem.start[:3]
        for phase, moves in zip(problem.task.phases, moving, strict=True):
            way = ways.way(now, goal, phase.segments) if moves else np.tile(now, (phase.segments, 1))
            if way is None:
                return None
            base.append(way)
            now = way[-1]
            begin += phase.segments
        return np.concatenate(base)

    def _problem(self, steps: Sequence[Step], options: Options | None = None) -> TrajectoryProblem:
        """Return the problem of steps from where the motion has come to."""
        options = options or self.options
        problem = TrajectoryProblem(self.scene, compile_task(self.scene, steps, options), options)
        self.build_time += problem.transcription.take_build_time()
        return problem

    def _solve(self, problem: TrajectoryProblem, seeds: Iterator[Seed], cause: str) -> NDArray[np.float64]:
        """Return the first solution from a seed; raise the error of `cause`, with the first motion that is none, otherwise."""
        first: Trajectory | None = None
        for seed in seeds:
            solution = solve(problem, seed.z, rounds=_ROUNDS)
            self.build_time += problem.transcription.take_build_time()
            self.iterations += solution.iterations
            for key, value in solution.timings.items():
                self.times[key] += value
            if solution.converged:
                return solution.z
            first = first or as_trajectory(problem, solution.z)
        raise _FailedError(cause, first)

    def _take(self, problem: TrajectoryProblem, z: NDArray[np.float64]) -> None:
        """Append a motion, and go on from where it ends."""
        self.parts.append(as_trajectory(problem, z))
        self.scene = scene_after(self.scene, problem.task, self.parts[-1])

    def _seed(self) -> int:
        return int(self.rng.integers(2**32))
