"""One try of a baseline: drive, reach, move, each on its own; see `separate` for what is done and why."""

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
from vkc_pin.goal import compile_task
from vkc_pin.initialization import Seed, initialize
from vkc_pin.knots import Knots, smooth
from vkc_pin.one_problem import TIMES
from vkc_pin.options import Options
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.scene import Scene
from vkc_pin.solver import RATE_TOLERANCE, solve
from vkc_pin.step_by_step import scene_after
from vkc_pin.steps import Actuate, GoTo, Grasp, Step
from vkc_pin.trajectory import Trajectory, join
from vkc_pin.unfold import as_trajectory

__all__ = ["FINER", "Attempt"]

FINER = 2
"""How many times more waypoints than elsewhere objects are moved in: an arm that only follows needs smaller steps, and time."""
_STANDS, _ENDS = 4, 10  # base poses that are tried in turn, the nearest first, at the handle and at the end
_ROUNDS = 8  # of the solver: what takes more is mostly in vain


class _FailedError(Exception):
    """A stage failed.

    Attributes:
        cause: Why; what becomes the plan's status.
        parts: What was done before, and as much as there is of the stage.
        share: How much of the stage works.
    """

    def __init__(self, cause: str, last: Trajectory | None = None, share: float = 0.0) -> None:
        super().__init__(cause)
        self.cause, self.share = cause, share
        self.parts = [] if last is None else [last]

    @property
    def came(self) -> float:
        """How many stages it came through."""
        return len(self.parts) + self.share


class Attempt:
    """One try; collects the motion stage by stage.

    Attributes:
        times: What it spent on the parts of `one_problem.TIMES` [s].
        build_time: On symbolic programs that were built for the first time [s].
    """

    def __init__(self, scene: Scene, options: Options, *, refine: bool, seed: Sequence[int], deadline: float = np.inf) -> None:
        """Prepare a try.

        Args:
            scene: Where it begins.
            options: How to plan.
            refine: Whether arm and object are moved out of collision at each waypoint (B2).
            seed: Of the random numbers.
            deadline: Value of `time.perf_counter()` after which no stage is begun.
        """
        self.scene, self.options, self.refine, self.deadline = scene, options, refine, deadline
        self.rng = np.random.default_rng(seed)
        self.parts: list[Trajectory] = []
        self.times = dict.fromkeys([*TIMES, "following"], 0.0)
        self.build_time, self.iterations = 0.0, 0

    def run(self, steps: Sequence[Actuate]) -> tuple[Trajectory, float, str]:
        """Return the motion, how many stages it came through (infinite: all), and why no further."""
        try:
            try:
                for step in steps:
                    self._actuate(step)
            except KeyboardInterrupt:
                raise _FailedError("interrupted") from None
        except _FailedError as error:
            came = len(self.parts) + error.came
            parts = [*self.parts, *error.parts]
            if not parts:
                problem = self._problem([GoTo(*self.scene.start[:3].tolist())])
                parts = [as_trajectory(problem, np.tile(problem.start, (problem.segments, 1)))]
            return join(parts, pause=self.options.grasp_time), came, error.cause
        return join(self.parts, pause=self.options.grasp_time), np.inf, ""

    def _actuate(self, step: Actuate) -> None:
        """Move joints of an object: drive to its handle and reach for it, unless it is held, and move it."""
        held = self.scene.held.get(step.object)
        if held is None or step.attachment not in (None, held):
            self.scene = self.scene.with_held({})
            self._take_hold([Grasp(step.object, step.attachment)])
        self._move(step)

    def _take_hold(self, steps: Sequence[Step]) -> None:
        """Drive to the nearest base pose from which the arm reaches what is to be grasped, and reach for it."""
        poses = self._free(self._poses(self._problem(steps)))
        scene, before, failure = self.scene, self.parts, _FailedError("no base pose", share=-1.0)
        for pose in poses[:_STANDS]:
            self.scene, self.parts = scene, list(before)
            try:
                self._drive(pose)
                self._reach(steps, pose)
                break
            except _FailedError as error:
                error.parts = [*self.parts[len(before) :], *error.parts]
                failure = max(failure, error, key=lambda one: one.came)
        else:
            self.parts = before
            raise failure

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
        problem = self._problem([step], replace(self.options, move_waypoints=FINER * self.options.move_waypoints))
        ways, failure = BaseWays(problem), _FailedError("no base path")
        for pose in self._poses(problem)[:_ENDS]:
            base = self._path(problem, ways, pose[:3])
            if base is None:
                continue
            self._in_time(failure)
            began = time.perf_counter()
            followed = follow(problem, base, self.rng, refine=self.refine)
            problem.take_time_for(followed.z)
            problem.stretch(followed.z)
            self.times["following"] += time.perf_counter() - began
            cause = followed.cause
            if not cause and problem.rate_violation(followed.z) > RATE_TOLERANCE:
                cause = "too fast"
            if not cause and problem.drift(followed.z) > 1.0:
                cause = "closure"
            if not cause:
                self._take(problem, followed.z)
                return
            if not failure.parts or followed.share > failure.share:
                failure = _FailedError(cause, as_trajectory(problem, followed.z), followed.share)
        raise failure

    def _in_time(self, failure: _FailedError) -> None:
        """Raise the error of what has failed so far if time is up."""
        if time.perf_counter() > self.deadline:
            failure.cause = failure.cause if failure.parts else "time limit"
            raise failure

    def _path(self, problem: TrajectoryProblem, ways: BaseWays, goal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the base at every waypoint, shape (N, 3): it stands while a latch is released; None: there is no way."""
        base: list[NDArray[np.float64]] = []
        now = problem.start[:3]
        for phase in problem.task.phases:
            if phase.name.startswith("move"):
                way = ways.way(now, goal, phase.segments)
                if way is None:
                    return None
            else:
                way = np.tile(now, (phase.segments, 1))
            base.append(way)
            now = way[-1]
        return np.concatenate(base)

    def _problem(self, steps: Sequence[Step], options: Options | None = None) -> TrajectoryProblem:
        """Return the problem of steps from where the motion has come to."""
        options = options or self.options
        problem = TrajectoryProblem(self.scene, compile_task(self.scene, steps, options), options)
        self.build_time += problem.transcription.take_build_time()
        return problem

    def _solve(self, problem: TrajectoryProblem, seeds: Iterator[Seed], cause: str) -> NDArray[np.float64]:
        """Return the first solution from a seed."""
        failure = _FailedError(cause)
        for seed in seeds:
            self._in_time(failure)
            solution = solve(problem, seed.z, rounds=_ROUNDS, deadline=self.deadline)
            self.build_time += problem.transcription.take_build_time()
            self.iterations += solution.iterations
            for key, value in solution.timings.items():
                self.times[key] += value
            if solution.converged:
                return solution.z
            if solution.status == "interrupted":
                raise KeyboardInterrupt
            if solution.status == "time limit":
                raise _FailedError("time limit", as_trajectory(problem, solution.z))
            if not failure.parts:
                failure = _FailedError(cause, as_trajectory(problem, solution.z))
        raise failure

    def _take(self, problem: TrajectoryProblem, z: NDArray[np.float64]) -> None:
        """Append a motion, and go on from where it ends."""
        self.parts.append(as_trajectory(problem, z))
        self.scene = scene_after(self.scene, problem.task, self.parts[-1])

    def _seed(self) -> int:
        return int(self.rng.integers(2**32))
