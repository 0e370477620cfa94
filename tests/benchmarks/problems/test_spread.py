"""The spread over random seeds, from the command line, on two problems."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.problems import spread
from vkc_pin.cli import main


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def test_spread(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "bench",
        "spread",
        "--problems",
        "9",
        "42",
        "--seeds",
        "2",
        "--seed",
        "4",
        "--quiet",
        "--out",
        str(tmp_path),
    ]
    assert main(command) == 0
    said = capsys.readouterr().out
    trials = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert [(r["number"], r["seed"]) for r in trials] == [(9, 4), (9, 5), (42, 4), (42, 5)]
    for number in (9, 42):
        own = [r for r in trials if r["number"] == number]
        found = spread.spread_of(own, "base_path_length")
        assert f"| {number} | {own[0]['problem']} | {sum(r['success'] for r in own)} of 2 |" in said
        if all(r["success"] for r in own):
            efforts = [r["base_path_length"] for r in own]
            assert found == pytest.approx(max(efforts) / min(efforts) - 1.0)


def test_the_spread_is_of_successes() -> None:
    records = [
        {"success": True, "x": 2.0},
        {"success": True, "x": 3.0},
        {"success": False, "x": 9.0},
        {"success": True},
    ]
    assert spread.spread_of(records, "x") == pytest.approx(0.5)
    assert spread.spread_of(records[1:], "x") is None
    assert spread.spread_of([{"success": True, "x": 0.0}, *records], "x") is None


@pytest.mark.parametrize("seeds", [1, 2.0, True])
def test_one_seed_has_no_spread(seeds: int, tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="at least 2"):
        spread.run(out=tmp_path, seeds=seeds)
