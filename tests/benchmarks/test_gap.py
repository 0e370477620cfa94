"""Tests the benchmark in which the robot drives through a gap to a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.experiments import run_benchmark

import vkc_pin as vkc
from tests.benchmarks import gap
from tests.benchmarks.problems.poses import CLEAR, sample_random_start
from vkc_pin import validate


def test_starts_are_random_free_and_reproducible() -> None:
    starts = [gap.make_start(3, number) for number in range(12)]
    configurations = np.array([scene.start for scene in starts])
    assert min(scene.start_clearance() for scene in starts) >= CLEAR
    assert (configurations[:, 0] < -1.0).all()
    assert (np.ptp(configurations[:, 2:], axis=0) > 3.0).all(), "any heading and arm posture"
    np.testing.assert_array_equal(gap.make_start(3, 7).start, configurations[7])
    assert not np.array_equal(gap.make_start(4, 7).start, configurations[7])


def test_random_starts_need_a_start_region() -> None:
    scene = vkc.load_scene(gap.SCENE)
    document = {key: value for key, value in scene.document.items() if key != "start_region"}
    with pytest.raises(vkc.InputError, match="start_region"):
        sample_random_start(
            vkc.Scene.from_document(document, scene.folder), np.random.default_rng(0)
        )


def test_robot_drives_through_the_gap_and_reaches_over_the_table() -> None:
    plan = vkc.plan(gap.make_start(0, 9), [vkc.Reach(gap.POSE)])
    assert plan.success, plan.summary()
    assert validate(plan.scene, plan.steps, plan.trajectory, plan.options).ok
    x, y, _ = plan.trajectory.positions[:, :3].T
    beside = np.abs(x) < 0.3  # next to the pillar
    assert beside.any()
    half_width = 0.335
    assert ((y > -2.0 + half_width) & (y < -1.15 - half_width))[beside].all()
    tool = plan.end_scene().tool_placement()
    np.testing.assert_allclose(tool.translation, gap.POSE[:3], atol=2e-3)
    np.testing.assert_allclose(tool.rotation[:, 2], [0.0, 0.0, -1.0], atol=5e-3)


def test_trial_is_recorded_and_tabulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, (record,) = run_benchmark("gap --trials 1", tmp_path)
    assert table in capsys.readouterr().out
    assert record["success"] is True, record["violations"]
    assert record["first_seed"] is (record["solves"] == 1)
    np.testing.assert_allclose(record["start"], gap.make_start(0, 0).start, atol=1e-8)
    assert f"| {gap.SCENE} | 1 of 1 | {int(record['first_seed'])} of 1 |" in table
