"""Through a gap to a table: the starts, one motion, and the benchmark from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks import gap
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.problems.poses import CLEAR, random_start
from vkc_pin.cli import main
from vkc_pin.validation.validate import validate


@pytest.fixture(autouse=True)
def same_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run."""
    monkeypatch.setattr(runner, "_sources", lambda: "abc")


def test_starts() -> None:
    starts = [gap.started(3, number) for number in range(12)]
    configurations = np.array([scene.start for scene in starts])
    assert min(scene.start_clearance() for scene in starts) >= CLEAR
    assert (configurations[:, 0] < -1.0).all()
    assert (np.ptp(configurations[:, 2:], axis=0) > 3.0).all(), "any heading, and the arm anywhere"
    np.testing.assert_array_equal(gap.started(3, 7).start, configurations[7])
    assert not np.array_equal(gap.started(4, 7).start, configurations[7])


def test_a_scene_without_a_region_has_no_random_starts() -> None:
    scene = vkc.load_scene(gap.SCENE)
    document = {key: value for key, value in scene.document.items() if key != "start_region"}
    with pytest.raises(vkc.InputError, match="start_region"):
        random_start(vkc.Scene.from_document(document, scene.folder), np.random.default_rng(0))


def test_the_robot_drives_through_the_gap_and_reaches_over_the_table() -> None:
    plan = vkc.plan(gap.started(0, 9), [vkc.Reach(gap.POSE)])
    assert plan.success, plan.summary()
    assert validate(plan.scene, plan.steps, plan.trajectory, plan.options).ok
    x, y, _ = plan.trajectory.positions[:, :3].T
    beside = np.abs(x) < 0.3  # at least as much of the way as the pillar is deep
    assert beside.any()
    assert ((y > -2.0 + 0.335) & (y < -1.15 - 0.335))[beside].all(), (
        "half of the robot's width from wall and pillar"
    )
    end = plan.trajectory.positions[-1]
    tool = plan.scene.with_start(base=end[:3], arm=end[3:]).tool_placement()
    np.testing.assert_allclose(tool.translation, gap.POSE[:3], atol=2e-3)
    np.testing.assert_allclose(tool.rotation[:, 2], [0.0, 0.0, -1.0], atol=5e-3)


def test_bench_gap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["bench", "gap", "--trials", "1", "--quiet", "--out", str(tmp_path)]
    assert main(command) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    result = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert result["meta"]["benchmark"] == "gap"
    assert result["meta"]["seed"] == 0
    assert result["meta"]["pose"] == list(gap.POSE)
    (record,) = result["trials"]
    assert record["success"] is True, record["violations"]
    assert record["first_seed"] is (record["solves"] == 1)
    assert {"commit", "cpu_time", "objective", "iterations", "seed", "initialization"} <= set(
        record
    )
    np.testing.assert_allclose(record["start"], gap.started(0, 0).start, atol=1e-8)
    assert (
        record["base_path_length"]
        > np.linalg.norm(np.array(gap.POSE[:2]) - record["start"][:2]) - 1.4
    )  # less the arm's reach
    assert f"| {gap.SCENE} | 1 of 1 | {int(record['first_seed'])} of 1 |" in table
    assert main(command) == 0  # nothing is left to do


def test_wrong_arguments(tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="trials"):
        gap.run(out=tmp_path, trials=0)
