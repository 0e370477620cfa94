from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from helpers.arm_urdf import HEIGHT, set_limits, write_arms
from helpers.texts import format_box, format_fixed_link, replace_in_file

import vkc_pin as vkc
from vkc_pin.importing.robots.doctor import Diagnosis
from vkc_pin.importing.robots.hand_checks import find_envelopes


def find_texts(diagnosis: Diagnosis, level: str, topic: str) -> list[str]:
    found = diagnosis.findings
    return [each.text for each in found if (each.level, each.topic) == (level, topic)]


def test_included_robot_is_healthy() -> None:
    found = vkc.importing.doctor("husky_ur5e", samples=40)
    assert found.healthy
    assert find_texts(found, "note", "home")[0].startswith("free")


def test_home_in_collision_and_below_the_floor_is_reported(tmp_path: Path) -> None:
    file = write_arms(tmp_path / "robot")
    home = {"arm_2_joint": 1.9, "arm_3_joint": 1.9}
    file.with_suffix(".yaml").write_text(json.dumps({"urdf": file.name, "home": home}))
    found = vkc.importing.doctor(tmp_path / "robot", samples=20)
    assert not found.healthy
    assert "below the floor" in " ".join(find_texts(found, "fault", "home"))
    loading = " ".join(find_texts(found, "warning", "loading"))
    assert "links that overlap at home are not checked" in loading
    assert str(found).startswith("robot: ")
    assert "fault" in str(found).splitlines()[1]


def test_inseparable_pairs_are_reported(tmp_path: Path) -> None:
    """The first link turns about the vertical, 30 mm above the body."""
    robot = vkc.load_robot(write_arms(tmp_path), pairs="all")
    found, small_margin = (
        find_texts(vkc.importing.doctor(robot, samples=60, margin=margin), "fault", "pairs")
        for margin in (0.035, 1e-3)
    )
    assert any("body and arm_1 were never more than 30.0 mm" in text for text in found)
    assert len(small_margin) < len(found)


def test_missing_limits_and_masses_are_reported(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    replace_in_file(path, ('effort="10" velocity="1.5"', 'effort="0" velocity="0"'), count=3)
    found = vkc.importing.doctor(path, samples=5)
    (limits,) = find_texts(found, "warning", "limits")
    assert "arm_1_joint, arm_2_joint, arm_3_joint (assumed: 3.14 rad/s)" in limits
    efforts = find_texts(found, "note", "effort")[0]
    assert "arm_1_joint" in efforts
    assert "arm_4_joint" not in efforts
    assert "body" in find_texts(found, "note", "mass")[0]
    hints = " ".join(finding.hint for finding in found.findings)
    assert re.findall(r"joints: \{NAME: \{(\w+):", hints) == ["velocity", "effort"]
    stated = {"urdf": path.name, "joints": {"arm_1_joint": {"velocity": 2.0, "effort": 30.0}}}
    path.with_suffix(".yaml").write_text(json.dumps(stated))
    found = vkc.importing.doctor(tmp_path, samples=5)
    limits = "no velocity limit in the file: arm_2_joint, arm_3_joint (assumed: 3.14 rad/s)"
    assert find_texts(found, "warning", "limits") == [limits]
    assert "arm_1_joint" not in find_texts(found, "note", "effort")[0]


def test_hand_in_front_of_its_tool_frame_is_reported(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    assert find_texts(vkc.importing.doctor(path, samples=5), "limitation", "hand") == [
        "no link may touch what is grasped: it can reach poses, but not grasp objects"
    ]
    add_elements(path, format_fixed_link("back", "hand", "0 0 -0.1"))
    settings = {"urdf": path.name, "tool_frame": "back", "touch_links": ["hand", "finger_a"]}
    path.with_suffix(".yaml").write_text(json.dumps(settings))
    faults = find_texts(vkc.importing.doctor(tmp_path, samples=5), "fault", "hand")
    assert "in front of its tool frame back" in faults[0]


def add_elements(path: Path, *elements: str) -> None:
    replace_in_file(path, ("</robot>", "".join((*elements, "</robot>"))))


def write_robot(folder: Path, **settings: object) -> Path:
    path = write_arms(folder)
    add_elements(path, format_fixed_link("tool", "hand", "0 0 0.125", rpy="0 0 1.57079633"))
    document: dict[str, object] = {"urdf": path.name, "tool_frame": "tool"}
    document["locked_joints"] = {"finger_a_joint": 0.03, "finger_b_joint": 0.03}
    document["base"] = {"height": HEIGHT}
    document["touch_links"] = ["arm_5", "hand", "finger_a", "finger_b"]
    path.with_suffix(".yaml").write_text(json.dumps(document | settings))
    return folder


def find_limitations(robot: Path) -> list[str]:
    """Return what the hand of a robot cannot do."""
    return find_texts(vkc.importing.doctor(robot, samples=5), "limitation", "hand")


def test_doctor_reports_a_closed_hand(tmp_path: Path) -> None:
    for position, is_reported in ((0.0, True), (0.03, False)):
        locked = {"finger_a_joint": position, "finger_b_joint": position}
        robot = write_robot(tmp_path, touch_links=["finger_a", "finger_b"], locked_joints=locked)
        faults = find_texts(vkc.importing.doctor(robot, samples=5), "fault", "hand")
        assert any("no room" in text for text in faults) == is_reported


OPEN = {"finger_a_joint": 0.03, "finger_b_joint": 0.03}


@pytest.mark.parametrize(
    ("settings", "limitation", "note"),
    [
        ({}, "", "up to 50 mm thick: level ones at 0.3 to 1."),
        # An arm that stands upright, with a wrist that pitches but does not roll.
        (
            {"locked_joints": OPEN | dict.fromkeys(("arm_2_joint", "arm_3_joint"), 0.0)},
            "cannot grasp level bars",
            "thick: upright ones at 1.",
        ),
        (
            {"base": {"height": -0.1}},
            "cannot turn door levers, 1 m high",
            "level ones at 0.1 to",
        ),
        (
            {"locked_joints": dict.fromkeys(OPEN, 0.01)},
            "cannot grasp bars more than 10 mm thick",
            "up to 10 mm thick",
        ),
        ({"touch_links": ["arm_5"]}, "has no fingers: it can reach poses", ""),
    ],
)
def test_doctor_reports_the_bars_that_a_hand_can_grasp(
    tmp_path: Path, settings: dict[str, object], limitation: str, note: str
) -> None:
    found = vkc.importing.doctor(write_robot(tmp_path, **settings), samples=5)
    limitations = find_texts(found, "limitation", "hand")
    assert len(limitations) == bool(limitation)
    assert limitation in " ".join(limitations)
    assert note in " ".join(find_texts(found, "note", "hand"))
    assert f"{bool(limitation):d} limitation" in str(found).splitlines()[0]


def test_doctor_proposes_a_height_that_suits_common_tasks(tmp_path: Path) -> None:
    robot = write_robot(tmp_path, base={"height": -0.3})
    found = vkc.importing.doctor(robot, samples=5)
    (hint,) = [finding.hint for finding in found.findings if finding.level == "limitation"]
    assert hint.startswith("mounted 0.7 m higher, it can: `base: {height: 0.4}`")
    write_robot(tmp_path, base={"height": 0.4})
    assert not find_limitations(robot)


@pytest.mark.parametrize(("gap", "is_obstructed"), [(0.01, True), (0.03, False)])
def test_doctor_applies_the_clearances_of_plans(
    tmp_path: Path, gap: float, is_obstructed: bool
) -> None:
    """The hand rolls by 90° for level bars, and moves a camera close to fins beside it."""
    locked = OPEN | {"arm_5_joint": 0.0}
    robot = write_robot(tmp_path, locked_joints=locked, srdf="all_pairs.srdf")
    (tmp_path / "all_pairs.srdf").write_text('<robot name="robot"/>')
    cube = format_box("0.04 0.04 0.04")
    add_elements(
        tmp_path / "robot.urdf",
        format_fixed_link("left_fin", "arm_3", "0 0.1 0.15", cube),
        format_fixed_link("right_fin", "arm_3", "0 -0.1 0.15", cube),
        format_fixed_link("camera", "arm_4", f"0.1 0 {gap - 0.01}", cube),
    )
    found = any("cannot grasp level bars" in text for text in find_limitations(robot))
    assert found == is_obstructed


@pytest.mark.parametrize(("range_", "side"), [((0.0, 2.0), "right"), ((-2.0, 0.0), "left")])
def test_doctor_reports_a_wrist_that_cannot_turn_a_lever(
    tmp_path: Path, range_: tuple[float, float], side: str
) -> None:
    """From the pose that grasps level bars, the hand rolls in one direction only."""
    robot = write_robot(tmp_path, locked_joints=OPEN | {"arm_5_joint": 0.0})
    path = tmp_path / "robot.urdf"
    path.write_text(set_limits(path.read_text(encoding="utf-8"), "arm_4_joint", *range_))
    text = " ".join(find_limitations(robot))
    assert f"turn door levers with the free end on the {side}" in text


def test_errors_name_the_invalid_argument() -> None:
    for call, arguments, field in (
        (vkc.importing.doctor, {"margin": -1.0}, "margin"),
        (vkc.importing.doctor, {"samples": 0}, "samples"),
        (vkc.importing.doctor, {"samples": 10**6 + 1}, "samples"),
        (vkc.importing.import_robot, {"samples": 0}, "samples"),
        (vkc.importing.import_robot, {"samples": 10**6 + 1}, "samples"),
    ):
        with pytest.raises(vkc.InputError) as caught:
            call("husky_ur5e", **arguments)
        assert caught.value.field == field
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'husky_ur5e'"):
        vkc.importing.doctor("husky_ur5")


SIZE, LIMITS = '<box size="0.5 0.4 0.5"/>', 'lower="-2" upper="2"'


@pytest.mark.parametrize(
    ("old", "new", "level", "part"),
    [
        (SIZE, '<box size="50 40 50"/>', "fault", "body is 50 m long"),
        (SIZE, '<sphere radius="250"/>', "fault", "body is 500 m long"),
        (SIZE, '<cylinder radius="0.1" length="20"/>', "fault", "body is 20 m long"),
        (LIMITS, 'lower="-180" upper="180"', "warning", "moves from -180 to 180 rad"),
        (LIMITS, 'lower="-6.3" upper="6.3"', "", ""),
        (LIMITS, 'lower="-100000" upper="100000"', "", ""),
        (SIZE, '<box size="3 2 1"/>', "", ""),
    ],
)
def test_wrong_units_are_recognized(
    tmp_path: Path, old: str, new: str, level: str, part: str
) -> None:
    path = replace_in_file(write_arms(tmp_path), (old, new))
    found = vkc.importing.doctor(vkc.load_robot(path, pairs="all"), samples=1)
    texts = {each: find_texts(found, each, "units") for each in ("fault", "warning")}
    if not level:
        assert texts == {"fault": [], "warning": []}
    else:
        assert part in texts[level][0]


def test_robot_in_kilometres_is_too_small(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    text = re.sub(
        r'(size|origin xyz)="(.*?)"',
        lambda match: f'{match[1]}="{" ".join(f"{float(x):g}e-3" for x in match[2].split())}"',
        path.read_text(encoding="utf-8"),
    )
    path.write_text(text, encoding="utf-8")
    found = vkc.importing.doctor(vkc.load_robot(path, pairs="all"), samples=1)
    assert "body, is only 0.5 mm long" in find_texts(found, "fault", "units")[0]


def test_lift_without_velocity_limit_is_assumed_to_be_slow(tmp_path: Path) -> None:
    path = replace_in_file(
        write_arms(tmp_path),
        (' velocity="1.5"', ' velocity="0"'),
        ('name="arm_1_joint" type="revolute"', 'name="arm_1_joint" type="prismatic"'),
    )
    robot = vkc.load_robot(path)
    assert robot.velocity[3:].tolist() == pytest.approx([0.1, *[3.14159265] * 4])
    text = " ".join(find_texts(vkc.importing.doctor(robot, samples=1), "warning", "limits"))
    assert "arm_1_joint (assumed: 0.1 m/s); arm_2_joint, arm_3_joint" in text


def write_caged_arm(folder: Path, *, size: str = "0.3 0.3 0.3", visual: bool = False) -> Path:
    """Write an arm whose hand is enclosed in a box, which has no visual shape by default."""
    cage = format_box(size) + (format_box(size, kind="visual") if visual else "")
    hand = '<link name="hand">'
    visible = hand + format_box("0.05 0.14 0.06", kind="visual")
    path = replace_in_file(write_arms(folder), (hand, visible))
    add_elements(path, format_fixed_link("cage", "hand", "0 0 0.1", cage))
    return path


def test_small_and_visible_shapes_are_not_envelopes(tmp_path: Path) -> None:
    small = write_caged_arm(tmp_path / "small", size="0.02 0.02 0.02")
    for file in (small, write_caged_arm(tmp_path / "visible", visual=True)):
        assert find_envelopes(vkc.load_robot(file, pairs="all", tool_frame="hand")) == {}


def test_import_removes_envelopes_and_doctor_reports_them(tmp_path: Path) -> None:
    file = write_caged_arm(tmp_path / "given")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=50)
    assert "cage" not in imported.robot.links
    assert "cage" not in imported.robot.touch_links
    assert {"hand", "finger_a", "finger_b"} <= set(imported.robot.touch_links)
    assert "cage encloses" in str(imported)
    found = vkc.importing.doctor(vkc.load_robot(file, tool_frame="hand"), samples=5)
    assert "cage encloses" in str(found)
    assert "cage" not in str(vkc.importing.doctor(imported.robot, samples=5))
