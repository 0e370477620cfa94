"""One setting changed at a time, from the command line, on two problems."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.problems import ablation
from vkc_pin.cli import main

CHANGE = "solver.loop:PROGRESS=0.6"


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def test_ablation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "bench",
        "ablation",
        "--problems",
        "42",
        "9",
        "--changes",
        CHANGE,
        "--quiet",
        "--out",
        str(tmp_path),
    ]
    assert main(command) == 0
    said = capsys.readouterr().out
    result = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert result["meta"]["problems"] == [9, 42]
    assert result["meta"]["changes"] == ["unchanged", CHANGE]
    expected = [
        (9, "reach", "unchanged"),
        (9, "reach", CHANGE),
        (42, "scene", "unchanged"),
        (42, "scene", CHANGE),
    ]
    assert [(r["number"], r["kind"], r["method"]) for r in result["trials"]] == expected
    for record in result["trials"]:
        assert {
            "objective",
            "solves",
            "first_seed",
            "cpu_time",
            "wall_time",
            "commit",
            "rounds",
            "iterations",
        } <= set(record)
    good = sum(r["success"] for r in result["trials"] if r["method"] == CHANGE)
    assert f"| {CHANGE} | {good} of 2 |" in said
    assert "| unchanged | reach | " in said
    assert main(command) == 0  # nothing is left to do


def test_tasks(tmp_path: Path) -> None:
    """Starts of an experiment's tasks instead of the sixty problems."""
    result = ablation.run(
        out=tmp_path, tasks=["drawer", "door"], starts=2, seed=5, changes=[CHANGE], progress=False
    )
    assert (result["meta"]["tasks"], result["meta"]["starts"]) == (["door", "drawer"], 2)
    told = {(r["task"], r["number"], r["method"]): r for r in result["trials"]}
    assert len(told) == len(result["trials"]) == 8
    assert (
        told["drawer", 0, "unchanged"]["base_path_length"]
        == told["drawer", 0, CHANGE]["base_path_length"]
    )
    assert (
        told["drawer", 0, CHANGE]["base_path_length"]
        != told["drawer", 1, CHANGE]["base_path_length"]
    )
    text = ablation.report(result)
    good = sum(
        record["success"]
        for (task, _, method), record in told.items()
        if (task, method) == ("door", CHANGE)
    )
    assert "2 random starts a task, planning seed 5" in text
    assert f"| {CHANGE} | door | {good} of 2 |" in text
    assert f"| {CHANGE} | 4 | " in text


def test_ratios_are_of_pairs_of_successes() -> None:
    def record(number: int, method: str, time: float, success: bool = True) -> dict[str, object]:
        efforts = {
            "base_path_length": 1.0,
            "arm_path_length": 0.0,
            "objective": 2.0 * time,
            "rounds": 1,
            "iterations": 2,
        }
        own = {
            "number": number,
            "method": method,
            "kind": "reach",
            "seed": 0,
            "status": "success" if success else "error",
        }
        return {
            **own,
            **efforts,
            "success": success,
            "first_seed": success,
            "planning_time": time,
            "cpu_time": 1,
            "wall_time": 1,
        }

    trials = [record(0, "unchanged", 1.0), record(0, "Options.dt=0.3", 3.0)]
    trials += [record(1, "unchanged", 1.0), record(1, "Options.dt=0.3", 9.0, False)]
    trials += [record(2, "unchanged", 2.0, False), record(2, "Options.dt=0.3", 9.0)]
    trials.append(
        {"number": 3, "method": "unchanged", "seed": 0, "success": False, "status": "error"}
    )  # no numbers at all
    meta = {
        "changes": ["unchanged", "Options.dt=0.3"],
        "problems": [0, 1, 2, 3],
        "seed": 0,
        "time_limit": 1.0,
    }
    meta |= {
        "machine": {"cores": 1, "processor": "x", "machine": "y", "system": "z", "python": "3"},
        "versions": {},
    }
    text = ablation.report({"meta": meta, "trials": trials})
    assert (
        "| Options.dt=0.3 | 1 | 3.000 (3.000–3.000) | 1.000 (1.000–1.000) | 1.000 (1.000–1.000) | – | 3.000 (3.000–3.000) |"
        in text
    )
    assert "| unchanged | 2 of 4 | 2 of 4 | 1.00 | 1.33 |" in text


def test_wrong_arguments(tmp_path: Path) -> None:
    wrong = (
        {"problems": [60]},
        {"problems": []},
        {"changes": ["Options.none=1"]},
        {"tasks": ["dor"]},
    )
    for given in (*wrong, {"tasks": ["door"], "problems": [1]}, {"tasks": ["door"], "starts": 0}):
        with pytest.raises(vkc.InputError):
            ablation.run(out=tmp_path, **given)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
