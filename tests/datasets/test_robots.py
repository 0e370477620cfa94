from __future__ import annotations

from pathlib import Path

import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets import robots
from vkc_pin.datasets.recipe import load_recipe
from vkc_pin.models.robot_file import load_robot


def test_a_robot_without_a_hand_is_imported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("coacd")
    recipe = load_recipe({**SMALL, "robots": ["husky_ur5e", {"name": "panda", "height": 0.5}]})
    found = robots.ready_robots(recipe, tmp_path)
    assert list(found) == ["panda"]  # the other one says what its hand is
    assert load_robot(found["panda"]).touch_links
    monkeypatch.setattr(robots, "import_robot", None)
    assert robots.ready_robots(recipe, tmp_path) == found
