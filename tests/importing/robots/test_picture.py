from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.importing.pictures import plot_robot


@pytest.mark.parametrize("name", ["husky_ur5e", "panda"])
def test_picture_shows_the_robot_at_home_and_its_tool_frame(name: str, tmp_path: Path) -> None:
    from PIL import Image

    robot = vkc.load_robot(name)
    figure = plot_robot(robot, tmp_path / "robot.png")
    whole, hand = figure.axes
    assert f"frame '{robot.tool_frame}'" in hand.get_title()
    for axes in (whole, hand):
        x, y, z = axes.get_xlim(), axes.get_ylim(), axes.get_zlim()
        for line in axes.lines:  # the tool's axes
            inside = [
                low - 0.3 <= value <= high + 0.3
                for values, (low, high) in zip(line.get_data_3d(), (x, y, z), strict=True)
                for value in values
            ]
            assert all(inside)
        assert len(axes.lines) == 3
    pixels = np.asarray(Image.open(tmp_path / "robot.png").convert("RGB"), int).reshape(-1, 3)
    orange = (pixels[:, 0] > pixels[:, 2] + 60).sum()
    assert (orange > 500) == bool(robot.touch_links)
