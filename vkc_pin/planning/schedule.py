"""Carries out schedules, which decide the next search of a planning call.

A schedule is a generator: it yields searches, is sent their results, and returns its own. So each
mode of planning is written down as a sequence of searches, and schedules are composed with
`yield from`, while one loop runs all searches: `carry_out`.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import TypeVar

from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import FINAL
from vkc_pin.planning.solve_task import Guess, TaskResult, TaskSearch
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task

T = TypeVar("T")

Schedule = Generator[TaskSearch, TaskResult | None, T]
"""Yields searches and is sent what `TaskSearch.run` returns; returns its own result."""


def carry_out(schedule: Schedule[T]) -> T:
    """Run every search that a schedule yields; return the schedule's result.

    An error in a search is raised where the schedule waits for its result: there it may be caught,
    and tracebacks contain how the schedule came there.
    """
    try:
        search = next(schedule)
        while True:
            try:
                result = search.run()
            except BaseException as error:
                search = schedule.throw(error)
            else:
                search = schedule.send(result)
    except StopIteration as end:
        found: T = end.value
        return found


def solve(
    scene: Scene,
    task: Task,
    requests: Sequence[PlanningRequest],
    *,
    guess: Guess | None = None,
    check_goals_first: bool = False,
) -> Schedule[TaskResult]:
    """Solve a task as one nonlinear program, as one request after the other asks for.

    Args:
        scene: Scene in which the task starts.
        task: The task.
        requests: Arguments of planning, such as with other random seeds; at least one. Those after
            a success or a proof of infeasibility are not used.
        guess: See `TaskSearch`.
        check_goals_first: See `TaskSearch`.
    """
    for request in requests:
        found = yield TaskSearch(scene, task, request, guess, check_goals_first=check_goals_first)
        assert found is not None
        result = found
        if result.is_solved or result.plan.status in FINAL:
            break
    return result
