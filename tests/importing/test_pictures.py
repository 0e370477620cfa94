from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from helpers.furniture import BAR, write_flap
from helpers.texts import format_box
from PIL import Image

import vkc_pin as vkc
from vkc_pin.importing.pictures import plot_attachments, plot_robot


def read_pixels(file: Path) -> np.ndarray:
    """Return the red, green and blue values of a picture, shape (3, n)."""
    return np.asarray(Image.open(file).convert("RGB"), int).reshape(-1, 3).T


def test_picture_has_a_panel_for_every_attachment(tmp_path: Path) -> None:
    found = vkc.importing.propose_attachments(write_flap(tmp_path, BAR.format("")))
    figure = plot_attachments(found, tmp_path / "attachments.png")
    assert len(figure.axes) == len(found.found)
    titles = [axes.get_title().split()[0] for axes in figure.axes]
    assert titles == [proposal.attachment.name for proposal in found.found]
    red, _, blue = read_pixels(tmp_path / "attachments.png")
    assert (blue > red + 60).sum() > 200 * len(found.found)  # the hand


@pytest.mark.parametrize(
    ("size", "thick", "tried"),
    [
        ((0.5, 0.4, 0.6), 0.02, True),  # a lid that lies flush on the case
        ((7.0, 0.4, 0.6), 0.3, False),  # too thick
        ((0.5, 0.4, 0.6), 0.0, False),  # no lid
    ],
)
def test_picture_shows_objects_that_no_hand_can_open(
    tmp_path: Path, size: tuple[float, float, float], thick: float, tried: bool
) -> None:
    with pytest.raises(vkc.InputError, match="proposals"):
        plot_attachments("drawer")  # type: ignore[arg-type]
    width, depth, height = size
    case = format_box(f"{width} {depth} {height}", f"0 0 {height / 2}")
    lid = f"""<link name="lid">{format_box(f"{width} {depth} {thick}")}</link>
        <joint name="top" type="prismatic"><origin xyz="0 0 {height + thick / 2}"/>
        <parent link="case"/><child link="lid"/><axis xyz="0 0 1"/>
        <limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>"""
    urdf = f'<robot name="r"><link name="case">{case}</link>{lid if thick else ""}</robot>'
    item = vkc.load_object({"urdf": urdf, "attachments": []}, folder=tmp_path)
    found = vkc.importing.propose_attachments(item)
    assert not found.found
    assert bool(found.rejected.get("top")) is tried
    figure = plot_attachments(found)
    (whole,) = figure.axes
    assert ("places tried" in whole.get_title()) is tried
    longest = max(width, depth, height + thick)
    assert np.ptp(whole.get_xlim()) == pytest.approx(longest, rel=0.1)
    assert len(whole.collections) == (3 if tried else 1)  # the shapes, and tried places with arrows
    text = figure.subfigs[1].texts[0].get_text().replace("\n", " ")
    assert text.startswith("No hand can open")
    assert ("300 mm at its thinnest" in text) == (thick == 0.3)


LONG = "of 28 places that are thin enough, 16 are not 20 mm from body, 5 are not 5 mm from left"
REASONS = {
    "one": {"slide": LONG},
    "eight of one reason": {f"drawer_slide_{k}": LONG for k in range(8)},
    "eight of two reasons": {f"drawer_slide_{k}": f"{k % 2:02d} {LONG}" for k in range(8)},
    "forty reasons": {f"slide_{k}": f"{k:02d} {LONG}" for k in range(40)},
    "long names": {f"{'name_of_a_joint_' * 12}{k}": f"{k:02d} {LONG}" for k in range(6)},
}


@pytest.mark.parametrize("with_grasps", [True, False], ids=["some", "none"])
@pytest.mark.parametrize("because", REASONS.values(), ids=REASONS)
def test_picture_has_room_for_every_reason(
    with_grasps: bool, because: dict[str, str], tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """The object is as large as with one reason, and no text is cut off."""
    found = vkc.importing.propose_attachments(write_flap(tmp_path, BAR.format("")))
    kept = found.found if with_grasps else ()
    figure = plot_attachments(
        dataclasses.replace(found, because=because, found=kept), tmp_path / "a.png"
    )
    assert not [str(warning.message) for warning in recwarn if "layout" in str(warning.message)]
    (words,) = figure.subfigs[1].texts
    everything = words.get_text().replace("\n", " ")
    for joint, reason in because.items():
        assert joint in everything.replace(" ", "")
        assert everything.count(reason) == 1
    box = words.get_window_extent()
    assert box.x0 >= 0.0
    assert box.y0 >= 0.0
    assert box.x1 <= figure.bbox.x1
    whole = figure.axes[-1]
    assert whole.get_title().startswith("closed")
    place = whole.get_window_extent()
    assert min(place.width, place.height) > 2.0 * figure.dpi
    assert place.y0 > box.y1


@pytest.mark.parametrize("name", ["husky_ur5e", "panda"])
def test_picture_shows_the_robot_at_home_and_its_tool_frame(name: str, tmp_path: Path) -> None:
    robot = vkc.load_robot(name)
    figure = plot_robot(robot, tmp_path / "robot.png")
    whole, hand = figure.axes
    assert f"frame '{robot.tool_frame}'" in hand.get_title()
    for axes in (whole, hand):
        low, high = np.transpose([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
        assert len(axes.lines) == 3  # the tool's axes
        for line in axes.lines:
            points = np.transpose(line.get_data_3d())
            assert ((points >= low - 0.3) & (points <= high + 0.3)).all()
    red, _, blue = read_pixels(tmp_path / "robot.png")
    assert ((red > blue + 60).sum() > 500) == bool(robot.touch_links)  # orange
