from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.furniture import BAR, write_flap

import vkc_pin as vkc
from vkc_pin.importing.pictures import plot_attachments, plot_robot


def test_picture_has_a_panel_for_every_attachment(tmp_path: Path) -> None:
    from PIL import Image

    found = vkc.importing.propose_attachments(write_flap(tmp_path, BAR.format("")))
    figure = plot_attachments(found, tmp_path / "attachments.png")
    assert len(figure.axes) == len(found.found)
    assert [axes.get_title().split()[0] for axes in figure.axes] == [
        proposal.attachment.name for proposal in found.found
    ]
    pixels = np.asarray(Image.open(tmp_path / "attachments.png").convert("RGB"), int).reshape(-1, 3)
    blue = (pixels[:, 2] > pixels[:, 0] + 60).sum()  # the hand
    assert blue > 200 * len(found.found)


def test_picture_explains_missing_attachments(tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="proposals"):
        plot_attachments("drawer")  # type: ignore[arg-type]
    found = vkc.importing.propose_attachments(write_flap(tmp_path, thick=0.12))
    figure = plot_attachments(found)
    text = figure.axes[1].texts[0].get_text().replace("\n", " ")
    assert "120 mm at its thinnest" in text


FIXED = '<collision><geometry><box size="{} {} {}"/></geometry></collision>'


@pytest.mark.parametrize(
    ("size", "door", "tried"),
    [
        ((0.5, 0.4, 0.6), "0.5 0.4 0.02", True),  # lies flush on the case
        ((0.5, 0.4, 0.6), "0.5 0.4 0.3", False),  # too thick
        ((7.0, 0.4, 0.6), "7.0 0.4 0.3", False),
        ((0.2, 0.2, 2.0), "0.2 0.2 0.3", False),
        ((0.5, 0.4, 0.6), "", False),  # no joint
    ],
)
def test_picture_shows_objects_that_no_hand_can_open(
    tmp_path: Path, size: tuple[float, float, float], door: str, tried: bool
) -> None:
    width, depth, height = size
    lid = FIXED.format(*door.split()) if door else ""
    thick = float(door.split()[2]) if door else 0.0
    joint = f"""<link name="lid">{lid}</link><joint name="top" type="prismatic"><origin
        xyz="0 0 {height + thick / 2}"/><parent link="case"/><child link="lid"/><axis xyz="0 0 1"/>
        <limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>"""
    case = FIXED.format(width, depth, height).replace(
        "<geometry>", f'<origin xyz="0 0 {height / 2}"/><geometry>'
    )
    urdf = f'<robot name="r"><link name="case">{case}</link>{joint if door else ""}</robot>'
    item = vkc.load_object({"urdf": urdf, "attachments": []}, folder=tmp_path)
    found = vkc.importing.propose_attachments(item)
    assert not found.found
    assert bool(found.rejected.get("top")) is tried
    whole, explanation = plot_attachments(found).axes
    assert ("places tried" in whole.get_title()) is tried
    longest = max(width, depth, height + thick)
    assert np.ptp(whole.get_xlim()) == pytest.approx(longest, rel=0.1)
    assert len(whole.collections) == (3 if tried else 1)  # the shapes, and tried places with arrows
    assert explanation.texts[0].get_text().startswith("No hand can open")


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
