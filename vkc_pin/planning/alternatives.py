"""Solves a task, and if that fails, the same task with other attachments."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

from vkc_pin.errors import InputError
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.schedule import Schedule, solve
from vkc_pin.planning.solve_task import TaskResult, TaskSearch
from vkc_pin.utils.budget import STOP_STATUSES, current_ending, share_budget
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import generate_alternatives, generate_regrasps
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step
from vkc_pin.world.task.terms import Term

PlanStepByStep = Callable[[Scene, Task, PlanningRequest], Schedule[TaskResult]]
"""Plans the steps of a task one after the other."""


def solve_with_alternatives(
    scene: Scene,
    task: Task,
    requests: Sequence[PlanningRequest],
    *,
    named: Collection[str] = (),
    plan_step_by_step: PlanStepByStep | None = None,
) -> Schedule[TaskResult]:
    """Solve a task; if that fails, with each of the other attachments that its steps leave open.

    What costs least comes first: the search for the task itself may pause after its first initial
    guess, if its goals seem to be blocked, and goes on only when all alternatives have failed. Of
    these, attachments without a known collision-free configuration at the end of a phase are
    skipped.

    Args:
        scene: Scene in which it starts.
        task: The task.
        requests: Arguments of planning, tried in turn; see `schedule.solve`.
        named: Objects that are held at attachments that the user has named.
        plan_step_by_step: Plans an alternative whose holds cannot be in one chain, as where an
            object is grasped anew whose measured grasp deviates. None: the result must be one
            problem with as many steps. Otherwise a grasped object that cannot be moved with its
            present grasp is released and grasped anew, and the search for the task itself may
            pause.

    Returns:
        The first success, whose steps name the attachment unless it is the default; if all fail,
        the result of the task itself, with notes on the others. Its status is "infeasible" only if
        that holds for all.
    """
    may_regrasp = plan_step_by_step is not None
    alternatives = functools.cache(
        lambda: tuple(_generate_steps(scene, task, requests[0], named, may_regrasp=may_regrasp))
    )
    first: TaskResult | None
    pauses = plan_step_by_step is not None and len(task.open_attachments) == 1
    search = TaskSearch(scene, task, requests[0], pauses=pauses)
    with share_budget(lambda: 1 + len(alternatives())):
        if pauses:
            first = yield search
        else:
            first = yield from solve(scene, task, requests)
    if first is not None and (first.is_solved or first.is_grasp_independent or current_ending()):
        return first
    others = list[TaskResult]()
    notes = list[str]()
    for number, (name, steps) in enumerate(alternatives()):
        if current_ending():
            break
        try:
            with share_budget(len(alternatives()) - number):
                other = yield from _solve_steps(scene, task, steps, requests, plan_step_by_step)
        except InputError as error:
            notes.append(f"at {name}: {error}")
            continue
        if other.is_solved:
            return other
        others.append(other)
        reason = next(iter(other.plan.report.notes), other.plan.status)
        if reason not in STOP_STATUSES:
            notes.append(f"at {name}: {reason}")
    if first is None:
        first = yield search
        assert first is not None
    if first.is_solved or not (others or notes):
        return first
    return _combine_failures(first, others, notes)


def _generate_steps(
    scene: Scene,
    task: Task,
    request: PlanningRequest,
    named: Collection[str],
    *,
    may_regrasp: bool,
) -> Iterator[tuple[str, tuple[Step, ...]]]:
    """Yield names of alternatives, such as "cup.top", and their steps."""
    # Terms may name phases by their numbers, which grasping anew would change.
    if may_regrasp and len(task.steps) == 1 and not request.terms:
        yield from generate_regrasps(scene, task, request.options, named)
    yield from generate_alternatives(task)


def _solve_steps(
    scene: Scene,
    original: Task,
    steps: Sequence[Step],
    requests: Sequence[PlanningRequest],
    plan_step_by_step: PlanStepByStep | None,
) -> Schedule[TaskResult]:
    """Solve the steps of an alternative to a task.

    Raises:
        InputError: They are impossible in the scene, lack a phase of the user's terms, or are no
            problem of the kind that is wanted.
    """
    task = compile_task(scene, steps, requests[0].options)
    _check_phases_of_terms(requests[0].terms, original, task)
    if find_shared_coordinate(scene, task.holds) is None:
        return (yield from solve(scene, task, requests, check_goals_first=True))
    if plan_step_by_step is None:
        raise InputError("its grasps cannot be part of one problem")
    return (yield from plan_step_by_step(scene, task, requests[0]))


def _check_phases_of_terms(terms: Iterable[Term], original: Task, alternative: Task) -> None:
    """Check that an alternative has all phases of a task that terms name.

    Phases are named after attachments: without them, a constraint would not hold anywhere.
    """
    names = {phase.name for phase in original.phases} - {one.name for one in alternative.phases}
    for term in terms:
        for name in term.during or ():
            if name in names:
                raise InputError(f"the term {term.name!r} holds during {name!r}, which it lacks")


def _combine_failures(
    first: TaskResult, others: Sequence[TaskResult], notes: Sequence[str]
) -> TaskResult:
    """Return the result of a task that failed, as its alternatives did."""
    plan = first.plan
    status = plan.status
    if any(other.plan.status != "infeasible" for other in others) and status == "infeasible":
        status = "not converged"
    report = dataclasses.replace(plan.report, notes=(*plan.report.notes, *notes))
    failed = dataclasses.replace(plan, report=report, status=current_ending() or status)
    is_blocked = all(result.is_goal_blocked for result in (first, *others))
    return dataclasses.replace(first, found=failed, is_goal_blocked=is_blocked)
