"""A reach and a held drawer by ompl."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from vkc_pin.benchmarks.peers.found import Clock, clearances, judged
from vkc_pin.benchmarks.peers.sampled import dense, plan_by_sampling, ranges
from vkc_pin.benchmarks.peers.tasks import given, problem_of


@pytest.mark.skipif(find_spec("ompl") is None, reason='needs ompl: pip install "vkc-pin[peers]"')
@pytest.mark.parametrize("task", ["reach", "drawer"])
def test_a_problem(task: str) -> None:
    own = given(task, 18, 0)
    problem = problem_of(own)
    found = plan_by_sampling(
        own,
        problem,
        0,
        Clock(60.0),
        lambda path: judged(own, problem, path, "", name="", seed=0).success,
    )
    assert found.path is not None, (found.status, found.about)
    assert np.array_equal(found.path[0], problem.start)
    result = judged(own, problem, found.path, found.status, name="peer", seed=0)
    assert result.success, result.report
    assert (
        min(value for value in clearances(problem, result.trajectory).values() if value is not None)
        > 0.0
    )


def test_straight_lines_in_small_steps() -> None:
    rows = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.5]])
    path = dense(rows, np.array([1.0, 2.0]), step=0.25)
    assert np.abs(np.diff(path, axis=0) * [1.0, 2.0]).max() == 0.25
    assert len(path) == 9
    assert np.array_equal(path[[0, 4, 8]], rows[[0, 1, 3]])


def test_ranges_are_finite_and_hold_the_start() -> None:
    problem = problem_of(given("drawer", 18, 0))
    lower, upper = ranges(problem)
    assert np.isfinite([lower, upper]).all()
    assert np.all((lower <= problem.start) & (problem.start <= upper))
    assert upper[-1] >= 0.3 > lower[-1]
