"""Robots from files: defaults, options, and how wrong ones are refused."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.robots import at_rest, placement, small_urdf

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.files import resources
from vkc_pin.models.robot import Robot
from vkc_pin.models.robot_file import load_robot

FOLDER = resources.folder("robots") / "husky_ur5e"


@pytest.fixture(scope="module")
def husky() -> Robot:
    return load_robot("husky_ur5e")


def test_bases() -> None:
    fixed = load_robot("husky_ur5e", base="fixed")
    np.testing.assert_array_equal(fixed.lower[:3], fixed.upper[:3])
    assert load_robot("husky_ur5e", base="differential").base == "differential"
    with pytest.raises(InputError, match="base"):
        load_robot("husky_ur5e", base="wheels")  # type: ignore[arg-type]


def test_locked_joints_and_another_tool_frame() -> None:
    robot = load_robot("husky_ur5e", tool_frame="wrist_2_link", locked_joints={"elbow_joint": -1.5})
    assert robot.coordinates.names[3:] == ("shoulder_pan_joint", "shoulder_lift_joint", "wrist_1_joint", "wrist_2_joint")
    whole = load_robot("husky_ur5e")
    arm = np.array([0.3, -1.0, -1.5, 0.4, 0.2, 0.0])
    here = placement(robot, "tool", np.concatenate([np.zeros(3), arm[[0, 1, 3, 4]]]))
    there = placement(whole, "tool", np.concatenate([np.zeros(3), arm]))
    assert here.isApprox(there, 1e-12)
    with pytest.raises(UnknownNameError) as caught:
        load_robot("husky_ur5e", locked_joints={"elbow": 0.0})
    assert caught.value.nearest == "elbow_joint"


@pytest.mark.parametrize(
    ("name", "tool", "joints"),
    [("panda", "panda_hand_tcp", 7), ("tiago_no_hand", "wrist_ft_tool_link", 8), ("ur5", "tool0", 6), ("kinova", None, 6)],
)
def test_robots_of_example_robot_data(name: str, tool: str | None, joints: int) -> None:
    robot = load_robot(name)
    assert tool in (None, robot.tool_frame)
    assert len(robot.home) == joints == robot.coordinates.size - 3
    assert len(robot.collision.collisionPairs) > 0
    assert (robot.velocity > 0).all()
    assert np.isfinite(robot.velocity).all()
    assert len({frame.name for frame in robot.model.frames}) == robot.model.nframes
    placement(robot, robot.tool_frame, at_rest(robot))


def test_tiago_with_its_hand() -> None:
    robot = load_robot("tiago", tool_frame="hand_tool_link", pairs="all")
    assert robot.coordinates.names[3:] == ("torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8)))


def test_any_urdf_has_sensible_defaults(tmp_path: Path) -> None:
    wheel = (
        '<joint name="wheel" type="continuous"><parent link="l0"/><child link="w"/></joint>'
        '<joint name="follower" type="revolute"><parent link="l3"/><child link="f"/><mimic joint="j0"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
    )
    robot = load_robot(small_urdf(tmp_path, joints=wheel, links='<link name="w"/><link name="f"/>'), pairs="all")
    assert robot.coordinates.names[3:] == ("j0", "j1", "j2")
    assert robot.name == "small"
    np.testing.assert_allclose(robot.velocity, [1, 1, 2, 1.5, 1.5, 1.5])
    np.testing.assert_allclose(robot.acceleration, [3, 3, 6, 1.4, 1.4, 1.4])
    np.testing.assert_array_equal(robot.model.jointPlacements[3].rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def test_robot_yaml_beside_a_urdf_is_used(tmp_path: Path) -> None:
    file = small_urdf(tmp_path)
    (tmp_path / "robot.yaml").write_text(
        "urdf: small.urdf\ntool_frame: l3\nhome: {j1: 0.5}\njoints: {j2: {velocity: 0.2, acceleration: 9}}\n"
    )
    robot = load_robot(file, pairs="all")
    assert (robot.tool_frame, robot.home.tolist(), robot.velocity[5], robot.acceleration[5]) == ("l3", [0.0, 0.5, 0.0], 0.2, 9.0)
    assert load_robot(tmp_path / "robot.yaml", pairs="all", home={"j1": -1.0}).home.tolist() == [0.0, -1.0, 0.0]


def test_a_robot_is_called_as_its_folder_or_its_file(tmp_path: Path) -> None:
    small_urdf(tmp_path)
    for name, called in (("robot.yaml", tmp_path.name), ("mine.yaml", "mine")):
        (tmp_path / name).write_text("urdf: small.urdf\n")
        assert load_robot(tmp_path / name, pairs="all").name == called


def test_a_copied_urdf_finds_the_meshes_of_example_robot_data(tmp_path: Path) -> None:
    original = load_robot("panda", pairs="all")
    copy = tmp_path / "copy.urdf"
    copy.write_text(original.urdf.read_text())
    assert "package://example-robot-data/" in copy.read_text()
    found = load_robot(copy, pairs="all")
    assert [shape.name for shape in found.collision.geometryObjects] == [s.name for s in original.collision.geometryObjects]
    copy.write_text(original.urdf.read_text().replace("/link0.stl", "/link00.stl"))
    with pytest.raises(InputError, match=r"link00\.stl"):
        load_robot(copy, pairs="all")


def test_unknown_names() -> None:
    with pytest.raises(UnknownNameError) as caught:
        load_robot("husky_ur5")
    assert caught.value.nearest == "husky_ur5e"
    with pytest.raises(UnknownNameError) as caught:
        load_robot("pandas")
    assert caught.value.nearest == "panda"
    with pytest.raises(UnknownNameError) as caught:
        load_robot("husky_ur5e", tool_frame="tol")
    assert caught.value.nearest == "tool"
    with pytest.raises(InputError, match="no such robot"):
        load_robot("nowhere/robot.urdf")


def test_broken_files(tmp_path: Path) -> None:
    (tmp_path / "a.urdf").write_text("<robot><link>")
    with pytest.raises(InputError, match="XML") as caught:
        load_robot(tmp_path / "a.urdf")
    assert caught.value.line == 1
    (tmp_path / "b.urdf").write_text("<sdf/>")
    with pytest.raises(InputError, match="no URDF"):
        load_robot(tmp_path / "b.urdf")
    (tmp_path / "c.urdf").write_text('<robot name="c"><link name="a"/><link name="b"/></robot>')
    with pytest.raises(InputError, match=r"c\.urdf:1: b: links that nothing connects"):
        load_robot(tmp_path / "c.urdf")
    mesh = '<link name="m"><collision><geometry><mesh filename="package://nowhere/m.stl"/></geometry></collision></link>'
    joint = '<joint name="jm" type="fixed"><parent link="l3"/><child link="m"/></joint>'
    with pytest.raises(InputError, match=r"package://nowhere/m\.stl"):
        load_robot(small_urdf(tmp_path, links=mesh, joints=joint))
    (tmp_path / "bad.stl").write_text("")
    file = small_urdf(tmp_path, links=mesh.replace("package://nowhere/m.stl", "bad.stl"), joints=joint)
    with pytest.raises(InputError, match=r"bad\.stl"):
        load_robot(file)
    bare = file.read_text().replace("<collision>", "<visual>").replace("</collision>", "</visual>").replace("bad.stl", "")
    file.write_text(bare)
    with pytest.raises(InputError, match="can collide"):
        load_robot(file)


def test_srdf_with_an_unknown_link(tmp_path: Path) -> None:
    file = small_urdf(tmp_path)
    (tmp_path / "small.srdf").write_text(
        '<robot name="small">\n<disable_collisions link1="l0" link2="l5" reason="Never"/>\n</robot>'
    )
    with pytest.raises(UnknownNameError, match="there is no link 'l5'") as caught:
        load_robot(file)
    assert (caught.value.file, caught.value.line) == (tmp_path / "small.srdf", 2)
    assert len(load_robot(file, pairs="sampled").collision.collisionPairs) == 0  # it cannot touch itself


def test_no_pair_left(tmp_path: Path) -> None:
    pairs = "".join(f'<disable_collisions link1="l{i}" link2="l{j}"/>' for i in range(4) for j in range(i))
    (tmp_path / "small.srdf").write_text(f"<robot>{pairs}</robot>")
    with pytest.raises(InputError, match="no pair of links"):
        load_robot(small_urdf(tmp_path))


def test_a_copy_of_the_robot_works_elsewhere(husky: Robot, tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "husky_ur5e")
    twin = load_robot(tmp_path / "husky_ur5e" / "husky_ur5e.urdf")
    assert twin.urdf.parent == (tmp_path / "husky_ur5e").resolve()
    assert (twin.name, twin.tool_frame, len(twin.collision.collisionPairs)) == (husky.name, "tool", 95)
    with pytest.raises(dataclasses.FrozenInstanceError):
        twin.name = "other"  # type: ignore[misc]
