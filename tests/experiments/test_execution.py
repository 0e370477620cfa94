"""Tests the experiment that executes planned motions in a physics simulation."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.experiments import run_experiment

from vkc_pin.experiments.execution import format_results
from vkc_pin.experiments.harness.record import describe_environment


def test_drawer_is_opened_with_a_welded_grasp(tmp_path: Path) -> None:
    table, (trial,) = run_experiment("execution --trials 1 --tasks drawer", tmp_path)
    assert trial["success"] is True, trial["violations"]
    assert trial["executed"] is True, trial["problems"]
    assert trial["problems"] == []
    assert 0.0 < trial["arm_error_rms"] <= trial["arm_error"] < 0.02
    assert 0.0 < trial["base_error_rms"] <= trial["base_error"] < 0.02
    assert trial["miss_m"] < 0.01
    assert trial["grasp_force"] > 1.0
    assert 0.0 < trial["effort_share"] < 1.0
    assert "| drawer | 1 of 1 | 1 of 1 |" in table
    assert "Nothing." in table


def test_drawer_is_opened_with_a_friction_grasp(tmp_path: Path) -> None:
    arguments = "execution --trials 1 --tasks drawer --grasp friction"
    table, (trial,) = run_experiment(arguments, tmp_path)
    assert "held by friction" in table
    assert trial["executed"] is True, trial["problems"]
    assert 0.0 < trial["slip"] < 0.005


def test_motion_after_grasping_is_planned_from_the_measured_grasp(tmp_path: Path) -> None:
    arguments = "execution --trials 1 --tasks drawer --off 4 --seed 3"
    table, (trial,) = run_experiment(arguments, tmp_path)
    assert trial["success"] is True, trial["violations"]
    assert trial["executed"] is True, trial["problems"]
    assert "| drawer, 4 mm off | 1 of 1 | 1 of 1 |" in table
    assert "- drawer, start 0, seed 3, 4 mm off: success, executed" in table


@pytest.mark.long
def test_measured_grasps_default_to_tasks_that_move_a_single_object(tmp_path: Path) -> None:
    _, trials = run_experiment("execution --trials 1 --off 2", tmp_path)
    tasks = {trial["task"] for trial in trials}
    assert {"door", "drawer", "household_cup"} <= tasks
    assert "init_1" not in tasks


def test_failed_executions_are_counted() -> None:
    executed = {"task": "drawer", "success": True, "executed": True}
    executed |= {"arm_error": 0.01, "problems": []}
    problems = ["cup – floor: 9 mm deep"]
    failed = {**executed, "executed": False, "arm_error": 0.02, "problems": problems}
    unplanned = {"task": "drawer", "success": False, "executed": False}
    meta = describe_environment(starts=3, seed=0, tasks=["drawer"], max_evaluations=1000)
    text = format_results({"meta": meta, "trials": [executed, failed, unplanned]})
    assert "| drawer | 2 of 3 | 1 of 2 |" in text
    assert "1.15" in text, "degrees, of 0.02 rad"
    assert "- drawer: cup – floor: 9 mm deep" in text
