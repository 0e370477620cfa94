from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.furniture import BAR, write_flap
from helpers.grippers import describe_cheeks_drawer, write_gripper

import vkc_pin as vkc
from vkc_pin.importing.proposals.fitting import HandClearance
from vkc_pin.importing.proposals.hand import make_hand


@pytest.mark.parametrize(
    ("name", "joint", "handle"),
    [
        ("drawer", "slide", "handle"),
        ("cabinet", "hinge", "handle"),
        ("dishwasher", "door", "door_handle"),
        ("door", "knob", "handle"),
    ],
)
def test_best_proposal_agrees_with_the_handwritten_attachment(
    name: str, joint: str, handle: str
) -> None:
    """The hand can slide along the bar to the handwritten grasp."""
    item = vkc.load_object(name)
    handwritten = item.attachment(handle)
    best = vkc.importing.propose_attachments(item).opening(joint)[0]
    assert best.attachment.link == handwritten.link
    offset = best.attachment.placement.inverse() * handwritten.placement
    slide = next(freedom for freedom in best.attachment.freedoms if freedom.kind == "prismatic")
    assert np.linalg.norm(offset.translation[[0, 2]]) < 0.005
    assert slide.lower - 0.02 <= offset.translation[1] <= slide.upper + 0.02
    assert abs(offset.rotation[1, 1]) == pytest.approx(1.0)
    k = item.coordinates.index(joint)
    assert best.opens[joint] == pytest.approx(max(item.lower[k], item.upper[k], key=abs))


def test_obstructing_door_is_opened_first() -> None:
    found = vkc.importing.propose_attachments(vkc.load_object("dishwasher"))
    assert found.because == {}
    assert dict(found.opening("rack")[0].when) == {"door": pytest.approx(np.pi / 2.0)}
    assert "while door is at 1.57" in found.summary()


def test_without_handle_the_free_edge_is_grasped(tmp_path: Path) -> None:
    best = vkc.importing.propose_attachments(write_flap(tmp_path, behind=0.1)).found[0]
    assert best.kind == "edge"
    assert best.thickness == pytest.approx(0.02)
    assert best.attachment.placement.translation[1] > 0.5


def test_named_handle_is_preferred(tmp_path: Path) -> None:
    other = BAR.replace("-0.08 0.5 0", "-0.08 0.4 0").format(' name="handle"')
    first = vkc.importing.propose_attachments(write_flap(tmp_path, BAR.format(""))).found[0]
    assert not first.named
    assert first.attachment.placement.translation[1] == pytest.approx(0.5)
    named = vkc.importing.propose_attachments(write_flap(tmp_path, BAR.format("") + other)).found[0]
    assert named.named
    assert named.attachment.placement.translation[1] == pytest.approx(0.4)


def test_thick_object_has_no_attachment(tmp_path: Path) -> None:
    found = vkc.importing.propose_attachments(write_flap(tmp_path, thick=0.12))
    assert found.found == ()
    assert "nothing of it fits between the fingers, 86 mm apart" in found.because["hinge"]
    assert "120 mm at its thinnest" in found.because["hinge"]
    assert found.because["hinge"] in found.summary()
    assert dict(found.make_object().attachments) == {}


def test_bar_without_clearance_behind_it_is_rejected(tmp_path: Path) -> None:
    flush = BAR.replace("-0.08", "-0.03").format(' name="handle"')
    found = vkc.importing.propose_attachments(write_flap(tmp_path, flush, thick=0.09))
    assert "are not 5 mm from flap" in found.because["hinge"]


def test_bar_close_to_the_flap_is_grasped_with_the_fingertips(tmp_path: Path) -> None:
    close = BAR.replace("-0.08", "-0.03").format(' name="handle"')
    best = vkc.importing.propose_attachments(write_flap(tmp_path, close)).found[0]
    assert best.kind == "bar"
    assert best.attachment.standoff > 0.0
    tight = vkc.importing.propose_attachments(write_flap(tmp_path, close), grasp_clearance=0.02)
    assert all(proposal.kind != "bar" for proposal in tight.found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"item": "drawer"}, "ArticulatedObject"),
        ({"robot": "husky_ur5"}, "did you mean 'husky_ur5e'"),
        ({"dist_safe": -0.1}, "dist_safe"),
        ({"most": 0}, "most"),
    ],
)
def test_errors_name_the_invalid_argument(arguments: dict[str, Any], message: str) -> None:
    item = arguments.pop("item", None) or vkc.load_object("drawer")
    with pytest.raises(vkc.InputError, match=message):
        vkc.importing.propose_attachments(item, **arguments)


def test_fingers_close_partly_where_space_is_narrow(tmp_path: Path) -> None:
    """Posts of the drawer's frame are 60 mm from the middle of its handle, on both sides."""
    item, robot = vkc.load_object(describe_cheeks_drawer()), vkc.load_robot(write_gripper(tmp_path))
    found = vkc.importing.propose_attachments(item, robot)
    best = found.opening("slide")[0]
    assert best.thickness == pytest.approx(0.02)
    assert best.attachment.opening == pytest.approx(0.03)  # 5 mm on both sides
    assert best.description()["opening"] == 0.03
    assert "20 mm thick, fingers 30 mm apart" in found.summary()
    fitting = HandClearance(item, make_hand(robot.opened(best.attachment.opening)), 0.02, 0.005)
    grasp = best.attachment.tool(np.zeros(len(best.attachment.freedoms)))
    tool = item.link_placement("front", [0.0]) * grasp
    assert fitting.find_obstruction(tool, "front") is None
    assert HandClearance(item, found.hand, 0.02, 0.005).find_obstruction(tool, "front") is not None
    wide = vkc.load_object(describe_cheeks_drawer(gap=0.15))
    assert vkc.importing.propose_attachments(wide, robot).found[0].attachment.opening is None
    without_gripper = dataclasses.replace(robot, gripper=None)
    others = vkc.importing.propose_attachments(item, without_gripper).found
    assert best.kind not in {one.kind for one in others}
