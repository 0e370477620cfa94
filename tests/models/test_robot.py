from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.files import resources
from vkc_pin.models.robot import Robot
from vkc_pin.models.robot_file import load_robot
from vkc_pin.scene.scene import Scene

FOLDER = resources.folder("robots") / "husky_ur5e"
ARM = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]


def at_rest(robot: Robot) -> np.ndarray:
    return np.concatenate([np.zeros(3), robot.home])


@pytest.fixture(scope="module")
def husky() -> Robot:
    return load_robot("husky_ur5e")


def placement(robot: Robot, frame: str, z: np.ndarray) -> pin.SE3:
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    return data.oMf[robot.model.getFrameId(frame)].copy()


def ur5e(q: np.ndarray) -> np.ndarray:
    """Forward kinematics by the Denavit-Hartenberg parameters that Universal Robots publishes."""
    d, a = [0.1625, 0, 0, 0.1333, 0.0997, 0.0996], [0, -0.425, -0.3922, 0, 0, 0]
    total = np.eye(4)
    for k, twist in enumerate([np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]):
        c, s, ct, st = np.cos(q[k]), np.sin(q[k]), np.cos(twist), np.sin(twist)
        total = total @ [[c, -s * ct, s * st, a[k] * c], [s, c * ct, -c * st, a[k] * s], [0, st, ct, d[k]], [0, 0, 0, 1]]
    return total


def small_urdf(folder: Path, *, joints: str = "", links: str = "", name: str = "small") -> Path:
    shape = "<collision><geometry><box size='0.1 0.1 0.1'/></geometry></collision>"
    chain = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0 0 0.5" rpy="1.5707963267948966 0 0"/>'
        f'<axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1.5" effort="1"/></joint>'
        for k in range(3)
    )
    file = folder / f"{name}.urdf"
    bodies = "".join(f'<link name="l{k}">{shape}</link>' for k in range(4))
    file.write_text(f'<robot name="{name}">{bodies}{links}{chain}{joints}</robot>')
    return file


def test_coordinates_and_limits(husky: Robot) -> None:
    assert husky.coordinates.names == ("base_x", "base_y", "base_yaw", *ARM)
    assert husky.model.names[1] == "base"
    assert husky.model.joints[1].shortname() == "JointModelPlanar"
    turn = 2.0 * np.pi
    np.testing.assert_allclose(husky.upper, [20, 20, np.inf, turn, turn, np.pi, turn, turn, turn])
    np.testing.assert_allclose(husky.lower, -husky.upper)
    np.testing.assert_allclose(husky.velocity, [1, 1, 2, *[np.pi] * 6])
    np.testing.assert_allclose(husky.acceleration, [3, 3, 6, *[1.4] * 6])
    np.testing.assert_allclose(husky.home, [1.57, -0.8678, -2.2043, -0.0347, 1.6315, 0])
    assert husky.touch_links == ("gripper_link", "gripper_left_finger", "gripper_right_finger")


def test_husky_is_as_large_as_the_data_sheet_says(husky: Robot) -> None:
    corners = [
        husky.collision.geometryObjects[k].placement.act(point)
        for k in range(husky.collision.ngeoms)
        if husky.link_of(k) == "base_link"
        for point in np.asarray(husky.collision.geometryObjects[k].geometry.points())
    ]
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.990, 0.670, 0.390], atol=1e-3)
    np.testing.assert_allclose(np.min(corners, axis=0)[2], 0.0, atol=5e-4)
    assert placement(husky, "top_plate_link", np.zeros(9)).translation[2] == pytest.approx(0.39)


def test_forward_kinematics_against_the_makers_parameters(husky: Robot) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        z = np.concatenate([rng.uniform(-3, 3, 3), rng.uniform(-np.pi, np.pi, 6)])
        base = pin.SE3(pin.rpy.rpyToMatrix(0, 0, z[2]), np.array([z[0], z[1], 0.0])).homogeneous
        foot = pin.SE3(np.eye(3), np.array([0.25, 0.0, 0.39])).homogeneous
        flange = base @ foot @ ur5e(z[3:])
        np.testing.assert_allclose(placement(husky, "tool0", z).homogeneous, flange, atol=1e-12)
        tool = flange @ pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.142224])).homogeneous
        np.testing.assert_allclose(placement(husky, husky.tool_frame, z).homogeneous, tool, atol=1e-12)


def test_foot_is_turned_by_pi(husky: Robot) -> None:
    np.testing.assert_allclose(placement(husky, "ur_base_link", np.zeros(9)).rotation, np.diag([-1, -1, 1]), atol=1e-12)


def test_joint_placements_are_clean(husky: Robot) -> None:
    for joint in husky.model.jointPlacements:
        for entry in np.asarray(joint.homogeneous).ravel():
            assert entry in (0.0, 1.0, -1.0) or abs(entry) > 1e-3


def test_fingers_leave_the_opening_free(husky: Robot) -> None:
    data, placed = husky.model.createData(), husky.collision.createData()
    pin.updateGeometryPlacements(husky.model, data, husky.collision, placed, husky.coordinates.q(at_rest(husky)))
    tool = placement(husky, "tool", at_rest(husky))

    def gap(shape: coal.CollisionGeometry, offset: tuple[float, float, float]) -> float:
        at = tool * pin.SE3(np.eye(3), np.array(offset))
        place, result = coal.Transform3s(at.rotation, at.translation), coal.DistanceResult()
        request = coal.DistanceRequest()
        return min(
            coal.distance(
                shape,
                place,
                husky.collision.geometryObjects[k].geometry,
                coal.Transform3s(m.rotation, m.translation),
                request,
                result,
            )
            for k, m in enumerate(placed.oMg)
        )

    assert 0.0 < gap(coal.Box(0.085, 0.02, 0.03), (0.0, 0.0, 0.0)) < 0.002  # what the fingers close on lies along x
    assert gap(coal.Box(0.09, 0.02, 0.03), (0.0, 0.0, 0.0)) < 0.0
    assert gap(coal.Box(0.02, 0.3, 0.03), (0.0, 0.0, 0.0)) > 0.02  # and passes through along y
    assert gap(coal.Box(0.02, 0.02, 0.3), (0.0, 0.0, 0.15)) > 0.02  # z points away from the palm
    assert gap(coal.Box(0.02, 0.02, 0.3), (0.0, 0.0, -0.15)) < 0.0


def test_collision_pieces_contain_the_links(husky: Robot) -> None:
    for link in husky.links:
        shapes = [shape for shape in husky.collision.geometryObjects if shape.name.rpartition("_")[0] == link]
        assert all(isinstance(shape.geometry, coal.Convex) and shape.geometry.num_points <= 40 for shape in shapes)
        frame = husky.model.frames[husky.model.getFrameId(link)].placement
        skin = trimesh.util.concatenate([shape.mesh() for shape in husky.file.shapes("visual") if shape.link == link])
        points = np.vstack([skin.vertices, trimesh.sample.sample_surface(skin, 3000, seed=0)[0]])
        points = points @ frame.rotation.T + frame.translation
        outside = np.full(len(points), np.inf)
        for shape in shapes:
            local = (points - shape.placement.translation) @ shape.placement.rotation
            hull = trimesh.convex.convex_hull(np.asarray(shape.geometry.points()))
            planes = np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
            outside = np.minimum(outside, (local @ hull.face_normals.T - planes).max(axis=1))
        assert outside.max() < 1e-6, link


def test_home_is_free_of_collisions_by_far(husky: Robot) -> None:
    data, placed = husky.model.createData(), husky.collision.createData()
    pin.computeDistances(husky.model, data, husky.collision, placed, husky.coordinates.q(at_rest(husky)))
    assert min(result.min_distance for result in placed.distanceResults) > 0.05


def test_pairs(husky: Robot) -> None:
    everything = load_robot("husky_ur5e", pairs="all")
    assert len(husky.collision.geometryObjects) == 18
    # 4 shapes on the base, 1, 3, 2, 1, 1 on the arm's links, 6 on the hand: all but those on the same joint
    counts = [4, 1, 3, 2, 1, 1, 6]
    assert len(everything.collision.collisionPairs) == (sum(counts) ** 2 - sum(count**2 for count in counts)) // 2
    assert len(husky.collision.collisionPairs) == 95
    links = {frozenset((husky.link_of(pair.first), husky.link_of(pair.second))) for pair in husky.collision.collisionPairs}
    assert frozenset(("base_link", "gripper_link")) in links
    assert frozenset(("upper_arm_link", "forearm_link")) not in links


def test_visual_geometry_is_light_and_coloured(husky: Robot) -> None:
    shapes = husky.visual.geometryObjects
    triangles = sum(shape.geometry.num_tris for shape in shapes if isinstance(shape.geometry, coal.BVHModelBase))
    assert 10_000 < triangles < 100_000
    assert all(shape.meshPath == "" for shape in shapes)
    assert len({tuple(shape.meshColor.round(3)) for shape in shapes}) > 5
    assert husky.visual is husky.visual


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


def test_locking_agrees_with_the_whole_model() -> None:
    robot = load_robot("panda")
    full = pin.buildModelFromUrdf(str(robot.urdf), pin.JointModelPlanar())
    rng = np.random.default_rng(2)
    z = np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(robot.lower[3:], robot.upper[3:])])
    q = pin.neutral(full)
    q[: robot.model.nq] = robot.coordinates.q(z)
    data, whole = robot.model.createData(), full.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    pin.framesForwardKinematics(full, whole, q)
    for index, frame in enumerate(robot.model.frames):
        kinds = [i for i, other in enumerate(full.frames) if other.name == frame.name and other.type == frame.type]
        if kinds:
            assert data.oMf[index].isApprox(whole.oMf[kinds[0]], 1e-9), frame.name
    assert pin.computeTotalMass(robot.model) == pytest.approx(pin.computeTotalMass(full))
    pin.centerOfMass(robot.model, data, robot.coordinates.q(z))
    pin.centerOfMass(full, whole, q)
    np.testing.assert_allclose(data.com[0], whole.com[0], atol=1e-9)


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


def test_a_scene_takes_a_robot_yaml_beside_it(tmp_path: Path) -> None:
    small_urdf(tmp_path)
    (tmp_path / "mine.yaml").write_text("urdf: small.urdf\ntool_frame: l2\n")
    document = {"robot": "mine.yaml", "start": {"base": [0, 0, 0]}}
    assert Scene.from_document(document, tmp_path).robot.tool_frame == "l2"


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
def test_mistakes_in_a_robot_yaml(tmp_path: Path, text: str, line: int | None, problem: str) -> None:
    small_urdf(tmp_path)
    (tmp_path / "robot.yaml").write_text(f"urdf: small.urdf\n{text}\n")
    with pytest.raises(InputError, match=problem) as caught:
        load_robot(tmp_path / "robot.yaml")
    assert caught.value.file is not None
    if line is not None:
        assert (caught.value.file, caught.value.line) == (tmp_path / "robot.yaml", line)


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
    with pytest.raises(InputError, match=r"URDF|joint"):
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
