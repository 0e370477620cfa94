"""Compares the virtual kinematic chain with its robot and re-rooted objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import make_room
from helpers.objects import SHAPES, format_joint, load_object_text
from helpers.small_problems import (
    load_door_scene,
    make_full_scene,
    replace_attachment,
    replace_objects,
    sample_configurations,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.chain.chain import (
    VirtualKinematicChain,
    consolidate,
    invert,
)
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene

KINDS = ("revolute", "continuous", "prismatic", "fixed")
AXES = ("1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 0 -1", "0.6 0 0.8", "1 -2 3")


@st.composite
def trees(draw: st.DrawFn) -> tuple[str, int]:
    """Draw a URDF tree of 1 to 8 links and the index of one of its links."""
    number = draw(st.integers(1, 8))
    length = st.floats(-1.0, 1.0).map(lambda x: round(x, 4))
    parts = []
    for i in range(number):
        xyz, rpy = (f"{draw(length)} {draw(length)} {draw(length)}" for _ in range(2))
        origin = f'<origin xyz="{xyz}" rpy="{rpy}"/>'
        shape = f"{origin}<geometry>{draw(st.sampled_from(SHAPES))}</geometry>"
        inertia = '<mass value="1.5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
        shapes = f"<collision>{shape}</collision><visual>{shape}</visual>"
        bodies = f"<inertial>{origin}{inertia}</inertial>{shapes}"
        parts.append(f'<link name="l{i}">{bodies}</link>')
    for i in range(1, number):
        xyz, rpy = (f"{draw(length)} {draw(length)} {draw(length)}" for _ in range(2))
        origin = f'<origin xyz="{xyz}" rpy="{rpy}"/>'
        parent, kind, axis = (
            draw(st.integers(0, i - 1)),
            draw(st.sampled_from(KINDS)),
            draw(st.sampled_from(AXES)),
        )
        limit = f'<limit lower="-2" upper="{1 + i}" velocity="{i}" effort="{10 * i}"/>'
        links = f'<parent link="l{parent}"/><child link="l{i}"/>'
        parts.append(
            f'<joint name="j{i}" type="{kind}">{links}{origin}<axis xyz="{axis}"/>{limit}</joint>'
        )
    return f'<robot name="t">{"".join(parts)}</robot>', draw(st.integers(0, number - 1))


def compute_placements(
    model: pin.Model, geometry: pin.GeometryModel, q: np.ndarray
) -> tuple[dict[str, pin.SE3], dict[str, pin.SE3]]:
    """Return the world placements of all body frames and of all shapes, by name."""
    data, shapes = model.createData(), geometry.createData()
    pin.framesForwardKinematics(model, data, q)
    pin.updateGeometryPlacements(model, data, geometry, shapes)
    bodies = {
        frame.name: data.oMf[i].copy()
        for i, frame in enumerate(model.frames)
        if frame.type == pin.FrameType.BODY
    }
    return bodies, {
        shape.name: shapes.oMg[i].copy() for i, shape in enumerate(geometry.geometryObjects)
    }


@settings(max_examples=50, deadline=None)
@given(trees(), st.integers(0, 2**32 - 1))
def test_inverted_trees_keep_all_frames_and_shapes(tree: tuple[str, int], seed: int) -> None:
    urdf, root = tree
    item = load_object_text(urdf, "urdf: thing.urdf\nattachments: [{name: a, link: l0}]")
    link, z = f"l{root}", np.random.default_rng(seed).uniform(-3.0, 3.0, item.coordinates.size)
    model, collision = invert(item, link, z)
    coordinates = Coordinates(model)
    moving = coordinates.names
    assert set(moving) <= set(item.coordinates.names)
    q = coordinates.q(np.array([z[item.coordinates.index(name)] for name in moving]))
    bodies, shapes = compute_placements(item.model, item.collision, item.coordinates.q(z))
    new_bodies, new_shapes = compute_placements(model, collision, q)
    assert new_bodies.keys() == bodies.keys()
    assert new_shapes.keys() == shapes.keys()
    to_root = bodies[link].inverse()
    for old, new in ((bodies, new_bodies), (shapes, new_shapes)):
        for name in old:
            np.testing.assert_allclose(
                new[name].homogeneous, (to_root * old[name]).homogeneous, atol=1e-12, rtol=0.0
            )
    for name in moving:
        old, new = item.coordinates.index(name), coordinates.index(name)
        for attribute in ("lower", "upper", "velocity"):
            assert getattr(coordinates, attribute)[new] == getattr(item.coordinates, attribute)[old]
    assert sum(i.mass for i in model.inertias) == pytest.approx(
        sum(i.mass for i in item.model.inertias)
    )
    for shape in collision.geometryObjects:
        frame = model.frames[shape.parentFrame]
        assert frame.parentJoint == shape.parentJoint
        assert shape.name.startswith(frame.name)


def test_only_joints_on_the_path_to_the_base_move() -> None:
    links = "".join(f'<link name="{name}"/>' for name in ("base", "arm", "hand", "side", "back"))
    joints = (
        format_joint("shoulder", "revolute", "base", "arm", "0 0 1")
        + format_joint("wrist", "prismatic", "arm", "hand", "1 0 0")
        + format_joint("flap", "revolute", "arm", "side", "0 1 0")
        + format_joint("lid", "revolute", "base", "back", "1 0 0")
    )
    urdf = f'<robot name="t">{links}{joints}</robot>'
    item = load_object_text(urdf, "urdf: thing.urdf\nattachments: [{name: a, link: hand}]")
    assert [*invert(item, "hand", np.zeros(4))[0].names[1:]] == ["wrist", "shoulder"]
    assert invert(item, "base", np.zeros(4))[0].nq == 0


def test_inverting_aligned_joints_leaves_exact_zeros_and_ones() -> None:
    model, _ = invert(load_object("door"), "lever", [0.0, 0.0])
    for placement in model.jointPlacements:
        assert set(np.abs(placement.rotation).ravel()) <= {0.0, 1.0}
    assert [joint.shortname() for joint in model.joints][1:] == [
        "JointModelRZ",
        "JointModelRZ",
    ]


def test_unknown_links_and_wrong_states_are_rejected() -> None:
    door = load_object("door")
    with pytest.raises(UnknownNameError) as caught:
        invert(door, "levr", [0.0, 0.0])
    assert caught.value.nearest == "lever"
    with pytest.raises(InputError, match="number of coordinates"):
        invert(door, "lever", [0.0])


GRASPS = [
    {"door": "handle"},
    {"drawer": "handle_free"},
    {"cabinet": "grip"},
    {"cabinet": "rail"},
    {"cabinet": "bar"},
    {"cabinet": "sleeve"},
    {"cabinet": "socket"},
    {"cabinet": "spike"},
    {"cabinet": "wheel"},
    {"cabinet": "face"},
    {"door": "handle", "drawer": "handle_free", "cabinet": "ball"},
]


def compute_frames(model: pin.Model, q: np.ndarray) -> list[pin.SE3]:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return [placement.copy() for placement in data.oMf]


def compute_shapes(model: pin.Model, geometry: pin.GeometryModel, q: np.ndarray) -> list[pin.SE3]:
    data, placed = model.createData(), geometry.createData()
    pin.updateGeometryPlacements(model, data, geometry, placed, q)
    return [placement.copy() for placement in placed.oMg]


def assert_same(first: pin.SE3, second: pin.SE3, tolerance: float = 1e-10) -> None:
    np.testing.assert_allclose(first.homogeneous, second.homogeneous, rtol=0.0, atol=tolerance)


def compute_virtual_motion(
    chain: VirtualKinematicChain, scene: Scene, name: str, grasp: str, z: np.ndarray
) -> pin.SE3:
    """Return J(v) followed by the standoff, from their definition."""
    attachment = scene.objects[name].object.attachments[grasp]

    def value(suffix: str) -> float:
        return float(z[chain.index(f"{name}.{grasp}{suffix}")])

    turn, shift = np.eye(3), np.zeros(3)
    if attachment.joint == "listed":
        moved = pin.SE3.Identity()
        for freedom in attachment.freedoms:
            if freedom.kind == "prismatic":
                moved = moved * pin.SE3(np.eye(3), freedom.axis * value(freedom.suffix))
            else:
                there, spin = (
                    pin.SE3(np.eye(3), freedom.through),
                    pin.AngleAxis(value(freedom.suffix), freedom.axis),
                )
                moved = moved * there * pin.SE3(spin.matrix(), np.zeros(3)) * there.inverse()
        turn, shift = moved.rotation, moved.translation
    if attachment.joint == "spherical":
        turn = (
            pin.utils.rotate("x", value("_x"))
            @ pin.utils.rotate("y", value("_y"))
            @ pin.utils.rotate("z", value("_z"))
        )
    elif attachment.joint == "revolute":
        turn = pin.AngleAxis(value(""), attachment.freedoms[0].axis).matrix()
    elif attachment.joint == "prismatic":
        shift = attachment.freedoms[0].axis * value("")
    elif attachment.joint == "cylindrical":
        turn = pin.AngleAxis(value("_turn"), attachment.freedoms[0].axis).matrix()
        shift = attachment.freedoms[0].axis * value("_slide")
    return pin.SE3(turn, shift - attachment.standoff * turn[:, 2])


def get_object_state(
    chain: VirtualKinematicChain, scene: Scene, name: str, z: np.ndarray
) -> np.ndarray:
    """Return the object's coordinates, from the chain or else from the scene."""
    placed = scene.objects[name]
    values = [
        z[chain.index(f"{name}.{joint}")] if f"{name}.{joint}" in chain.names else value
        for joint, value in zip(placed.object.coordinates.names, placed.state, strict=True)
    ]
    return np.array(values)


def test_chain_begins_with_the_robot() -> None:
    scene = make_full_scene()
    chain, robot = consolidate(scene, GRASPS[-1]), scene.robot
    for z in sample_configurations(chain.lower, chain.upper, 4, np.random.default_rng(0)):
        q, q_robot = chain.coordinates.q(z), robot.coordinates.q(z[: robot.coordinates.size])
        chain_frames, robot_frames = (
            compute_frames(chain.model, q),
            compute_frames(robot.model, q_robot),
        )
        for index, frame in enumerate(robot.model.frames):
            assert_same(chain_frames[chain.model.getFrameId(frame.name)], robot_frames[index])
        found = compute_shapes(chain.model, chain.collision, q)
        expected = compute_shapes(robot.model, robot.collision, q_robot)
        for one, other in zip(found, expected, strict=False):
            assert_same(one, other)


@pytest.mark.parametrize(
    ("grasps", "added", "limits"),
    [
        (
            {"drawer": "handle", "cabinet": "rail"},
            ["drawer.slide", "cabinet.rail", "cabinet.slide", "cabinet.swing"],
            [
                (0.0, 0.4, 0.5, 1.0),
                (-0.05, 0.08, 1.0, 2.0),
                (0.0, 0.3, 0.4, 0.7),
                (-1.0, 2.0, 1.5, 3.0),
            ],
        ),
    ],
)
def test_names_and_limits_are_those_of_the_joints(
    grasps: dict[str, str], added: list[str], limits: list[tuple[float, float, float, float]]
) -> None:
    scene = make_full_scene()
    chain, robot = consolidate(scene, grasps), scene.robot
    size = robot.coordinates.size
    assert chain.names == (*robot.coordinates.names, *added)
    assert chain.size == chain.coordinates.size == chain.model.nv == size + len(added)
    found = np.column_stack([chain.lower, chain.upper, chain.velocity, chain.acceleration])
    np.testing.assert_array_equal(
        found[:size],
        np.column_stack([robot.lower, robot.upper, robot.velocity, robot.acceleration]),
    )
    np.testing.assert_allclose(found[size:], limits, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(chain.coordinates.lower[size:], chain.lower[size:])
    np.testing.assert_allclose(chain.coordinates.upper[size:], chain.upper[size:])
    np.testing.assert_allclose(chain.coordinates.velocity[size:], chain.velocity[size:])
    assert [chain.model.names[j] for j in chain.coordinates.joints[size:]] == added
    for index, name in enumerate(chain.names):
        assert chain.index(name) == index


def test_geometry_consists_of_the_robot_and_moving_links() -> None:
    scene = make_full_scene()
    held = {
        Hold("door", "handle"): ["panel_0", "lever_0", "lever_1"],
        Hold("cabinet", "grip"): ["arm_0", "tray_0", "tray_1", "flap_0"],
    }
    chain, robot = consolidate(scene, list(held)), scene.robot.collision.geometryObjects
    found = chain.collision.geometryObjects
    assert len(found) == len(robot) + sum(len(names) for names in held.values())
    for one, other in zip(found, robot, strict=False):
        assert (one.name, one.parentJoint) == (other.name, other.parentJoint)
    for hold, names in held.items():
        indices = chain.held_geometries[hold]
        assert sorted(found[i].name for i in indices) == [
            f"{hold.object}.{k}" for k in sorted(names)
        ]
        assert all(found[i].parentJoint >= scene.robot.model.njoints - 1 for i in indices)


def test_joint_placements_equal_pinocchio() -> None:
    chain = consolidate(make_full_scene(), GRASPS[-1])
    z = sample_configurations(chain.lower, chain.upper, 10, np.random.default_rng(3))
    rotations, translations = chain.joint_placements(z)
    assert rotations.shape == (10, chain.model.njoints, 3, 3)
    assert translations.shape == (10, chain.model.njoints, 3)
    data = chain.model.createData()
    for row, q in enumerate(chain.coordinates.q(z)):
        pin.forwardKinematics(chain.model, data, q)
        for joint in range(chain.model.njoints):
            np.testing.assert_allclose(
                rotations[row, joint], data.oMi[joint].rotation, rtol=0.0, atol=1e-12
            )
            np.testing.assert_allclose(
                translations[row, joint], data.oMi[joint].translation, rtol=0.0, atol=1e-12
            )


def test_chain_without_holds_is_the_robot() -> None:
    scene = load_door_scene()
    before = scene.robot.model.copy()
    consolidate(scene, {"door": "handle_free"})
    chain = consolidate(scene, {})
    assert chain.names == scene.robot.coordinates.names
    assert not chain.closures
    assert len(chain.collision.geometryObjects) == len(scene.robot.collision.geometryObjects)
    assert scene.robot.model == before


def test_unknown_names_are_rejected() -> None:
    scene = make_full_scene()
    with pytest.raises(UnknownNameError, match=r"dor.*door"):
        consolidate(scene, {"dor": "handle"})
    with pytest.raises(UnknownNameError, match=r"handel.*handle"):
        consolidate(scene, {"door": "handel"})
    with pytest.raises(UnknownNameError, match=r"door\.hing"):
        consolidate(scene, {"door": "handle"}).index("door.hing")


def test_attachment_named_like_a_joint_is_rejected() -> None:
    scene = make_full_scene()
    bar = dataclasses.replace(scene.objects["door"].object.attachments["handle_free"], name="hinge")
    twice = replace_objects(scene, {"door": replace_attachment(scene.objects["door"], bar)})
    with pytest.raises(InputError, match=r"door\.hinge"):
        consolidate(twice, {"door": "hinge"})


# --- carried objects

STICK, END = Hold("stick", "grip"), Hold("stick", "end")
BALL, PULLED, PUSHED = (
    Hold("ball", "grip"),
    Hold("ball", "pull", STICK, "tip"),
    Hold("ball", "pull", END, "tip"),
)
CARRIED = [
    (END,),
    (STICK, PULLED),
    (STICK, BALL),  # two branches of the robot's tree
    (STICK, END),  # two branches of one object
    (STICK, BALL, END, PULLED),
    (END, PUSHED, Hold("cabinet", "ball")),
    (
        STICK,
        PULLED,
        Hold("cabinet", "sleeve", PULLED, "ball"),
    ),  # a chain of three, the last with joints
]


@cache
def make_carried_scene() -> Scene:
    """Return a scene with stick, ball, and a free cabinet."""
    scene, cabinet = make_room(objects=("stick", "ball")), make_full_scene().objects["cabinet"]
    return replace_objects(
        scene,
        {
            "cabinet": dataclasses.replace(
                cabinet, object=dataclasses.replace(cabinet.object, free=True)
            )
        },
    )


def compute_expected_frames(
    chain: VirtualKinematicChain, scene: Scene, hold: Hold, z: np.ndarray
) -> tuple[pin.SE3, dict[str, pin.SE3]]:
    """Return the placements of an object's base and links, computed from the robot outwards."""
    item, grasp = (
        scene.objects[hold.object].object,
        scene.objects[hold.object].object.attachments[hold.attachment],
    )
    if hold.by is None:
        robot = scene.robot
        holder = compute_frames(robot.model, robot.coordinates.q(z[: robot.coordinates.size]))[
            robot.model.getFrameId(robot.tool_frame)
        ]
    else:
        holder = compute_expected_frames(chain, scene, hold.by, z)[1][hold.link or ""]
    own = compute_frames(
        item.model, item.coordinates.q(get_object_state(chain, scene, hold.object, z))
    )
    links = {
        f.name: own[i] for i, f in enumerate(item.model.frames) if f.type == pin.FrameType.BODY
    }
    motion = compute_virtual_motion(chain, scene, hold.object, hold.attachment, z)
    base = holder * (links[grasp.link] * grasp.placement * motion).inverse()
    return base, {link: base * placement for link, placement in links.items()}


@pytest.mark.parametrize(
    ("scene", "holds"),
    [
        *((make_carried_scene, holds) for holds in CARRIED),
        *((make_full_scene, tuple(map(Hold, grasps, grasps.values()))) for grasps in GRASPS),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else value.__name__,
)
def test_objects_follow_hand_and_grasp(scene: Callable[[], Scene], holds: tuple[Hold, ...]) -> None:
    objects, chain = scene().objects, consolidate(scene(), holds)
    for table in (chain.closures, chain.held_geometries, chain.virtual, chain.prefixes):
        assert tuple(table) == holds
    for z in sample_configurations(chain.lower, chain.upper, 3, np.random.default_rng(4)):
        q = chain.coordinates.q(z)
        shape_placements, data = (
            compute_shapes(chain.model, chain.collision, q),
            chain.model.createData(),
        )
        pin.forwardKinematics(chain.model, data, q)
        for hold in holds:
            placed = objects[hold.object]
            base, links = compute_expected_frames(chain, scene(), hold, z)
            for link, placement in links.items():
                joint, local = chain.frame(link, hold)
                assert_same(data.oMi[joint] * local, placement)
            closure = chain.closures[hold]
            assert_same(data.oMi[closure.joint] * closure.local, base)
            assert_same(closure.target, placed.link_placement(placed.object.base_link))
            state = get_object_state(chain, scene(), hold.object, z)
            world_shapes = make_world_shapes(
                dataclasses.replace(placed, placement=base, state=state)
            )
            expected = {shape.name: shape.placement for shape in world_shapes}
            for index in chain.held_geometries[hold]:
                shape = chain.collision.geometryObjects[index]
                assert_same(shape_placements[index], expected[shape.name.rpartition(".")[2]])
                assert shape.parentJoint > 1


def test_all_links_of_a_free_object_move() -> None:
    free, fixed = (
        consolidate(scene, [Hold("cabinet", "grip")]).collision.geometryObjects
        for scene in (make_carried_scene(), make_full_scene())
    )
    names = {shape.name for shape in free} - {shape.name for shape in fixed}
    assert names == {"cabinet.case_0", "cabinet.lid_0"}


def test_every_hold_has_its_own_shapes_joints_and_names() -> None:
    holds = (STICK, BALL, END, PULLED)
    chain = consolidate(make_carried_scene(), holds)
    robot = make_carried_scene().robot
    assert chain.names == (
        *robot.coordinates.names,
        "stick.grip_turn",
        "stick.grip_slide",
        *(f"ball.{grasp}_{axis}" for grasp in ("grip", "pull") for axis in "zyx"),
    )
    assert chain.virtual[STICK] == ("stick.grip_turn", "stick.grip_slide")
    assert chain.virtual[END] == ()
    assert chain.virtual[PULLED] == ("ball.pull_z", "ball.pull_y", "ball.pull_x")
    assert chain.prefixes == {STICK: "stick.", BALL: "ball.", END: "stick'.", PULLED: "ball'."}
    indices = [i for hold in holds for i in chain.held_geometries[hold]]
    count = len(robot.collision.geometryObjects)
    assert sorted(indices) == list(range(count, len(chain.collision.geometryObjects)))
    assert [len(chain.held_geometries[hold]) for hold in holds] == [5, 1, 5, 1]
    names = [shape.name for shape in chain.collision.geometryObjects]
    assert len(set(names)) == len(names)
    frames = [frame.name for frame in chain.model.frames]
    assert len(set(frames)) == len(frames)


def test_attachment_held_twice_is_rejected() -> None:
    """Two coordinates would have the same name."""
    with pytest.raises(InputError, match="two coordinates share this name") as caught:
        consolidate(make_carried_scene(), [STICK, PULLED, Hold("ball", "pull")])
    assert str(caught.value.field).startswith("ball.pull_")
    chain = consolidate(make_carried_scene(), [STICK, Hold("cabinet", "spike", STICK, "tip")])
    assert chain.prefixes[Hold("cabinet", "spike", STICK, "tip")] == "cabinet."
