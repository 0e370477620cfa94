"""Makes one attempt of a baseline: drive, reach and move, each on its own; see `separate`."""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from vkc_pin.experiments.baselines.following import FailedError, follow
from vkc_pin.experiments.baselines.paths import BasePaths, find_goal_poses
from vkc_pin.experiments.baselines.postures import (
    find_base_poses,
    generate_postures,
    interpolate_path,
    is_at_home,
)
from vkc_pin.options import Options
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, sample_smoothstep
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import STAGES
from vkc_pin.planning.results import make_stationary_trajectory
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import BudgetExhaustedError, record_evaluations
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step
from vkc_pin.world.trajectory.splicing import concatenate_trajectories
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import compute_final_scene

BaselineStep = Actuate | Place | GoTo | Reach

FINER = 2
"""Factor of `Options.move_waypoints` for moving objects, since the arm only follows."""
# numbers of base poses that are tried at the handle and at the end
_HANDLE_POSES = 4
_END_POSES = 10
_BASE = slice(3)


class Attempt:
    """One attempt; it collects the motion stage by stage.

    Attributes:
        times: Times of the stages of planning [s].
    """

    def __init__(
        self,
        scene: Scene,
        options: Options,
        *,
        refine: bool,
        seed: Sequence[int],
        finer: int,
        cache: Cache,
    ) -> None:
        self.scene = scene
        self.options = options
        self.refine = refine
        self.finer = finer
        self.cache = cache
        self.rng = np.random.default_rng(seed)
        self.parts: list[Trajectory] = []
        self.times = dict.fromkeys([*STAGES, "following"], 0.0)
        self.iterations = 0

    def run(self, steps: Sequence[BaselineStep]) -> tuple[Trajectory, float, str]:
        """Return the motion, the number of completed stages (infinite: all), and the cause."""
        pause = self.options.grasp_time
        try:
            for step in steps:
                self._do_step(step)
        except (FailedError, BudgetExhaustedError) as error:
            failure = error if isinstance(error, FailedError) else FailedError(str(error))
            progress = len(self.parts) + failure.progress
            parts = [*self.parts, *failure.parts]
            if not parts:
                parts = [make_stationary_trajectory(self.scene, self.options)]
            return concatenate_trajectories(parts, pause=pause), progress, failure.cause
        return concatenate_trajectories(self.parts, pause=pause), np.inf, ""

    def _do_step(self, step: BaselineStep) -> None:
        """Carry out a step, stage by stage."""
        if isinstance(step, Actuate):
            self._actuate(step)
        elif isinstance(step, Place):
            self._place(step)
        elif isinstance(step, Reach):
            poses = self._find_poses(self._make_problem([step]))
            self._drive_and_reach([step], poses, _HANDLE_POSES)
        else:  # without a goal heading, the best one
            goals = find_goal_poses(step, float(self.scene.start[2]))
            drive = functools.partial(self._drive, goals)
            self._do_withdrawn(drive, FailedError("no base path"))

    def _actuate(self, step: Actuate) -> None:
        """Drive to an object's handle, grasp it unless it is grasped, and move the joints."""
        after = compile_task(self.scene, [step], self.options, nothing=True).after
        (attachment,) = (hold.attachment for hold in after if hold.object == step.object)
        if self.scene.held.get(step.object) != attachment:
            self._grasp([Grasp(step.object, attachment)])
        self._move(step)

    def _place(self, step: Place) -> None:
        """Grasp an object unless it is grasped, carry it to a base pose, and put it down."""
        if step.object not in self.scene.held:
            self._grasp([Grasp(step.object, step.attachment)])
        poses = self._find_poses(self._make_problem([step]))
        self._drive_and_reach([step], poses, _END_POSES)

    def _grasp(self, steps: Sequence[Step]) -> None:
        """Drive to the nearest base pose from which the arm reaches the grasp, and grasp."""
        poses = self._find_poses(self._make_problem(steps, scene=self.scene.with_held({})))
        self._drive_and_reach(steps, poses, _HANDLE_POSES)

    def _drive_and_reach(self, steps: Sequence[Step], poses: Floats, most: int) -> None:
        """Drive to one of the first `most` base poses, shape (K, n), and reach from there."""

        def drive_and_reach(pose: Floats) -> None:
            self._drive(pose[None, :3])
            self._reach(steps, pose)

        def try_poses() -> None:
            failure = FailedError("no base pose", share=-1.0)
            self._try_choices(self._select_free(poses)[:most], drive_and_reach, failure)

        self._do_withdrawn(try_poses, FailedError("no base pose", share=-1.0))

    def _do_withdrawn(self, stage: Callable[[], None], failure: FailedError) -> None:
        """Move the arm to a posture for driving, as near as possible, and do a stage."""

        def withdraw(path: Floats) -> None:
            self._withdraw(path)
            stage()

        postures = generate_postures(self._make_problem([self._stay()]))
        self._try_choices(postures, withdraw, failure)

    def _try_choices(
        self, choices: Iterable[Floats], stage: Callable[[Floats], None], failure: FailedError
    ) -> None:
        """Do a stage with the first choice that works, or raise the failure with most progress."""
        scene = self.scene
        before = self.parts
        for choice in choices:
            self.parts = list(before)
            try:
                stage(choice)
                return
            except FailedError as error:
                error.parts = [*self.parts[len(before) :], *error.parts]
                if error.progress > failure.progress:
                    failure = error
                self.scene = scene
                self.parts = before
        raise failure

    def _find_poses(self, problem: TrajectoryProblem) -> Floats:
        """Return configurations for the end of a problem, the nearest first."""
        began = time.perf_counter()
        poses = find_base_poses(problem, problem.segments, problem.start, self.rng)
        self.times["initialization"] += time.perf_counter() - began
        if not len(poses):
            raise FailedError("no base pose")
        return poses

    def _select_free(self, poses: Floats) -> Floats:
        """Return the poses at which the base is free with the present arm."""
        problem = self._make_problem([self._stay()])
        # The base at all poses, and where it is.
        ends = np.tile(problem.start, (len(poses) + 1, 1))
        ends[:-1, :3] = poses[:, :3]
        sampler = KeyframeSampler(problem, self.rng)
        shortfalls = sampler.compute_shortfall(ends, problem.segments)
        # The arm may stay as close to the robot as it is.
        accepted = min(shortfalls[-1], CLEARANCE_TOLERANCE)
        return np.asarray(poses[shortfalls[:-1] <= accepted])

    def _withdraw(self, path: Floats) -> None:
        """Move the arm along configurations, shape (K, n), while the base is stationary."""
        if not len(path):
            return
        problem = _fix_coordinates(self._make_problem([self._stay()]), _BASE)
        arm = slice(3, problem.chain.robot.coordinates.size)
        problem = _fix_coordinates(problem, arm, path[-1, arm], rows=-1)
        guesses = [InitialGuess("straight", interpolate_path(problem, path))]
        if len(path) > 1:
            guesses.append(InitialGuess("straight", interpolate_path(problem, path[-1:])))
        self._append(problem, *self._solve(problem, iter(guesses), "arm does not reach"))

    def _drive(self, goals: Floats) -> None:
        """Drive to one of several poses, shape (G, 3), with the arm as it is."""
        x, y, yaw = goals[0].tolist()
        has_heading = len(goals) == 1
        problem = self._make_problem([GoTo(x, y, yaw if has_heading else None)])
        problem = _fix_coordinates(problem, slice(3, problem.chain.robot.coordinates.size))
        if is_at_home(problem) and not self.scene.held and has_heading:
            guesses = initialize(problem, "astar", self._draw_seed())
        else:
            guesses = BasePaths(problem, whole=True).make_guesses(problem, goals)
        self._append(problem, *self._solve(problem, guesses, "no base path"))

    def _reach(self, steps: Sequence[Step], pose: Floats) -> None:
        """Grasp the object or put it down, while the base is stationary."""
        problem = _fix_coordinates(self._make_problem(steps), _BASE)
        last = np.append(problem.start[:3], pose[3:])
        fractions = sample_smoothstep(problem.segments)[:, None]
        straight = problem.start + fractions * (last - problem.start)
        guesses = [InitialGuess("straight", straight)]
        phase = problem.task.phases[-1]
        if phase.lowered:
            approach = ApproachPaths(KeyframeSampler(problem, self.rng))
            above = approach.find_release_retreat(last, phase)[::-1]
            if len(above):
                lowering = interpolate_path(problem, np.vstack([above, last]))
                guesses.insert(0, InitialGuess("from above", lowering))
        more = initialize(problem, "interpolated", self._draw_seed())
        all_guesses = itertools.chain(guesses, more)
        self._append(problem, *self._solve(problem, all_guesses, "arm does not reach"))

    def _move(self, step: Actuate) -> None:
        """Move the object's joints; the base drives to the nearest pose that suits the arm."""
        waypoints = self.finer * self.options.move_waypoints
        problem = self._make_problem([step], replace(self.options, move_waypoints=waypoints))
        paths = BasePaths(problem)
        failure = FailedError("no base path")
        for pose in self._find_poses(problem)[:_END_POSES]:
            base = paths.find_base_path(problem, pose[:3])
            if base is None:
                continue
            began = time.perf_counter()
            followed = follow(problem, base, self.rng, refine=self.refine)
            timing = problem.timing_for(followed.z)
            timing = timing.stretch(*problem.pace(followed.z, timing.dt))
            pace = problem.pace(followed.z, timing.dt)
            self.times["following"] += time.perf_counter() - began
            cause = followed.cause
            if not cause and timing.compute_violation(*pace) > TOLERANCE:
                cause = "too fast"
            if not cause and problem.drift(followed.z) > 1.0:
                cause = "closure"
            if not cause:
                self._append(problem, followed.z, timing.dt)
                return
            if not failure.parts or followed.share > failure.share:
                motion = make_trajectory(problem, followed.z, timing.dt)
                failure = FailedError(cause, motion, followed.share)
        raise failure

    def _stay(self) -> GoTo:
        """Return the step that keeps the base where it is."""
        return GoTo(*self.scene.start[:3].tolist())

    def _make_problem(
        self, steps: Sequence[Step], options: Options | None = None, scene: Scene | None = None
    ) -> TrajectoryProblem:
        """Make the problem of some steps from the present scene."""
        options = options or self.options
        scene = scene or self.scene
        task = compile_task(scene, steps, options)
        return TrajectoryProblem(scene, task, options, cache=self.cache)

    def _solve(
        self, problem: TrajectoryProblem, guesses: Iterator[InitialGuess], cause: str
    ) -> tuple[Floats, Floats]:
        """Return the first solution from an initial guess: z_1..z_N and time steps [s]."""
        failure = FailedError(cause)
        for guess in guesses:
            solution = solve(problem, guess.z)
            self.iterations += solution.iterations
            for key, value in solution.timings.items():
                self.times[key] += value
            if solution.converged:
                return solution.z, solution.dt
            record_evaluations()
            if not failure.parts:
                failure = FailedError(cause, make_trajectory(problem, solution.z, solution.dt))
        raise failure

    def _append(self, problem: TrajectoryProblem, z: Floats, dt: Floats) -> None:
        """Append the motion of a stage, and continue from its end."""
        part = make_trajectory(problem, z, dt)
        self.parts.append(part)
        self.scene = compute_final_scene(self.scene, part, problem.task.after)

    def _draw_seed(self) -> int:
        return int(self.rng.integers(2**32))


def _fix_coordinates(
    problem: TrajectoryProblem,
    columns: slice,
    values: Floats | None = None,
    rows: slice | int = slice(None),
) -> TrajectoryProblem:
    """Return a problem in which coordinates are fixed, to their start by default."""
    if values is None:
        values = problem.start[columns]
    lower = problem.lower.copy()
    upper = problem.upper.copy()
    lower[rows, columns] = values
    upper[rows, columns] = values
    return problem.with_bounds(lower, upper)
