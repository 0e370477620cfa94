from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml
from helpers.arm_urdf import HEIGHT, set_limits, write_arms
from helpers.telescopes import FOLLOWERS, write_telescope

import vkc_pin as vkc
from vkc_pin.importing.robots.rest_configuration import HOME_ROOM, Clearances
from vkc_pin.world.files.writing import write_atomically

SAMPLES = 150


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> vkc.importing.ImportedRobot:
    """Import a robot with two arms on a mobile base, an open bin 0.35 m above the floor."""
    folder = tmp_path_factory.mktemp("imported")
    walls = [trimesh.creation.box((0.5, 0.4, 0.05)).apply_translation((0, 0, -0.325))]
    walls += [
        trimesh.creation.box((0.02, 0.4, 0.4)).apply_translation((x, 0, -0.099))
        for x in (-0.24, 0.24)
    ]
    write_atomically(
        folder / "given" / "bin.stl", trimesh.util.concatenate(walls).export(file_type="stl")
    )
    file = write_arms(folder / "given", sides=("left_", "right_"), own_base=True, mesh="bin.stl")
    return vkc.importing.import_robot(file, folder / "mine", arm="right", samples=SAMPLES)


def test_folder_describes_the_robot(imported: vkc.importing.ImportedRobot) -> None:
    names = {path.name for path in imported.folder.iterdir()}
    assert names == {
        ".vkc-pin.json",
        "robot.yaml",
        "robot.png",
        "scene.yaml",
        "mine.urdf",
        "mine.srdf",
        "collision",
    }
    loaded = vkc.load_robot(imported.folder)
    assert loaded.name == "mine"
    assert loaded.coordinates.names[3:] == tuple(f"right_arm_{k}_joint" for k in range(1, 6))
    assert loaded.tool_frame == "tool"
    touching = ("arm_5", "hand", "finger_a", "finger_b")
    assert set(loaded.touch_links) == {f"right_{name}" for name in touching}
    np.testing.assert_array_equal(loaded.home, imported.robot.home)
    gripper = loaded.gripper
    assert gripper is not None
    assert gripper.names == ("right_finger_a_joint", "right_finger_b_joint")
    assert (gripper.min_opening, gripper.max_opening) == (0.0, pytest.approx(0.08, abs=2e-4))
    stated = yaml.safe_load((imported.folder / "robot.yaml").read_text(encoding="utf-8"))
    assert not set(stated["locked_joints"]) & set(stated["gripper"])


def test_report_lists_guesses(imported: vkc.importing.ImportedRobot) -> None:
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
    assert robot.frames[robot.getFrameId("body")].placement.translation[2] == pytest.approx(
        HEIGHT, abs=1e-5
    )


def test_gripper_that_does_not_open_is_locked(tmp_path: Path) -> None:
    """A bar across the fingertips leaves no room between the fingers at any position."""
    file = write_arms(tmp_path / "given")
    shape = '<collision><geometry><box size="0.02 0.02 0.09"/></geometry></collision>'
    bar = f'<link name="bar">{shape}</link><joint name="bar_joint" type="fixed">'
    joint = '<parent link="hand"/><child link="bar"/><origin xyz="0 0 0.1"/></joint>'
    file.write_text(
        file.read_text(encoding="utf-8").replace("</robot>", bar + joint + "</robot>"),
        encoding="utf-8",
    )
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    text = (imported.folder / "robot.yaml").read_text(encoding="utf-8")
    assert imported.robot.gripper is None
    assert "gripper" not in text
    assert "finger_a_joint: 0.04" in text
    assert "the fingers are locked: the gripper does not open" in str(imported)


def test_reachable_poses_are_planned(imported: vkc.importing.ImportedRobot, tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        f"robot: {imported.folder / 'robot.yaml'}\nstart: {{base: [0, 0, 0]}}\n", encoding="utf-8"
    )
    loaded = vkc.load_scene(scene)
    robot, rng = loaded.robot, np.random.default_rng(4)
    clearances, data, frame = (
        Clearances(robot),
        robot.model.createData(),
        robot.model.getFrameId(robot.tool_frame),
    )
    arm = rng.uniform(robot.lower[3:], robot.upper[3:])
    clearances.place(arm)
    while clearances.least() <= HOME_ROOM:
        arm = rng.uniform(robot.lower[3:], robot.upper[3:])
        clearances.place(arm)
    configuration = robot.coordinates.q(np.concatenate([[1.0, 0.5, 2.0], arm]))
    pin.framesForwardKinematics(robot.model, data, configuration)
    plan = vkc.plan(loaded, [vkc.Reach(data.oMf[frame].copy())])
    assert plan.success, plan.summary()


def test_links_that_overlap_at_zero_are_separated_at_home(tmp_path: Path) -> None:
    file = write_arms(tmp_path / "given")
    text = file.read_text(encoding="utf-8")
    for joint in ("arm_2_joint", "arm_3_joint"):
        text = text.replace(
            f'name="{joint}" type="revolute"><origin xyz="0 0 0.2"/>',
            f'name="{joint}" type="revolute"><origin xyz="0 0 0.2" rpy="0 1.9 0"/>',
        )
    file.write_text(text, encoding="utf-8")
    plain = vkc.load_robot(file, pairs="all")
    clearances = Clearances(plain)
    clearances.place(np.zeros(5))
    assert ("arm_4", "body") in {tuple(sorted(pair[:2])) for pair in clearances.links(0.0)}, (
        "precondition of the test"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # warnings about overlapping links or missing folders
        imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    clearances = Clearances(imported.robot)
    clearances.place(imported.robot.home)
    assert clearances.least() >= HOME_ROOM
    checked_pairs = {
        tuple(sorted((imported.robot.link_of(a), imported.robot.link_of(b))))
        for a, b in clearances.pairs
    }
    assert ("arm_4", "body") in checked_pairs


def test_folder_is_replaced_only_with_force_and_kept_on_failure(tmp_path: Path) -> None:
    file, target = write_arms(tmp_path / "given"), tmp_path / "mine"
    vkc.importing.import_robot(file, target, samples=20)
    (target / "notes.txt").write_text("dear", encoding="utf-8")
    with pytest.raises(vkc.InputError, match="--force"):
        vkc.importing.import_robot(file, target)
    with pytest.raises(vkc.InputError, match=r"would delete .*got notes\.txt\)"):
        vkc.importing.import_robot(file, target, samples=20, force=True)
    (target / "notes.txt").unlink()
    (target / "mine.urdf").write_text("changed by hand", encoding="utf-8")
    with pytest.raises(vkc.UnknownNameError, match=r"given/robot\.urdf: tool_frame: .*'hand'"):
        vkc.importing.import_robot(file, target, tool_frame="hnd", force=True)
    with pytest.raises(vkc.UnknownNameError):
        vkc.importing.import_robot(file, target, arm="third", force=True)
    assert (target / "mine.urdf").read_text(encoding="utf-8") == "changed by hand"
    vkc.importing.import_robot(file, target, samples=20, force=True)
    assert (target / "mine.urdf").read_text(encoding="utf-8") != "changed by hand"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["given", "mine"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<sdf/>", r"expected <robot> \(URDF or xacro\) or <mujoco> \(MJCF\), got <sdf>"),
        ("<robot name='x'><link name='a'/></robot>", "the robot has no shapes"),
        ("not xml", "not valid XML"),
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
        file = (
            write_telescope(tmp_path / f"given{mimics}", couplings="", mimics=mimics).parent
            / "robot.urdf"
        )
        imported = vkc.importing.import_robot(file, tmp_path / f"mine{mimics}", samples=SAMPLES)
        assert imported.robot.coordinates.names[3:] == (
            "lift",
            "out_1",
            "yaw_joint",
            "pitch_joint",
            "roll_joint",
        )
        document = yaml.safe_load((imported.folder / "robot.yaml").read_text())
        assert document.get("couplings", {}) == (FOLLOWERS if is_proposed else {})
        assert ("out_2, out_3, out_4 follow out_1 as a telescope" in str(imported)) == is_proposed
        assert set(document["home"]) == {*imported.robot.coordinates.names[3:]}


def test_file_name_cannot_add_fields_to_the_description(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = write_arms(tmp_path / "given").read_text(encoding="utf-8").replace(' name="robot"', "")
    file = tmp_path / "x\ntool_frame: body\n#\x01\udcff.urdf"
    file.write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    imported = vkc.importing.import_robot(file, None, samples=20)
    stem = "x_tool_frame__body____"
    assert imported.folder.name == stem
    assert {path.stem for path in imported.folder.glob("*.?rdf")} == {stem}
    stated = (imported.folder / "robot.yaml").read_text(encoding="utf-8")
    assert stated.startswith(
        "# Made of x\\ntool_frame: body\\n#\\x01\\udcff.urdf (URDF) by vkc-pin"
    )
    assert yaml.safe_load(stated)["tool_frame"] == "tool"
    assert vkc.load_robot(imported.folder).name == stem


@pytest.mark.parametrize(
    ("first", "links"), [("body", "all links"), ("arm_5", "arm_5, hand, finger_a, finger_b")]
)
def test_visual_shapes_replace_missing_collision_shapes(
    tmp_path: Path, first: str, links: str
) -> None:
    """Only the links before `first` have collision shapes."""
    file = write_arms(tmp_path / "given")
    head, link, tail = file.read_text(encoding="utf-8").partition(f'<link name="{first}"')
    file.write_text(head + link + tail.replace("collision>", "visual>"), encoding="utf-8")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    assert f"visual shapes are used for want of collision shapes: {links} [guess]" in str(imported)
    assert "which open from 0 to 80 mm" in str(imported)
    assert {"hand", "finger_a", "finger_b"} <= set(imported.robot.touch_links)


STUCK = ("the gripper does not move: its fingers stay", False)


@pytest.mark.parametrize(
    ("finger", "limits", "expected", "healthy"),
    [
        ("revolute", (0.0, 0.0), "a_joint 0.0 to 0.0, right_finger_b_joint 0.0 to 0.0", False),
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
    file = write_arms(tmp_path, sides=("right_",))
    text = file.read_text(encoding="utf-8").replace('"prismatic"', f'"{finger}"')
    low, high = limits
    text = text.replace('lower="0.0" upper="0.04"', f'lower="{low}" upper="{high}"')
    if finger == "fixed":
        text = text.partition('<link name="right_hand">')[0] + "</robot>"
    file.write_text(text, encoding="utf-8")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=30)
    assert expected in str(imported)
    assert ".vkc-pin-" not in str(imported)
    assert imported.diagnosis.healthy is healthy


def test_column_of_a_lift_may_sink_into_the_floor(tmp_path: Path) -> None:
    file = write_arms(tmp_path / "given")
    foot = '<link name="foot"><collision><origin xyz="0 0 0.05"/><geometry>'
    foot += '<box size="0.4 0.4 0.1"/></geometry></collision></link>'
    foot += '<joint name="lift" type="prismatic"><parent link="foot"/><child link="body"/>'
    foot += '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="9" velocity="1"/></joint>'
    text = file.read_text(encoding="utf-8").replace('name="robot">', f'name="robot">{foot}')
    text = text.replace("0 0 -0.1", "0 0 -0.5").replace("0.5 0.4 0.5", "0.1 0.1 1.0")
    file.write_text(text, encoding="utf-8")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    assert "the lift sinks body into the floor" in str(imported)
    assert "body" not in imported.robot.links
    assert imported.diagnosis.healthy
    assert "level ones at 0.1 to 1.9 m" in str(imported)


@pytest.mark.parametrize(("first", "second"), [("a", "b"), ("b", "a")])
def test_closing_direction_suits_a_wrist_without_roll(
    tmp_path: Path, first: str, second: str
) -> None:
    """The arm pitches forwards only: the hand's y axis never turns upside down."""
    file = write_arms(tmp_path / "given")
    text = file.read_text(encoding="utf-8").replace("finger_a", f"finger_{first}_")
    text = text.replace("finger_b", f"finger_{second}_")
    for k in (3, 4):
        text = text.replace(f'"arm_{k}_joint" type="revolute"', f'"arm_{k}_joint" type="fixed"')
    for k in (2, 5):
        text = set_limits(text, f"arm_{k}_joint", 0, 2)
    post = '<link name="post"><collision><geometry><box size="0.1 0.1 0.9"/></geometry></collision>'
    post += '</link><joint name="post_joint" type="fixed"><origin xyz="0.6 0 0.1"/>'
    post += '<parent link="body"/><child link="post"/></joint></robot>'
    file.write_text(text.replace("</robot>", post), encoding="utf-8")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    assert "thick: upright ones at" in str(imported)


@pytest.mark.parametrize(("first", "second"), [("a", "b"), ("b", "a")])
def test_closing_direction_leaves_the_wrist_room_to_turn_levers(
    tmp_path: Path, first: str, second: str
) -> None:
    """The arm pitches forwards only, and its wrist rolls by slightly more than half a turn."""
    file = write_arms(tmp_path / "given")
    text = file.read_text(encoding="utf-8").replace("finger_a", f"finger_{first}_")
    text = text.replace("finger_b", f"finger_{second}_")
    text = text.replace('"arm_5_joint" type="revolute"', '"arm_5_joint" type="fixed"')
    for joint, limits in ((2, (0, 2)), (3, (0, 2)), (4, (-2.3, 1.6))):
        text = set_limits(text, f"arm_{joint}_joint", *limits)
    file.write_text(text, encoding="utf-8")
    imported = vkc.importing.import_robot(file, tmp_path / "mine", samples=SAMPLES)
    assert "turn door levers" not in str(imported)
