"""A reach and a held drawer by tesseract-robotics-nanobind."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from vkc_pin.benchmarks.peers.found import Clock, clearances, judged
from vkc_pin.benchmarks.peers.optimized import plan_by_trajopt
from vkc_pin.benchmarks.peers.tasks import given, problem_of


@pytest.mark.skipif(
    find_spec("tesseract_robotics") is None,
    reason='needs tesseract-robotics-nanobind: pip install "vkc-pin[peers]"',
)
@pytest.mark.parametrize("task", ["reach", "drawer"])
def test_a_problem(task: str) -> None:
    own = given(task, 18, 0)
    problem = problem_of(own)
    found = plan_by_trajopt(
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
