"""Tests the spread of results over random seeds."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.experiments import run_benchmark

from tests.benchmarks.problems import spread


@pytest.mark.long
def test_problem_is_planned_with_each_seed(tmp_path: Path) -> None:
    table, trials = run_benchmark("spread --problems 9 --seeds 2 --seed 4", tmp_path)
    assert [(r["number"], r["seed"]) for r in trials] == [(9, 4), (9, 5)]
    successes = sum(r["success"] for r in trials)
    assert f"| 9 | {trials[0]['problem']} | {successes} of 2 |" in table


def test_spread_covers_successes_only() -> None:
    records = [
        {"success": True, "x": 2.0},
        {"success": True, "x": 3.0},
        {"success": False, "x": 9.0},
        {"success": True},
    ]
    assert spread.compute_spread(records, "x") == pytest.approx(0.5)
    assert spread.compute_spread(records[1:], "x") is None
    assert spread.compute_spread([{"success": True, "x": 0.0}, *records], "x") is None
