"""The door and the drawer with every kind of base: the starts, and the benchmark from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.driving import bases
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.record import meta
from vkc_pin.cli import main


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def test_starts_are_the_same_for_every_base() -> None:
    scenes = [bases.started("door", base, 3, 7) for base in bases.BASES]
    assert [scene.robot.base for scene in scenes] == ["omni", "differential", "ackermann"]
    assert scenes[-1].robot.turning_radius == bases.TURNING_RADIUS
    for scene in scenes[1:]:
        np.testing.assert_array_equal(scene.start, scenes[0].start)
    assert not np.array_equal(bases.started("door", "omni", 3, 8).start, scenes[0].start)


def test_bench_bases(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "bench",
        "bases",
        "--trials",
        "1",
        "--tasks",
        "drawer",
        "--bases",
        "omni",
        "differential",
        "--quiet",
    ]
    assert main([*command, "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    records = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["trials"]
    assert {(r["task"], r["base"], r["success"]) for r in records} == {
        ("drawer", "omni", True),
        ("drawer", "differential", True),
    }
    for record in records:
        (row,) = [
            line for line in table.splitlines() if line.startswith(f"| drawer | {record['base']} |")
        ]
        assert f"| 1 of 1 | {record['planning_time']:.3f} |" in row
        assert (
            f"| {record['base_path_length']:.2f} | {record['arm_path_length']:.2f} | {record['duration']:.2f} |"
            in row
        )


def test_failures_are_listed() -> None:
    record = {
        "task": "door",
        "base": "ackermann",
        "number": 4,
        "success": False,
        "status": "rejected",
        "violations": ["turning base"],
    }
    fields = (
        "planning_time",
        "evaluations",
        "iterations",
        "base_path_length",
        "arm_path_length",
        "duration",
    )
    about = {"starts": 5, "seed": 0, "radius": 0.8, "tasks": ["door"], "bases": ["ackermann"]}
    foot = {
        **meta(),
        "trials": 1,
        "jobs": 1,
        "wall_time": 1.0,
        "peak_memory_mb": 100.0,
        "sources": "abc",
    }
    text = bases.report(
        {"meta": {**foot, **about}, "trials": [record | dict.fromkeys(fields, 1.0)]}
    )
    assert "- door, ackermann, start 4: rejected; turning base" in text
    assert "| door | ackermann | 0 of 1 |" in text


def test_unknown_names(tmp_path: Path) -> None:
    with pytest.raises(vkc.UnknownNameError, match="differential"):
        bases.run(out=tmp_path, bases=["diferential"])
    with pytest.raises(vkc.UnknownNameError, match="drawer"):
        bases.run(out=tmp_path, tasks=["drawers"])
    with pytest.raises(vkc.InputError, match="trials"):
        bases.run(out=tmp_path, trials=0)
