"""Tests that web pages show the executed motion beside the plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.executions import make_grasping_scene, make_stationary_motion, simulate_drawer

import vkc_pin as vkc
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.replay import Replay


def test_replay_reproduces_executed_coordinates() -> None:
    scene = make_grasping_scene()
    result = simulate(scene, [vkc.Grasp("stick")], make_stationary_motion(scene))
    world = Replay(scene, result.trajectory.times, result.rows)
    rows = world.compute_positions(result.trajectory, result.trajectory.times)
    np.testing.assert_allclose(np.abs(rows), np.abs(result.rows), atol=1e-12)
    assert np.abs(np.diff(rows, axis=0)).max() < 0.1  # quaternions keep their sign


def test_page_contains_motion_and_ghost(tmp_path: Path) -> None:
    result = simulate_drawer()
    text = result.to_html(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "drawer in physics: ok" in text
    assert "as planned" in text
    assert len(text) > 500_000
