"""Tests that the sixty problems are reproducible and can be compiled."""

from __future__ import annotations

import numpy as np
import pytest

import vkc_pin as vkc
from tests.benchmarks.problems.problem_set import get_kind, problem
from vkc_pin.experiments.tasks import make_start
from vkc_pin.world.scene.scene import START_CLEARANCE
from vkc_pin.world.task.compiler import compile_task


@pytest.mark.parametrize("number", [-1, 60, 1.0, True])
def test_other_numbers_are_refused(number: int) -> None:
    with pytest.raises(vkc.InputError) as raised:
        problem(number)
    assert (raised.value.expected, raised.value.got) == ("0 to 59", repr(number))


@pytest.mark.parametrize(
    "number",
    [
        *(0, 10, 20, 30, 40),
        *(pytest.param(number, marks=pytest.mark.long) for number in (1, 11, 23, 44, 54, 55)),
    ],
)
def test_problems_are_reproducible_and_can_be_compiled(number: int) -> None:
    one = problem(number)
    other = problem(number)
    assert (one.number, one.kind, one.name) == (number, get_kind(number), other.name)
    assert one.scene.document == other.scene.document
    assert [str(step) for step in one.steps] == [str(step) for step in other.steps]
    assert one.scene.start_clearance() >= START_CLEARANCE
    assert compile_task(one.scene, one.steps, vkc.Options()).phases


def test_starts_depend_on_task_seed_and_number() -> None:
    starts = [
        make_start(*arguments).start[:3].tolist()
        for arguments in (("door", 1, 0), ("door", 1, 0), ("door", 1, 1), ("door", 2, 0))
    ]
    assert starts[0] == starts[1]
    assert len({tuple(start) for start in starts}) == 3
    cups = [
        make_start("household_cup", 1, number).objects["cup"].placement.translation
        for number in (0, 1)
    ]
    assert not np.allclose(*cups)
