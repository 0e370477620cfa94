"""Tests of drawings of measured points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.visualization.plots.scene_view import plot_scene
from vkc_pin.visualization.room import Room

POINTS = np.random.default_rng(1).uniform([1.0, -2.0, 0.1], [2.0, 2.0, 1.5], (500, 3))


@pytest.fixture(scope="module")
def scene() -> vkc.Scene:
    return vkc.load_scene("init_1").with_points(POINTS, 0.02)


def test_viewer_draws_the_points_and_not_their_boxes(scene: vkc.Scene) -> None:
    room = Room(scene)
    ((name, points, radius, _),) = room.make_clouds()
    assert name == "points"
    assert radius == 0.02
    expected = POINTS[np.lexsort(POINTS.T)]
    np.testing.assert_allclose(points[np.lexsort(points.T)], expected, atol=1e-6)
    assert not any(part.name.startswith("points") for part in room.make_parts())


def test_page_of_a_scene_has_the_points(scene: vkc.Scene, tmp_path: Path) -> None:
    page = vkc.visualization.to_html(scene, tmp_path / "with.html")
    other = vkc.visualization.to_html(vkc.load_scene("init_1"), tmp_path / "without.html")
    assert page.stat().st_size > other.stat().st_size + 12 * len(POINTS)


def test_top_view_draws_the_points(scene: vkc.Scene) -> None:
    figure = plot_scene(scene)
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) == len(POINTS)]
    assert len(lines) == 1
