"""Tests the comparison with other planners, on equal problems and with equal validation."""

from __future__ import annotations

from pathlib import Path

from helpers.experiments import run_benchmark

from tests.benchmarks.peers.run import format_results
from vkc_pin.experiments.harness.record import describe_environment


def test_baseline_and_planner_solve_the_same_reach(tmp_path: Path) -> None:
    arguments = "peers --trials 1 --tasks reach --methods B1 VKC --seed 18"
    table, trials = run_benchmark(arguments, tmp_path)
    assert [trial["method"] for trial in trials] == ["B1", "VKC"]
    for trial in trials:
        assert trial["success"] is True, trial["violations"]
        assert min(trial["clearance_at"], trial["clearance_between"]) > 0.0
        assert 0.0 < trial["time_own"] < trial["time_first"] <= trial["time_final"]
    assert trials[0]["start"] == trials[1]["start"]
    assert "| reach | VKC | 1 of 1 | 0 |" in table
    assert len(list((tmp_path / "plans").glob("*.npz"))) == 2


def test_table_counts_trials_that_timed_out() -> None:
    meta = describe_environment(starts=2, seed=0, tasks=["door"], methods=["OMPL", "VKC"])
    meta |= {"peers": {"ompl": "2"}, "time_limit": 60.0}
    timed_out = {"task": "door", "method": "OMPL", "success": False, "status": "timed out"}
    success = {**timed_out, "success": True, "status": "success"}
    timed_out |= {"time_final": 9.0, "time_own": 8.0}
    success |= {"time_final": 3.0, "time_own": 0.5, "time_first": 1.0}
    success |= {"base_path_length": 1.5, "arm_path_length": 2.0}
    success |= {"clearance_at": 0.03, "clearance_between": 0.025}
    text = format_results({"meta": meta, "trials": [timed_out, success]})
    numbers = "1 of 2 | 1 | 1.00 | 6.00 | 8.70 | 4.25 | 1.50 | 2.00 | 30.0 | 25.0"
    assert f"| door | OMPL | {numbers} |" in text
    assert "| door | VKC |" not in text
