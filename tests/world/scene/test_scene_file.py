"""Tests scene files and their errors."""

from __future__ import annotations

import json
import re
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from helpers.meshes import write_wedge
from helpers.rooms import TINY, load_scene_text

from vkc_pin import Scene, load_scene
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.obstacles import FLOOR


def test_all_types_of_obstacles_are_loaded(tmp_path: Path) -> None:
    write_wedge(tmp_path / "wedge.obj")
    (tmp_path / "chest.urdf").write_text(
        """<robot name="r"><link name="a"><collision><origin xyz="0 0 1"/><geometry>
        <sphere radius="0.1"/></geometry></collision></link><link name="b">
        <collision><geometry><box size="1 2 3"/></geometry></collision></link>
        <joint name="j" type="continuous"><parent link="a"/><child link="b"/>
        <origin xyz="0.5 0 0" rpy="0 0 0.4"/><axis xyz="0 0 1"/></joint></robot>"""
    )
    extra = """\
  - {name: ball, type: sphere, radius: 0.2, position: [0, 2, 0.2], colour: red}
  - {name: pole, type: capsule, radius: 0.05, length: 1, position: [-3, 0, 1]}
  - {name: rock, type: mesh, file: wedge.obj, scale: [2, 1, 3], position: [1, 2, 0]}
  - {name: chest, type: urdf, file: chest.urdf, position: [-1, 2, 0], colour: [1, 0, 0]}
"""
    scene = load_scene_text(tmp_path, TINY + extra)
    assert scene.obstacle_names == ("crate", "post", "ball", "pole", "rock", "chest")
    assert scene.obstacle_labels == (*scene.obstacle_names, "chest", FLOOR)
    names = ("crate", "post", "ball", "pole", "rock", "chest_0", "chest_1", FLOOR)
    assert tuple(shape.name for shape in scene.obstacles) == names
    assert {shape.parentJoint for shape in scene.obstacles} == {0}
    crate, post, ball, pole, rock, *chest, floor = scene.obstacles
    solids = [shape.geometry for shape in (crate, post, ball, pole)]
    assert [type(s) for s in solids] == [coal.Box, coal.Cylinder, coal.Sphere, coal.Capsule]
    np.testing.assert_allclose(2.0 * solids[0].halfSide, [0.5, 0.4, 0.3])
    assert [solid.radius for solid in solids[1:]] == [0.1, 0.2, 0.05]
    assert [2.0 * solid.halfLength for solid in solids[1::2]] == [1.0, 1.0]
    np.testing.assert_allclose(np.max(rock.geometry.points(), axis=0), [2, 1, 3])
    paths = {shape.meshPath for shape in scene.obstacle_visual}
    assert paths == {"", str(tmp_path / "wedge.obj")}
    for shape, at, rotation in (
        (crate, [2, 2, 0.15], pin.utils.rotate("z", 0.2)),
        (chest[0], [-1, 2, 1], np.eye(3)),
        (chest[1], [-0.5, 2, 0], pin.utils.rotate("z", 0.4)),  # with joints at zero
    ):
        np.testing.assert_allclose(shape.placement, pin.SE3(rotation, np.array(at, float)))
        np.testing.assert_array_equal(shape.meshColor, [1, 0, 0, 1])
    # The floor covers the arena and a border.
    bounds = compute_world_box(floor.geometry, floor.placement)
    np.testing.assert_allclose(bounds, [[-6, -5, -0.1], [6, 5, 0.0]], atol=1e-12)
    assert FLOOR not in load_scene_text(tmp_path, TINY + "floor: false\n").obstacle_labels
    again = Scene.from_document(json.loads(json.dumps(scene.document)), tmp_path)
    assert [s.name for s in again.obstacles] == [s.name for s in scene.obstacles]


def test_number_of_obstacles_is_limited() -> None:
    ball = {"name": "b", "type": "sphere", "radius": 0.01, "position": [9, 9, 9]}
    document = {"robot": "husky_ur5e", "start": {"base": [0, 0, 0]}, "obstacles": [ball] * 10_001}
    with expect_error("^obstacles: .{0,20}too many.{0,250}$"):
        Scene.from_document(document)


BOX = "  - {{name: b, type: box, size: [1, 2, 3], position: [0, 3, 2], {}}}\n"


def test_orientations_may_be_quaternions(tmp_path: Path) -> None:
    scene = load_scene_text(tmp_path, TINY + BOX.format("quaternion: [0, 0, 0.7071, 0.7071]"))
    turn = pin.utils.rotate("z", np.pi / 2)
    np.testing.assert_allclose(scene.obstacles[2].placement.rotation, turn, atol=1e-12)


@pytest.mark.parametrize(
    ("orientation", "message"),
    [
        ("quaternion: [0, 0, 1, 1]", "not a rotation .*length 1, not 1.414"),
        ("quaternion: [0, 0, 1]", "4 values"),
        (
            "quaternion: [0, 0, 0, 1], yaw: 0",
            "more than one orientation .*one of rpy, yaw and quaternion",
        ),
        ("quaternion: [0, 0, 0, 1], rpy: [0, 0, 0]", "more than one orientation"),
    ],
)
def test_invalid_orientations_are_located(tmp_path: Path, orientation: str, message: str) -> None:
    with expect_error(message, line=len(TINY.splitlines()) + 1):
        load_scene_text(tmp_path, TINY + BOX.format(orientation))


SIZE, BASE = "size: [0.5, 0.4, 0.3]", "base: [0.0, 0.0, 0.5]"


@pytest.mark.parametrize(
    ("old", "new", "line", "field", "details"),
    [
        ("robot: husky_ur5e", "robot: husky_ur5", 1, "robot", "did you mean 'husky_ur5e'?"),
        (
            "robot: husky_ur5e",
            "robot: {name: husky_ur5e, base: omnni}",
            1,
            "robot.base",
            "did you mean 'omni'?",
        ),
        ("  arm: home", "  arn: home", 4, "start.arn", "did you mean 'arm'?"),
        ("type: door", "type: doors", 9, "objects[0].type", "did you mean 'door'?"),
        (
            "state: {hinge: 0.3}",
            "state: {hing: 0.3}",
            11,
            "objects[0].state.hing",
            "did you mean 'hinge'?",
        ),
        ("type: box", "type: bax", 13, "obstacles[0].type", "did you mean 'box'?"),
        ("    radius: 0.1", "    radus: 0.1", 16, "obstacles[1].radus", "did you mean 'radius'?"),
        (BASE, "base: [0.0, 0.0]", 3, "start.base", "expected 3 values, got [0.0, 0.0]"),
        (BASE, "base: [9.0, 0.0, 0.5]", 3, "start.base[0]", "expected x from -4 to 4, got 9.0"),
        (f"  {BASE}\n", "", 2, "start.base", "missing"),
        ("arm: home", "arm: [0, 0, 0]", 4, "start.arm", "wrong number of arm joints"),
        ("arm: home", "arm: [0, 0, 9, 0, 0, 0]", 4, "start.arm[2]", "3.14159, got 9"),
        ("arm: home", "arm: {elbow: 1}", 4, "start.arm.elbow", "did you mean 'elbow_joint'?"),
        ("arm: home", "arm: {elbow_joint: 9}", 4, "start.arm.elbow_joint", "3.14159, got 9"),
        ("arm: home", "arm: rest", 4, "start.arm", "expected home, a list of joint values"),
        ("x: [-1, 1], y", "x: [1, -1], y", 5, "start_region.x", "expected [lowest, highest]"),
        ("x: [-1, 1], y", "x: [-9, 1], y", 5, "start_region.x", "expected x from -4 to 4"),
        ("yaw: any", "yaw: north", 5, "start_region.yaw", "expected any, or [lowest, highest]"),
        ("{hinge: 0.3}", "{hinge: 3}", 11, "objects[0].state.hinge", "expected -1.57 to 1.57"),
        ("type: door", "type: my/door.yaml", 9, "objects[0].type", "got my/door.yaml"),
        ("type: door", "type: 5", 9, "objects[0].type", "the name or file"),
        ("type: door", "type: {}", 9, "urdf", "missing"),
        (SIZE, "size: [0.5, -0.4, 0.3]", 13, "obstacles[0].size[1]", "a number from 1e-06"),
        ("yaw: 0.2, ", "yaw: 0.2, rpy: [0, 0, 0], ", 13, "obstacles[0]", "one of rpy, yaw and"),
        ("colour: [1, 0, 0]", "colour: rd", 13, "obstacles[0].colour", "unknown colour 'rd'"),
        ("colour: [1, 0, 0]", "colour: [255, 0, 0]", 13, "obstacles[0].colour[0]", "number <= 1"),
        ("    type: cylinder\n", "", 14, "obstacles[1].type", "missing"),
        ("name: post", "name: crate", 14, "obstacles[1].name", "as obstacles[0] in line 13"),
        ("name: front", "name: crate", 8, "objects[0].name", "as obstacles[0] in line 13"),
        ("name: front", "name: floor", 8, "objects[0].name", "got floor, as the floor"),
        ("name: front", "name: a.b", 8, "objects[0].name", "not a name"),
        (f"box, {SIZE}", "mesh, file: none.obj", 13, "obstacles[0].file", "got none.obj"),
        ("robot: husky_ur5e\n", "", 1, "robot", "missing"),
        (TINY, "- 1\n", 1, None, "expected fields (name: value), got [1]"),
    ],
)
def test_invalid_input_is_located(
    tmp_path: Path, old: str, new: str, line: int | None, field: str | None, details: str
) -> None:
    assert old in TINY
    with expect_error(re.escape(details), file=tmp_path / "room.yaml", line=line, field=field):
        load_scene_text(tmp_path, TINY.replace(old, new))


def test_the_first_error_in_the_file_is_reported(tmp_path: Path) -> None:
    text = TINY.replace("radius: 0.1", "radius: -1").replace("size: [0.5", "size: [0")
    with expect_error(line=4):
        load_scene_text(tmp_path, text.replace("arm: home", "arm: 3"))


def test_errors_in_named_files_are_located_there(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text("urdf: none.urdf\nattachment: []\n")
    with expect_error(file=tmp_path / "bad.yaml", line=2, nearest="attachments"):
        load_scene_text(tmp_path, TINY.replace("type: door", "type: bad.yaml"))
    (tmp_path / "bad.urdf").write_text("<robot>")
    with expect_error(file=tmp_path / "bad.urdf"):
        load_scene_text(
            tmp_path, TINY.replace("type: box, size: [0.5, 0.4, 0.3]", "type: urdf, file: bad.urdf")
        )


INLINE_SCENE = """\
robot: husky_ur5e
start: {base: [0, 0, 0]}
objects:
  - name: trap
    position: [2, 0, 0]
    state: {hinge: 0.3}
    type:
      joints:
        hinge: {acceleration: 3}
      attachments:
        - {name: ring, link: leaf, position: [-0.4, 0, 0], approach: [0, 0, -1], closing: [1, 0, 0]}
      urdf: |
        <robot name="trap_door">
          <link name="frame"/>
          <link name="leaf">
            <collision><origin xyz="-0.25 0 0"/><geometry><box size="0.5 0.5 0.02"/></geometry>
            </collision>
          </link>
          <joint name="hinge" type="revolute">
            <parent link="frame"/><child link="leaf"/><axis xyz="0 1 0"/>
            <limit lower="0" upper="1.5" velocity="1" effort="1"/>
          </joint>
        </robot>
"""


def test_inline_object_descriptions_are_loaded(tmp_path: Path) -> None:
    file = tmp_path / "room.yaml"
    file.write_text(INLINE_SCENE)
    scene = load_scene(file)
    placed = scene.objects["trap"]
    assert (placed.object.name, placed.object.urdf, placed.state[0]) == ("trap_door", None, 0.3)
    assert placed.object.acceleration[0] == 3.0
    elsewhere = Scene.from_document(json.loads(json.dumps(scene.document)), "/")
    assert elsewhere.document == scene.document
    assert elsewhere.objects["trap"].object.model == placed.object.model


@pytest.mark.parametrize(
    ("old", "new", "line", "field"),
    [
        ("link: leaf,", "link: leav,", 11, "attachments[0].link"),
        ("acceleration: 3", "acceleration: -3", 9, "joints.hinge.acceleration"),
        ('<child link="leaf"/>', '<child link="leav"/>', 8, "hinge: child"),
    ],
)
def test_errors_in_inline_descriptions_are_located(
    tmp_path: Path, old: str, new: str, line: int, field: str
) -> None:
    """Covers the scene file and the URDF text inside it."""
    assert old in INLINE_SCENE
    (tmp_path / "room.yaml").write_text(INLINE_SCENE.replace(old, new))
    place = r"room\.yaml: urdf:" if "link=" in old else r"room\.yaml:"
    with expect_error(f"{place}{line}: ", line=line, field=field):
        load_scene(tmp_path / "room.yaml")


def test_missing_files_are_reported(tmp_path: Path) -> None:
    with expect_error(nearest="door"):
        load_scene("dor")
    with expect_error(file=tmp_path / "none.yaml"):
        load_scene(tmp_path / "none.yaml")
    for name in ("dor.yaml", "dor.yml"):
        (tmp_path / name).touch()
    with expect_error(rf"a file in {tmp_path}, perhaps dor\.yaml, got door\.yaml"):
        load_scene_text(tmp_path, TINY.replace("type: door", "type: door.yaml"))


def test_start_may_name_some_joints(tmp_path: Path) -> None:
    """The others are at home."""
    scene = load_scene_text(tmp_path, TINY.replace("arm: home", "arm: {elbow_joint: 1.25}"))
    arm = dict(zip(scene.robot.coordinates.names[3:], scene.start[3:], strict=True))
    home = dict(zip(scene.robot.coordinates.names[3:], scene.robot.home, strict=True))
    assert arm == {**home, "elbow_joint": 1.25}


def test_start_may_have_a_height(tmp_path: Path) -> None:
    """The height is constant and part of the document; scenes of one robot may differ."""
    high = load_scene_text(tmp_path, TINY.replace("arm: home", "arm: home\n  z: 0.4"))
    low = load_scene_text(tmp_path, TINY)
    assert (low.robot.height, high.robot.height) == (0.0, 0.4)
    assert "z" not in low.document["start"]
    again = Scene.from_document(high.with_start(base=[1.0, 0.0, 0.0]).document, tmp_path)
    assert again.document["start"]["z"] == again.robot.height == 0.4
    rise = high.tool_placement().translation - low.tool_placement().translation
    np.testing.assert_allclose(rise, [0.0, 0.0, 0.4], atol=1e-12)
