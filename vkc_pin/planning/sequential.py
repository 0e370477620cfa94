"""Plans steps simultaneously or sequentially, and with other attachments where planning fails."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass

from vkc_pin.errors import InputError
from vkc_pin.planning.alternatives import solve_with_alternatives
from vkc_pin.planning.initialization.initial_guess import (
    make_guess_from_motion,
    make_initial_guess,
)
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import concatenate_plans
from vkc_pin.planning.schedule import Schedule, solve
from vkc_pin.planning.solve_task import TaskResult
from vkc_pin.utils.budget import current_ending, reserve_time, share_budget
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import get_grasped_object
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.world_model import compute_final_scene


@dataclass(frozen=True, eq=False)
class PlannedStep:
    """Result of a step, or of several steps planned as one problem.

    Attributes:
        first, last: Numbers of the first and the last step, from 0.
        result: Result of their task.
        left_open: Objects that they grasp at an attachment that they do not name.
    """

    first: int
    last: int
    result: TaskResult
    left_open: frozenset[str] = frozenset()


def plan_from_motion(scene: Scene, task: Task, request: PlanningRequest) -> Schedule[Plan]:
    """Plan all steps as one problem from the motion of the request; if that fails, without it."""
    assert request.guess is not None
    guess = functools.partial(make_guess_from_motion, motion=request.guess)
    with share_budget(2):
        first = yield from solve(scene, task, [request], guess=guess)
    if first.is_solved or current_ending():
        return first.plan
    return (yield from plan_as_one(scene, task, dataclasses.replace(request, guess=None)))


def plan_as_one(scene: Scene, task: Task, request: PlanningRequest) -> Schedule[Plan]:
    """Plan all steps as one problem, in which grasps and base poses depend on later steps.

    Of several steps, "auto" starts from their solutions, planned sequentially: their search is
    cheaper, and the motion costs no more than theirs. Initial guesses for all steps together are
    searched if a step fails; with other initializations they come first.
    """
    if len(task.steps) == 1:
        result = yield from solve_with_alternatives(
            scene, task, [request], plan_step_by_step=_plan_step_by_step
        )
        return result.plan
    is_auto = request.initialization == "auto"
    order = (_plan_from_steps, _plan_from_guesses)
    plan_first, plan_second = order if is_auto else order[::-1]
    with share_budget(2):
        first, is_final = yield from plan_first(scene, task, request)
    if first.success or is_final or current_ending():
        return first
    second, _ = yield from plan_second(scene, task, request)
    return second if second.success or is_auto else first


def plan_sequentially(scene: Scene, task: Task, request: PlanningRequest) -> Schedule[Plan]:
    """Plan every step from the end of the one before, up to the first failure; concatenate them."""
    parts = yield from plan_each_step(scene, task, request)
    plans = [part.result.plan for part in parts]
    return concatenate_plans(scene, _list_steps(task, parts), request, plans)


def _plan_from_guesses(
    scene: Scene, task: Task, request: PlanningRequest
) -> Schedule[tuple[Plan, bool]]:
    """Plan all steps as one problem, from initial guesses for the whole.

    Returns:
        The plan, and whether planning from steps would fail, too.
    """
    result = yield from solve_with_alternatives(
        scene, task, [request], plan_step_by_step=_plan_step_by_step
    )
    plan = result.plan
    return plan, plan.status == "infeasible" and len(task.open_attachments) <= 1


def _plan_from_steps(
    scene: Scene, task: Task, request: PlanningRequest
) -> Schedule[tuple[Plan, bool]]:
    """Plan all steps as one problem, from their solutions one after the other.

    The solutions of the steps are drafts: they are retimed and validated only where the problem
    that starts from them fails.

    Returns:
        The plan, and whether planning from guesses would fail, too: if the goal of a step is
        blocked. The concatenated solutions of the steps if one fails, or if they cannot be
        improved; a stationary plan, no success, if they are no one problem.
    """
    drafting = dataclasses.replace(request, wants_draft=True)
    parts = yield from plan_each_step(scene, task, drafting)
    steps = _list_steps(task, parts)
    whole = task
    if steps != task.steps:
        try:
            whole = compile_task(scene, steps, request.options)
        except InputError:
            # A free object was grasped anew, from where it lies only after planning: these steps
            # are no task that begins here. All steps together choose another grasp.
            return concatenate_plans(scene, task.steps, request, []), False
    is_planned = parts and all(part.result.is_solved for part in parts) and not current_ending()
    # A chain can contain a joint only once.
    if is_planned and find_shared_coordinate(scene, whole.holds) is None:
        waypoints = [part.result.phase_waypoints() for part in parts]
        guess = functools.partial(make_initial_guess, parts=waypoints)
        result = yield from solve(scene, whole, [request], guess=guess)
        if result.is_solved:
            return result.plan, True
    began = time.perf_counter()
    plans = [part.result.plan for part in parts]
    request.log.add(PlanningStatistics(planning_time=time.perf_counter() - began))
    plan = concatenate_plans(scene, steps, request, plans)
    return plan, bool(parts) and parts[-1].result.is_blocked_after(scene)


def _list_steps(task: Task, parts: Sequence[PlannedStep]) -> tuple[Step, ...]:
    """Return the steps of a task, with the attachments of their plans."""
    steps = list[Step]()
    count = 0  # of the task's steps so far; one becomes several where an object is grasped anew
    for part in parts:
        steps += task.steps[count : part.first]
        steps += part.result.found.steps
        count = part.last + 1
    steps += task.steps[count:]
    return tuple(steps)


def _plan_step_by_step(scene: Scene, task: Task, request: PlanningRequest) -> Schedule[TaskResult]:
    """Plan an alternative of a step or of several step by step; see `solve_with_alternatives`."""
    request = dataclasses.replace(request, wants_draft=False)
    parts = yield from plan_each_step(scene, task, request)
    plans = [part.result.plan for part in parts]
    plan = concatenate_plans(scene, task.steps, request, plans)
    return dataclasses.replace(parts[-1].result, scene=scene, found=plan)


def plan_each_step(
    scene: Scene, task: Task, request: PlanningRequest
) -> Schedule[list[PlannedStep]]:
    """Plan every step that changes the world from the end of the one before, until one fails.

    If a step of a longer draft fails, it is planned with steps before it as one problem.
    """
    current = scene
    parts = list[PlannedStep]()
    reserved = 0.0
    named = set[str]()
    for number, step in enumerate(task.steps):
        # The end of a step is known only once it is planned; the first starts where the task does.
        if number == 0:
            own = task.truncate(1)
        else:
            own = compile_task(current, [step], request.options, nothing=True)
        if not own.phases:
            continue
        request.progress.set_steps(number + 1, 1, len(task.steps))
        held = {hold.object for hold in current.holds}
        has_chosen_grasp = any(not held.isdisjoint(part.left_open) for part in parts)
        is_tentative = request.wants_draft and has_chosen_grasp
        trial = dataclasses.replace(request, is_tentative=is_tentative)
        result = yield from solve_with_alternatives(
            current, own, [trial], named=named, plan_step_by_step=_plan_step_by_step
        )
        part = PlannedStep(number, number, result, _list_open_objects(own))
        can_join = request.wants_draft and parts and not result.is_solved
        if can_join and not result.is_blocked_after(scene):
            joint = yield from _join_steps(task, parts, part, request)
            if joint is not None:
                part = joint
                result = joint.result
                parts = [before for before in parts if before.first < joint.first]
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
) -> Schedule[PlannedStep | None]:
    """Plan a step that failed with steps before it as one problem.

    These begin with the one that grasped what the hand holds, if it left the attachment open, else
    with the one before, whose end may be a dead end.

    Returns:
        The joint step. None if the holds prevent it, or if these are all steps: they are planned
        from guesses for the whole.
    """
    held = {hold.object for hold in failed.result.scene.holds}
    begin = parts[-1]
    for part in parts:
        if not held.isdisjoint(part.left_open):
            begin = part
    if begin.first == 0 and failed.last + 1 == len(task.steps):
        begin = parts[-1]
    scene = begin.result.scene
    steps = task.steps[begin.first : failed.last + 1]
    joint = compile_task(scene, steps, request.options, nothing=True)
    is_chain = find_shared_coordinate(scene, joint.holds) is None
    if len(steps) == len(task.steps) or not is_chain or current_ending():
        return None
    result = yield from solve_with_alternatives(
        scene, joint, [request], plan_step_by_step=_plan_step_by_step
    )
    return PlannedStep(begin.first, failed.last, result, _list_open_objects(joint))


def _list_open_objects(task: Task) -> frozenset[str]:
    """Return the objects whose attachments the steps of a task leave open."""
    return frozenset(grasp.object for grasp in task.open_attachments)
