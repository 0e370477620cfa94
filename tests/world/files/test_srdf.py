"""Tests pairs, states and groups of SRDF files, which mean what they mean to MoveIt."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from helpers.expected_errors import expect_error

from vkc_pin.world.files.srdf import Srdf, SrdfPlanarJoint, find_srdf, read_allowed_pairs, read_srdf


def make_urdf() -> ElementTree.Element:
    """Return base – lift – arm – fore – tool, and base – left – right beside it."""
    parents = {"lift": "base", "arm": "lift", "fore": "arm", "tool": "fore"}
    parents |= {"left": "base", "right": "left"}
    links = "".join(f'<link name="{name}"/>' for name in ("base", *parents))
    joints = "".join(
        f'<joint name="j_{child}" type="{"fixed" if child == "tool" else "revolute"}">'
        f'<parent link="{parent}"/><child link="{child}"/></joint>'
        for child, parent in parents.items()
    )
    return ElementTree.fromstring(f'<robot name="r">{links}{joints}</robot>')


def read_text(folder: Path, content: str) -> Srdf:
    (folder / "r.srdf").write_text(f'<robot name="r">\n{content}\n</robot>')
    return read_srdf(folder / "r.srdf", make_urdf())


def format_state(name: str, group: str = "all", **joints: str) -> str:
    values = "".join(
        f'<joint name="j_{joint}" value="{value}"/>' for joint, value in joints.items()
    )
    return f'<group_state name="{name}" group="{group}">{values}</group_state>'


def disable(one: str, other: str, reason: str = "") -> str:
    return f'<disable_collisions link1="{one}" link2="{other}" reason="{reason}"/>'


def test_pairs_are_sorted_and_keep_their_reason(tmp_path: Path) -> None:
    pairs = disable("tool", "arm", "Adjacent") + '<disable_collisions link1="arm" link2=" base "/>'
    assert read_text(tmp_path, pairs).allowed == {("arm", "tool"): "Adjacent", ("arm", "base"): ""}


DEFAULT = '<disable_default_collisions link="tool"/>'
OTHERS = {"base", "lift", "arm", "fore", "left", "right"}


@pytest.mark.parametrize(
    ("elements", "others"),
    [
        (DEFAULT, OTHERS),
        (DEFAULT + '<enable_collisions link1="tool" link2="base"/>', OTHERS - {"base"}),
        ('<enable_collisions link1="base" link2="tool"/>' + DEFAULT, OTHERS - {"base"}),
        (
            disable("base", "tool") + '<enable_collisions link1="tool" link2="base"/>' + DEFAULT,
            OTHERS,
        ),
        ('<enable_collisions link1="base" link2="tool"/>', set()),
        (DEFAULT * 2 + '<enable_collisions link1="tool" link2="gone"/>', OTHERS),
    ],
)
def test_pairs_of_a_link_are_allowed_by_default(
    tmp_path: Path, elements: str, others: set[str]
) -> None:
    """Allowing a pair counts most, then checking it, then the default of a link."""
    found = read_text(tmp_path, elements + disable("arm", "lift"))
    pairs = {frozenset(("tool", other)) for other in others} | {frozenset(("arm", "lift"))}
    assert set(map(frozenset, found.allowed)) == pairs
    assert all(one < other for one, other in found.allowed)


def test_defaults_concern_the_links_of_one_model(tmp_path: Path) -> None:
    file = tmp_path / "r.srdf"
    file.write_text(f"<robot>{DEFAULT}{disable('tool', 'cup')}{disable('plate', 'cup')}</robot>")
    found = read_allowed_pairs(file, [["tool", "arm"], ["cup", "table"]])
    assert found.allowed.keys() == {("arm", "tool"), ("cup", "tool")}
    assert found.unknown == {"plate": 1}


def test_stale_names_are_skipped_one_by_one(tmp_path: Path) -> None:
    srdf = read_text(
        tmp_path,
        disable("arm", "arm_sc")
        + disable("arm", "fore")
        + '<virtual_joint name="world" type="fixed" parent_frame="w" child_link="base"/>'
        + '<group name="main"><joint name="world"/><joint name="j_gone"/><joint name="j_arm"/>'
        + '<chain base_link="base" tip_link="hook"/><link name="flange"/></group>'
        + '<group name="half"><group name="main"/><group name="nowhere"/></group>'
        + '<group name="whole"><group name="half"/></group>'
        + '<group name="ring"><group name="ring"/><joint name="j_arm"/></group>'
        + format_state("up", arm="0.5", gone="1"),
    )
    assert srdf.allowed.keys() == {("arm", "fore")}
    assert srdf.groups.keys() == {"main"}
    assert srdf.groups["main"].joints == ("j_arm",)
    assert srdf.states[0].positions == {"j_arm": 0.5}
    text = "\n".join(srdf.notes)
    for name in ("arm_sc", "hook", "flange", "j_gone", "half", "whole", "ring"):
        assert name in text
    assert "world" not in text


def format_property(joint: str, name: str, value: str) -> str:
    return f'<joint_property joint_name="{joint}" property_name="{name}" value="{value}"/>'


PLANAR = '<virtual_joint name="drive" type="planar" parent_frame="odom" child_link="base"/>'


@pytest.mark.parametrize(
    ("elements", "expected"),
    [
        ("", None),
        ('<virtual_joint name="v" type="fixed" parent_frame="w" child_link="base"/>', None),
        (PLANAR, SrdfPlanarJoint("drive")),
        (
            PLANAR
            + format_property("drive", "angular_distance_weight", "1")
            + format_property("other", "motion_model", "holonomic")
            + format_property("drive", "motion_model", "diff_drive"),
            SrdfPlanarJoint("drive", "diff_drive"),
        ),
    ],
)
def test_planar_joint_is_the_base(
    tmp_path: Path, elements: str, expected: SrdfPlanarJoint | None
) -> None:
    assert read_text(tmp_path, elements).planar_joint == expected


def test_places_of_the_base_in_states_are_noted(tmp_path: Path) -> None:
    state = '<joint name="drive" value="1 2 0.5"/><joint name="j_arm" value="0.3"/>'
    home = f'<group_state name="home" group="all">{state}</group_state>'
    found = read_text(tmp_path, PLANAR + home)
    assert found.states[0].positions == {"j_arm": 0.3}
    assert found.notes == ("skipped places of the base in states: drive",)


def test_srdf_of_another_robot_is_an_error(tmp_path: Path) -> None:
    with expect_error("names no link of this robot"):
        read_text(tmp_path, disable("elbow", "wrist"))
    assert read_text(tmp_path, "").notes == ()


@pytest.mark.parametrize(
    ("content", "joints", "tip"),
    [
        ('<chain base_link="base" tip_link="fore"/>', {"lift", "arm", "fore"}, "fore"),
        ('<chain base_link="lift" tip_link="tool"/>', {"arm", "fore", "tool"}, "tool"),
        ('<link name="lift"/><link name="arm"/><link name="base"/>', {"lift", "arm"}, "arm"),
        ('<joint name="j_fore"/><joint name="j_lift"/>', {"lift", "fore"}, "fore"),
        ('<group name="part"/><link name="tool"/>', {"left", "tool"}, "tool"),
        ('<group name="outer"/>', {"left", "arm"}, "arm"),
        ('<chain base_link="right" tip_link="arm"/>', {"left", "right", "lift", "arm"}, "arm"),
        (
            '<joint name="j_lift"/><chain base_link="arm" tip_link="fore"/>',
            {"lift", "fore"},
            "fore",
        ),
    ],
)
def test_groups_consist_of_links_joints_chains_and_groups(
    tmp_path: Path, content: str, joints: set[str], tip: str
) -> None:
    """Groups may be defined after those that contain them."""
    found = read_text(
        tmp_path,
        f'<group name="g">{content}</group>'
        '<group name="outer"><group name="part"/><link name="arm"/></group>'
        '<group name="part"><joint name="j_left"/></group><group name="empty"/>',
    ).groups
    assert set(found["g"].joints) == {f"j_{joint}" for joint in joints}
    assert found["g"].tip == tip
    assert "empty" not in found


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (["up", "rest", "home"], "home"),
        (["up", "rest"], "rest"),
        (["down", "up"], "down"),
        (["up", "default", "rest"], "default"),
    ],
)
def test_home_states_are_preferred(tmp_path: Path, names: list[str], chosen: str) -> None:
    values = {name: float(number) for number, name in enumerate(names)}
    srdf = read_text(
        tmp_path,
        "".join(format_state(name, arm=str(value), lift="0") for name, value in values.items())
        + format_state("home", fore="1"),
    )
    assert srdf.find_home(["j_arm", "j_lift"])["j_arm"] == values[chosen]
    assert srdf.find_home(["j_arm", "j_right"]) == {}


def test_states_of_disjoint_groups_are_merged(tmp_path: Path) -> None:
    """Joints with several coordinates, and values that are no numbers, are skipped."""
    srdf = read_text(
        tmp_path,
        format_state("home", "a", arm="0.5")
        + format_state("up", "a", arm="-1e-1", fore="1 0 0")
        + format_state("odd", "a", arm="nan", lift="inf")
        + format_state("home", "b", lift="2"),
    )
    both = ["j_arm", "j_lift"]
    assert srdf.find_states(both) == {"home": {"j_arm": 0.5, "j_lift": 2.0}}
    assert srdf.find_states(["j_arm"]) == {"home": {"j_arm": 0.5}, "up": {"j_arm": -0.1}}


TORSO = format_state("home", "arm_torso", lift="0.3", arm="1.2", fore="-1")
ARM = format_state("home", "arm", arm="-0.4", fore="1.5")
HEAD = format_state("home", "head", left="0.7", arm="9")
ALL = ["j_lift", "j_arm", "j_fore"]


@pytest.mark.parametrize("states", [TORSO + ARM, ARM + TORSO, HEAD + ARM + TORSO])
@pytest.mark.parametrize(
    ("joints", "group", "expected"),
    [
        (ALL, "arm_torso", [0.3, 1.2, -1.0]),
        (ALL, None, [0.3, 1.2, -1.0]),  # the only one that states all of them
        (ALL[1:], "arm", [-0.4, 1.5]),
        (ALL[1:], None, [-0.4, 1.5]),  # the shortest one
        (ALL, "arm", [None, -0.4, 1.5]),  # nobody states the lift together with it
        ([*ALL, "j_right"], None, [None] * 4),
    ],
)
def test_no_state_is_mixed_of_contradictory_ones(
    tmp_path: Path, states: str, joints: list[str], group: str | None, expected: list[float | None]
) -> None:
    found = read_text(tmp_path, states).find_home(joints, group)
    assert [found.get(joint) for joint in joints] == expected


def test_states_of_the_planned_group_come_before_others_named_home(tmp_path: Path) -> None:
    states = format_state("ready", "arm", arm="0.1", fore="0.2") + TORSO
    assert read_text(tmp_path, states).find_home(ALL[1:], "arm") == {"j_arm": 0.1, "j_fore": 0.2}
    assert read_text(tmp_path, states).find_home(ALL[1:]) == {"j_arm": 1.2, "j_fore": -1.0}


@pytest.mark.parametrize("place", ["my.srdf", "../srdf/my.srdf", "my_robot.srdf"])
def test_srdf_is_found_beside_the_file(tmp_path: Path, place: str) -> None:
    folder = tmp_path / "urdf"
    (tmp_path / "srdf").mkdir()
    folder.mkdir()
    assert find_srdf(folder / "my_robot.urdf") is None
    (folder / place).write_text("<robot/>")
    found = find_srdf(folder / "my_robot.urdf")
    assert found is not None
    assert found.samefile(folder / place)
