"""Compares the virtual kinematic chain with the robot and the objects it consists of."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import room
from helpers.small_problems import (
    CABINET_STATE,
    door_scene,
    full_scene,
    random_configurations,
    with_attachment,
    with_objects,
)

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.chain.chain import (
    FREEDOM_ACCELERATION,
    FREEDOM_VELOCITY,
    VirtualKinematicChain,
    consolidate,
)
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.world_model import World

GRASPS = [
    {"door": "handle"},
    {"door": "handle_free"},
    {"drawer": "handle"},
    {"drawer": "handle_free"},
    {"cabinet": "grip"},
    {"cabinet": "rail"},
    {"cabinet": "bar"},
    {"cabinet": "ball"},
    {"cabinet": "sleeve"},
    {"cabinet": "socket"},
    {"cabinet": "spike"},
    {"cabinet": "wheel"},
    {"cabinet": "face"},
    {"door": "handle", "drawer": "handle_free", "cabinet": "ball"},
]
IDS = [" ".join(f"{name}.{grasp}" for name, grasp in grasps.items()) for grasps in GRASPS]


def frames(model: pin.Model, q: np.ndarray) -> list[pin.SE3]:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return [placement.copy() for placement in data.oMf]


def shapes(model: pin.Model, geometry: pin.GeometryModel, q: np.ndarray) -> list[pin.SE3]:
    data, placed = model.createData(), geometry.createData()
    pin.updateGeometryPlacements(model, data, geometry, placed, q)
    return [placement.copy() for placement in placed.oMg]


def assert_same(first: pin.SE3, second: pin.SE3, tolerance: float = 1e-10) -> None:
    np.testing.assert_allclose(first.homogeneous, second.homogeneous, rtol=0.0, atol=tolerance)


def virtual_motion(
    chain: VirtualKinematicChain, scene: Scene, name: str, grasp: str, z: np.ndarray
) -> pin.SE3:
    """J(v) and the standoff after it, from their definition."""
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


def object_state(
    chain: VirtualKinematicChain, scene: Scene, name: str, z: np.ndarray
) -> np.ndarray:
    """The object's own coordinates: those of the chain, and those it leaves as they are."""
    placed = scene.objects[name]
    values = [
        z[chain.index(f"{name}.{joint}")] if f"{name}.{joint}" in chain.names else value
        for joint, value in zip(placed.object.coordinates.names, placed.state, strict=True)
    ]
    return np.array(values)


@pytest.mark.parametrize("grasps", GRASPS, ids=IDS)
def test_every_frame_and_shape_is_where_robot_and_object_have_it(grasps: dict[str, str]) -> None:
    scene = full_scene()
    chain, robot = consolidate(scene, grasps), scene.robot
    size = robot.coordinates.size
    for z in random_configurations(chain.lower, chain.upper, 8, np.random.default_rng(0)):
        q, q_robot = chain.coordinates.q(z), robot.coordinates.q(z[:size])
        of_chain, of_robot = frames(chain.model, q), frames(robot.model, q_robot)
        for index, frame in enumerate(robot.model.frames):
            assert_same(of_chain[chain.model.getFrameId(frame.name)], of_robot[index])
        chain_shapes = shapes(chain.model, chain.collision, q)
        for found, expected in zip(
            chain_shapes, shapes(robot.model, robot.collision, q_robot), strict=False
        ):
            assert_same(found, expected)
        tool = of_robot[robot.model.getFrameId(robot.tool_frame)]
        for name, grasp in grasps.items():
            thing, attachment = (
                scene.objects[name].object,
                scene.objects[name].object.attachments[grasp],
            )
            q_object = thing.coordinates.q(object_state(chain, scene, name, z))
            own = frames(thing.model, q_object)
            # The tool in the link is placement · J(v), so the object's base in the world is:
            link = own[thing.model.getFrameId(attachment.link, pin.FrameType.BODY)]
            base = (
                tool
                * (attachment.placement * virtual_motion(chain, scene, name, grasp, z)).inverse()
                * link.inverse()
            )
            bodies = [
                i for i, frame in enumerate(thing.model.frames) if frame.type == pin.FrameType.BODY
            ]
            assert len(bodies) >= 2
            for index in bodies:
                frame = f"{name}.{thing.model.frames[index].name}"
                assert_same(of_chain[chain.model.getFrameId(frame)], base * own[index])
            own_shapes = dict(
                zip(
                    [shape.name for shape in thing.collision.geometryObjects],
                    shapes(thing.model, thing.collision, q_object),
                    strict=True,
                )
            )
            for index in chain.held_geometries[Hold(name, grasp)]:
                shape = chain.collision.geometryObjects[index].name.removeprefix(f"{name}.")
                assert_same(chain_shapes[index], base * own_shapes[shape])


@pytest.mark.parametrize("grasps", GRASPS, ids=IDS)
def test_where_the_closure_holds_the_objects_are_those_of_the_world(grasps: dict[str, str]) -> None:
    """Where the closures hold, objects equal those of a world without inversion."""
    scene, size = full_scene(), full_scene().robot.coordinates.size
    chain = consolidate(scene, grasps)
    for z in random_configurations(chain.lower, chain.upper, 4, np.random.default_rng(1)):
        q = chain.coordinates.q(z)
        of_chain = frames(chain.model, q)
        moved = {}
        for name in grasps:
            placed = scene.objects[name]
            base = of_chain[chain.model.getFrameId(f"{name}.{placed.object.base_link}")]
            state = object_state(chain, scene, name, z)
            moved[name] = dataclasses.replace(placed, placement=base, state=state)
        there = with_objects(scene, moved)
        world, closed = World(there), consolidate(there, grasps)
        values = dict(zip(world.coordinates.names, world.start, strict=True)) | dict(
            zip(world.coordinates.names[:size], z[:size], strict=True)
        )
        expected = frames(
            world.model,
            world.coordinates.q(np.array([values[name] for name in world.coordinates.names])),
        )
        of_chain = frames(closed.model, closed.coordinates.q(z))
        joints = closed.model.createData()
        pin.forwardKinematics(closed.model, joints, closed.coordinates.q(z))
        for name, grasp in grasps.items():
            closure = closed.closures[Hold(name, grasp)]
            assert_same(joints.oMi[closure.joint] * closure.local, closure.target)
            compared = [
                i
                for i, frame in enumerate(closed.model.frames)
                if frame.name.startswith(f"{name}.")
            ]
            assert compared
            for index in compared:
                assert_same(
                    of_chain[index],
                    expected[
                        world.model.getFrameId(closed.model.frames[index].name, pin.FrameType.BODY)
                    ],
                )


def test_the_closures_target_is_the_base_link_in_the_world() -> None:
    scene = full_scene()
    for name, placed in scene.objects.items():
        grasp = next(iter(placed.object.attachments))
        chain = consolidate(scene, {name: grasp})
        closure = chain.closures[Hold(name, grasp)]
        assert_same(closure.target, placed.link_placement(placed.object.base_link))
        base = chain.model.frames[chain.model.getFrameId(f"{name}.{placed.object.base_link}")]
        assert (closure.joint, closure.local) == (base.parentJoint, base.placement)


@pytest.mark.parametrize(
    ("grasps", "added", "limits"),
    [
        (
            {"cabinet": "sleeve"},
            ["cabinet.sleeve_turn", "cabinet.sleeve_slide", "cabinet.slide", "cabinet.swing"],
            [
                (-0.5, 0.9, FREEDOM_VELOCITY, FREEDOM_ACCELERATION),
                (-0.05, 0.08, FREEDOM_VELOCITY, FREEDOM_ACCELERATION),
                (0.0, 0.3, 0.4, 0.7),
                (-1.0, 2.0, 1.5, 3.0),
            ],
        ),
        (
            {"door": "handle"},
            ["door.knob", "door.hinge"],
            [(0.0, 0.8, 2.0, 4.0), (-1.57, 1.57, 1.0, 1.0)],
        ),
        (
            {"door": "handle_free"},
            ["door.handle_free", "door.knob", "door.hinge"],
            [
                (-0.6, 0.6, FREEDOM_VELOCITY, FREEDOM_ACCELERATION),
                (0.0, 0.8, 2.0, 4.0),
                (-1.57, 1.57, 1.0, 1.0),
            ],
        ),
        ({"drawer": "handle"}, ["drawer.slide"], [(0.0, 0.4, 0.5, 1.0)]),
        (
            {"cabinet": "ball"},
            [
                "cabinet.ball_z",
                "cabinet.ball_y",
                "cabinet.ball_x",
                "cabinet.slide",
                "cabinet.swing",
            ],
            [(-0.7, 0.6, FREEDOM_VELOCITY, FREEDOM_ACCELERATION)] * 3
            + [(0.0, 0.3, 0.4, 0.7), (-1.0, 2.0, 1.5, 3.0)],
        ),
        (
            {"drawer": "handle", "cabinet": "rail"},
            ["drawer.slide", "cabinet.rail", "cabinet.slide", "cabinet.swing"],
            [
                (0.0, 0.4, 0.5, 1.0),
                (-0.05, 0.08, FREEDOM_VELOCITY, FREEDOM_ACCELERATION),
                (0.0, 0.3, 0.4, 0.7),
                (-1.0, 2.0, 1.5, 3.0),
            ],
        ),
    ],
)
def test_names_and_limits_follow_the_joints(
    grasps: dict[str, str], added: list[str], limits: list[tuple[float, float, float, float]]
) -> None:
    scene = full_scene()
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
    # The model says the same, joint by joint.
    np.testing.assert_allclose(chain.coordinates.lower[size:], chain.lower[size:])
    np.testing.assert_allclose(chain.coordinates.upper[size:], chain.upper[size:])
    np.testing.assert_allclose(chain.coordinates.velocity[size:], chain.velocity[size:])
    assert [chain.model.names[j] for j in chain.coordinates.joints[size:]] == added
    for index, name in enumerate(chain.names):
        assert chain.index(name) == index


def test_virtual_joints_are_named_by_object() -> None:
    chain = consolidate(full_scene(), {"door": "handle", "cabinet": "ball"})
    assert chain.virtual == {
        Hold("door", "handle"): (),
        Hold("cabinet", "ball"): ("cabinet.ball_z", "cabinet.ball_y", "cabinet.ball_x"),
    }


@pytest.mark.parametrize(
    ("grasps", "held"),
    [
        ({"door": "handle"}, {"door": ["panel_0", "lever_0", "lever_1"]}),
        ({"drawer": "handle"}, {"drawer": [f"tray_{k}" for k in range(8)]}),
        ({"cabinet": "grip"}, {"cabinet": ["arm_0", "tray_0", "tray_1", "flap_0"]}),
        (
            {"door": "handle", "cabinet": "grip"},
            {
                "door": ["panel_0", "lever_0", "lever_1"],
                "cabinet": ["arm_0", "tray_0", "tray_1", "flap_0"],
            },
        ),
    ],
)
def test_geometry_is_the_robots_and_that_of_the_links_that_move(
    grasps: dict[str, str], held: dict[str, list[str]]
) -> None:
    scene = full_scene()
    chain, robot = consolidate(scene, grasps), scene.robot
    count = len(robot.collision.geometryObjects)
    found = chain.collision.geometryObjects
    assert len(found) == count + sum(len(names) for names in held.values())
    assert [shape.name for shape in found[:count]] == [
        shape.name for shape in robot.collision.geometryObjects
    ]
    assert [shape.parentJoint for shape in found[:count]] == [
        shape.parentJoint for shape in robot.collision.geometryObjects
    ]
    for name, names in held.items():
        indices = chain.held_geometries[Hold(name, grasps[name])]
        assert sorted(found[i].name for i in indices) == sorted(
            f"{name}.{shape}" for shape in names
        )
        assert all(found[i].parentJoint >= robot.model.njoints - 1 for i in indices)


def test_side_branches_are_locked() -> None:
    chain = consolidate(full_scene(), {"cabinet": "grip"})
    assert not {"cabinet.flap_hinge", "cabinet.lid_hinge"} & set(chain.names)
    z = random_configurations(chain.lower, chain.upper, 1, np.random.default_rng(2))[0]
    at = frames(chain.model, chain.coordinates.q(z))
    arm, flap, case, lid = (
        at[chain.model.getFrameId(f"cabinet.{link}")] for link in ("arm", "flap", "case", "lid")
    )
    np.testing.assert_allclose(
        (arm.inverse() * flap).rotation,
        pin.utils.rotate("x", CABINET_STATE["flap_hinge"]),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        (case.inverse() * lid).rotation,
        pin.utils.rotate("y", CABINET_STATE["lid_hinge"]),
        atol=1e-12,
    )


def test_joint_placements_of_many_configurations_are_pinocchios() -> None:
    chain = consolidate(full_scene(), GRASPS[-1])
    z = random_configurations(chain.lower, chain.upper, 30, np.random.default_rng(3))
    rotations, translations = chain.joint_placements(z)
    assert rotations.shape == (30, chain.model.njoints, 3, 3)
    assert translations.shape == (30, chain.model.njoints, 3)
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


def test_scene_and_robot_are_not_modified() -> None:
    scene = door_scene()
    before = (
        scene.robot.model.njoints,
        scene.robot.model.nframes,
        len(scene.robot.collision.geometryObjects),
    )
    pairs = len(scene.robot.collision.collisionPairs)
    consolidate(scene, {"door": "handle_free"})
    after = (
        scene.robot.model.njoints,
        scene.robot.model.nframes,
        len(scene.robot.collision.geometryObjects),
    )
    assert (after, len(scene.robot.collision.collisionPairs)) == (before, pairs)
    assert before[0] > 3


def test_chain_without_holds_is_the_robot() -> None:
    scene = door_scene()
    chain = consolidate(scene, {})
    assert chain.names == scene.robot.coordinates.names
    assert not chain.closures
    assert len(chain.collision.geometryObjects) == len(scene.robot.collision.geometryObjects)


def test_unknown_names_are_rejected() -> None:
    scene = full_scene()
    with pytest.raises(UnknownNameError, match=r"dor.*door"):
        consolidate(scene, {"dor": "handle"})
    with pytest.raises(UnknownNameError, match=r"handel.*handle"):
        consolidate(scene, {"door": "handel"})
    with pytest.raises(UnknownNameError, match=r"door\.hing"):
        consolidate(scene, {"door": "handle"}).index("door.hing")


def test_attachment_named_like_a_joint_is_rejected() -> None:
    scene = full_scene()
    bar = dataclasses.replace(scene.objects["door"].object.attachments["handle_free"], name="hinge")
    twice = with_objects(scene, {"door": with_attachment(scene.objects["door"], bar)})
    with pytest.raises(InputError, match=r"door\.hinge"):
        consolidate(twice, {"door": "hinge"})


# --- free objects: carried, and what is held through them
# -------------------------------------------------------------

STICK, END = Hold("stick", "grip"), Hold("stick", "end")
BALL, PULLED, PUSHED = (
    Hold("ball", "grip"),
    Hold("ball", "pull", STICK, "tip"),
    Hold("ball", "pull", END, "tip"),
)
CARRIED = [
    (STICK,),
    (END,),
    (BALL,),
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
def carried_scene() -> Scene:
    """Return stick, ball, and a cabinet that can be carried away."""
    scene, case = room(objects=("stick", "ball")), full_scene().objects["cabinet"]
    return with_objects(
        scene,
        {"cabinet": dataclasses.replace(case, object=dataclasses.replace(case.object, free=True))},
    )


def expected_frames(
    chain: VirtualKinematicChain, scene: Scene, hold: Hold, z: np.ndarray
) -> tuple[pin.SE3, dict[str, pin.SE3]]:
    """Return the placements of an object's base and links, multiplied from the robot outwards."""
    thing, grasp = (
        scene.objects[hold.object].object,
        scene.objects[hold.object].object.attachments[hold.attachment],
    )
    if hold.by is None:
        robot = scene.robot
        holder = frames(robot.model, robot.coordinates.q(z[: robot.coordinates.size]))[
            robot.model.getFrameId(robot.tool_frame)
        ]
    else:
        holder = expected_frames(chain, scene, hold.by, z)[1][hold.link or ""]
    own = frames(thing.model, thing.coordinates.q(object_state(chain, scene, hold.object, z)))
    links = {
        f.name: own[i] for i, f in enumerate(thing.model.frames) if f.type == pin.FrameType.BODY
    }
    motion = virtual_motion(chain, scene, hold.object, hold.attachment, z)
    base = holder * (links[grasp.link] * grasp.placement * motion).inverse()
    return base, {link: base * placement for link, placement in links.items()}


@pytest.mark.parametrize("holds", CARRIED, ids=lambda holds: " ".join(str(hold) for hold in holds))
def test_carried_objects_follow_hand_and_grasp(holds: tuple[Hold, ...]) -> None:
    scene = carried_scene()
    chain = consolidate(scene, holds)
    assert (
        tuple(chain.closures)
        == tuple(chain.held_geometries)
        == tuple(chain.virtual)
        == tuple(chain.prefixes)
        == holds
    )
    for z in random_configurations(chain.lower, chain.upper, 6, np.random.default_rng(4)):
        q = chain.coordinates.q(z)
        of_chain, of_shapes = frames(chain.model, q), shapes(chain.model, chain.collision, q)
        data = chain.model.createData()
        pin.forwardKinematics(chain.model, data, q)
        for hold in holds:
            placed = scene.objects[hold.object]
            base, links = expected_frames(chain, scene, hold, z)
            for link, placement in links.items():
                joint, local = chain.frame(link, hold)
                assert_same(data.oMi[joint] * local, placement)
                assert_same(
                    of_chain[chain.model.getFrameId(chain.prefixes[hold] + link)], placement
                )
            closure = chain.closures[hold]
            assert_same(data.oMi[closure.joint] * closure.local, base)
            assert_same(closure.target, placed.placement)
            state = object_state(chain, scene, hold.object, z)
            there = make_world_shapes(dataclasses.replace(placed, placement=base, state=state))
            indices = chain.held_geometries[hold]
            assert [
                chain.collision.geometryObjects[i].name.rpartition(".")[2] for i in indices
            ] == [s.name for s in there]
            for index, shape in zip(indices, there, strict=True):
                assert_same(of_shapes[index], shape.placement)
                assert chain.collision.geometryObjects[index].parentJoint > 1


def test_all_of_a_free_object_moves_and_only_the_links_in_hand_of_a_fixed_one() -> None:
    free, fixed = carried_scene(), full_scene()
    hold = Hold("cabinet", "grip")
    moving = {
        scene: [chain.collision.geometryObjects[i].name for i in chain.held_geometries[hold]]
        for scene, chain in ((scene, consolidate(scene, [hold])) for scene in (free, fixed))
    }
    assert set(moving[free]) - set(moving[fixed]) == {"cabinet.case_0", "cabinet.lid_0"}
    assert len(moving[free]) == len(free.objects["cabinet"].object.collision.geometryObjects)


def test_every_hold_has_its_own_shapes_joints_and_names() -> None:
    holds = (STICK, BALL, END, PULLED)
    chain = consolidate(carried_scene(), holds)
    robot = carried_scene().robot
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
    body = [frame.name for frame in chain.model.frames]
    assert len(set(body)) == len(body)


def test_attachment_held_twice_is_rejected() -> None:
    """Its freedom would have one name for two coordinates; without freedoms that is allowed."""
    with pytest.raises(InputError, match="two coordinates share this name") as caught:
        consolidate(carried_scene(), [STICK, PULLED, Hold("ball", "pull")])
    assert str(caught.value.field).startswith("ball.pull_")
    chain = consolidate(carried_scene(), [STICK, Hold("cabinet", "spike", STICK, "tip")])
    assert chain.prefixes[Hold("cabinet", "spike", STICK, "tip")] == "cabinet."


def test_holds_and_mappings_make_the_same_chain() -> None:
    first, second = (
        consolidate(carried_scene(), {"stick": "grip", "ball": "grip"}),
        consolidate(carried_scene(), [STICK, BALL]),
    )
    assert first.names == second.names
    assert first.model == second.model
    assert tuple(first.closures) == (STICK, BALL)
