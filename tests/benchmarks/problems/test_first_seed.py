"""How often the first seed suffices, from the command line, at two tasks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.problems import first_seed
from vkc_pin.cli import main


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def test_first_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "bench",
        "first-seed",
        "--trials",
        "1",
        "--tasks",
        "drawer",
        "door",
        "--quiet",
        "--out",
        str(tmp_path),
    ]
    assert main(command) == 0
    said = capsys.readouterr().out
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [r["task"] for r in trials] == ["door", "drawer"]
    for record in trials:
        assert record["first_seed"] is (record["success"] and record["solves"] == 1)
        assert (
            f"| {record['task']} | {int(record['success'])} of 1 | {int(record['first_seed'])} of 1 |"
            in said
        )
    assert f"| all | {sum(r['success'] for r in trials)} of 2 |" in said


def test_wrong_arguments(tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="trials"):
        first_seed.run(out=tmp_path, trials=0)
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'drawer'"):
        first_seed.run(out=tmp_path, tasks=["drawr"])
