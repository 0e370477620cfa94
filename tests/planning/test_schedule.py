"""Tests that schedules get the results and errors of their searches, without deep calls."""

from __future__ import annotations

import inspect
import traceback
from typing import Any, cast

import pytest
from helpers.drives import make_hall
from helpers.small_problems import SHORT

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.planning.schedule import Schedule, carry_out
from vkc_pin.planning.solve_task import TaskSearch
from vkc_pin.world.task.steps import Step

DRIVES = (vkc.GoTo(1.0, 0.0), vkc.GoTo(1.0, 0.5))

KINDS = [
    (DRIVES[:1], {}),
    (DRIVES, {}),
    (DRIVES, {"initialization": "interpolated"}),
    (DRIVES, {"simultaneous": False}),
    (DRIVES, {"window": 1}),
    (DRIVES, {"window": 2}),
]

# frames from `plan` to the callback of the solver, both counted
MAX_FRAMES = 8


class Search:
    """Search that returns a text, or raises it."""

    def __init__(self, text: str, *, fails: bool = False) -> None:
        self.text = text
        self.fails = fails

    def run(self) -> str:
        if self.fails:
            raise InputError(self.text)
        return self.text


def yield_search(text: str, *, fails: bool = False) -> Schedule[str]:
    result = yield cast("TaskSearch", Search(text, fails=fails))
    return cast("str", result)


def test_schedule_gets_results_and_errors() -> None:
    def plan() -> Schedule[list[str]]:
        found = [(yield from yield_search("first"))]
        try:
            yield from yield_search("refused", fails=True)
        except InputError as error:
            found.append(error.problem)
        found.append((yield from yield_search("last")))
        return found

    assert carry_out(plan()) == ["first", "refused", "last"]
    with pytest.raises(InputError, match="refused"):
        carry_out(yield_search("refused", fails=True))


@pytest.mark.parametrize(("steps", "options"), KINDS)
def test_all_kinds_of_calls_are_equally_deep(
    steps: tuple[Step, ...], options: dict[str, Any]
) -> None:
    depths = set[int]()

    def count_frames(row: vkc.Iteration) -> None:
        names = [frame.function for frame in inspect.stack(context=0)]
        depths.add(names.index("plan") + 1)

    plan = vkc.plan(make_hall(), steps, options=SHORT, callback=count_frames, **options)
    assert plan.success, plan.summary()
    assert depths
    assert max(depths) <= MAX_FRAMES


def test_traceback_tells_what_was_planned() -> None:
    def fail(row: vkc.Iteration) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as caught:
        vkc.plan(make_hall(), DRIVES, options=SHORT, callback=fail, simultaneous=False)
    names = [frame.name for frame in traceback.extract_tb(caught.tb)]
    assert names.index("plan_sequentially") < names.index("plan_each_step") < names.index("fail")
