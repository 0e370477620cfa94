"""Compares the virtual kinematic chain with its robot and re-rooted objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import make_room
from helpers.objects import SHAPES, load_object_text
from helpers.small_problems import (
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
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import Scene

KINDS = ("revolute", "continuous", "prismatic", "fixed")
AXES = ("1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 0 -1", "0.6 0 0.8", "1 -2 3")


def make_tree(rng: np.random.Generator, number: int) -> str:
    """Return a random URDF tree of links l0, l1, etc."""

    def make_origin() -> str:
        xyz, rpy = (" ".join(map(str, row)) for row in rng.uniform(-1.0, 1.0, (2, 3)).round(4))
        return f'<origin xyz="{xyz}" rpy="{rpy}"/>'

    parts = []
    for i in range(number):
        shape = f"{make_origin()}<geometry>{rng.choice(SHAPES)}</geometry>"
        inertia = '<mass value="1.5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
        body = f"<inertial>{inertia}</inertial><collision>{shape}</collision>"
        parts.append(f'<link name="l{i}">{body}</link>')
    for i in range(1, number):
        kind, axis = rng.choice(KINDS), f'<axis xyz="{rng.choice(AXES)}"/>'
        limit = f'<limit lower="-2" upper="{1 + i}" velocity="{i}" effort="{10 * i}"/>'
        links = f'<parent link="l{rng.integers(i)}"/><child link="l{i}"/>'
        joint = f"{links}{make_origin()}{axis}{limit}"
        parts.append(f'<joint name="j{i}" type="{kind}">{joint}</joint>')
    return f'<robot name="t">{"".join(parts)}</robot>'


def compute_placements(
    model: pin.Model, geometry: pin.GeometryModel, q: np.ndarray
) -> tuple[dict[str, pin.SE3], dict[str, pin.SE3]]:
    """Return the world placements of all frames and of all shapes, by name."""
    data, shapes = model.createData(), geometry.createData()
    pin.framesForwardKinematics(model, data, q)
    pin.updateGeometryPlacements(model, data, geometry, shapes)
    return (
        {frame.name: data.oMf[i].copy() for i, frame in enumerate(model.frames)},
        {shape.name: shapes.oMg[i].copy() for i, shape in enumerate(geometry.geometryObjects)},
    )


def assert_same(found: pin.SE3, expected: pin.SE3, tolerance: float = 1e-10) -> None:
    np.testing.assert_allclose(found.homogeneous, expected.homogeneous, rtol=0.0, atol=tolerance)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 8), st.integers(0, 2**32 - 1))
def test_inverted_trees_keep_all_frames_and_shapes(links: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    text = "urdf: thing.urdf\nattachments: [{name: a, link: l0}]"
    item = load_object_text(make_tree(rng, links), text)
    link, z = f"l{rng.integers(links)}", rng.uniform(-3.0, 3.0, item.coordinates.size)
    model, collision = invert(item, link, z)
    coordinates = Coordinates(model)
    moving = [item.coordinates.index(name) for name in coordinates.names]
    names = {name for name in item.coordinates.names if link in item.links_moved_by({name})}
    assert set(coordinates.names) == names
    frames, shapes = compute_placements(item.model, item.collision, item.coordinates.q(z))
    new_frames, new_shapes = compute_placements(model, collision, coordinates.q(z[moving]))
    assert new_shapes.keys() == shapes.keys()
    to_root = frames[link].inverse()
    for name in item.links:
        assert_same(new_frames[name], to_root * frames[name], 1e-12)
    for name, placement in shapes.items():
        assert_same(new_shapes[name], to_root * placement, 1e-12)
    for attribute in ("lower", "upper", "velocity"):
        old, new = (getattr(each, attribute) for each in (item.coordinates, coordinates))
        np.testing.assert_array_equal(new, old[moving])
    masses = [sum(inertia.mass for inertia in each.inertias) for each in (model, item.model)]
    assert masses[0] == pytest.approx(masses[1])
    for shape in collision.geometryObjects:
        frame = model.frames[shape.parentFrame]
        assert frame.parentJoint == shape.parentJoint
        assert shape.name.startswith(frame.name)


def test_inverting_aligned_joints_leaves_exact_zeros_and_ones() -> None:
    model, _ = invert(load_object("door"), "lever", [0.0, 0.0])
    for placement in model.jointPlacements:
        assert set(np.abs(placement.rotation).ravel()) <= {0.0, 1.0}
    assert [joint.shortname() for joint in model.joints][1:] == ["JointModelRZ"] * 2


def test_wrong_states_are_rejected() -> None:
    with pytest.raises(InputError, match="number of coordinates"):
        invert(load_object("door"), "lever", [0.0])


GRASPS = [
    {"door": "handle"},
    {"drawer": "handle_free"},
    *(
        {"cabinet": attachment}
        for attachment in ("grip", "rail", "bar", "sleeve", "socket", "spike", "wheel", "face")
    ),
    {"door": "handle", "drawer": "handle_free", "cabinet": "ball"},
]


def test_chain_begins_with_the_robot() -> None:
    scene, rng = make_full_scene(), np.random.default_rng(0)
    for grasps in ({}, GRASPS[-1]):
        chain, robot = consolidate(scene, grasps), scene.robot
        for z in sample_configurations(chain.lower, chain.upper, 3, rng):
            frames, shapes = compute_placements(
                chain.model, chain.collision, chain.coordinates.q(z)
            )
            robot_frames, robot_shapes = compute_placements(
                robot.model, robot.collision, robot.coordinates.q(z[: robot.coordinates.size])
            )
            for name, placement in robot_frames.items():
                assert_same(frames[name], placement)
            assert list(shapes)[: len(robot_shapes)] == list(robot_shapes)
            for name, placement in robot_shapes.items():
                assert_same(shapes[name], placement)
            assert grasps or (len(shapes), chain.closures) == (len(robot_shapes), {})


def test_names_and_limits_are_those_of_the_joints() -> None:
    chain = consolidate(make_full_scene(), {"drawer": "handle", "cabinet": "rail"})
    robot = make_full_scene().robot
    added = ["drawer.slide", "cabinet.rail", "cabinet.slide", "cabinet.swing"]
    size = robot.coordinates.size
    assert chain.names == (*robot.coordinates.names, *added)
    assert [chain.index(name) for name in chain.names] == list(range(size + len(added)))
    assert chain.size == chain.coordinates.size == chain.model.nv == size + len(added)
    names = ("lower", "upper", "velocity", "acceleration")
    found, own = (np.transpose([getattr(each, k) for k in names]) for each in (chain, robot))
    np.testing.assert_array_equal(found[:size], own)
    limits = [
        (0.0, 0.4, 0.5, 1.0),
        (-0.05, 0.08, 1.0, 2.0),
        (0.0, 0.3, 0.4, 0.7),
        (-1.0, 2.0, 1.5, 3.0),
    ]
    np.testing.assert_allclose(found[size:], limits, rtol=0.0, atol=1e-12)
    for k, name in enumerate(names[:3]):
        np.testing.assert_allclose(getattr(chain.coordinates, name)[size:], found[size:, k])
    assert [chain.model.names[j] for j in chain.coordinates.joints[size:]] == added


def test_joint_placements_equal_pinocchio() -> None:
    chain = consolidate(make_full_scene(), GRASPS[-1])
    z = sample_configurations(chain.lower, chain.upper, 10, np.random.default_rng(3))
    rotations, translations = chain.joint_placements(z)
    data = chain.model.createData()
    for row, q in enumerate(chain.coordinates.q(z)):
        pin.forwardKinematics(chain.model, data, q)
        for found, part in ((rotations, "rotation"), (translations, "translation")):
            expected = [getattr(placement, part) for placement in data.oMi]
            np.testing.assert_allclose(found[row], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("find", "message"),
    [
        (lambda: invert(load_object("door"), "levr", [0.0, 0.0]), "levr.*lever"),
        (lambda: consolidate(make_full_scene(), {"dor": "handle"}), "dor.*door"),
        (lambda: consolidate(make_full_scene(), {"door": "handel"}), "handel.*handle"),
        (lambda: consolidate(make_full_scene(), {}).index("base_z"), "base_z.*base_"),
    ],
)
def test_unknown_names_are_rejected(find: Callable[[], object], message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        find()


def test_attachment_named_like_a_joint_is_rejected() -> None:
    scene = make_full_scene()
    bar = dataclasses.replace(scene.objects["door"].object.attachments["handle_free"], name="hinge")
    twice = replace_objects(scene, {"door": replace_attachment(scene.objects["door"], bar)})
    with pytest.raises(InputError, match=r"door\.hinge"):
        consolidate(twice, {"door": "hinge"})


# --- carried objects

STICK, END = Hold("stick", "grip"), Hold("stick", "end")
BALL = Hold("ball", "grip")
PULLED = Hold("ball", "pull", STICK, "tip")
PUSHED = Hold("ball", "pull", END, "tip")
CARRIED = [
    (END,),
    (STICK, PULLED),
    (STICK, BALL),  # two branches of the robot's tree
    (STICK, END),  # two branches of one object
    (STICK, BALL, END, PULLED),
    (END, PUSHED, Hold("cabinet", "ball")),
    # A chain of three, the last with joints.
    (STICK, PULLED, Hold("cabinet", "sleeve", PULLED, "ball")),
]


@cache
def make_carried_scene() -> Scene:
    """Return a scene with stick, ball, and a free cabinet."""
    scene, cabinet = make_room(objects=("stick", "ball")), make_full_scene().objects["cabinet"]
    free = dataclasses.replace(cabinet.object, free=True)
    return replace_objects(scene, {"cabinet": dataclasses.replace(cabinet, object=free)})


def compute_expected_links(
    chain: VirtualKinematicChain, scene: Scene, hold: Hold, z: np.ndarray
) -> tuple[PlacedObject, dict[str, pin.SE3]]:
    """Return a held object and its links where they are, computed from the robot outwards."""
    values = dict(zip(chain.names, z.tolist(), strict=True))
    placed, robot = scene.objects[hold.object], scene.robot
    item = placed.object
    state = [
        values.get(f"{hold.object}.{joint}", value)
        for joint, value in zip(item.coordinates.names, placed.state, strict=True)
    ]
    grasp = item.attachments[hold.attachment]
    tool = grasp.tool([values[f"{hold.object}.{name}"] for name in grasp.coordinates])
    if hold.by is None:
        holder = dataclasses.replace(scene, start=z[: robot.coordinates.size]).tool_placement()
    else:
        holder = compute_expected_links(chain, scene, hold.by, z)[1][hold.link or ""]
    base = holder * (item.link_placement(grasp.link, state) * tool).inverse()
    links = {link: base * item.link_placement(link, state) for link in item.links}
    return dataclasses.replace(placed, placement=base, state=np.array(state)), links


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
    for table in (chain.closures, chain.grasped_geometries, chain.virtual, chain.prefixes):
        assert tuple(table) == holds
    for z in sample_configurations(chain.lower, chain.upper, 3, np.random.default_rng(4)):
        q, data = chain.coordinates.q(z), chain.model.createData()
        shapes = list(compute_placements(chain.model, chain.collision, q)[1].items())
        pin.forwardKinematics(chain.model, data, q)
        for hold in holds:
            placed, links = compute_expected_links(chain, scene(), hold, z)
            for link, placement in links.items():
                joint, local = chain.frame(link, hold)
                assert_same(data.oMi[joint] * local, placement)
            closure, base_link = chain.closures[hold], placed.object.base_link
            assert_same(data.oMi[closure.joint] * closure.local, placed.placement)
            assert_same(closure.target, objects[hold.object].link_placement(base_link))
            expected = {shape.name: shape.placement for shape in make_world_shapes(placed)}
            for index in chain.grasped_geometries[hold]:
                name, placement = shapes[index]
                assert_same(placement, expected[name.rpartition(".")[2]])
                assert chain.collision.geometryObjects[index].parentJoint > 1


def test_all_links_of_a_free_object_move() -> None:
    free, fixed = (
        consolidate(scene, [Hold("cabinet", "grip")]).collision.geometryObjects
        for scene in (make_carried_scene(), make_full_scene())
    )
    names = {shape.name for shape in free} - {shape.name for shape in fixed}
    assert names == {"cabinet.case_0", "cabinet.lid_0"}
    assert len(free) == len(fixed) + 2


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
    assert [len(chain.virtual[hold]) for hold in holds] == [2, 3, 0, 3]
    assert chain.prefixes == {STICK: "stick.", BALL: "ball.", END: "stick'.", PULLED: "ball'."}
    for named in (chain.collision.geometryObjects, chain.model.frames):
        names = [one.name for one in named]
        assert len(set(names)) == len(names)
    indices = [index for hold in holds for index in chain.grasped_geometries[hold]]
    count = len(robot.collision.geometryObjects)
    assert sorted(indices) == list(range(count, len(chain.collision.geometryObjects)))


def test_attachment_held_twice_is_rejected() -> None:
    """Two coordinates would have the same name."""
    with pytest.raises(InputError, match="two coordinates share this name") as caught:
        consolidate(make_carried_scene(), [STICK, PULLED, Hold("ball", "pull")])
    assert str(caught.value.field).startswith("ball.pull_")
    chain = consolidate(make_carried_scene(), [STICK, Hold("cabinet", "spike", STICK, "tip")])
    assert chain.prefixes[Hold("cabinet", "spike", STICK, "tip")] == "cabinet."
