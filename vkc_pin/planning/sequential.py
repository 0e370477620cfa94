"""Plans steps simultaneously or sequentially, and with other attachments where planning fails."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

from vkc_pin.errors import InputError
from vkc_pin.planning.alternatives import try_alternatives
from vkc_pin.planning.initialization.initial_guess import make_initial_guess
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import add_statistics, concatenate_plans
from vkc_pin.planning.solve_task import TaskResult, TaskSearch, solve_task
from vkc_pin.utils.budget import current_ending, reserve_time, share_budget
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import (
    generate_alternatives,
    generate_regrasps,
    get_grasped_object,
)
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.world_model import compute_final_scene


class PlannedStep(NamedTuple):
    """Result of a step, or of two steps planned as one problem.

    Attributes:
        first, last: Numbers of the first and the last step, from 0.
        result: Result of their task.
        left_open: Objects that they grasp at an attachment that they do not name.
    """

    first: int
    last: int
    result: TaskResult
    left_open: frozenset[str] = frozenset()


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
    plan = solve_with_alternatives(scene, task, request).plan
    return plan, plan.status == "infeasible" and len(task.open_attachments) <= 1


def _plan_from_steps(scene: Scene, task: Task, request: PlanningRequest) -> tuple[Plan, bool]:
    """Plan all steps as one problem, from their solutions one after the other.

    The solutions of the steps are drafts: they are retimed and validated only where the problem
    that starts from them fails.

    Returns:
        The plan, and whether planning from guesses would fail, too: if the goal of a step is
        blocked. The concatenated solutions of the steps if one fails, or if they cannot be
        improved; a stationary plan, no success, if they are no one problem.
    """
    parts = plan_each_step(scene, task, dataclasses.replace(request, wants_draft=True))
    steps = _list_steps(task, parts)
    statistics = [part.result.found.statistics for part in parts]
    common = list[PlanningStatistics]()
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
    plans = [part.result.plan for part in parts]
    statistics = [plan.statistics for plan in plans]
    plan = concatenate_plans(scene, steps, request, plans, statistics=statistics + common)
    return plan, bool(parts) and parts[-1].result.is_blocked_after(scene)


def _list_steps(task: Task, parts: Sequence[PlannedStep]) -> tuple[Step, ...]:
    """Return the steps of a task, with the attachments of their plans."""
    steps: list[tuple[Step, ...]] = [(step,) for step in task.steps]
    for part in parts:  # one step becomes several where an object is grasped anew
        steps[part.first : part.last + 1] = [
            part.result.found.steps,
            *[()] * (part.last - part.first),
        ]
    return tuple(itertools.chain(*steps))


def solve_with_alternatives(
    scene: Scene, task: Task, request: PlanningRequest, *, named: Collection[str] = ()
) -> TaskResult:
    """Solve a task; if that fails, with each of the other attachments that its steps leave open.

    A grasped object that cannot be moved with its present grasp is released and grasped anew.
    Attachments without a known collision-free configuration at the end of a phase are skipped.

    Args:
        scene: Scene in which it starts.
        task: The task.
        request: Arguments of planning.
        named: Objects that are held at attachments that the user has named.

    Returns:
        The first success, whose steps name the attachment unless it is the default; if all fail,
        the first result, with notes on the others.
    """

    def list_alternatives() -> Iterator[tuple[str, tuple[Step, ...]]]:
        # Terms may name phases by their numbers, which grasping anew would change.
        if len(task.steps) == 1 and not request.terms:
            yield from generate_regrasps(scene, task, request.options, named)
        yield from generate_alternatives(task)

    return try_alternatives(
        TaskSearch(scene, task, request),
        list_alternatives,
        functools.partial(_solve_alternative, scene, request),
        pauses=len(task.open_attachments) == 1,
    )


def _solve_alternative(scene: Scene, request: PlanningRequest, steps: Sequence[Step]) -> TaskResult:
    """Solve a task as one problem, or step by step if its holds cannot be in one chain.

    The latter is so where an object is grasped anew whose measured grasp deviates.
    """
    task = compile_task(scene, steps, request.options)
    if find_shared_coordinate(scene, task.holds) is None:
        return solve_task(scene, task, request, check_goals_first=True)
    request = dataclasses.replace(request, wants_draft=False)
    results = [part.result for part in plan_each_step(scene, task, request)]
    plan = concatenate_plans(scene, steps, request, [result.plan for result in results])
    return dataclasses.replace(results[-1], scene=scene, found=plan)


def plan_each_step(scene: Scene, task: Task, request: PlanningRequest) -> list[PlannedStep]:
    """Plan every step that changes the world from the end of the one before, until one fails.

    If a step of a longer draft fails, it is planned with steps before it as one problem.
    """
    current, parts, reserved = scene, list[PlannedStep](), 0.0
    named = set[str]()
    for number, step in enumerate(task.steps):
        # The end of a step is known only once it is planned; the first starts where the task does.
        own = task.truncate(1)
        if number:
            own = compile_task(current, [step], request.options, nothing=True)
        if not own.phases:
            continue
        request.progress.set_steps(number + 1, 1, len(task.steps))
        held = {hold.object for hold in current.holds}
        is_tentative = request.wants_draft and any(one.left_open & held for one in parts)
        trial = dataclasses.replace(request, is_tentative=is_tentative)
        result = solve_with_alternatives(current, own, trial, named=named)
        part = PlannedStep(number, number, result, _list_open_objects(own))
        can_join = request.wants_draft and parts
        if can_join and not result.is_solved and not result.is_blocked_after(scene):
            joint = _join_steps(task, parts, part, request)
            if joint is not None:
                parts = [one for one in parts if one.first < joint.first]
                part, result = joint, joint.result
        parts.append(part)
        grasped = get_grasped_object(step)
        if grasped is not None and getattr(step, "attachment", None) is not None:
            named.add(grasped)
        if not result.is_solved or current_ending():
            break
        reserved += result.check_time
        reserve_time("planned steps", reserved)
        current = compute_final_scene(result.scene, result.found.trajectory, result.task.after)
    return parts


def _join_steps(
    task: Task, parts: Sequence[PlannedStep], failed: PlannedStep, request: PlanningRequest
) -> PlannedStep | None:
    """Plan a step that failed with steps before it as one problem.

    These begin with the one that grasped what the hand holds, if it left the attachment open, else
    with the one before, whose end may be a dead end.

    Returns:
        The joint step, with the statistics of the steps that it replaces. None if their holds
        prevent it, or if these are all steps: they are planned from guesses for the whole.
    """
    held = {hold.object for hold in failed.result.scene.holds}
    grasping = [part.first for part in parts if part.left_open & held]
    shortest = parts[-1].first
    first = grasping[-1] if grasping else shortest
    if first == 0 and failed.last + 1 == len(task.steps):
        first = shortest
    steps = task.steps[first : failed.last + 1]
    replaced = [part.result for part in parts if part.first >= first]
    scene = replaced[0].scene
    joint = compile_task(scene, steps, request.options, nothing=True)
    is_chain = find_shared_coordinate(scene, joint.holds) is None
    if len(steps) == len(task.steps) or not is_chain or current_ending():
        return None
    result = solve_with_alternatives(scene, joint, request)
    results = [*replaced, failed.result, result]
    found = add_statistics(result.found, [one.found.statistics for one in results])
    whole = dataclasses.replace(result, found=found)
    return PlannedStep(first, failed.last, whole, _list_open_objects(joint))


def _list_open_objects(task: Task) -> frozenset[str]:
    """Return the objects whose attachments the steps of a task leave open."""
    return frozenset(grasp.object for grasp in task.open_attachments)
