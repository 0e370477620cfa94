"""Tests the loading and validation of robots: defaults, options and errors."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.arm_urdf import write_arms
from helpers.expected_errors import expect_error
from helpers.robots import compute_placement, write_small_urdf
from helpers.texts import format_box, format_fixed_link

from vkc_pin import Robot, UnknownNameError, load_robot
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.robot_file import find_robot


def write_yaml(folder: Path, text: str) -> Path:
    file = folder / "robot.yaml"
    file.write_text(f"urdf: small.urdf\n{text}\n")
    return file


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("tool_fram: l3", 2, "tool_frame"),
        ("tool_frame: l9", None, "l3"),
        ("home: {j7: 0}", 2, "j[0-2]"),
        ("home: {j1: 3}", None, "between -2 and 2"),
        ("joints: {j2: {velocity: fast}}", 2, "number"),
        ("joints: {k2: {velocity: 1}}", 2, "j2"),
        ("touch_links: [hand]", 2, "l0"),
        ("packages: [no_such_package_here]", 2, "pip install no-such-package-here"),
        ("base: {position: [[1, -1], [0, 1]]}", 2, "lower"),
        ("srdf: none.srdf", None, "none.srdf"),
    ],
)
def test_invalid_robot_yaml_raises_with_its_line(
    tmp_path: Path, text: str, line: int | None, problem: str
) -> None:
    write_small_urdf(tmp_path)
    file = write_yaml(tmp_path, text)
    place = {} if line is None else {"file": file, "line": line}
    with expect_error(problem, **place):
        load_robot(file)


def test_base_types(tmp_path: Path) -> None:
    fixed = load_robot("husky_ur5e", base="fixed")
    np.testing.assert_array_equal(fixed.lower[:3], fixed.upper[:3])
    assert load_robot("husky_ur5e", base="differential").base == "differential"
    husky = load_robot("husky_ur5e", base="ackermann", turning_radius=0.8)
    assert husky.turning_radius == 0.8
    assert husky.wheels is not None
    assert husky.wheels.rim_speed == pytest.approx(husky.wheels.radius * husky.wheels.speed)
    file = write_small_urdf(tmp_path)
    for arguments, field, message in (
        ({"base": "wheels"}, "base", "omni"),
        ({"base": "ackermann"}, "turning_radius", "turning_radius"),
        ({"base": "ackermann", "turning_radius": -1.0}, "turning_radius", "> 0"),
        (
            {"base": "differential", "turning_radius": 1.0},
            "turning_radius",
            "or base='ackermann'",
        ),
    ):
        with expect_error(message, field=field):
            load_robot(file, **arguments)
    write_yaml(tmp_path, "base: {turning_radius: 1.2}\n")
    assert load_robot(file, base="ackermann").turning_radius == 1.2
    assert load_robot(file, base="ackermann", turning_radius=0.7).turning_radius == 0.7
    assert load_robot(file, base="differential").turning_radius == 0.0


def test_locked_joints_and_tool_frame(husky: Robot) -> None:
    robot = load_robot("husky_ur5e", tool_frame="wrist_2_link", locked_joints={"elbow_joint": -1.5})
    names = husky.coordinates.names
    assert robot.coordinates.names == (*names[:5], *names[6:8])
    arm = np.array([0.3, -1.0, -1.5, 0.4, 0.2, 0.0])
    found = compute_placement(robot, "tool", np.concatenate([np.zeros(3), arm[[0, 1, 3, 4]]]))
    expected = compute_placement(husky, "tool", np.concatenate([np.zeros(3), arm]))
    assert found.isApprox(expected, 1e-12)


@pytest.mark.parametrize(
    ("name", "tool", "joints"),
    [("panda", "panda_hand_tcp", 7), ("ur5", "tool0", 6)],
)
def test_robots_of_example_robot_data_can_be_loaded(name: str, tool: str, joints: int) -> None:
    robot = load_robot(name)
    assert robot.tool_frame == tool
    assert len(robot.home) == joints == robot.coordinates.size - 3
    assert len(robot.collision.collisionPairs) > 0
    assert (robot.velocity > 0).all()
    assert np.isfinite(robot.velocity).all()


def test_defaults_of_a_urdf(tmp_path: Path) -> None:
    """Joints off the path to the tool are left out; a follower limits its leader."""
    joints = (
        '<joint name="wheel" type="continuous"><parent link="l0"/><child link="w"/></joint>'
        '<joint name="follower" type="revolute">'
        '<parent link="l3"/><child link="f"/><mimic joint="j0"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
    )
    links = '<link name="w"/><link name="f"/>'
    robot = load_robot(write_small_urdf(tmp_path, joints=joints, links=links), pairs="all")
    assert robot.coordinates.names[3:] == ("j0", "j1", "j2")
    np.testing.assert_allclose(robot.velocity, [1, 1, 2, 1.0, 1.5, 1.5])
    np.testing.assert_allclose(robot.acceleration, [3, 3, 6, 1.4, 1.4, 1.4])
    np.testing.assert_array_equal(
        robot.model.jointPlacements[3].rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    )


def test_robot_yaml_beside_the_urdf_is_used(tmp_path: Path) -> None:
    file = write_small_urdf(tmp_path)
    write_yaml(
        tmp_path,
        "tool_frame: l3\nhome: {j1: 0.5}\njoints: {j2: {velocity: 0.2, acceleration: 9}}\n",
    )
    robot = load_robot(file, pairs="all")
    assert (robot.tool_frame, robot.home.tolist()) == ("l3", [0.0, 0.5, 0.0])
    assert (robot.velocity[5], robot.acceleration[5]) == (0.2, 9.0)
    moved = load_robot(tmp_path / "robot.yaml", pairs="all", home={"j1": -1.0})
    assert moved.home.tolist() == [0.0, -1.0, 0.0]


def test_robots_are_named_after_folder_or_file(tmp_path: Path) -> None:
    write_small_urdf(tmp_path)
    for name, expected in (("robot.yaml", tmp_path.name), ("mine.yaml", "mine")):
        (tmp_path / name).write_text("urdf: small.urdf\n")
        assert load_robot(tmp_path / name, pairs="all").name == expected


@pytest.mark.parametrize(
    ("name", "arguments", "nearest"),
    [
        ("husky_ur5", {}, "husky_ur5e"),
        ("pandas", {}, "panda"),
        ("husky_ur5e", {"tool_frame": "tol"}, "tool"),
        ("husky_ur5e", {"locked_joints": {"elbow": 0.0}}, "elbow_joint"),
    ],
)
def test_unknown_names_raise(name: str, arguments: dict[str, Any], nearest: str) -> None:
    with expect_error(nearest=nearest):
        load_robot(name, **arguments)


def test_invalid_files_raise(tmp_path: Path) -> None:
    file = write_small_urdf(tmp_path)
    text = file.read_text()
    for new, problem in (
        (text.replace("collision>", "visual>"), "no collision geometry"),
        (re.sub("<box.*?/>", '<mesh filename="package://no/m.stl"/>', text), "package://no/m.stl"),
    ):
        file.write_text(new)
        with expect_error(problem):
            load_robot(file)


def test_srdf_that_allows_all_pairs_raises_if_some_can_collide(tmp_path: Path) -> None:
    for file in (write_arms(tmp_path / "arms"), write_small_urdf(tmp_path)):
        links = read_urdf(file).links
        pairs = "".join(
            f'<disable_collisions link1="{one}" link2="{other}"/>'
            for one, other in itertools.combinations(links, 2)
        )
        file.with_suffix(".srdf").write_text(f"<robot>{pairs}</robot>")
    with expect_error("no pair of links"):
        load_robot(tmp_path / "arms" / "robot.urdf")
    assert not len(load_robot(file).collision.collisionPairs)  # its small links are far apart


@pytest.mark.parametrize("field", ["locked_joints", "home"])
@pytest.mark.parametrize("joint", ["j1", "j2"], ids=["planned", "locked"])
def test_positions_outside_limits_raise(tmp_path: Path, field: str, joint: str) -> None:
    urdf, file = write_small_urdf(tmp_path), tmp_path / "robot.yaml"
    write_yaml(tmp_path, f"tool_frame: l2\n{field}: {{{joint}: 2.5}}")
    problem = r"outside the joint.s limits .expected between -2 and 2, got 2.5"
    with expect_error(problem, field=f"{field}.{joint}", line=3):
        load_robot(file)
    file.unlink()
    with expect_error(problem, file=urdf, line=None):
        load_robot(urdf, **{field: {joint: 2.5}})  # type: ignore[arg-type]
    load_robot(urdf, **{field: {joint: 2.0 + 1e-7}})  # type: ignore[arg-type]


def write_driving_urdf(
    folder: Path, *, order: str = "xyt", shape: str = "", tilt: float = 0.0
) -> Path:
    """Write the small robot on a planar base of joints and empty links, as in simulators."""
    names = ["world", "m0", "m1", "l0"]
    axes = {"x": "1 0 0", "y": "0 1 0", "t": "0 0 1"}
    links = f'<link name="world"/><link name="m0"/><link name="m1">{shape}</link>'
    joints = "".join(
        f'<joint name="drive_{k}" type="{"continuous" if letter == "t" else "prismatic"}">'
        f'<parent link="{names[k]}"/><child link="{names[k + 1]}"/>'
        f'<origin rpy="{0.0 if k else tilt} 0 0"/>'
        f'<axis xyz="{axes[letter]}"/><limit lower="-9" upper="9"/></joint>'
        for k, letter in enumerate(order)
    )
    return write_small_urdf(folder, links=links, joints=joints)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("order", ["xyt", "yxt", "txy", "xty"])
def test_planar_bases_in_the_urdf_are_locked(tmp_path: Path, order: str) -> None:
    file = write_driving_urdf(tmp_path, order=order)
    with pytest.warns(UserWarning, match=r"small.urdf: the .* locked: drive_0, drive_1, drive_2$"):
        robot = load_robot(file)
    assert robot.coordinates.names == ("base_x", "base_y", "base_yaw", "j0", "j1", "j2")
    # There is no warning if their positions are given.
    load_robot(file, locked_joints={f"drive_{k}": 0.0 for k in range(3)})
    assert len(load_robot(file, base="fixed").home) == 6
    plain, z = load_robot(write_small_urdf(tmp_path)), np.array([0.3, -0.2, 1.0, 0.5, -0.4, 0.3])
    assert compute_placement(robot, "l3", z).isApprox(compute_placement(plain, "l3", z), 1e-12)


SHAPE = "<collision><geometry><sphere radius='1'/></geometry></collision>"


@pytest.mark.parametrize(
    "change",
    [{"shape": SHAPE}, {"tilt": 0.3}, {"order": "xxt"}, {"order": "xyx"}, {"order": "ttx"}],
)
def test_other_joints_are_not_a_planar_base(tmp_path: Path, change: dict[str, Any]) -> None:
    """Collision shapes, non-horizontal axes or parallel axes exclude a planar base."""
    assert len(load_robot(write_driving_urdf(tmp_path, **change)).coordinates.names) == 9


def test_height_of_the_root_link(tmp_path: Path) -> None:
    """The whole robot is raised at any base pose; the argument overrides the file."""
    file = write_small_urdf(tmp_path)
    low, z = load_robot(file), np.array([0.3, -0.2, 1.0, 0.5, -0.4, 0.3])
    write_yaml(tmp_path, "base: {height: 0.25}\n")
    for robot, height in ((load_robot(file), 0.25), (load_robot(file, height=0.7), 0.7)):
        raised = pin.SE3(np.eye(3), np.array([0.0, 0.0, height]))
        assert robot.height == height
        for frame in ("l0", "l3"):
            expected = raised * compute_placement(low, frame, z)
            assert compute_placement(robot, frame, z).isApprox(expected, 1e-12)
        shape, other = (one.collision.geometryObjects[0].placement for one in (robot, low))
        assert shape.isApprox(raised * other, 1e-12)
    with expect_error("height"):
        load_robot(file, height=float("nan"))


def test_groups_of_the_srdf_select_the_tool_frame(tmp_path: Path) -> None:
    with expect_error("there are: none"):
        load_robot(write_small_urdf(tmp_path), arm="short")
    (tmp_path / "small.srdf").write_text(
        '<robot name="small"><group name="short"><chain base_link="l0" tip_link="l2"/></group>'
        '<group name="whole"><joint name="j0"/><joint name="elsewhere"/><joint name="j2"/></group>'
        '<group name="links"><link name="l3"/></group></robot>'
    )
    write_yaml(tmp_path, "arm: short\n")
    for arguments, tool in (({}, "l2"), ({"arm": "whole"}, "l3"), ({"tool_frame": "l1"}, "l1")):
        robot = load_robot(tmp_path, **arguments)
        assert (robot.tool_frame, len(robot.home)) == (tool, int(tool[1]))
    with pytest.raises(UnknownNameError, match=r"arm: .*'short'.* There are: short, whole, links"):
        load_robot(tmp_path, arm="shrt")
    with expect_error("exclude each other"):
        load_robot(tmp_path, arm="short", tool_frame="l2")
    write_yaml(tmp_path, "tool_frame: l3\narm: short\n")
    with expect_error(r"robot\.yaml:3: arm: .*exclude each other"):
        load_robot(tmp_path)


GROUPS = (
    '<group name="whole"><chain base_link="l0" tip_link="l3"/></group>'
    '<group name="links"><link name="l1"/><link name="l2"/></group>'
    '<group name="both"><group name="links"/><link name="l3"/></group>'
)


@pytest.mark.parametrize(
    ("group", "tool", "home"),
    [
        ("whole", "l3", [0.3, 1.2, -1.0]),
        ("links", "l2", [-0.4, 1.5]),
        ("both", "l3", [0.3, 1.2, -1.0]),
    ],
)
def test_home_is_the_state_of_the_planned_group(
    tmp_path: Path, group: str, tool: str, home: list[float]
) -> None:
    """Groups of links and of groups have states, of the same name as those of another group."""
    values = {"whole": [0.3, 1.2, -1.0], "links": [-0.4, 1.5]}
    states = "".join(
        f'<group_state name="home" group="{name}">'
        + "".join(f'<joint name="j{k}" value="{value}"/>' for k, value in enumerate(positions))
        + "</group_state>"
        for name, positions in values.items()
    )
    file = write_small_urdf(tmp_path)
    file.with_suffix(".srdf").write_text(f"<robot>{GROUPS}{states}</robot>")
    robot = load_robot(file, arm=group)
    assert (robot.tool_frame, robot.home.tolist()) == (tool, home)


def test_default_of_a_link_is_as_good_as_its_pairs(tmp_path: Path) -> None:
    """A coarse link around the last ones is checked against the base alone."""
    coarse = format_fixed_link("coarse", "l3", "0 0 -0.1", format_box("0.9 0.9 0.9"))
    file = write_small_urdf(tmp_path, links=coarse)
    by_pairs = "".join(f'<disable_collisions link1="coarse" link2="l{k}"/>' for k in range(1, 4))
    by_default = (
        '<disable_default_collisions link="coarse"/><enable_collisions link1="l0" link2="coarse"/>'
    )
    found = []
    for text in (by_pairs, by_default, ""):
        file.with_suffix(".srdf").write_text(f"<robot>{text}</robot>")
        robot = load_robot(file, tool_frame="l3", home={"j1": 1.0})
        pairs = robot.collision.collisionPairs
        found.append({frozenset((robot.link_of(p.first), robot.link_of(p.second))) for p in pairs})
    assert found[0] == found[1] < found[2]
    assert [pair for pair in found[0] if "coarse" in pair] == [frozenset(("l0", "coarse"))]


def test_stale_names_of_the_srdf_are_warned_of(tmp_path: Path) -> None:
    file = write_small_urdf(tmp_path)
    pairs = "".join(f'<disable_collisions link1="l0" link2="{name}"/>' for name in ("l2", "l2_sc"))
    file.with_suffix(".srdf").write_text(f"<robot>{pairs}</robot>")
    with pytest.warns(UserWarning, match=r"small\.srdf: skipped links .*: l2_sc"):
        robot = load_robot(file)
    pairs_left = [(p.first, p.second) for p in robot.collision.collisionPairs]
    assert (0, 2) not in pairs_left
    assert (0, 3) in pairs_left
    file.with_suffix(".srdf").write_text("<robot><disable_default_collisions link='x'/></robot>")
    with expect_error("names no link of this robot"):
        load_robot(file)


def test_folders_do_not_shadow_robot_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Strings with a slash and `Path` objects are paths, even if a robot has that name."""
    folder = write_arms(tmp_path / "husky_ur5e").parent
    (folder / "robot.yaml").write_text("urdf: robot.urdf\n")
    monkeypatch.chdir(tmp_path)
    for path in ("./husky_ur5e", "husky_ur5e/", Path("husky_ur5e"), str(folder)):
        assert find_robot(path).resolve() == folder / "robot.yaml"
        assert load_robot(path).urdf.resolve() == folder / "robot.urdf"
    assert find_robot("husky_ur5e").parent != folder
    with expect_error("this robot file does not exist"):
        find_robot("./husky")
