"""Tests the ablation experiment, which changes one setting at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.experiments import run_benchmark

from tests.benchmarks.problems import ablation
from vkc_pin.experiments.harness.record import describe_environment

CHANGE = "solver.loop:PROGRESS=0.6"


@pytest.mark.long
def test_numbered_problems_are_planned_with_each_setting(tmp_path: Path) -> None:
    table, trials = run_benchmark(f"ablation --problems 42 9 --changes {CHANGE}", tmp_path)
    assert [(r["number"], r["kind"], r["method"]) for r in trials] == [
        (number, kind, method)
        for number, kind in ((9, "reach"), (42, "scene"))
        for method in ("unchanged", CHANGE)
    ]
    successes = sum(r["success"] for r in trials if r["method"] == CHANGE)
    assert f"| {CHANGE} | {successes} of 2 |" in table
    assert "| unchanged | reach | " in table


@pytest.mark.long
def test_tasks_are_planned_from_random_starts_with_each_setting(tmp_path: Path) -> None:
    arguments = f"ablation --tasks drawer --starts 2 --seed 5 --changes {CHANGE}"
    table, trials = run_benchmark(arguments, tmp_path)
    length = {(r["number"], r["method"]): r["base_path_length"] for r in trials}
    assert len(length) == len(trials) == 4
    assert length[0, CHANGE] != length[1, CHANGE]
    successes = sum(r["success"] for r in trials if r["method"] == CHANGE)
    assert "2 random starts a task, planning seed 5" in table
    assert f"| {CHANGE} | drawer | {successes} of 2 |" in table


def test_ratios_are_of_problems_that_both_settings_solve() -> None:
    def make_record(number: int, method: str, time: float, success: bool = True) -> dict[str, Any]:
        record = {"number": number, "method": method, "kind": "reach", "seed": 0}
        record |= {"success": success, "first_seed": success}
        record |= {"rounds": 1, "iterations": 2, "cpu_time": 1, "planning_time": time}
        record |= {"base_path_length": 1.0, "arm_path_length": 0.0, "objective": 2.0 * time}
        return {**record, "status": "success" if success else "error"}

    changed = "Options.dt=0.3"
    trials = [make_record(0, "unchanged", 1.0), make_record(0, changed, 3.0)]
    trials += [make_record(1, "unchanged", 1.0), make_record(1, changed, 9.0, False)]
    trials += [make_record(2, "unchanged", 2.0, False), make_record(2, changed, 9.0)]
    error = {"number": 3, "method": "unchanged", "seed": 0, "success": False, "status": "error"}
    meta = {"changes": ["unchanged", changed], "problems": [0, 1, 2, 3], "seed": 0}
    text = ablation.format_results(
        {"meta": {**describe_environment(time_limit=1.0), **meta}, "trials": [*trials, error]}
    )
    triple = "3.000 (3.000–3.000)"
    same = "1.000 (1.000–1.000)"
    assert f"| {changed} | 1 | {triple} | {same} | {same} | – | {triple} |" in text
    assert "| unchanged | 2 of 4 | 2 of 4 | 1.00 | 1.33 |" in text
