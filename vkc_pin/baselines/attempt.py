"""One try of a baseline: drive, reach, move, each on its own; see `separate` for what is done and why."""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from vkc_pin.baselines.following import FailedError, follow
from vkc_pin.baselines.paths import BasePaths, headings
from vkc_pin.baselines.postures import at_home, base_poses, postures, through
from vkc_pin.options import Options
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, sample_smoothstep
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.results import make_stationary_trajectory
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.planning.statistics import STAGES
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import BudgetExhaustedError, record_evaluations
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step
from vkc_pin.world.trajectory.splicing import concatenate_trajectories
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import compute_final_scene

__all__ = ["FINER", "Attempt", "Doable"]

Doable = Actuate | Place | GoTo | Reach
"""The steps that the baselines know."""

FINER = 2
"""How many times more waypoints than elsewhere objects are moved in, unless told: an arm that only follows needs small steps."""
_STANDS, _ENDS = (
    4,
    10,
)  # base poses that are tried in turn, the nearest first, at the handle and at the end
_BASE = slice(3)  # its coordinates


class Attempt:
    """One try; collects the motion stage by stage.

    Attributes:
        times: What it spent on the parts of `outcome.STAGES` [s].
    """

    def __init__(
        self,
        scene: Scene,
        options: Options,
        *,
        refine: bool,
        seed: Sequence[int],
        finer: int = FINER,
        cache: Cache | None = None,
    ) -> None:
        """Prepare a try.

        Args:
            scene: Where it begins.
            options: How to plan.
            refine: Whether arm and object are moved out of collision at each waypoint (B2).
            seed: Of the random numbers.
            finer: How many times `Options.move_waypoints` objects are moved in.
            cache: Keeps what is built; None: one of its own.
        """
        self.scene, self.options, self.refine, self.finer = scene, options, refine, finer
        self.rng = np.random.default_rng(seed)
        self.parts: list[Trajectory] = []
        self.times = dict.fromkeys([*STAGES, "following"], 0.0)
        self.iterations, self.cache = 0, cache or Cache()

    def run(self, steps: Sequence[Doable]) -> tuple[Trajectory, float, str]:
        """Return the motion, how many stages it came through (infinite: all), and why no further."""
        try:
            for step in steps:
                if isinstance(step, Actuate):
                    self._actuate(step)
                elif isinstance(step, Place):
                    self._place(step)
                elif isinstance(step, Reach):
                    self._drive_and_reach([step], self._poses(self._problem([step])), _STANDS)
                else:  # drive somewhere, at whichever heading is best if none is asked for
                    goals = headings(step, float(self.scene.start[2]))
                    self._withdrawn(
                        functools.partial(self._drive, goals), FailedError("no base path")
                    )
        except (FailedError, BudgetExhaustedError) as error:
            failure = error if isinstance(error, FailedError) else FailedError(str(error))
            parts = [*self.parts, *failure.parts] or [
                make_stationary_trajectory(self.scene, self.options)
            ]
            return (
                concatenate_trajectories(parts, pause=self.options.grasp_time),
                len(self.parts) + failure.came,
                failure.cause,
            )
        return concatenate_trajectories(self.parts, pause=self.options.grasp_time), np.inf, ""

    def _actuate(self, step: Actuate) -> None:
        """Move joints of an object: drive to its handle and reach for it, unless it is held, and move it."""
        after = compile_task(self.scene, [step], self.options, nothing=True).after
        (attachment,) = (hold.attachment for hold in after if hold.object == step.object)
        if self.scene.held.get(step.object) != attachment:
            self._take_hold([Grasp(step.object, attachment)])
        self._move(step)

    def _place(self, step: Place) -> None:
        """Put an object down: take it, unless it is held, carry it to where the arm can put it down, and do so."""
        if step.object not in self.scene.held:
            self._take_hold([Grasp(step.object, step.attachment)])
        poses = self._poses(self._problem([step]))
        self._drive_and_reach([step], poses, _ENDS)

    def _take_hold(self, steps: Sequence[Step]) -> None:
        """Drive to the nearest base pose from which the arm reaches what is to be grasped, and reach for it."""
        poses = self._poses(self._problem(steps, scene=self.scene.with_held({})))
        self._drive_and_reach(steps, poses, _STANDS)

    def _drive_and_reach(self, steps: Sequence[Step], poses: Floats, most: int) -> None:
        """Drive to the first base poses of `poses`, shape (K, n), from where the arm then does its part; at most `most`."""

        def at(pose: Floats) -> None:
            self._drive(pose[None, :3])
            self._reach(steps, pose)

        def somewhere() -> None:
            self._first(self._free(poses)[:most], at, FailedError("no base pose", share=-1.0))

        self._withdrawn(somewhere, FailedError("no base pose", share=-1.0))

    def _withdrawn(self, stage: Callable[[], None], failure: FailedError) -> None:
        """Bring the arm to how it can be held while the base drives, with as little motion as will do, and go on with a stage."""

        def held(path: Floats) -> None:
            self._withdraw(path)
            stage()

        self._first(postures(self._problem([self._here()])), held, failure)

    def _first(
        self, choices: Iterable[Floats], stage: Callable[[Floats], None], failure: FailedError
    ) -> None:
        """Do a stage with the first choice with which it works; if there is none, raise the failure that came furthest."""
        scene, before = self.scene, self.parts
        for choice in choices:
            self.parts = list(before)
            try:
                stage(choice)
                return
            except FailedError as error:
                error.parts = [*self.parts[len(before) :], *error.parts]
                failure = max(failure, error, key=lambda one: one.came)
                self.scene, self.parts = scene, before
        raise failure

    def _poses(self, problem: TrajectoryProblem) -> Floats:
        """Return configurations for the end of a problem, the nearest first."""
        began = time.perf_counter()
        poses = base_poses(problem, problem.segments, problem.start, self.rng)
        self.times["initialization"] += time.perf_counter() - began
        if not len(poses):
            raise FailedError("no base pose")
        return poses

    def _free(self, poses: Floats) -> Floats:
        """Return those whose base may stand there while the arm is still as it is."""
        stay = self._problem([self._here()])
        ends = np.tile(stay.start, (len(poses) + 1, 1))
        ends[:-1, :3] = poses[:, :3]
        depth = KeyframeSampler(stay, self.rng).compute_shortfall(ends, stay.segments)
        return np.asarray(
            poses[depth[:-1] <= min(depth[-1], CLEARANCE_TOLERANCE)]
        )  # the arm may be as close to the robot as it is

    def _withdraw(self, path: Floats) -> None:
        """Move the arm along configurations, shape (K, n), to the last of them, the base stands; nothing to do if K = 0."""
        if not len(path):
            return
        problem = _fixed(self._problem([self._here()]), _BASE)
        arm = slice(3, problem.chain.robot.coordinates.size)
        problem = _fixed(problem, arm, path[-1, arm], rows=-1)
        seeds = [
            InitialGuess("straight", through(problem, path[k:])) for k in (0, -1)[: len(path)]
        ]  # along it, and directly
        self._take(problem, *self._solve(problem, iter(seeds), "arm does not reach"))

    def _drive(self, goals: Floats) -> None:
        """Drive to where the base has to stand, or to one of several headings there, shape (G, 3), the arm as it is."""
        x, y, yaw = goals[0].tolist()
        problem = self._problem([GoTo(x, y, yaw if len(goals) == 1 else None)])
        problem = _fixed(problem, slice(3, problem.chain.robot.coordinates.size))
        bare = at_home(problem) and not self.scene.held and len(goals) == 1
        seeds = (
            initialize(problem, "astar", self._seed())
            if bare
            else BasePaths(problem, whole=True).seeds(problem, goals)
        )
        self._take(problem, *self._solve(problem, seeds, "no base path"))

    def _reach(self, steps: Sequence[Step], pose: Floats) -> None:
        """Take hold of the object, or put it down, the base stands."""
        problem = _fixed(self._problem(steps), _BASE)
        last = np.append(problem.start[:3], pose[3:])
        seeds = [
            InitialGuess(
                "straight",
                problem.start
                + sample_smoothstep(problem.segments)[:, None] * (last - problem.start),
            )
        ]
        phase = problem.task.phases[-1]
        if phase.lowered:  # from above
            above = ApproachPaths(KeyframeSampler(problem, self.rng)).find_release_retreat(
                last, phase
            )[::-1]
            seeds = [InitialGuess("from above", through(problem, np.vstack([above, last])))] * (
                len(above) > 0
            ) + seeds
        more = initialize(problem, "interpolated", self._seed())
        self._take(
            problem, *self._solve(problem, itertools.chain(seeds, more), "arm does not reach")
        )

    def _move(self, step: Actuate) -> None:
        """Move the object's joints: the base goes to the nearest pose to which the arm can follow."""
        problem = self._problem(
            [step], replace(self.options, move_waypoints=self.finer * self.options.move_waypoints)
        )
        paths, failure = BasePaths(problem), FailedError("no base path")
        for pose in self._poses(problem)[:_ENDS]:
            base = paths.along(problem, pose[:3])
            if base is None:
                continue
            began = time.perf_counter()
            followed = follow(problem, base, self.rng, refine=self.refine)
            pace = problem.pace(followed.z)
            timing = problem.timing_for(followed.z).stretch(*pace)
            self.times["following"] += time.perf_counter() - began
            cause = followed.cause
            if not cause and timing.compute_violation(*pace) > TOLERANCE:
                cause = "too fast"
            if not cause and problem.drift(followed.z) > 1.0:
                cause = "closure"
            if not cause:
                self._take(problem, followed.z, timing.dt)
                return
            if not failure.parts or followed.share > failure.share:
                failure = FailedError(
                    cause, make_trajectory(problem, followed.z, timing.dt), followed.share
                )
        raise failure

    def _here(self) -> GoTo:
        return GoTo(*self.scene.start[:3].tolist())

    def _problem(
        self, steps: Sequence[Step], options: Options | None = None, scene: Scene | None = None
    ) -> TrajectoryProblem:
        """Return the problem of steps from where the motion has come to, or from another scene."""
        options, scene = options or self.options, scene or self.scene
        return TrajectoryProblem(
            scene, compile_task(scene, steps, options), options, cache=self.cache
        )

    def _solve(
        self, problem: TrajectoryProblem, seeds: Iterator[InitialGuess], cause: str
    ) -> tuple[Floats, Floats]:
        """Return the first solution from a seed: z_1..z_N, shape (N, n), and the time of every step, shape (N,) [s]."""
        failure = FailedError(cause)
        for seed in seeds:
            solution = solve(problem, seed.z)
            self.iterations += solution.iterations
            for key, value in solution.timings.items():
                self.times[key] += value
            if solution.converged:
                return solution.z, solution.dt
            record_evaluations()
            if not failure.parts:
                failure = FailedError(cause, make_trajectory(problem, solution.z, solution.dt))
        raise failure

    def _take(self, problem: TrajectoryProblem, z: Floats, dt: Floats) -> None:
        """Append a motion, and go on from where it ends."""
        self.parts.append(make_trajectory(problem, z, dt))
        self.scene = compute_final_scene(self.scene, self.parts[-1], problem.task.after)

    def _seed(self) -> int:
        return int(self.rng.integers(2**32))


def _fixed(
    problem: TrajectoryProblem,
    columns: slice,
    values: Floats | None = None,
    rows: slice | int = slice(None),
) -> TrajectoryProblem:
    """Return a problem in which coordinates are at `values`, or else where they start, at some waypoints, by default all."""
    lower, upper = problem.lower.copy(), problem.upper.copy()
    lower[rows, columns] = upper[rows, columns] = (
        problem.start[columns] if values is None else values
    )
    return problem.with_bounds(lower, upper)
