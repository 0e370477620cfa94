from __future__ import annotations

from pathlib import Path

import pytest
from helpers.arm_urdf import write_arms
from helpers.telescopes import format_joint, format_link, write_telescope
from helpers.texts import format_box, format_fixed_link, replace_in_file

import vkc_pin as vkc
from vkc_pin.importing.robots.arms import (
    Arm,
    build_body_tree,
    choose_arm,
    find_arms,
    find_own_base,
    find_telescopes,
    guess_base_kind,
)
from vkc_pin.world.files import resources
from vkc_pin.world.files.urdf import UrdfFile, read_urdf
from vkc_pin.world.models.robot_model import build_full_model


def find_all_arms(file: UrdfFile, groups: dict[str, list[str]] | None = None) -> list[Arm]:
    solid = {shape.link for shape in file.read_shapes("collision")}
    return find_arms(file, build_body_tree(file), groups or {}, solid)


def test_arms_are_found_by_their_hands(tmp_path: Path) -> None:
    file = read_urdf(write_arms(tmp_path, sides=("left_", "right_")))
    arms = find_all_arms(file)
    assert sorted(arm.name for arm in arms) == ["left", "right"]
    left = choose_arm(arms, "Left", file, {})
    assert left.joints == tuple(f"left_arm_{k}_joint" for k in range(1, 6))
    assert [finger.name for finger in left.fingers] == [
        "left_finger_a_joint",
        "left_finger_b_joint",
    ]
    assert left.palm.links == ["left_arm_5", "left_hand"]
    assert left.sure == "sure"
    groups = {"port": [f"left_arm_{k}_joint" for k in range(1, 6)], "hand": ["left_finger_a_joint"]}
    assert {arm.name for arm in find_all_arms(file, groups)} == {"port", "right"}
    assert choose_arm(arms, "port", file, groups).name == "left"
    with pytest.raises(vkc.UnknownNameError) as caught:
        choose_arm(arms, "midle", file, groups)
    assert set(caught.value.choices) == {"left", "right", "port"}


@pytest.mark.parametrize(("ahead", "count"), [(0.15, 5), (0.0, 6)])
def test_jaw_named_by_its_link_closes_against_the_hand(
    tmp_path: Path, ahead: float, count: int
) -> None:
    """The hand extends beside the jaw, or ends where the last link of the wrist begins."""
    path = write_arms(tmp_path)
    text = path.read_text(encoding="utf-8")
    jaw = format_box("0.02 0.02 0.2", "0 0.02 0.1")
    side = format_box(f"0.02 0.02 {ahead or 0.01}", f"0 -0.03 {ahead / 2}")
    hand = f"""<link name="gripper">{jaw}</link>
        <joint name="joint_6" type="revolute"><parent link="hand"/><child link="gripper"/>
        <origin xyz="0 0 0.06"/><axis xyz="1 0 0"/><limit lower="-0.2" upper="1.2"/></joint>"""
    hand += format_fixed_link("side", "hand", f"0 0 {0.06 if ahead else 0.03}", side)
    replace_in_file(path, (text[text.index('<link name="finger_a">') :], f"{hand}</robot>"))
    (arm,) = find_all_arms(read_urdf(path))
    assert len(arm.joints) == count
    assert [finger.name for finger in arm.fingers] == ["joint_6"] * (6 - count)


def test_base_joints_are_not_part_of_the_arm(tmp_path: Path) -> None:
    file = read_urdf(write_arms(tmp_path, own_base=True))
    assert find_base_joints(file) == ("drive_x", "drive_y", "drive_yaw")
    assert find_all_arms(file)[0].joints[0] == "arm_1_joint"
    assert find_base_joints(read_urdf(write_arms(tmp_path))) == ()


def find_base_joints(file: UrdfFile) -> tuple[str, ...]:
    solid = {shape.link for shape in file.read_shapes("collision")}
    return find_own_base(file, build_body_tree(file), solid)


@pytest.mark.parametrize(
    ("chain", "count"),
    [
        ("px py rz pz", 3),  # a lift on a base
        ("px py pz rz", 2),
        ("pz px py rz", 0),
        ("px py rz rx", 3),
        ("pz rz", 0),
        ("px", 0),  # a rail
        ("px rz", 2),
        ("fx px pz ry", 3),  # the frame is turned by a right angle about x
        ("fx px py rz", 0),
        ("fx pz py rz", 0),
    ],
)
def test_lifts_are_not_part_of_the_base(tmp_path: Path, chain: str, count: int) -> None:
    """Each word of `chain` is a joint: its kind (fixed, prismatic, revolute) and its axis."""
    kinds = {"p": "prismatic", "r": "revolute", "f": "fixed"}
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    text, parent = format_link("root"), "root"
    for k, (kind, axis) in enumerate(chain.split()):
        is_last = k == len(chain.split()) - 1
        text += format_link(f"l{k}", "1 1 1" if is_last else "")
        joint = format_joint(f"j{k}", kinds[kind], parent, f"l{k}", axis=axes[axis])
        roll = ' rpy="1.5707963267948966 0 0"/>' if kind == "f" else "/>"
        text += joint.replace("/>", roll, 1)
        parent = f"l{k}"
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{text}</robot>')
    found = find_base_joints(read_urdf(tmp_path / "r.urdf"))
    first = 1 if chain.startswith("f") else 0
    assert found == tuple(f"j{k}" for k in range(first, first + count))


def find_robot(pattern: str) -> Path:
    folder = resources.find_example_robot_data()
    assert folder is not None
    return min((folder / "robots").glob(pattern))


@pytest.mark.parametrize(
    ("pattern", "joints", "fingers"),
    [
        ("**/panda.urdf", 7, 2),
        ("**/ur5_robot.urdf", 6, 0),
        ("**/pr2.urdf", 8, 2),
        ("**/talos_reduced.urdf", 9, 1),
    ],
)
def test_arms_of_published_robots_are_found(pattern: str, joints: int, fingers: int) -> None:
    best = find_all_arms(read_urdf(find_robot(pattern)))[0]
    assert (len(best.joints), len(best.fingers)) == (joints, fingers)


@pytest.mark.parametrize("pattern", ["**/anymal_b*/**/anymal.urdf", "**/allegro_right_hand.urdf"])
def test_legs_and_hands_are_not_arms(pattern: str) -> None:
    file = read_urdf(find_robot(pattern))
    assert find_all_arms(file) == []
    with pytest.raises(vkc.InputError, match="no arm was found"):
        choose_arm([], None, file, {})


def test_wheels_determine_the_base_kind(tmp_path: Path) -> None:
    assert guess_base_kind(read_urdf(find_robot("**/tiago.urdf")).root)[0] == "differential"
    assert guess_base_kind(read_urdf(find_robot("**/pr2.urdf")).root)[0] == "omni"
    assert guess_base_kind(read_urdf(write_arms(tmp_path)).root)[0] == "omni"


@pytest.mark.parametrize(
    ("replacements", "groups"),
    [
        ([], [("out_1", "out_2", "out_3", "out_4")]),
        ([('name="out_3" type="prismatic"', 'name="out_3" type="revolute"')], [("out_1", "out_2")]),
        (
            [('link="segment_3"/><axis xyz="1 0 0"/>', 'link="segment_3"/><axis xyz="-1 0 0"/>')],
            [("out_1", "out_2")],
        ),
        ([('upper="0.15"', 'upper="0.16"')], [("out_2", "out_3", "out_4")]),
    ],
)
def test_telescope_segments_are_found(
    tmp_path: Path, replacements: list[tuple[str, str]], groups: list[tuple[str, ...]]
) -> None:
    file = write_telescope(tmp_path).with_name("robot.urdf")
    urdf = read_urdf(replace_in_file(file, *replacements, count=1))
    names = ("lift", "out_1", "out_2", "out_3", "out_4", "yaw_joint", "pitch_joint", "roll_joint")
    assert find_telescopes(build_full_model(urdf), names) == groups
