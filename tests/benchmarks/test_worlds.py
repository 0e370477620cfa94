"""Tests the benchmark that plans in one room from several sources."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.experiments import run_benchmark

from tests.benchmarks import worlds


def test_room_is_the_same_from_a_map_and_a_planning_scene(tmp_path: Path) -> None:
    table, trials = run_benchmark("worlds --starts 1 --sources map moveit", tmp_path)
    for trial in trials:
        assert trial["success"] is True, trial["violations"]
        assert trial["twin"] is True
        assert trial["ratio"] > 0.0
    assert "| map | " in table
    assert "| moveit | " in table


def test_points_are_on_the_walls() -> None:
    points = worlds.sample_points(0.5)
    distances = []
    for _, size, position in worlds.list_boxes():
        outside = np.abs(points - position) - size / 2.0
        distances.append(np.abs(outside.max(axis=1)))
    np.testing.assert_allclose(np.min(distances, axis=0), 0.0, atol=1e-9)
    assert len(points) > 100
