"""Plans steps simultaneously or sequentially, and with other attachments where planning fails."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

from vkc_pin.errors import InputError
from vkc_pin.planning.initialization.initial_guess import make_initial_guess
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import add_statistics, complete_draft, concatenate_plans
from vkc_pin.planning.solve_task import TaskResult, solve_task
from vkc_pin.utils.budget import STOP_STATUSES, current_ending, reserve_time, share_budget
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import (
    generate_alternatives,
    has_open_attachment,
    list_untried_attachments,
)
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.world_model import compute_final_scene

__all__ = [
    "PlannedStep",
    "plan_each_step",
    "plan_sequentially",
    "plan_simultaneously",
    "solve_with_alternatives",
]


class PlannedStep(NamedTuple):
    """Result of a step, or of two steps planned as one problem.

    Attributes:
        first, last: Numbers of the first and the last step, from 0.
        result: Result of their task.
    """

    first: int
    last: int
    result: TaskResult


def plan_sequentially(scene: Scene, task: Task, request: PlanningRequest) -> Plan:
    """Plan every step from the end of the one before, up to the first failure; concatenate them."""
    parts = plan_each_step(scene, task, request)
    plans = [part.result.plan for part in parts]
    return concatenate_plans(scene, _list_steps(task, parts), request, plans)


def plan_simultaneously(scene: Scene, task: Task, request: PlanningRequest) -> Plan:
    """Plan several steps as one problem, in which grasps and base poses depend on later steps.

    "auto" starts from the solutions of the steps, planned sequentially: their search is cheaper,
    and the motion costs no more than theirs. Initial guesses for all steps together are searched if
    a step fails; with other initializations they come first.
    """
    is_auto = request.initialization == "auto"
    order = (_plan_from_steps, _plan_from_guesses)
    plan_first, plan_second = order if is_auto else order[::-1]
    with share_budget(2):
        first, is_final = plan_first(scene, task, request)
    if first.success or is_final or current_ending():
        return first
    second, _ = plan_second(scene, task, request)
    best = second if second.success or is_auto else first
    return add_statistics(best, [first.statistics, second.statistics])


def _plan_from_guesses(scene: Scene, task: Task, request: PlanningRequest) -> tuple[Plan, bool]:
    """Plan all steps as one problem, from initial guesses for the whole.

    Returns:
        The plan, and whether planning from steps would fail, too.
    """
    plan = solve_task(scene, task, request).plan
    has_alternatives = any(has_open_attachment(scene, step) for step in task.steps)
    return plan, plan.status == "infeasible" and not has_alternatives


def _plan_from_steps(scene: Scene, task: Task, request: PlanningRequest) -> tuple[Plan, bool]:
    """Plan all steps as one problem, from their solutions one after the other.

    The solutions of the steps are drafts: they are retimed and validated only where the problem
    that starts from them fails.

    Returns:
        The plan, and whether planning from guesses would fail, too: if the goal of a step is
        blocked. The concatenated solutions of the steps if one fails, or if they cannot be
        improved; a stationary plan, no success, if they are no one problem.
    """
    parts = plan_each_step(scene, task, dataclasses.replace(request, is_draft=True))
    steps, plans = _list_steps(task, parts), [part.result.plan for part in parts]
    statistics, common = [plan.statistics for plan in plans], list[PlanningStatistics]()
    try:
        whole = task if steps == task.steps else compile_task(scene, steps, request.options)
    except InputError:
        # A free object was grasped anew, from where it lies only after planning: these steps are no
        # task that begins here. All steps together choose another grasp.
        return concatenate_plans(scene, task.steps, request, [], statistics=statistics), False
    is_planned = parts and all(part.result.is_solved for part in parts) and not current_ending()
    # A chain can contain a joint only once.
    if is_planned and find_shared_coordinate(scene, whole.holds) is None:
        pieces = [part.result.phase_waypoints() for part in parts]
        guess = functools.partial(make_initial_guess, parts=pieces)
        plan = solve_task(scene, whole, request, guess=guess).plan
        common.append(plan.statistics)
        if plan.success:
            return add_statistics(plan, statistics + common), True
    plans = [complete_draft(plan) for plan in plans]
    statistics = [plan.statistics for plan in plans]
    plan = concatenate_plans(scene, steps, request, plans, statistics=statistics + common)
    return plan, bool(parts) and parts[-1].result.is_blocked_after(scene)


def _list_steps(task: Task, parts: Sequence[PlannedStep]) -> tuple[Step, ...]:
    """Return the steps of a task, with the attachments of their plans."""
    steps: list[tuple[Step, ...]] = [(step,) for step in task.steps]
    for part in parts:  # one step becomes several where an object is grasped anew
        steps[part.first : part.last + 1] = [
            part.result.plan.steps,
            *[()] * (part.last - part.first),
        ]
    return tuple(itertools.chain(*steps))


def solve_with_alternatives(scene: Scene, task: Task, request: PlanningRequest) -> TaskResult:
    """Solve a task; if that fails, with each of the other attachments that its steps leave open.

    A grasped object that cannot be moved with its present grasp is released and grasped anew.
    Attachments without a known collision-free configuration at the end of a phase are skipped.

    Returns:
        The first success, whose steps name the attachment unless it is the default; if all fail,
        the first result, with notes on the others and on attachments that only a user can choose.
    """
    # Terms may name phases by their numbers, which grasping anew would change.
    alternatives = functools.cache(
        lambda: tuple(generate_alternatives(scene, task, anew=not request.terms))
    )
    with share_budget(lambda: 1 + len(alternatives())):
        first = last = solve_task(scene, task, request)
    if first.is_solved or first.is_grasp_independent or current_ending():
        return first
    statistics, notes = [first.plan.statistics], list[str]()
    if first.plan.report.notes:  # reasons that may be those of the grasp
        notes += list_untried_attachments(scene, task)
    for number, (name, steps) in enumerate(alternatives()):
        if current_ending():
            break
        with share_budget(len(alternatives()) - number):
            last = _solve_alternative(scene, steps, request)
        statistics.append(last.plan.statistics)
        if last.is_solved:
            return dataclasses.replace(last, plan=add_statistics(last.plan, statistics))
        reason = next(iter(last.plan.report.notes), last.plan.status)
        notes += [f"at {name}: {reason}"] * (reason not in STOP_STATUSES)
    if not notes and len(statistics) == 1:
        return first
    plan = first.plan
    status = current_ending() or plan.status
    report = dataclasses.replace(plan.report, notes=(*plan.report.notes, *notes))
    failed = dataclasses.replace(plan, report=report, status=status)
    return dataclasses.replace(first, plan=add_statistics(failed, statistics))


def _solve_alternative(scene: Scene, steps: Sequence[Step], request: PlanningRequest) -> TaskResult:
    """Solve a task as one problem, or step by step if its holds cannot be in one chain.

    The latter is so where an object is grasped anew whose measured grasp deviates.
    """
    task = compile_task(scene, steps, request.options)
    if find_shared_coordinate(scene, task.holds) is None:
        return solve_task(scene, task, request, check_goals_first=True)
    request = dataclasses.replace(request, is_draft=False)
    results = [part.result for part in plan_each_step(scene, task, request)]
    plan = concatenate_plans(scene, steps, request, [result.plan for result in results])
    return dataclasses.replace(results[-1], scene=scene, plan=plan)


def plan_each_step(scene: Scene, task: Task, request: PlanningRequest) -> list[PlannedStep]:
    """Plan every step that changes the world from the end of the one before, until one fails.

    If a step of a longer draft fails, it is planned with the one before as one problem: its start
    may have been a dead end.
    """
    current, parts, reserved = scene, list[PlannedStep](), 0.0
    for number, step in enumerate(task.steps):
        # The end of a step is known only once it is planned; the first starts where the task does.
        own = task.truncate(1)
        if number:
            own = compile_task(current, [step], request.options, nothing=True)
        if not own.phases:
            continue
        request.progress.set_steps(number + 1, 1, len(task.steps))
        result = solve_with_alternatives(current, own, request)
        part = PlannedStep(number, number, result)
        can_join = request.is_draft and parts and len(task.steps) > 2
        if can_join and not result.is_solved and not result.is_blocked_after(scene):
            joint = _join_steps(task, parts[-1], part, request)
            if joint is not None:
                parts.pop()
                part, result = joint, joint.result
        parts.append(part)
        if not result.is_solved or current_ending():
            break
        reserved += result.check_time
        reserve_time("planned steps", reserved)
        current = compute_final_scene(result.scene, result.plan.trajectory, result.task.after)
    return parts


def _join_steps(
    task: Task, before: PlannedStep, failed: PlannedStep, request: PlanningRequest
) -> PlannedStep | None:
    """Plan a step that failed with the one before as one problem; None: their holds prevent it."""
    scene, results = before.result.scene, [before.result, failed.result]
    steps = task.steps[before.first : failed.last + 1]
    joint = compile_task(scene, steps, request.options, nothing=True)
    if find_shared_coordinate(scene, joint.holds) is not None or current_ending():
        return None
    results.append(solve_task(scene, joint, request))
    plan = add_statistics(results[-1].plan, [result.plan.statistics for result in results])
    return PlannedStep(before.first, failed.last, dataclasses.replace(results[-1], plan=plan))
