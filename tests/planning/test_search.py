"""Tests that searches go on until their limit, and that their paths are kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drives import make_hall

import vkc_pin as vkc
from vkc_pin.planning import solve_task
from vkc_pin.planning.request import DEFAULT_TIME_LIMIT, make_budget
from vkc_pin.planning.solver.solution import Solution

POLE = {"name": "pole", "type": "cylinder", "radius": 0.05, "length": 1.2}
BEFORE, BEHIND = (0.57, -1.2, -1.2, -0.03, 1.63, 0.0), (2.57, -1.2, -1.2, -0.03, 1.63, 0.0)
SHORT = vkc.Options(reach_waypoints=30, max_restarts=1, dist_safe=0.01, self_distance=0.01)


def make_scene() -> tuple[vkc.Scene, vkc.Configure]:
    """Return an arm on a fixed base before a pole, and a goal behind it."""
    hall = make_hall(base="fixed", obstacles=[{**POLE, "position": [0.37, 0.25, 1.7]}])
    names = hall.robot.coordinates.names[3:]
    return hall.with_start(arm=BEFORE), vkc.Configure(dict(zip(names, BEHIND, strict=True)))


def fail(problem: vkc.TrajectoryProblem, guess: np.ndarray, **more: Any) -> Solution:
    """Leave the guess for where the solver cannot return from."""
    return Solution(problem.still, problem.timing_for(guess).dt, shortfall=1.0)


def test_path_is_the_plan_if_the_solver_leaves_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    scene, goal = make_scene()
    solved = vkc.plan(scene, [goal], options=SHORT)
    assert solved.success
    assert solved.is_optimized
    monkeypatch.setattr(solve_task, "solve", fail)
    found = vkc.plan(scene, [goal], options=SHORT)
    assert found.success
    assert not found.is_optimized
    assert "which is the motion, not optimized" in " ".join(found.summary().split())
    loaded = vkc.Plan.load(found.save(tmp_path / "found.npz"))
    assert loaded.success
    assert not loaded.is_optimized
    assert not loaded.to_dict()["is_optimized"]


@pytest.mark.parametrize("limit", [{"time_limit": 2.0}, {"max_evaluations": 60_000}])
def test_search_goes_on_until_the_limit(
    limit: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ends neither with the first guesses nor without saying how to continue."""
    scene, goal = make_scene()
    seeds: list[bytes] = []

    def fail_far_away(problem: vkc.TrajectoryProblem, guess: np.ndarray, **more: Any) -> Solution:
        seeds.append(guess.tobytes())
        return fail(problem, guess)

    monkeypatch.setattr(solve_task, "solve", fail_far_away)
    monkeypatch.setattr(solve_task.TaskSearch, "_add_guess", lambda *_: None)
    plan = vkc.plan(scene, [goal], options=SHORT, **limit)
    (name,) = limit
    assert plan.status == {"time_limit": "time limit"}.get(name, "evaluation limit")
    assert f"a larger {name} goes on" in plan.report.notes[-1]
    # Without a limit of time and evaluations there are as many guesses as the options say.
    assert len(set(seeds)) > 2
    seeds.clear()
    plan = vkc.plan(scene, [goal], options=SHORT, time_limit=float("inf"))
    assert plan.status == "not converged"
    assert len(seeds) == 2, "interpolated and rrt: without a base, astar is interpolated"
    assert "with a time_limit it goes on" in plan.report.notes[-1]


def test_a_call_without_limits_ends_in_time() -> None:
    for arguments, is_limited, status in (
        ((None, None), True, f"{DEFAULT_TIME_LIMIT:g} s"),
        ((None, 5), True, "5 evaluations"),
        ((3.0, None), True, "3 s"),
        ((float("inf"), None), False, ""),
    ):
        budget = make_budget(*arguments)
        assert budget.is_limited is is_limited
        # An attempt may have used up its share, though the budget is not exhausted.
        ending = "evaluation limit" if arguments[1] else "time limit"
        if status:
            assert budget.describe_limit(ending) == status


def test_base_moves_where_its_arm_has_room() -> None:
    """At the start of the base, the goal of the arm is in a box."""
    goal = (0.0, -0.3, 0.3, 0.0, 0.0, 0.0)
    place = make_hall().with_start(arm=goal).tool_placement().translation
    box = {"name": "box", "type": "box", "size": [0.3, 0.3, 0.3], "position": place.tolist()}
    hall = make_hall(obstacles=[box])
    blocked = hall.with_start(arm=goal)
    assert vkc.plan(blocked, [vkc.GoTo(-3.0, 0.0)]).status == "infeasible"
    names = hall.robot.coordinates.names[3:]
    plan = vkc.plan(hall, [vkc.Configure(dict(zip(names, goal, strict=True)))])
    assert plan.success
    assert plan.metrics["base_path_length"] > 0.1
