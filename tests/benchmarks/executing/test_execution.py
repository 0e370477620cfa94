"""Plans of two tasks are executed from the command line, resumed, and counted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vkc_pin.benchmarks.executing.execution import TASKS, report
from vkc_pin.benchmarks.problems.problem_set import TASKS as ALL
from vkc_pin.cli import main


def test_two_tasks_from_one_start(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = [
        "bench",
        "execution",
        "--trials",
        "1",
        "--tasks",
        "drawer",
        "init_1",
        "--quiet",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {
        "results.json",
        "results.csv",
        "table.md",
        "trials.jsonl",
    }
    result = json.loads((out / "results.json").read_text(encoding="utf-8"))
    drawer, stick = result["trials"]
    assert (drawer["task"], stick["task"]) == ("drawer", "init_1")
    for trial in (drawer, stick):
        assert trial["success"] is True, trial["violations"]
        assert trial["executed"] is True, trial["problems"]
        assert trial["problems"] == []
        assert 0.0 < trial["arm_error_rms"] <= trial["arm_error"] < 0.02
        assert 0.0 < trial["base_error_rms"] <= trial["base_error"] < 0.02
        assert trial["miss_m"] < 0.01
        assert trial["grasp_force"] > 1.0
        assert 0.0 < trial["effort_share"] < 1.0
    assert "| all | 2 of 2 | 2 of 2 |" in said
    assert "Nothing." in said
    before = (out / "trials.jsonl").read_bytes()
    assert main(command) == 0
    assert (out / "trials.jsonl").read_bytes() == before


def test_by_friction(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = [
        "bench",
        "execution",
        "--trials",
        "1",
        "--tasks",
        "drawer",
        "--grasp",
        "friction",
        "--quiet",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    assert "held by friction" in capsys.readouterr().out
    (trial,) = json.loads((out / "results.json").read_text(encoding="utf-8"))["trials"]
    assert trial["executed"] is True, trial["problems"]
    assert 0.0 < trial["slip"] < 0.005
    assert main([*command[:-1], str(tmp_path / "other"), "--grasp", "glue"]) == 2
    assert "glue" in capsys.readouterr().err


def test_what_goes_wrong_is_counted() -> None:
    fine = {"task": "drawer", "success": True, "executed": True, "arm_error": 0.01, "problems": []}
    bad = {
        "task": "drawer",
        "success": True,
        "executed": False,
        "arm_error": 0.02,
        "problems": ["cup – floor: 9 mm deep"],
    }
    never = {"task": "drawer", "success": False, "executed": False}
    recorded = json.loads(
        (Path(__file__).parents[3] / "docs/results/gap.json").read_text(encoding="utf-8")
    )["meta"]
    text = report(
        {"meta": {**recorded, "starts": 3, "tasks": ["drawer"]}, "trials": [fine, bad, never]}
    )
    assert "| drawer | 2 of 3 | 1 of 2 |" in text
    assert "1.15" in text
    assert "- drawer: cup – floor: 9 mm deep" in text


def test_tasks_are_those_of_the_experiments() -> None:
    assert set(TASKS) <= set(ALL)
