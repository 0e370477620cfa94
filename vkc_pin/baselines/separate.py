"""Plans base and arm one after the other, with the base poses found beforehand: the baselines B1 and B2 of the paper.

After section IV-C of Jiao et al. (IROS 2021) and its authors' code. For a step that moves joints of
an object:

1. Base poses from which the arm reaches the handle (`base_poses`), the nearest first, that the base
   can drive to.
2. The base drives there, the arm as it is: A*, then optimisation.
3. The base stands, the arm reaches the handle: optimisation.
4. Base poses from which the arm reaches the handle when all is done, the nearest first; the base's
   path to there.
5. The object's joints run to their goals, the base along its path, and the arm follows
   (`following`): B1 by inverse kinematics, B2 moving arm and object out of collision at each
   waypoint.

To put something down (`Place`), it is taken as in 1 to 3, and then:

4. Base poses from which the arm puts it down, the nearest first.
5. The base stands, the arm lifts it, or goes home with it if the base gets nowhere otherwise
   (`postures`).
6. The base drives there, the arm as it is: A*, then optimisation.
7. The base stands, the arm puts it down: optimisation.

To bring the tool somewhere (`Reach`) is 1 to 3 with the pose in place of the handle, and nothing
more.

To drive somewhere (`GoTo`), the arm stays as it is if that will do, goes back from the handle it
let go of, or else home, and the base drives as in 6. Neither has anything to follow, so B1 and B2
are the same there.

Where a stage fails, the next nearest base poses are tried, then all again with other random
numbers. Scene, limits, steps of time, clearances and validation are those of `planner.plan`, and so
is the solver of the optimisations.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Sequence
from typing import cast

from vkc_pin.baselines.attempt import FINER, Attempt, Doable
from vkc_pin.errors import InputError, format_value
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, acquire_cache
from vkc_pin.planning.request import check_arguments, make_budget
from vkc_pin.planning.results import build_plan
from vkc_pin.planning.retime_validated import retime_validated
from vkc_pin.planning.statistics import PlanningStatistics
from vkc_pin.utils.arguments import check_choice, check_integer
from vkc_pin.utils.budget import reserve_time
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.formats.archives import PlanStatus
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["BASELINES", "RETRIES", "plan_separately"]

BASELINES = ("B1", "B2")
RETRIES = 5
"""How often all is tried."""
LARGEST_FINER = 16  # waypoints beyond those of so fine a motion tell nothing new


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
    """Plan as the baselines do.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change: `Actuate`, `Place`, `GoTo` and `Reach`, any number.
        method: "B1" or "B2".
        options: As for `planner.plan`.
        seed: Of the random numbers.
        time_limit: As for `planner.plan`.
        max_evaluations: As for `planner.plan`; an iteration of inverse kinematics of the arm counts 1.
        retries: How often all is tried, with other random numbers, until validation accepts a
            motion.
        finer: In how many times `Options.move_waypoints` objects are moved; 1: in as many as by
            `planner.plan`.
        planner: As for `planner.plan`.

    Returns:
        The plan of the first try that validation accepts, else the one that came furthest. Its
        status is then the cause: "no base pose", "no base path", "arm does not reach", "no inverse
        kinematics", "collision", "too fast", "closure" or "rejected" by validation; "time limit",
        "evaluation limit" or "interrupted" if not all tries were made. Planning time is that of all
        tries; `rounds` is their number.

    Raises:
        InputError: Steps that cannot be done or are of another kind, or an argument is wrong.
    """
    options = Options() if options is None else options
    budget = make_budget(time_limit, max_evaluations)
    check_arguments(scene, options, seed)
    check_choice(method, BASELINES, "method", "method")
    check_integer(retries, "retries", low=1)
    check_integer(finer, "finer", low=1, high=LARGEST_FINER)
    task = compile_task(scene, steps, options)
    actions: list[Doable] = []
    for number, step in enumerate(task.steps):
        if not isinstance(step, Doable):
            expected = "Actuate, Place, GoTo or Reach"
            raise InputError(
                "the baselines know no such step",
                field=f"steps[{number}]",
                expected=expected,
                got=format_value(step),
            )
        actions.append(step)
    with acquire_cache(planner) as cache, budget.activate():
        began, times, iterations, before = time.perf_counter(), Counter[str](), 0, cache.build_time
        best: tuple[float, PlanStatus, int, Trajectory, Report] | None = None
        for number in range(retries):
            attempt = Attempt(
                scene,
                options,
                refine=method == "B2",
                seed=[int(seed), number],
                finer=finer,
                cache=cache,
            )
            trajectory, came, cause = attempt.run(actions)
            before_checks, checked = attempt.times["validation"], time.perf_counter()
            trajectory, report = _timed(
                scene, task.steps, trajectory, options, attempt.times, failed=cause != ""
            )
            took = time.perf_counter() - checked
            reserve_time("validation", took)
            attempt.times["retiming"] += took - (attempt.times["validation"] - before_checks)
            status = "success" if report.ok else cast("PlanStatus", cause or "rejected")
            iterations += attempt.iterations
            times.update(attempt.times)
            if best is None or status == "success" or came > best[0]:
                best = came, status, number, trajectory, report
            ended = budget.stop_status
            if status == "success" or ended:
                break
        built = cache.build_time - before
    assert best is not None
    _, status, tried, trajectory, report = best
    if ended and status not in ("success", ended):
        status, notes = ended, (*report.notes, f"the try that came furthest failed with: {status}")
        report = dataclasses.replace(report, notes=notes)
    statistics = PlanningStatistics(
        planning_time=time.perf_counter() - began - built,
        build_time=built,
        iterations=iterations,
        rounds=number + 1,
        evaluations=budget.evaluations,
    ).with_times(times)
    name = f"{method}, try {tried + 1}"
    return build_plan(
        scene,
        task.steps,
        options,
        trajectory,
        report,
        status,
        statistics=statistics,
        random_seed=int(seed),
        initialization=name,
    )


def _timed(
    scene: Scene,
    steps: Sequence[Step],
    trajectory: Trajectory,
    options: Options,
    times: dict[str, float],
    *,
    failed: bool,
) -> tuple[Trajectory, Report]:
    """Return a motion timed as those of `plan` are, or in its own time if only that is accepted, and what validation says.

    What the checks take [s] is added to `times`.
    """

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
