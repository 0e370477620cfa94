from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.arm_urdf import write_arms
from helpers.texts import format_box, format_fixed_link, replace_in_file

from vkc_pin.importing import import_robot
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.importing.robots.arms import Arm, build_body_tree, find_arms
from vkc_pin.importing.robots.hands import Hand, analyze_hand
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.gripper import find_thickest_rod
from vkc_pin.world.models.robot_model import build_full_model


def analyze_first_hand(path: Path) -> tuple[Arm, Hand]:
    file = read_urdf(path)
    solid = {shape.link for shape in file.read_shapes("collision")}
    arm = find_arms(file, build_body_tree(file), {}, solid)[0]
    return arm, analyze_hand(file, build_full_model(file), arm)


def test_tool_frame_lies_between_the_fingertips(tmp_path: Path) -> None:
    _, hand = analyze_first_hand(write_arms(tmp_path))
    assert hand.link == "arm_5"
    # The approach is along the fingers, and the closing direction across them.
    np.testing.assert_allclose(hand.tool.rotation[:, 2], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(np.abs(hand.tool.rotation[:, 0]), [0, 1, 0], atol=1e-9)
    assert np.linalg.det(hand.tool.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(hand.tool.translation[:2], 0.0, atol=2e-3)
    assert 0.2 + 0.06 + 0.05 < hand.tool.translation[2] < 0.2 + 0.06 + 0.08
    assert hand.open == {"finger_a_joint": 0.04, "finger_b_joint": 0.04}
    assert hand.closed == {"finger_a_joint": 0.0, "finger_b_joint": 0.0}
    ends = {"closed": 0.0, "open": 0.04}
    assert hand.settings() == {"gripper": {"finger_a_joint": ends, "finger_b_joint": ends}}
    assert hand.opening == pytest.approx(0.08, abs=0.01)
    assert set(hand.touch_links) == {"arm_5", "hand", "finger_a", "finger_b"}
    assert hand.sure == "sure"


def test_single_jaw_opens_from_the_hand(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    replace_in_file(path, ('finger_b_joint" type="prismatic"', 'finger_b_joint" type="fixed"'))
    arm, hand = analyze_first_hand(path)
    assert [finger.name for finger in arm.fingers] == ["finger_a_joint"]
    assert hand.open == {"finger_a_joint": 0.04}
    np.testing.assert_allclose(hand.tool.rotation[:, 2], [0, 0, 1], atol=0.3)
    assert np.abs(hand.tool.rotation[1, 0]) > 0.9


def test_hand_beside_a_hinge_approaches_across_its_axis(tmp_path: Path) -> None:
    wrist = '<joint name="wrist" type="fixed"><origin xyz="0 {} 0.2"/>'
    path = replace_in_file(write_arms(tmp_path), (wrist.format(0), wrist.format(0.15)))
    _, hand = analyze_first_hand(path)
    np.testing.assert_allclose(hand.tool.rotation[:, 2], [0, 0, 1], atol=1e-9)


def test_wide_jaw_opens_far_enough_for_a_lever(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    text = path.read_text(encoding="utf-8")
    jaw = format_box("0.02 0.02 0.08", "0 0.01 0.04")
    side = format_box("0.02 0.02 0.08", "0 -0.01 0.04")
    hand = f"""<link name="jaw">{jaw}</link>
        <joint name="jaw_joint" type="revolute"><parent link="hand"/><child link="jaw"/>
        <origin xyz="0 0 0.06"/><axis xyz="-1 0 0"/><limit lower="0" upper="2.6"/></joint>"""
    hand += format_fixed_link("side", "hand", "0 0 0.06", side)
    replace_in_file(path, (text[text.index('<link name="finger_a">') :], f"{hand}</robot>"))
    robot = import_robot(path, tmp_path / "mine", samples=20).robot
    assert find_thickest_rod(make_hand(robot).touch) > 0.035
    assert robot.gripper is not None
    assert 0.5 < robot.gripper.open[0] < 2.5


def test_tool_frame_of_a_flange_points_along_the_last_axis(tmp_path: Path) -> None:
    path = replace_in_file(write_arms(tmp_path), ('type="prismatic"', 'type="fixed"'))
    arm, hand = analyze_first_hand(path)
    assert arm.fingers == ()
    assert hand.open == {}
    assert hand.settings() == {}
    np.testing.assert_allclose(hand.tool.rotation[:, 2], [0, 0, 1], atol=0.2)
    assert hand.tool.translation[2] == pytest.approx(0.2 + 0.14, abs=0.01)  # in front of all shapes
