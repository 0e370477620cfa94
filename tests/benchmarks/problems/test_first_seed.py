"""Tests the count of trials that the first initial guess solves."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.experiments import run_benchmark


@pytest.mark.long
def test_first_guess_successes_are_counted(tmp_path: Path) -> None:
    table, trials = run_benchmark("first-seed --trials 1 --tasks drawer door", tmp_path)
    assert [r["task"] for r in trials] == ["door", "drawer"]
    for r in trials:
        assert r["first_seed"] is (r["success"] and r["solves"] == 1)
        counts = f"{int(r['success'])} of 1 | {int(r['first_seed'])} of 1"
        assert f"| {r['task']} | {counts} |" in table
    assert f"| all | {sum(r['success'] for r in trials)} of 2 |" in table
