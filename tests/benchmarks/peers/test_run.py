"""Other planners, the baselines and this package get the same problems, and are judged alike."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vkc_pin.benchmarks.peers.run import METHODS, report
from vkc_pin.cli import main
from vkc_pin.errors import InputError, UnknownNameError


def test_ours_and_the_baselines_at_a_reach(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = [
        "bench",
        "peers",
        "--trials",
        "1",
        "--tasks",
        "reach",
        "--methods",
        "B1",
        "B2",
        "VKC",
        "--seed",
        "18",
    ]
    command += ["--quiet", "--out", str(out)]
    assert main(command) == 0
    said = capsys.readouterr().out
    trials = json.loads((out / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [trial["method"] for trial in trials] == ["B1", "B2", "VKC"]
    for trial in trials:
        assert trial["success"] is True, trial["violations"]
        assert min(trial["clearance_at"], trial["clearance_between"]) > 0.0
        assert 0.0 < trial["time_own"] < trial["time_first"] <= trial["time_final"]
    assert trials[0]["start"] == trials[2]["start"]
    assert "| reach | VKC | 1 of 1 | 0 |" in said
    assert len(list((out / "plans").glob("*.npz"))) == 3
    before = (out / "trials.jsonl").read_bytes()
    assert main(command) == 0
    assert (out / "trials.jsonl").read_bytes() == before


def test_what_is_not_there(tmp_path: Path) -> None:
    from vkc_pin.benchmarks.peers.run import run

    with pytest.raises(UnknownNameError, match="trajopt"):
        run(out=tmp_path, methods=["trajop"])
    with pytest.raises(InputError, match="at least 1"):
        run(out=tmp_path, trials=0)
    assert METHODS[-1] == "VKC"


def test_the_table_counts_what_ran_out_of_time() -> None:
    recorded = json.loads(
        (Path(__file__).parents[3] / "docs/results/gap.json").read_text(encoding="utf-8")
    )["meta"]
    about = {
        **recorded,
        "starts": 2,
        "tasks": ["door"],
        "methods": ["OMPL", "VKC"],
        "peers": {"ompl": "2"},
        "time_limit": 60.0,
    }
    late = {
        "task": "door",
        "method": "OMPL",
        "success": False,
        "status": "timed out",
        "time_final": 9.0,
        "time_own": 8.0,
    }
    good = {
        "task": "door",
        "method": "OMPL",
        "success": True,
        "status": "success",
        "time_first": 1.0,
        "time_final": 3.0,
    }
    good |= {
        "time_own": 0.5,
        "base_path_length": 1.5,
        "arm_path_length": 2.0,
        "clearance_at": 0.03,
        "clearance_between": 0.025,
    }
    text = report({"meta": about, "trials": [late, good]})
    assert (
        "| door | OMPL | 1 of 2 | 1 | 1.00 | 6.00 | 8.70 | 4.25 | 1.50 | 2.00 | 30.0 | 25.0 |"
        in text
    )
    assert "| door | VKC |" not in text
