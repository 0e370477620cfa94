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
)
from vkc_pin.world.files import resources
from vkc_pin.world.files.srdf import SrdfGroup
from vkc_pin.world.files.urdf import UrdfFile, read_urdf
from vkc_pin.world.models.robot_model import build_full_model
from vkc_pin.world.models.wheels import find_drive


def find_all_arms(file: UrdfFile, groups: dict[str, SrdfGroup] | None = None) -> list[Arm]:
    return find_arms(file, build_body_tree(file), groups or {}, find_solid_links(file))


def find_solid_links(file: UrdfFile) -> set[str]:
    return {shape.link for shape in file.read_shapes("collision")}


def choose(
    file: UrdfFile, name: str | None, groups: dict[str, SrdfGroup] | None = None
) -> tuple[Arm, list[Arm]]:
    arms, tree = find_all_arms(file), build_body_tree(file)
    return choose_arm(arms, name, file, tree, groups or {}, find_solid_links(file)), arms


def test_arms_are_found_by_their_hands(tmp_path: Path) -> None:
    file = read_urdf(write_arms(tmp_path, sides=("left_", "right_")))
    arms = find_all_arms(file)
    assert sorted(arm.name for arm in arms) == ["left", "right"]
    left, _ = choose(file, "Left")
    assert left.joints == tuple(f"left_arm_{k}_joint" for k in range(1, 6))
    assert [finger.name for finger in left.fingers] == [
        "left_finger_a_joint",
        "left_finger_b_joint",
    ]
    assert left.palm.links == ["left_arm_5", "left_hand"]
    assert left.sure == "sure"
    groups = {
        "port": SrdfGroup(tuple(f"left_arm_{k}_joint" for k in range(1, 6)), "left_arm_5"),
        "hand": SrdfGroup(("left_finger_a_joint",), "left_finger_a"),
    }
    assert {arm.name for arm in find_all_arms(file, groups)} == {"port", "right"}
    for name in ("port", "hand"):  # a group of the fingers belongs to their arm
        assert choose(file, name, groups)[0].name == "left"
    with pytest.raises(vkc.UnknownNameError) as caught:
        choose(file, "midle", groups)
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
        choose(file, None)


def test_wheels_determine_the_base_kind(tmp_path: Path) -> None:
    assert guess_base(read_urdf(find_robot("**/tiago.urdf"))) == "differential"
    assert guess_base(read_urdf(find_robot("**/pr2.urdf"))) is None  # its wheels are fixed
    assert guess_base(read_urdf(write_arms(tmp_path))) is None


def guess_base(file: UrdfFile) -> str | None:
    drive = find_drive(build_full_model(file), file)
    return None if drive is None else drive.kind


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


@pytest.mark.parametrize(
    "prefix",
    ["openarm_", "arm_", "left_forearm_gripper_", "Shoulder", "head_", "hipgripper_", "neck-"],
)
def test_fingers_may_have_the_name_of_another_part_before_theirs(
    tmp_path: Path, prefix: str
) -> None:
    names = [
        (f'"finger_{side}{end}"', f'"{prefix}Finger_{side}{end}"')
        for side in "ab"
        for end in ("", "_joint")
    ]
    (arm,) = find_all_arms(read_urdf(replace_in_file(write_arms(tmp_path), *names)))
    assert (len(arm.joints), len(arm.fingers)) == (5, 2)


def write_bare_arm(folder: Path, name: str) -> UrdfFile:
    """Write an arm of five joints without fingers, the fourth of which has a name."""
    path = write_arms(folder)
    text = path.read_text(encoding="utf-8")
    fingers = text[text.index('<link name="finger_a">') :]
    replace_in_file(path, (fingers, "</robot>"), ('"arm_4', f'"{name}'))
    return read_urdf(path)


@pytest.mark.parametrize(
    "name",
    [
        "forearm_roll",
        "linear_axis",
        "bearing",
        "rear_link",
        "retail",
        "bulkhead",
        "toeplitz",
        "LegoPart",
    ],
)
def test_parts_of_words_do_not_rule_out_an_arm(tmp_path: Path, name: str) -> None:
    (arm,) = find_all_arms(write_bare_arm(tmp_path, name))
    assert len(arm.joints) == 5


@pytest.mark.parametrize("name", ["ear", "left_ear_pitch", "headtilt", "knee2", "LFoot", "wheels"])
def test_words_of_other_limbs_rule_out_an_arm(tmp_path: Path, name: str) -> None:
    assert find_all_arms(write_bare_arm(tmp_path, name)) == []


def test_group_of_the_srdf_is_an_arm_whatever_its_names(tmp_path: Path) -> None:
    """It ends at its tip, or with the hand around it."""
    file = write_bare_arm(tmp_path / "bare", "ear")
    group = SrdfGroup(("arm_1_joint", "arm_2_joint", "arm_3_joint"), "arm_3")
    arm, _ = choose(file, "upper", {"upper": group})
    assert (arm.name, arm.joints, arm.palm.links[0]) == ("upper", group.joints, "arm_3")
    file = read_urdf(write_arms(tmp_path / "whole"))
    for joints, tip in ((("finger_a_joint",), "finger_a"), (("wrist",), "hand")):
        arm, _ = choose(file, "end", {"end": SrdfGroup(joints, tip)})
        assert (len(arm.joints), len(arm.fingers)) == (5, 2)
