"""Tests the kinematic tree of a scene against the separate trees of robot and objects."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import make_room
from helpers.small_problems import make_full_scene, sample_configurations

import vkc_pin as vkc
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.placements import key_times, sample_motion
from vkc_pin.world.trajectory.world_model import World, find_coordinate_units


@pytest.fixture(scope="module")
def world() -> World:
    return World(make_full_scene())


def sample_rows(world: World, seed: int, count: int = 1) -> np.ndarray:
    robot, objects = world.scene.robot, [placed.object for placed in world.scene.objects.values()]
    lower = np.concatenate([robot.lower, *(item.lower for item in objects)])
    upper = np.concatenate([robot.upper, *(item.upper for item in objects)])
    return sample_configurations(lower, upper, count, np.random.default_rng(seed))


@pytest.mark.parametrize("kind", ["collision", "visual"])
def test_shapes_equal_those_of_robot_and_objects(world: World, kind: str) -> None:
    scene, (z,) = world.scene, sample_rows(world, 3)
    geometry = getattr(world, kind)
    data, shapes = world.model.createData(), geometry.createData()
    pin.updateGeometryPlacements(world.model, data, geometry, shapes, world.coordinates.q(z))
    expected: list[tuple[str, pin.GeometryObject, pin.SE3]] = []
    robot, n = scene.robot, scene.robot.coordinates.size
    source = getattr(robot, kind)
    own_data, bodies = robot.model.createData(), source.createData()
    pin.updateGeometryPlacements(robot.model, own_data, source, bodies, robot.coordinates.q(z[:n]))
    for shape, placement in zip(source.geometryObjects, bodies.oMg, strict=True):
        expected.append((shape.name, shape, placement))
    for name, placed in scene.objects.items():
        joints = placed.object.coordinates.names
        posed = placed.with_state(dict(zip(joints, z[n : n + len(joints)].tolist(), strict=True)))
        n += len(joints)
        for shape in make_world_shapes(posed, visual=kind == "visual"):
            expected.append((f"{name}.{shape.name}", shape, shape.placement))
    for shape in scene.obstacles if kind == "collision" else scene.obstacle_visual:
        expected.append((shape.name, shape, shape.placement))
    assert n == world.coordinates.size == world.model.nv
    found = zip(geometry.geometryObjects, shapes.oMg, strict=True)
    for (name, shape, placement), (copy, at) in zip(expected, found, strict=True):
        assert copy.name == name
        np.testing.assert_allclose(at, placement, atol=1e-9)
        np.testing.assert_array_equal(copy.meshColor, shape.meshColor)
        np.testing.assert_array_equal(copy.meshScale, shape.meshScale)
        assert copy.geometry.getNodeType() == shape.geometry.getNodeType()
        for field in ("meshPath", "overrideMaterial"):
            assert getattr(copy, field) == getattr(shape, field)
    assert len(geometry.collisionPairs) == 0


def test_positions_along_a_motion(world: World) -> None:
    """Columns are matched by name; coordinates without a column keep their start values."""
    robot = world.scene.robot.coordinates.names
    names = (*robot, "drawer.slide", "door.handle_free", "door.hinge")
    values = np.random.default_rng(0).normal(size=(3, len(names)))
    phases = (vkc.PhaseSpan("all", 0, 2),)
    motion = vkc.Trajectory(names, np.array([0.0, 1.0, 3.0]), values, phases, len(robot))
    for times, expected in ((None, values), ([0.5], values[:2].mean(axis=0, keepdims=True))):
        rows = np.tile(world.start, (len(expected), 1))
        for k, name in enumerate(world.coordinates.names):
            if name in names:
                rows[:, k] = expected[:, names.index(name)]
        np.testing.assert_allclose(world.compute_positions(motion, times), rows, atol=1e-15)
    assert world.compute_positions(motion, np.zeros(0)).shape == (0, world.coordinates.size)


def test_units_of_sliding_joints_and_grasps() -> None:
    units = find_coordinate_units(vkc.load_scene("drawer"))
    assert (units["drawer.slide"], units["base_x"], units["base_yaw"]) == ("m", "m", "rad")
    stick = find_coordinate_units(vkc.load_scene("init_3"))
    assert (stick["stick.grip_slide"], stick["stick.grip_turn"]) == ("m", "rad")


def test_key_times_limit_the_change_of_coordinates(plan: vkc.Plan) -> None:
    motion, names = plan.trajectory, plan.trajectory.names
    times = key_times(motion)
    assert set(motion.times) <= set(times)
    assert np.abs(np.diff(motion.at(times), axis=0)).max() <= 1.0 + 1e-9
    finer = key_times(motion, {names[0]: 2.0, names[3]: 0.0125})
    assert np.abs(np.diff(motion.at(finer)[:, 3])).max() <= 0.0125 + 1e-9


def interpolate_key_frames(world: World, motion: vkc.Trajectory, at: np.ndarray) -> np.ndarray:
    """Return world coordinates as a viewer shows them, by straight lines between key frames."""
    times = sample_motion(world, motion).times
    rows = world.compute_positions(motion, times)
    return np.column_stack([np.interp(at, times, column) for column in rows.T])


CURVES = {
    "rest to rest": ([0.0, 1.0], [0.0, 0.9], [0.0, 0.0]),
    "there and back": ([0.0, 1.0], [0.0, 0.0], [6.0, -6.0]),
    "far": ([0.0, 2.0], [0.0, 7.0], [0.0, 0.0]),
    "slow": ([0.0, 1e6], [0.0, 0.9], [0.0, 0.0]),
    "jump": ([0.0, 1.0, 1.000001, 2.0], [0.0, 1.0, 1.0, 0.0], [1.0, 1.0, -1.0, -1.0]),
    "late": ([1e6, 1e6 + 1.0], [0.0, 0.9], [0.0, 0.0]),
}


@pytest.mark.parametrize("kind", CURVES)
def test_key_frames_follow_curves(kind: str) -> None:
    """A motion of two waypoints may bend, return, and change direction between them."""
    scene = vkc.load_scene("door")
    knots, offsets, slopes = map(np.array, CURVES[kind])
    direction = np.linspace(-1.0, 1.0, len(scene.start))
    positions = scene.start + np.outer(offsets, direction)
    curve = Curve(knots, positions, np.outer(slopes, direction))
    names, ends = scene.robot.coordinates.names, [0, -1]
    phases = (vkc.PhaseSpan("move", 0, 1),)
    motion = vkc.Trajectory(names, knots[ends], positions[ends], phases, len(names), curve)
    world = World(scene)
    at = np.linspace(knots[0], knots[-1], 1001)
    shown, truth = interpolate_key_frames(world, motion, at), world.compute_positions(motion, at)
    np.testing.assert_allclose(shown, truth, atol=5e-3)
    assert len(sample_motion(world, motion).times) < 60


@pytest.mark.parametrize("coordinate", ["base_yaw", "shoulder_pan_joint"])
def test_key_frames_keep_carried_objects_in_the_hand(coordinate: str) -> None:
    """Free objects are moved along chords, which must be near the arcs of the hand."""
    scene = make_room()
    robot = scene.robot.coordinates.names
    names = (*robot, "stick.grip_slide", "stick.grip_turn")
    positions = np.tile([*scene.start, 0.0, 0.0], (2, 1))
    positions[1, names.index(coordinate)] += 0.9
    phases = (vkc.PhaseSpan("turn", 0, 1, (vkc.Hold("stick", "grip"),)),)
    motion = vkc.Trajectory(names, np.array([0.0, 3.0]), positions, phases, len(robot))
    world, at = World(scene), np.linspace(0.0, 3.0, 301)
    shown, truth = interpolate_key_frames(world, motion, at), world.compute_positions(motion, at)
    place = world.get_placement_columns("stick")
    assert np.ptp(truth[:, place], axis=0).max() > 0.3
    np.testing.assert_allclose(shown[:, place], truth[:, place], atol=5e-3)


def test_placements_equal_those_of_the_world_model(plan: vkc.Plan) -> None:
    world, k = World(plan.scene), 5
    motion, data = sample_motion(world, plan.trajectory), world.model.createData()
    (row,) = world.compute_positions(plan.trajectory, [motion.times[k]])
    pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
    tool = data.oMf[world.model.getFrameId(plan.scene.robot.tool_frame)].translation
    assert np.allclose(motion.tool[k], tool)
    assert np.allclose(motion.base[k, :2], row[:2])
    for j in range(1, world.model.njoints):
        assert np.allclose(motion.world[k, j], data.oMi[j].homogeneous)
        parent = motion.world[k, world.model.parents[j]]
        assert np.allclose(parent @ motion.local[j][k].homogeneous, data.oMi[j].homogeneous)
