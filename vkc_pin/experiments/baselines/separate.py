"""Plans base and arm one after the other: the baselines B1 and B2 of the paper.

After section IV-C of Jiao et al. (IROS 2021) and its authors' code. A step that moves joints of an
object has five stages:

1. Find base poses from which the arm reaches the handle, the nearest first (`find_base_poses`).
2. Drive there with the arm as it is: A*, then optimisation.
3. Reach the handle with a stationary base: optimisation.
4. Find base poses from which the arm reaches the handle's final pose, and a path of the base.
5. Move the object's joints to their goals and the base along its path; the arm follows
   (`following`): B1 by inverse kinematics, B2 moving arm and object out of collision at each
   waypoint.

`Place` continues after 3 by base poses from which the arm can put the object down, lifting it (or
moving it home, see `postures`), driving, and putting it down. `Reach` is 1 to 3 with a pose in
place of the handle. `GoTo` drives as in 2, after withdrawing the arm if necessary. In these B1 and
B2 are equal.

After a failed stage the next base poses are tried, then everything with other random numbers.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Sequence

from vkc_pin.errors import InputError, format_value
from vkc_pin.experiments.baselines.attempt import FINER, Attempt, BaselineStep
from vkc_pin.experiments.baselines.following import import_solvers
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.planner import Planner, acquire_cache
from vkc_pin.planning.request import check_arguments, make_budget
from vkc_pin.planning.results import retime_validated
from vkc_pin.utils.arguments import check_choice, check_integer
from vkc_pin.utils.budget import reserve_time
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.trajectory import Trajectory

BASELINES = ("B1", "B2")
RETRIES = 5
"""Number of attempts."""
LARGEST_FINER = 16


def plan_separately(
    scene: Scene,
    steps: Sequence[Step],
    *,
    method: str = "B1",
    options: Options | None = None,
    seed: int = 0,
    time_limit: float | None = None,
    max_evaluations: int | None = None,
    retries: int = RETRIES,
    finer: int = FINER,
    planner: Planner | None = None,
) -> Plan:
    """Plan by a baseline.

    Args:
        scene: Robot, objects and obstacles.
        steps: Any number of `Actuate`, `Place`, `GoTo` and `Reach`.
        method: "B1" or "B2".
        options: As for `plan`.
        seed: Random seed.
        time_limit: As for `plan`.
        max_evaluations: As for `plan`; an iteration of inverse kinematics counts 1.
        retries: Number of attempts, with other random numbers, until a motion is valid.
        finer: Factor of `Options.move_waypoints` for moving objects.
        planner: As for `plan`.

    Returns:
        The plan of the first valid attempt, else of the one with most progress. Its status is then
        the cause: "no base pose", "no base path", "arm does not reach", "no inverse kinematics",
        "collision", "too fast", "closure" or "rejected"; "time limit", "evaluation limit" or
        "interrupted" if not all attempts were made. `rounds` is the number of attempts.

    Raises:
        InputError: A step is impossible or of another kind, an argument is invalid, or the extra
            `experiments` is not installed.
    """
    import_solvers()
    options = Options() if options is None else options
    budget = make_budget(time_limit, max_evaluations)
    check_arguments(scene, options, seed)
    check_choice(method, BASELINES, "method", "method")
    check_integer(retries, "retries", low=1)
    check_integer(finer, "finer", low=1, high=LARGEST_FINER)
    task = compile_task(scene, steps, options)
    actions = _check_steps(task.steps)
    with acquire_cache(planner) as cache, budget.activate():
        began = time.perf_counter()
        build_time_before = cache.build_time
        times = Counter[str]()
        iterations = 0
        best: _Outcome | None = None
        for number in range(retries):
            attempt = Attempt(
                scene,
                options,
                refine=method == "B2",
                seed=[int(seed), number],
                finer=finer,
                cache=cache,
            )
            outcome = _make_attempt(attempt, number, scene, actions, options)
            iterations += attempt.iterations
            times.update(attempt.times)
            is_success = outcome.status == "success"
            if best is None or is_success or outcome.progress > best.progress:
                best = outcome
            stop_status = budget.stop_status
            if is_success or stop_status:
                break
        build_time = cache.build_time - build_time_before
    assert best is not None
    status = best.status
    report = best.report
    if stop_status and status not in ("success", stop_status):
        note = f"the attempt with most progress failed with: {status}"
        report = dataclasses.replace(report, notes=(*report.notes, note))
        status = stop_status
    statistics = PlanningStatistics(
        planning_time=time.perf_counter() - began - build_time,
        build_time=build_time,
        iterations=iterations,
        rounds=number + 1,
        evaluations=budget.evaluations,
    ).with_times(times)
    return Plan(
        scene,
        task.steps,
        options,
        best.trajectory,
        report,
        status,
        statistics=statistics,
        seed=int(seed),
        initialization=f"{method}, try {best.number + 1}",
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Outcome:
    """Outcome of one attempt.

    Attributes:
        number: Number of the attempt, from 0.
        progress: Number of completed stages; infinite if all are.
        status: "success", or the cause of the failure.
        trajectory: The motion.
        report: Its validation.
    """

    number: int
    progress: float
    status: str
    trajectory: Trajectory
    report: Report


def _check_steps(steps: Sequence[Step]) -> list[BaselineStep]:
    """Check that the baselines know all steps, and return them."""
    actions: list[BaselineStep] = []
    for number, step in enumerate(steps):
        if not isinstance(step, BaselineStep):
            raise InputError(
                "the baselines know no such step",
                field=f"steps[{number}]",
                expected="Actuate, Place, GoTo or Reach",
                got=format_value(step),
            )
        actions.append(step)
    return actions


def _make_attempt(
    attempt: Attempt,
    number: int,
    scene: Scene,
    steps: Sequence[BaselineStep],
    options: Options,
) -> _Outcome:
    """Make an attempt, retime and validate its motion, and measure the times of both."""
    times = attempt.times
    trajectory, progress, cause = attempt.run(steps)
    validation_before = times["validation"]
    began = time.perf_counter()
    trajectory, report = _retime(scene, steps, trajectory, options, times, failed=cause != "")
    elapsed = time.perf_counter() - began
    reserve_time("validation", elapsed)
    times["retiming"] += elapsed - (times["validation"] - validation_before)
    status = "success" if report.ok else cause or "rejected"
    return _Outcome(number, progress, status, trajectory, report)


def _retime(
    scene: Scene,
    steps: Sequence[Step],
    trajectory: Trajectory,
    options: Options,
    times: dict[str, float],
    *,
    failed: bool,
) -> tuple[Trajectory, Report]:
    """Return the motion as `plan` retimes it, or with its own times if only that is valid."""

    def check(motion: Trajectory) -> Report:
        began = time.perf_counter()
        report = validate(scene, steps, motion, options)
        times["validation"] += time.perf_counter() - began
        return report

    if not failed:
        timed, report = retime_validated(scene, trajectory, check, jerk_time=options.jerk_time)
        if report.ok:
            return timed, report
    return trajectory, check(trajectory)
