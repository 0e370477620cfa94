from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.furniture import BAR, write_flap
from helpers.grippers import describe_cheeks_drawer, write_gripper
from helpers.texts import format_box

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


def write_drawer(folder: Path, *pieces: tuple[str, str, str], walls: str = "") -> Path:
    """Write a drawer that slides along -x, with pieces (name, place, size) on its front."""
    shapes = format_box("0.02 0.5 0.3", "0.01 0 0")
    shapes += "".join(format_box(size, at, name=name) for name, at, size in pieces)
    case = format_box("0.5 0.5 0.5", "0.3 0 0") + walls
    (folder / "d.urdf").write_text(f"""<robot name="d"><link name="case">{case}</link>
      <link name="tray">{shapes}</link><joint name="slide" type="prismatic">
      <parent link="case"/><child link="tray"/><axis xyz="-1 0 0"/>
      <limit lower="0" upper="0.3" effort="1" velocity="1"/></joint></robot>""")
    return folder / "d.urdf"


DRAWER_BAR = [
    ("bar", "-0.06 0.19 0.14", "0.015 0.11 0.015"),
    ("post_1", "-0.03 0.24 0.14", "0.06 0.012 0.012"),
    ("post_2", "-0.03 0.14 0.14", "0.06 0.012 0.012"),
]


@pytest.mark.parametrize(
    "knob",
    [
        ("knob", "-0.02 0 0", "0.04 0.004 0.004"),
        ("knob", "-0.02 0 -0.02", "0.04 0.003 0.03"),
        ("handle", "-0.03 0 0.02", "0.06 0.004 0.004"),
        ("pull_screw", "-0.02 0 0", "0.04 0.003 0.003"),
        ("lever", "-0.02 0.02 0", "0.04 0.002 0.01"),
    ],
)
def test_bar_is_preferred_to_a_thin_knob(tmp_path: Path, knob: tuple[str, str, str]) -> None:
    """The bar is off the centre, and its name does not suggest a handle."""
    file = write_drawer(tmp_path, *DRAWER_BAR, knob)
    (found,) = vkc.importing.import_object(file, tmp_path / "out", most=1).proposals.found
    assert found.thickness > 0.01


@pytest.mark.parametrize("hidden", [True, False])
def test_reachable_bar_is_preferred_to_a_hidden_knob(tmp_path: Path, hidden: bool) -> None:
    """A board behind the knob obstructs the hand there, but not at the bar."""
    knob = ("knob", "-0.025 0 -0.05", "0.05 0.03 0.03")
    board = format_box("0.2 0.5 0.02", "-0.7 0 -0.05") if hidden else ""
    file = write_drawer(tmp_path, *DRAWER_BAR, knob, walls=board)
    best = vkc.importing.import_object(file, tmp_path / "out").proposals.found[0]
    assert best.named is not hidden
    assert best.opens == {"slide": pytest.approx(0.3)}


@pytest.mark.parametrize(("gap", "goal"), [(0.3, 0.225), (0.34, 0.2625), (0.6, 0.3)])
def test_report_states_the_reachable_opening_of_a_joint(
    tmp_path: Path, gap: float, goal: float
) -> None:
    """A wall in front of the drawer stops the hand before the joint's limit."""
    wall = format_box("0.1 0.6 0.5", f"{-gap - 0.05} 0 0")
    file = write_drawer(tmp_path, *DRAWER_BAR, walls=wall)
    imported = vkc.importing.import_object(file, tmp_path / "out", most=1)
    assert imported.proposals.find_goal("slide") == pytest.approx(goal)
    text = f": a hand opens it to {goal:.3g} m, {goal / 0.3:.0%} of its range"
    assert (text in imported.summary()) is (goal < 0.3)
