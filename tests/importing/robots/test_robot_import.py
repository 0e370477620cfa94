from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from helpers.arm_urdf import HEIGHT, set_limits, write_arms
from helpers.robots import compute_placement
from helpers.telescopes import FOLLOWERS, format_joint, write_telescope
from helpers.texts import format_box, format_fixed_link, replace_in_file

import vkc_pin as vkc
from vkc_pin.importing.robots.rest_configuration import HOME_ROOM, Clearances

SAMPLES = 150
HAND = ("hand", "finger_a", "finger_b")


def import_arm(
    folder: Path, *changes: tuple[str, str], samples: int = SAMPLES
) -> vkc.importing.ImportedRobot:
    """Import an arm with changes to its file."""
    file = replace_in_file(write_arms(folder / "given"), *changes)
    return vkc.importing.import_robot(file, folder / "mine", samples=samples)


def add_elements(*elements: str) -> tuple[str, str]:
    return "</robot>", "".join((*elements, "</robot>"))


@pytest.mark.parametrize(
    ("model", "base"),
    [(None, "omni"), ("diff_drive", "differential"), ("tracked", "omni")],
)
def test_base_and_home_are_those_of_the_srdf(tmp_path: Path, model: str | None, base: str) -> None:
    file = write_arms(tmp_path / "given")
    positions = {f"arm_{k}_joint": value for k, value in enumerate((0.1, 0.2, 0.3, 0.4, 0.5), 1)}
    joints = [f'<joint name="{name}" value="{value}"/>' for name, value in positions.items()]
    property_text = ""
    if model is not None:
        names = 'joint_name="drive" property_name="motion_model"'
        property_text = f'<joint_property {names} value="{model}"/>'
    file.with_suffix(".srdf").write_text(
        '<robot name="robot">'
        '<virtual_joint name="drive" type="planar" parent_frame="odom" child_link="body"/>'
        f'{property_text}<group name="all"><joint name="drive"/><joint name="arm_1_joint"/></group>'
        f'<group_state name="home" group="all">{"".join(joints)}</group_state></robot>'
    )
    made = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    scene = vkc.load_scene(made.folder / "scene.yaml")
    assert scene.robot.base == base
    assert dict(zip(made.robot.coordinates.names[3:], made.robot.home, strict=True)) == (
        pytest.approx(positions)
    )
    report = str(made.diagnosis)
    assert f"base: {base} (planar joint drive of the SRDF" in report
    assert ("with an unknown motion model 'tracked') [guess]" in report) == (model == "tracked")


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> vkc.importing.ImportedRobot:
    """Import a robot with two arms on a mobile base, an open bin 0.35 m above the floor."""
    folder = tmp_path_factory.mktemp("imported")
    walls = [
        trimesh.creation.box(size).apply_translation((x, 0, z))
        for size, x, z in (
            ((0.5, 0.4, 0.05), 0, -0.325),
            ((0.02, 0.4, 0.4), -0.24, -0.099),
            ((0.02, 0.4, 0.4), 0.24, -0.099),
        )
    ]
    (folder / "given").mkdir()
    trimesh.util.concatenate(walls).export(folder / "given" / "bin.stl")
    file = write_arms(folder / "given", sides=("left_", "right_"), own_base=True, mesh="bin.stl")
    return vkc.importing.import_robot(file, folder / "mine", arm="right", samples=SAMPLES)


def test_folder_and_report_describe_the_robot(imported: vkc.importing.ImportedRobot) -> None:
    names = {path.name for path in imported.folder.iterdir()}
    written = {f"robot.{kind}" for kind in ("yaml", "png")} | {"scene.yaml", ".vkc-pin.json"}
    assert names == {*written, "mine.urdf", "mine.srdf", "collision"}
    loaded = vkc.load_robot(imported.folder)
    assert loaded.name == "mine"
    assert loaded.coordinates.names[3:] == tuple(f"right_arm_{k}_joint" for k in range(1, 6))
    assert loaded.tool_frame == "tool"
    assert set(loaded.touch_links) == {f"right_{name}" for name in ("arm_5", *HAND)}
    np.testing.assert_array_equal(loaded.home, imported.robot.home)
    gripper = loaded.gripper
    assert gripper is not None
    assert gripper.names == ("right_finger_a_joint", "right_finger_b_joint")
    assert (gripper.min_opening, gripper.max_opening) == (0.0, pytest.approx(0.08, abs=2e-4))
    stated = yaml.safe_load((imported.folder / "robot.yaml").read_text(encoding="utf-8"))
    assert not set(stated["locked_joints"]) & set(stated["gripper"])
    assert imported.arms == ("right", "left")
    for part in (
        "drive_x, drive_y, drive_yaw are locked",
        "arm: right, 5 joints",
        "open from 0 to 80 mm",
        "bin.stl in 3 pieces",
    ):
        assert part in str(imported)
    assert imported.diagnosis.healthy


def test_base_is_hollow_and_rests_on_the_floor(imported: vkc.importing.ImportedRobot) -> None:
    (piece,) = imported.pieces
    assert piece.count == 3
    assert piece.overhead < 0.05
    assert piece.hull > 1.0
    assert len(list((imported.folder / "collision").iterdir())) == 3
    clearances = Clearances(imported.robot)
    clearances.place(imported.robot.home)
    assert clearances.floor(moved=False)[0][1] == pytest.approx(0.0, abs=1e-5)
    assert clearances.least() >= HOME_ROOM
    robot = imported.robot.model
    height = robot.frames[robot.getFrameId("body")].placement.translation[2]
    assert height == pytest.approx(HEIGHT, abs=1e-5)


def test_gripper_that_does_not_open_is_locked(tmp_path: Path) -> None:
    """A bar across the fingertips leaves no room between the fingers at any position."""
    bar = format_fixed_link("bar", "hand", "0 0 0.1", format_box("0.02 0.02 0.09"))
    imported = import_arm(tmp_path, add_elements(bar))
    text = (imported.folder / "robot.yaml").read_text(encoding="utf-8")
    assert imported.robot.gripper is None
    assert "gripper" not in text
    assert "finger_a_joint: 0.04" in text
    assert "the fingers are locked: the gripper does not open" in str(imported)


def test_reachable_poses_are_planned(imported: vkc.importing.ImportedRobot) -> None:
    scene = vkc.load_scene(imported.folder / "scene.yaml")
    robot, rng, clearances = scene.robot, np.random.default_rng(4), Clearances(scene.robot)
    clearances.place(arm := rng.uniform(robot.lower[3:], robot.upper[3:]))
    while clearances.least() <= HOME_ROOM:
        clearances.place(arm := rng.uniform(robot.lower[3:], robot.upper[3:]))
    pose = compute_placement(robot, robot.tool_frame, np.array([1.0, 0.5, 2.0, *arm]))
    plan = vkc.plan(scene, [vkc.Reach(pose)])
    assert plan.success, plan.summary()


def test_links_that_overlap_at_zero_are_separated_at_home(tmp_path: Path) -> None:
    bends = [
        (f'{joint}"><origin xyz="0 0 0.2"/>', f'{joint}"><origin xyz="0 0 0.2" rpy="0 1.9 0"/>')
        for joint in ('arm_2_joint" type="revolute', 'arm_3_joint" type="revolute')
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # warnings about overlapping links or missing folders
        imported = import_arm(tmp_path, *bends)
    plain = Clearances(vkc.load_robot(tmp_path / "given" / "robot.urdf", pairs="all"))
    plain.place(np.zeros(5))
    overlaps = {tuple(sorted(pair[:2])) for pair in plain.links(0.0)}
    assert ("arm_4", "body") in overlaps, "precondition of the test"
    clearances = Clearances(imported.robot)
    clearances.place(imported.robot.home)
    assert clearances.least() >= HOME_ROOM
    checked_pairs = {tuple(sorted(map(imported.robot.link_of, pair))) for pair in clearances.pairs}
    assert ("arm_4", "body") in checked_pairs


def test_folder_is_replaced_only_with_force_and_kept_on_failure(tmp_path: Path) -> None:
    file, target = write_arms(tmp_path / "given"), tmp_path / "mine"
    vkc.importing.import_robot(file, target, samples=20)
    with pytest.raises(vkc.InputError, match="--force"):
        vkc.importing.import_robot(file, target)
    urdf = target / "mine.urdf"
    urdf.write_text("changed by hand", encoding="utf-8")
    with pytest.raises(vkc.UnknownNameError, match=r"given/robot\.urdf: tool_frame: .*'hand'"):
        vkc.importing.import_robot(file, target, tool_frame="hnd", force=True)
    with pytest.raises(vkc.UnknownNameError):
        vkc.importing.import_robot(file, target, arm="third", force=True)
    assert urdf.read_text(encoding="utf-8") == "changed by hand"
    vkc.importing.import_robot(file, target, samples=20, force=True)
    assert urdf.read_text(encoding="utf-8") != "changed by hand"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["given", "mine"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<world/>", r"expected a URDF or xacro \(<robot>\), MJCF .* or SDF .*, got <world>"),
        ("<robot name='x'><link name='a'/></robot>", "the robot has no shapes"),
        ("not xml", "the file is not XML"),
    ],
)
def test_errors_name_the_problem_of_an_invalid_robot(
    tmp_path: Path, text: str, message: str
) -> None:
    file = tmp_path / "wrong.urdf"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(vkc.InputError, match=message):
        vkc.importing.import_robot(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_telescope_is_proposed_as_one_coordinate(tmp_path: Path) -> None:
    """No coupling is proposed if the file states the mimic joints."""
    for mimics, is_proposed in (("", True), ("chain", False)):
        given = write_telescope(tmp_path / f"given{mimics}", couplings="", mimics=mimics)
        file = given.with_name("robot.urdf")
        imported = vkc.importing.import_robot(file, tmp_path / f"mine{mimics}", samples=SAMPLES)
        names = imported.robot.coordinates.names[3:]
        assert names == ("lift", "out_1", "yaw_joint", "pitch_joint", "roll_joint")
        document = yaml.safe_load((imported.folder / "robot.yaml").read_text())
        assert document.get("couplings", {}) == (FOLLOWERS if is_proposed else {})
        assert ("out_2, out_3, out_4 follow out_1 as a telescope" in str(imported)) == is_proposed
        assert set(document["home"]) == {*names}


@pytest.mark.parametrize(
    ("first", "links"), [("body", "all links"), ("arm_5", "arm_5, hand, finger_a, finger_b")]
)
def test_visual_shapes_replace_missing_collision_shapes(
    tmp_path: Path, first: str, links: str
) -> None:
    """Only the links before `first` have collision shapes."""
    text = write_arms(tmp_path / "given").read_text(encoding="utf-8")
    tail = text[text.index(f'<link name="{first}"') :]
    imported = import_arm(tmp_path, (tail, tail.replace("collision>", "visual>")))
    assert f"visual shapes are used for want of collision shapes: {links} [guess]" in str(imported)
    assert "which open from 0 to 80 mm" in str(imported)
    assert set(HAND) <= set(imported.robot.touch_links)


@pytest.mark.parametrize(
    "solid",
    [("arm_5",), ("hand",), ("body",), ("arm_3", "arm_4"), ("finger_a", "finger_b"), ("arm_2",)],
)
def test_parts_of_an_arm_without_collision_shapes_use_their_visual_ones(
    tmp_path: Path, solid: tuple[str, ...]
) -> None:
    """Only some links have collision shapes; a rigid body with one on any of its links has its."""
    file = write_arms(tmp_path / "given")
    text = file.read_text(encoding="utf-8")
    links = ["body", *(f"arm_{k}" for k in range(1, 6)), *HAND]
    for link in (name for name in links if name not in solid):
        begin = text.index(f'<link name="{link}">')
        end = text.index("</link>", begin)
        text = text[:begin] + text[begin:end].replace("collision>", "visual>") + text[end:]
    file.write_text(text, encoding="utf-8")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=60)
    bodies = [{"arm_5", "hand"}, *({link} for link in links if link not in ("arm_5", "hand"))]
    expected = {link for body in bodies for link in (body & set(solid) or body)}
    assert set(imported.robot.links) == expected
    used = ", ".join(link for link in links if link in expected and link not in solid)
    assert f"visual shapes are used for want of collision shapes: {used} [guess]" in str(imported)


def test_arm_whose_links_cannot_collide_is_imported(tmp_path: Path) -> None:
    """Joints about the vertical move links of different heights."""
    links = "".join(
        f'<link name="arm_{k}">{format_box("0.05 0.05 0.05", "0.3 0 0")}</link>' for k in range(5)
    )
    joints = "".join(
        format_joint(f"j{k}", "revolute", f"arm_{k}", f"arm_{k + 1}", "0.3 0 0.3") for k in range(4)
    )
    file = tmp_path / "tower.urdf"
    file.write_text(f'<robot name="tower">{links}{joints}</robot>', encoding="utf-8")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=60)
    assert not len(imported.robot.collision.collisionPairs)
    assert "0 pairs of links are checked" in str(imported)


def test_arm_with_the_shape_of_its_last_link_alone_is_imported(tmp_path: Path) -> None:
    text = write_arms(tmp_path / "given").read_text(encoding="utf-8")
    head, last, tail = text.partition('<link name="arm_5">')
    tail = tail[: tail.index('<link name="hand">')] + "</robot>"
    head = re.sub("<collision>.*?</collision>", "", head)
    imported = import_arm(tmp_path, (text, head + last + tail))
    assert imported.robot.links == ("arm_5",)
    assert len(imported.robot.home) == 5


STUCK = ("the gripper does not move: its fingers stay", False)


@pytest.mark.parametrize(
    ("finger", "limits", "expected", "healthy"),
    [
        ("revolute", (0.0, 0.0), "a_joint 0 to 0, right_finger_b_joint 0 to 0", False),
        ("prismatic", (0.0, 0.0), *STUCK),
        pytest.param("prismatic", (0.0, 0.001), *STUCK, marks=pytest.mark.long),
        pytest.param("continuous", (0.0, 0.0), *STUCK, marks=pytest.mark.long),
        ("prismatic", (0.03, 0.03), "its fingers stay 60 mm apart; limits in the file", True),
        ("prismatic", (0.0, 0.04), "which open from 0 to 80 mm", True),
        ("fixed", (0.0, 0.0), "'mine' has no fingers: it can reach", True),
    ],
)
def test_opening_of_the_hand_is_diagnosed(
    tmp_path: Path, finger: str, limits: tuple[float, float], expected: str, healthy: bool
) -> None:
    low, high = limits
    changes = [('lower="0.0" upper="0.04"', f'lower="{low}" upper="{high}"')]
    changes += [('"prismatic"', f'"{finger}"')]
    file = write_arms(tmp_path, sides=("right_",))
    if finger == "fixed":
        text = file.read_text(encoding="utf-8")
        changes = [(text[text.index('<link name="right_hand">') :], "</robot>")]
    replace_in_file(file, *changes)
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=30)
    assert expected in str(imported)
    assert ".vkc-pin-" not in str(imported)
    assert imported.diagnosis.healthy is healthy


def test_column_of_a_lift_may_sink_into_the_floor(tmp_path: Path) -> None:
    foot = f'<link name="foot">{format_box("0.4 0.4 0.1", "0 0 0.05")}</link>'
    lift = format_joint("lift", "prismatic", "foot", "body", limits=(0.0, 1.0))
    column = [("0 0 -0.1", "0 0 -0.5"), ("0.5 0.4 0.5", "0.1 0.1 1.0")]
    imported = import_arm(tmp_path, *column, add_elements(foot, lift))
    assert "the lift sinks body into the floor" in str(imported)
    assert "body" not in imported.robot.links
    assert imported.diagnosis.healthy
    assert "level ones at 0.1 to 1.9 m" in str(imported)


POST = format_fixed_link("post", "body", "0.6 0 0.1", format_box("0.1 0.1 0.9"))


@pytest.mark.parametrize(("first", "second"), [("a", "b"), ("b", "a")])
@pytest.mark.parametrize(
    ("fixed", "limits", "elements", "part", "is_reported"),
    [
        # The hand's y axis never turns upside down.
        ((3, 4), {2: (0, 2), 5: (0, 2)}, POST, "thick: upright ones at", True),
        # The wrist rolls by slightly more than half a turn.
        ((5,), {2: (0, 2), 3: (0, 2), 4: (-2.3, 1.6)}, "", "turn door levers", False),
    ],
    ids=["without roll", "with roll"],
)
def test_closing_direction_suits_the_wrist(
    tmp_path: Path,
    fixed: tuple[int, ...],
    limits: dict[int, tuple[float, float]],
    elements: str,
    part: str,
    is_reported: bool,
    first: str,
    second: str,
) -> None:
    """The arm pitches forwards only."""
    text = write_arms(tmp_path / "given").read_text(encoding="utf-8")
    limited = text
    for joint, ends in limits.items():
        limited = set_limits(limited, f"arm_{joint}_joint", *ends)
    imported = import_arm(
        tmp_path,
        (text, limited),
        ("finger_a", f"finger_{first}_"),
        ("finger_b", f"finger_{second}_"),
        *((f'arm_{k}_joint" type="revolute', f'arm_{k}_joint" type="fixed') for k in fixed),
        add_elements(elements),
    )
    assert (part in str(imported)) == is_reported
