"""Tests requested robots and objects, and their scenes in a hall."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.arm_urdf import write_arms

import vkc_pin as vkc
from tests.benchmarks.robot_object_matrix.pairs import (
    SHARE,
    Request,
    load_description,
    make_hall,
    make_pair,
    parse_requests,
    prepare_object,
    prepare_robot,
)
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.models.robot_file import find_robot
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE

SMOOTH = """<robot name="smooth"><link name="frame"/>
<link name="block"><collision><geometry><box size="0.4 0.4 0.4"/></geometry></collision></link>
<joint name="slide" type="prismatic">
<parent link="frame"/><child link="block"/><origin xyz="0 0 0.5"/><axis xyz="-1 0 0"/>
<limit lower="0" upper="0.3" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def husky() -> vkc.Robot:
    return vkc.load_robot("husky_ur5e")


def test_description_does_not_depend_on_its_source() -> None:
    stored = find_resource_folder("scenes") / "objects" / "narrow_door.yaml"
    by_name = load_description("narrow_door")
    by_path = load_description(str(stored))
    assert by_name == by_path
    assert Path(by_name["urdf"]).is_absolute()
    assert vkc.load_object(by_name).name == "narrow_door"
    assert load_description("oven_7") == vkc.procedural.random_object("oven", 7)


def compute_bounds(scene: vkc.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner of the placed object."""
    shapes = make_world_shapes(scene.objects["it"])
    boxes = np.array([compute_world_box(shape.geometry, shape.placement) for shape in shapes])
    return boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)


def has_counter(scene: vkc.Scene) -> bool:
    return any("worktop" in label for label in scene.obstacle_names)


@pytest.mark.parametrize("name", ["drawers_0", "faucet_0", "narrow_door", "low_drawer"])
def test_objects_are_placed_by_kind(name: str) -> None:
    scene = make_hall("husky_ur5e", name, load_description(name))
    low, high = compute_bounds(scene)
    assert has_counter(scene) == (name == "faucet_0")
    assert (low[2] > 0.7) if has_counter(scene) else (0.0 <= low[2] < 0.05)
    in_wall = name == "narrow_door"
    assert (high[0] > 4.0) == in_wall, (
        "a door is in the wall at x = 4 m, other objects are in front of it"
    )
    assert scene.arena[1] == (6.0 if in_wall else 4.0), "the floor extends beyond a door"
    assert low[0] > 2.9, "the robot starts 2 m away"
    start = scene.sample_start(np.random.default_rng(0))
    assert start.start_clearance() >= START_CLEARANCE
    assert not np.array_equal(start.start, scene.start)


def test_joint_is_opened_by_half_its_range(husky: vkc.Robot) -> None:
    pair = make_pair(husky, "husky_ur5e", "drawers_0")
    assert pair.scene is not None
    assert pair.step is not None
    item = pair.scene.objects["it"].object
    ((joint, goal),) = pair.step.joints.items()
    assert pair.step.attachment is None, "the planner chooses the attachment"
    span = (item.upper - item.lower)[item.coordinates.index(joint)]
    assert goal == pytest.approx(SHARE * span, abs=1e-3)
    drawers = vkc.load_object(vkc.procedural.random_object("drawers", 0))
    proposals = vkc.importing.propose_attachments(drawers, husky).opening(joint)
    reached = [one.attachment.name for one in proposals if one.opens[joint] >= goal]
    assert list(item.attachments) == reached


@pytest.mark.parametrize(("height", "raised"), [(0.4, True), (0.8, False)])
def test_low_objects_are_placed_on_a_counter(tmp_path: Path, height: float, raised: bool) -> None:
    urdf = SMOOTH.replace("0.4 0.4 0.4", f"0.4 0.4 {height}").replace(
        "0 0 0.5", f"0 0 {height / 2}"
    )
    file = _write_object(tmp_path / "box.yaml", urdf)
    scene = make_hall("husky_ur5e", file, load_description(file))
    assert has_counter(scene) == raised
    assert compute_bounds(scene)[0][2] == pytest.approx(0.801 if raised else 0.0, abs=1e-6)
    assert not [pair for pair in vkc.check_scene(scene).close if pair.distance < 0.0]


def _write_object(path: Path, urdf: str) -> str:
    return str(vkc.procedural.write_object({"urdf": urdf, "attachments": []}, path))


def test_object_without_a_grasp_is_unreachable(husky: vkc.Robot, tmp_path: Path) -> None:
    """No hand can grasp a ball or turn it by pushing."""
    ball = SMOOTH.replace('<box size="0.4 0.4 0.4"/>', '<sphere radius="0.2"/>')
    ball = ball.replace("prismatic", "revolute").replace("-1 0 0", "0 0 1")
    pair = make_pair(husky, "husky_ur5e", _write_object(tmp_path / "ball.yaml", ball))
    assert pair.step is None
    assert pair.because.startswith("slide: nothing of it fits between the fingers")


def test_robot_without_a_hand_has_no_step() -> None:
    pair = make_pair(vkc.load_robot("ur5"), "ur5", "drawers_0")
    assert (pair.scene, pair.step) == (None, None)
    assert "the hand of 'ur5_robot' is undefined" in pair.because


def test_high_object_is_unreachable(husky: vkc.Robot, tmp_path: Path) -> None:
    high = DESK.replace("0 0.28 0.6", "0 0.28 3.5")
    pair = make_pair(husky, "husky_ur5e", _write_object(tmp_path / "high.yaml", high))
    assert pair.step is None
    assert pair.because.startswith("tray_bar: reach it.tray_bar: out of reach")


# A box with a drawer that is pulled towards +y, and a lamp beside it.
DESK = """<robot name="desk">
  <link name="room"/>
  <link name="case">
    <collision><origin xyz="0 0 0.4"/><geometry><box size="0.5 0.5 0.8"/></geometry></collision>
  </link>
  <link name="tray"><collision><geometry><box size="0.3 0.02 0.1"/></geometry></collision>
    <collision name="handle">
      <origin xyz="0 0.08 0"/><geometry><box size="0.3 0.02 0.02"/></geometry>
    </collision></link>
  <link name="lamp">
    <collision><origin xyz="1 0 0.5"/><geometry><box size="0.2 0.2 1.0"/></geometry></collision>
  </link>
  <joint name="stands" type="fixed"><parent link="room"/><child link="case"/></joint>
  <joint name="beside" type="fixed"><parent link="room"/><child link="lamp"/></joint>
  <joint name="slide" type="prismatic">
    <parent link="case"/><child link="tray"/><origin xyz="0 0.28 0.6"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
</robot>"""


def test_requests_are_parsed() -> None:
    texts = [
        "default",
        "my_oven=kitchens/kitchen.xml#oven",
        "kitchens/kitchen.xml#sink top",
        "home/desk.yaml",
        "drawer",
    ]
    assert parse_requests(texts, "objects", ("oven_0", "door")) == [
        Request("oven_0", "oven_0"),
        Request("door", "door"),
        Request("my_oven", "kitchens/kitchen.xml", "oven"),
        Request("sink top", "kitchens/kitchen.xml", "sink top"),
        Request("desk", "home/desk.yaml"),
        Request("drawer", "drawer"),
    ]
    assert [
        request.is_imported
        for request in parse_requests(["a.URDF", "b.sdf", "c.yaml", "urdf"], "objects", ())
    ] == [True, True, False, False]


@pytest.mark.parametrize(
    "texts",
    [[], ["oven_0", "oven_0"], ["default", "oven_0"], ["a=oven_0", "a=oven_1"], [""], ["#link"]],
)
def test_malformed_requests_are_refused(texts: list[str]) -> None:
    with pytest.raises(vkc.InputError, match="objects: not a choice"):
        parse_requests(texts, "objects", ("oven_0",))


def test_object_file_is_imported_once_and_faces_the_robot(tmp_path: Path) -> None:
    (tmp_path / "flat.urdf").write_text(DESK, encoding="utf-8")
    (request,) = parse_requests([f"desk={tmp_path / 'flat.urdf'}#case"], "objects", ())

    def read_files() -> dict[Path, bytes]:
        return {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}

    file_name = prepare_object(request, tmp_path / "objects")
    item = vkc.load_object(load_description(file_name))
    assert sorted(item.links) == ["case", "front", "tray"], "not the lamp"
    attachment = item.attachment()
    approach = (item.link_placement(attachment.link, [0.0]) * attachment.placement).rotation[:, 2]
    np.testing.assert_allclose(approach, [1.0, 0.0, 0.0], atol=1e-9)
    closed, opened = (item.link_placement("tray", [value]).translation for value in (0.0, 0.3))
    np.testing.assert_allclose(opened - closed, [-0.3, 0.0, 0.0], atol=1e-9)
    written = read_files()
    assert prepare_object(request, tmp_path / "objects") == file_name
    assert read_files() == written
    assert not list((tmp_path / "objects").glob(".*")), "no temporary files remain"


@pytest.mark.parametrize("link", ["../../evil", "..", "a/b", "/evil", ".hidden"])
def test_link_name_must_be_a_file_name(tmp_path: Path, link: str) -> None:
    file = tmp_path / "flat.urdf"
    objects = tmp_path / "a" / "objects"
    file.write_text(DESK.replace("case", link), encoding="utf-8")
    wrong, right = parse_requests([f"{file}#{link}", f"desk={file}#{link}"], "objects", ())
    with pytest.raises(vkc.InputError, match="objects: not a plain file name"):
        prepare_object(wrong, objects)
    with pytest.raises(vkc.InputError, match="robots: not a plain file name"):
        prepare_robot(Request(link, "husky_ur5e"), tmp_path / "a" / "robots")
    assert list(tmp_path.rglob("*")) == [file]
    assert prepare_object(right, objects) == str(objects / "desk/desk.yaml")


def test_bundled_robot_is_used_and_robot_file_is_imported_once(tmp_path: Path) -> None:
    assert prepare_robot(Request("husky", "husky_ur5e"), tmp_path) == "husky_ur5e"
    assert not list(tmp_path.iterdir())
    file = write_arms(tmp_path / "given")
    folder = Path(prepare_robot(Request("two_arms", str(file)), tmp_path / "robots"))
    assert folder == tmp_path / "robots" / "two_arms"
    assert vkc.load_robot(folder).touch_links
    changed = (folder / "robot.yaml").stat().st_mtime_ns
    prepare_robot(Request("two_arms", str(file)), tmp_path / "robots")
    assert (folder / "robot.yaml").stat().st_mtime_ns == changed


@pytest.mark.parametrize("text", ["rover/robot.yaml", "rover"])
def test_relative_path_of_a_robot_is_relative_to_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(find_robot("husky_ur5e").parent, "rover")
    found = prepare_robot(Request("rover", f"./{text}"), Path("robots"))
    scene = make_hall(found, "drawer", load_description("drawer"))
    assert scene.robot.urdf == tmp_path / "rover/husky_ur5e.urdf"
