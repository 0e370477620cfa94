"""Tests that a task is solved from one initial guess after another, within its budget."""

from __future__ import annotations

import dataclasses
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.carrying import describe_box, describe_table, lift, make_room
from helpers.drawers import SHORT, replace_scene_fields
from helpers.drives import make_hall
from helpers.gates import make_gate_problem
from helpers.schedules import solve_task
from helpers.small_problems import load_door_scene

import vkc_pin as vkc
from tests.benchmarks.problems.problem_set import problem as make_random_problem
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.results import Draft
from vkc_pin.planning.solve_task import TaskResult
from vkc_pin.world.task.compiler import compile_task

OPEN = [vkc.Actuate("door", {"hinge": 1.2})]


def test_draft_is_not_solved_from_a_deep_guess() -> None:
    """The robot is behind a door, through which the only guess leads."""
    scene = vkc.load_scene("door").with_state("door", {"hinge": -1.5})
    scene, request = scene.with_start(base=(1.7, 1.2, -1.4)), PlanningRequest("auto", SHORT)
    task = compile_task(scene, [vkc.GoTo(4.1, -0.3)], SHORT)
    results = [
        solve_task(scene, task, dataclasses.replace(request, wants_draft=is_draft))
        for is_draft in (False, True)
    ]
    assert [result.plan.metrics["rounds"] > 0 for result in results] == [True, False]
    assert not any(result.is_solved for result in results)


@pytest.mark.long
def test_blocked_goal_may_be_due_to_a_kept_grasp_or_a_placed_object() -> None:
    scene = make_room(describe_table())

    def is_blocked(begin: vkc.Scene, **changes: Any) -> bool:
        task = compile_task(begin, [vkc.GoTo(0.0, 0.3)], SHORT)
        result = solve_task(begin, task, PlanningRequest("auto", SHORT))
        return dataclasses.replace(result, **changes).is_blocked_after(scene)

    assert is_blocked(scene, is_goal_blocked=True)
    assert not is_blocked(scene)
    held = dataclasses.replace(scene, holds=scene.with_held({"stick": "grip"}).holds)
    aside = lift(scene.objects["stick"].placement, [0.0, 0.1, 0.0])
    for begin in (held, scene.with_placement("stick", aside)):
        assert not is_blocked(begin, is_goal_blocked=True)


@pytest.mark.parametrize(("number", "seed"), [(35, 9035)])
def test_guesses_are_tried_until_a_trajectory_is_valid(number: int, seed: int) -> None:
    problem, rows = make_random_problem(number), list[vkc.Iteration]()
    plan = vkc.plan(problem.scene, problem.steps, seed=seed, callback=rows.append)
    assert plan.success, plan.summary()
    begins = [k for k, row in enumerate(rows) if row.round == 1]
    assert len(begins) > 1, "the first guess succeeds: choose another problem"
    assert plan.metrics["rounds"] == len(rows) == len(plan.history)
    ends = [rows[k - 1].iterations for k in (*begins[1:], len(rows))]
    assert plan.metrics["iterations"] == sum(ends)
    stages = ("initialization", "coal", "ipopt", "retiming", "validation")
    assert all(plan.metrics[f"time_{stage}"] > 0.0 for stage in stages)
    parts = sum(value for key, value in plan.metrics.items() if key.startswith("time_"))
    assert parts <= plan.metrics["planning_time"] + plan.metrics["build_time"]


def test_user_guess_is_the_only_one() -> None:
    scene = make_hall()
    task = compile_task(scene, [vkc.GoTo(1.0, 0.0)], SHORT)
    request, problems = PlanningRequest("auto", SHORT), []

    def guess(problem: vkc.TrajectoryProblem) -> InitialGuess:
        problems.append(problem)
        return InitialGuess("mine", problem.still)

    result = solve_task(scene, task, request, guess=guess)
    assert result.plan.success, result.plan.summary()
    assert result.plan.initialization == "mine"
    assert problems == [result.problem]


def test_draft_becomes_a_plan_when_it_is_retimed_and_validated() -> None:
    request = PlanningRequest("auto", SHORT, wants_draft=True)

    def drive(x: float, request: PlanningRequest = request) -> TaskResult:
        return solve_task(
            make_hall(), compile_task(make_hall(), [vkc.GoTo(x, 0.0)], SHORT), request
        )

    expected = drive(1.0, dataclasses.replace(request, wants_draft=False)).plan
    result = drive(1.0)
    draft = result.found
    assert isinstance(draft, Draft)
    assert result.is_solved
    found = result.plan
    assert found.success, found.summary()
    np.testing.assert_array_equal(found.trajectory.times, expected.trajectory.times)
    assert found.report == expected.report
    beside = dataclasses.replace(draft, steps=(vkc.GoTo(1.0, 0.5),))
    assert beside.complete().status == "rejected"
    infeasible = drive(30.0)
    assert (infeasible.is_solved, infeasible.plan.report.ok) == (False, False)
    assert infeasible.plan.status == "infeasible"


def test_coarse_phases_are_repaired_by_closing_the_chain() -> None:
    """On five segments of a door's arc a straight hand drifts by 3 mm; the arm corrects it."""
    scene, options = load_door_scene(), vkc.Options(move_waypoints=5, max_refinements=0)
    task = compile_task(scene, [vkc.Actuate("door", {"hinge": 1.3}, "handle")], options)
    result = solve_task(scene, task, PlanningRequest("interpolated", options, random_seed=1))
    assert result.problem is not None
    assert result.plan.success, result.plan.summary()
    assert result.plan.initialization == "interpolated"
    assert result.problem.task.phases == task.phases
    assert result.problem.drift(result.z) > 2.0, "relative to the tolerance, between waypoints"
    assert result.phase_waypoints().phases == tuple(phase.key for phase in task.phases)


@pytest.mark.parametrize(("begin", "end"), [(2, 8), (3, 12), (4, 8), (6, 12)])
def test_segments_double_until_the_motion_holds_between_waypoints(begin: int, end: int) -> None:
    """The hand is to move on a line; turned in equal parts, joints leave it between waypoints."""
    scene = replace_scene_fields(make_hall(), robot={"name": "husky_ur5e", "base": "fixed"})
    goal = scene.tool_placement()
    first = goal.translation.copy()
    goal.translation = first + np.array([0.35, -0.5, 0.0])
    across = np.array([0.5, 0.35, 0.0]) / np.hypot(0.5, 0.35)
    line = vkc.Constraint(
        "line",
        lambda s: ca.dot(across, s.position("tool") - first),
        lower=-0.002,
        upper=0.002,
        tolerance=1e-4,
    )

    def reach(refinements: int) -> vkc.Plan:
        options = vkc.Options(reach_waypoints=begin, max_refinements=refinements, max_restarts=1)
        return vkc.plan(
            scene, [vkc.Reach(goal)], options=options, terms=[line], initialization="interpolated"
        )

    def count_segments(plan: vkc.Plan) -> int:
        return len(plan.trajectory.times) - 1

    coarse = reach(0)
    assert (coarse.status, count_segments(coarse)) == ("rejected", begin)
    assert {one.constraint for one in coarse.report.violations} == {"term"}
    once = reach(1)
    assert (once.success, count_segments(once)) == (end == 2 * begin, 2 * begin)
    enough = reach(vkc.Options().max_refinements)
    assert enough.success, enough.summary()
    assert count_segments(enough) == end
    assert enough.metrics["rounds"] > coarse.metrics["rounds"]
    times = np.linspace(0.0, enough.trajectory.times[-1], 200)
    hand = np.array([enough.pose(None, time).translation for time in times])
    assert np.abs((hand - first) @ across).max() <= 0.002 + 10 * 1e-4


def test_infeasible_solution_with_the_least_shortfall_is_returned() -> None:
    """A wall spans the hall."""

    def make_straight_guess(problem: vkc.TrajectoryProblem) -> InitialGuess:
        z = np.tile(problem.start, (problem.segments, 1))
        z[:, 0] = np.linspace(0.0, 4.0, problem.segments + 1)[1:]
        return InitialGuess("straight", z)

    wall = describe_box("wall", [0.6, 12.0, 2.0], [2.0, 0.0, 1.0])
    scene, options = make_hall(obstacles=[wall]), vkc.Options(max_restarts=1)
    task = compile_task(scene, [vkc.GoTo(4.0, 0.0)], options)
    request = PlanningRequest("interpolated", options)
    plan = solve_task(scene, task, request, guess=make_straight_guess).plan
    assert not plan.success
    assert plan.metrics["rounds"] > 0
    assert "wall" in plan.summary()
    assert plan.trajectory.positions[-1, 0] == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize(
    ("budget", "status"),
    [
        ({"time_limit": 1e-3}, "time limit"),
        ({"max_evaluations": 1}, "evaluation limit"),
        ({"max_evaluations": 3000}, "evaluation limit"),
    ],
)
def test_budget_may_end_before_the_first_guess(budget: dict[str, Any], status: str) -> None:
    plan = vkc.plan(load_door_scene(), OPEN, planner=vkc.Planner(), **budget)
    assert (plan.status, plan.initialization, plan.metrics["rounds"]) == (status, "none", 0)
    assert plan.report.violations
    assert np.ptp(plan.trajectory.positions, axis=0).max() == 0.0
    assert np.isfinite(plan.metrics["duration"])


def test_sufficient_budget_changes_nothing() -> None:
    scene, steps = load_door_scene(), OPEN
    whole = vkc.plan(scene, steps, planner=vkc.Planner())
    assert whole.success
    used = int(whole.metrics["evaluations"])
    again = vkc.plan(scene, steps, max_evaluations=used)
    assert again.success
    assert again.metrics["evaluations"] == used
    np.testing.assert_array_equal(again.trajectory.positions, whole.trajectory.positions)
    short = [
        vkc.plan(scene, steps, max_evaluations=used // 2, planner=planner)
        for planner in (None, vkc.Planner())
    ]
    assert [plan.status for plan in short] == ["evaluation limit"] * 2
    np.testing.assert_array_equal(short[0].trajectory.positions, short[1].trajectory.positions)


@pytest.mark.parametrize(
    ("width", "goals", "status", "text"),
    [
        (0.66, [4.0], "infeasible", "from (0.00, 0.00) to (4.00, 0.00), and none with the arm"),
        (0.72, [4.0], "not converged", "from (0.00, 0.00) to (4.00, 0.00) but with the arm"),
        (0.66, [0.5, 4.0], "not converged", "from (0.50, 0.00) to (4.00, 0.00), and none with"),
    ],
)
def test_missing_base_path_is_infeasible_only_for_every_arm_posture_and_start(
    width: float, goals: list[float], status: str, text: str
) -> None:
    """The base is 0.67 m wide, or 0.72 m with the arm at home. Later phases may start elsewhere."""
    scene = make_gate_problem(width).scene
    task = compile_task(scene, [vkc.GoTo(x, 0.0, 0.0) for x in goals], SHORT)
    plan = solve_task(scene, task, PlanningRequest("astar", SHORT)).plan
    assert plan.status == status, plan.summary()
    assert f"found no path for the base {text}" in plan.report.notes[-1]
