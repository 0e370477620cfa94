"""Solves a task, and if that fails, the same task with other attachments."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from vkc_pin.errors import InputError
from vkc_pin.planning.plan import PlanningStatistics
from vkc_pin.planning.results import add_statistics
from vkc_pin.planning.solve_task import TaskResult
from vkc_pin.utils.budget import STOP_STATUSES, current_ending, share_budget
from vkc_pin.world.task.steps import Step

Alternatives = Iterable[tuple[str, tuple[Step, ...]]]
"""Names of alternatives, such as "cup.top", and their steps."""


class Search(Protocol):
    """Search for the solution of a task, such as `TaskSearch`."""

    @property
    def statistics(self) -> PlanningStatistics:
        """Statistics so far."""

    def run(self, *, pauses: bool = False) -> TaskResult | None:
        """Search on. Returns the result; None at a pause, if it may pause."""


def try_alternatives(
    search: Search,
    list_alternatives: Callable[[], Alternatives],
    solve: Callable[[Sequence[Step]], TaskResult],
    *,
    pauses: bool,
) -> TaskResult:
    """Solve a task; if that fails, its alternatives.

    What costs least comes first: the search for the task itself pauses as soon as its first initial
    guess has failed, if its goals seem to be blocked, and goes on only when all alternatives have
    failed. Of these, `solve` should reject the ones with blocked goals before it searches.

    Args:
        search: Search for the solution of the task itself.
        list_alternatives: Lists the alternatives; called only if they are needed.
        solve: Solves the steps of an alternative. An `InputError` rejects it.
        pauses: Whether the search may pause.

    Returns:
        The first success; if all fail, the result of the task itself, with notes on the others.
        Its status is "infeasible" only if that holds for all.
    """
    alternatives = functools.cache(lambda: tuple(list_alternatives()))
    with share_budget(lambda: 1 + len(alternatives())):
        first = search.run(pauses=pauses)
    if first is not None and (first.is_solved or first.is_grasp_independent or current_ending()):
        return first
    others = list[TaskResult]()
    notes = list[str]()
    for number, (name, steps) in enumerate(alternatives()):
        if current_ending():
            break
        try:
            with share_budget(len(alternatives()) - number):
                other = solve(steps)
        except InputError as error:
            notes.append(f"at {name}: {error}")
            continue
        others.append(other)
        if other.is_solved:
            return _add_up(other, search, others)
        reason = next(iter(other.plan.report.notes), other.plan.status)
        if reason not in STOP_STATUSES:
            notes.append(f"at {name}: {reason}")
    if first is None:
        first = search.run()
        assert first is not None
    if first.is_solved or not (others or notes):
        return _add_up(first, search, others)
    return _combine_failures(first, others, notes)


def _add_up(result: TaskResult, search: Search, others: Sequence[TaskResult]) -> TaskResult:
    """Return a result with the statistics of the search for the task and of its alternatives."""
    statistics = [search.statistics]
    statistics += [other.found.statistics for other in others]
    return dataclasses.replace(result, found=add_statistics(result.found, statistics))


def _combine_failures(
    first: TaskResult, others: Sequence[TaskResult], notes: Sequence[str]
) -> TaskResult:
    """Return the result of a task that failed, as its alternatives did."""
    results = [first, *others]
    plans = [result.plan for result in results]
    plan = plans[0]
    status = plan.status
    if any(each.status != "infeasible" for each in plans) and status == "infeasible":
        status = "not converged"
    report = dataclasses.replace(plan.report, notes=(*plan.report.notes, *notes))
    failed = dataclasses.replace(plan, report=report, status=current_ending() or status)
    found = add_statistics(failed, [each.statistics for each in plans])
    is_blocked = all(result.is_goal_blocked for result in results)
    return dataclasses.replace(first, found=found, is_goal_blocked=is_blocked)
