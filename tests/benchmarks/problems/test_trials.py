"""Tests that the record of a trial agrees with its plan."""

from __future__ import annotations

import dataclasses

import pytest

import vkc_pin as vkc
from tests.benchmarks.problems import trials
from tests.benchmarks.problems.changes import parse_change
from tests.benchmarks.problems.problem_set import problem


@pytest.fixture(scope="module")
def solved_problem() -> vkc.Plan:
    case = problem(20)
    return vkc.plan(case.scene, case.steps)


def test_objective_equals_that_of_the_last_accepted_round(solved_problem: vkc.Plan) -> None:
    """Without grasp freedoms, the objective covers all coordinates."""
    assert solved_problem.success, solved_problem.summary()
    (last, *_) = [row["objective"] for row in reversed(solved_problem.history) if row["accepted"]]
    assert trials.compute_objective(solved_problem) == pytest.approx(last, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "solves", "expected"),
    [
        ("interpolated", 1, True),
        ("astar 2", 2, False),
        ("astar, interpolated", 3, False),
        ("astar, rrt, then all at once", 3, True),
        ("astar, rrt, then all at once", 4, False),
    ],
)
def test_first_guess_success_depends_on_solves_and_status(
    solved_problem: vkc.Plan, name: str, solves: int, expected: bool
) -> None:
    plan = dataclasses.replace(solved_problem, initialization=name)
    assert trials.is_first_guess_success(plan, solves) is expected
    assert not trials.is_first_guess_success(dataclasses.replace(plan, status="rejected"), solves)


def test_record_has_settings_and_times() -> None:
    case = problem(20)
    record = trials.run_trial(
        case.scene, case.steps, seed=3, change=parse_change("Options.max_restarts=2"), number=20
    )
    assert record["success"] is True, record["violations"]
    assert (record["method"], record["seed"], record["number"]) == ("Options.max_restarts=2", 3, 20)
    assert record["solves"] >= 1
    assert record["first_seed"] is (record["solves"] == 1)
    assert record["wall_time"] >= record["planning_time"] > 0.0
    assert record["cpu_time"] > 0.0
    assert record["objective"] > 0.0
    assert "commit" in record
