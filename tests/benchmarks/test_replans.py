"""Tests the benchmark that plans motions again."""

from __future__ import annotations

from pathlib import Path

from helpers.experiments import run_benchmark


def test_drawer_is_replanned_beside_plans_of_the_same_case(tmp_path: Path) -> None:
    table, (record,) = run_benchmark("replans --starts 1 --tasks drawer", tmp_path)
    assert record["success"] is True, record["violations"]
    assert min(record["whole"], record["moving"], record["replan"]) > 0.0
    assert record["moment"] > 0.0
    assert record["longer"] > 0.5
    assert record["possible"] is True
    assert "| drawer | 1 of 1 | 1 of 1 |" in table
