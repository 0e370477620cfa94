"""Tests that problems are reproducible and start collision-free."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.peers.tasks import TASKS, build_program, make_problem, sample_goals
from vkc_pin.planning.initialization.keyframes import compute_shortfall


@pytest.mark.parametrize(
    "task",
    [task if task == "reach" else pytest.param(task, marks=pytest.mark.long) for task in TASKS],
)
def test_problems_are_reproducible_and_start_collision_free(task: str) -> None:
    one = make_problem(task, 3, 1)
    same = make_problem(task, 3, 1)
    other = make_problem(task, 3, 2)
    assert np.array_equal(one.scene.start, same.scene.start)
    assert not np.array_equal(one.scene.start, other.scene.start)
    problem = build_program(one)
    assert compute_shortfall(problem, problem.start[None], 1)[0] == 0.0
    goals = sample_goals(problem, np.random.default_rng(0), 5)
    assert 1 <= len(goals) <= 5
    residual, _ = problem.pose_solvers[0].evaluate(goals, problem.targets[0])
    assert np.abs(residual).max() < 1e-7
    distances = np.linalg.norm((goals - problem.start) * problem.chain.metric, axis=1)
    assert np.all(np.diff(distances) >= 0.0)
