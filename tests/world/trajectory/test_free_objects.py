"""Where free objects are in the world along a motion: with the hand while it holds them, and where it left them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    BALL,
    STICK,
    UP,
    Script,
    above,
    carried_over,
    freedom,
    lifted,
    moved_base,
    reaching,
    room,
    stand,
    table,
    tool_at,
    with_object,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.free_objects import to_free_joint_positions
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

TIP = pin.SE3(pin.utils.rotate("x", -np.pi / 2), np.array([0.0, 0.25, 0.0]))  # in the stick
PULL = (np.pi / 2, 0.0, 0.0)  # how the ball lies on the tip that comes from the right


def placements(scene: Scene, motion: Trajectory, name: str, times: np.ndarray) -> list[pin.SE3]:
    """Return where a free object is at some times, as the world says."""
    world = World(scene)
    return [
        pin.XYZQUATToSE3(row)
        for row in world.compute_positions(motion, times)[:, world.get_placement_columns(name)]
    ]


def tools(scene: Scene, motion: Trajectory, times: np.ndarray) -> list[pin.SE3]:
    """Return where the hand is, from the robot alone."""
    model, data, found = scene.robot.model, scene.robot.model.createData(), []
    for row in motion.at(times)[:, : motion.robot_size]:
        pin.framesForwardKinematics(model, data, scene.robot.coordinates.q(row))
        found.append(data.oMf[model.getFrameId(scene.robot.tool_frame)].copy())
    return found


def inside(motion: Trajectory, phase: int, count: int = 40) -> np.ndarray:
    """Return times of a phase, both ends among them."""
    return np.linspace(
        motion.times[motion.phases[phase].first], motion.times[motion.phases[phase].last], count
    )


def assert_same(first: pin.SE3, second: pin.SE3, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(first.homogeneous, second.homogeneous, rtol=0.0, atol=tolerance)


@cache
def carried() -> tuple[Scene, Trajectory]:
    """Return the stick that is carried over the table, and a ball that is not."""
    scene = room(table(), objects=("stick", "ball"))
    return scene, carried_over(scene, values=(0.03, 0.2)).motion()


def test_it_stands_still_until_it_is_taken_and_stays_where_it_is_left() -> None:
    scene, motion = carried()
    held = [k for k, phase in enumerate(motion.phases) if phase.held]
    assert held == [2, 3, 4]
    for phase in (0, 1):
        for at in placements(scene, motion, "stick", inside(motion, phase)):
            assert_same(at, STICK, 1e-12)
    for at in placements(scene, motion, "stick", inside(motion, 5)):
        assert_same(at, lifted(STICK, [0.0, 0.5, 0.0]))
    for phase in range(len(motion.phases)):
        for at in placements(scene, motion, "ball", inside(motion, phase, 5)):
            assert_same(at, BALL, 1e-12)


def test_it_moves_rigidly_with_the_hand() -> None:
    scene, motion = carried()
    for phase in (2, 3, 4):
        times = inside(motion, phase)
        for at, tool in zip(
            placements(scene, motion, "stick", times), tools(scene, motion, times), strict=True
        ):
            assert_same(at.inverse() * tool, tool_at(pin.SE3.Identity(), values=(0.03, 0.2)))
    lowest, highest = (
        placements(scene, motion, "stick", np.array([motion.times[motion.phases[k].last]]))[0]
        for k in (1, 2)
    )
    np.testing.assert_allclose(highest.translation - lowest.translation, UP, atol=1e-9)


def test_the_hand_closes_a_hair_beside_the_attachment() -> None:
    """Then the object keeps that offset, and does not jump into the hand."""
    scene = room(table())
    off = pin.SE3(pin.exp3(np.array([0.0, 0.01, 0.02])), np.array([0.002, -0.001, 0.0005]))
    motion = carried_over(scene, off=off).motion()
    for phase in (2, 3, 4):
        times = inside(motion, phase)
        for at, tool in zip(
            placements(scene, motion, "stick", times), tools(scene, motion, times), strict=True
        ):
            assert_same(at.inverse() * tool, tool_at(pin.SE3.Identity()) * off)
    assert_same(
        placements(scene, motion, "stick", np.array([motion.times[motion.phases[2].first]]))[0],
        STICK,
        1e-12,
    )


def test_a_hand_that_slides_and_turns_on_it() -> None:
    scene = room(table())
    script = carried_over(scene)
    count = len(script.rows)
    slide, turn = (
        0.05 * np.sin(np.linspace(0.0, 9.0, count)),
        0.3 * np.sin(np.linspace(0.0, 5.0, count)),
    )
    motion = script.motion(stick__grip_slide=slide, stick__grip_turn=turn)
    first = motion.phases[2].first
    # Where the hand closes the stick lies as it lies, whatever the coordinates say; from then on
    # they count.
    offset = (
        tool_at(pin.SE3.Identity(), values=(slide[first], turn[first]))
        * tool_at(STICK).inverse()
        * STICK
    )
    assert np.abs(pin.log6(offset).vector).max() > 1e-2
    for phase in (2, 3, 4):
        times = inside(motion, phase, 23)
        values = np.column_stack(
            [np.interp(times, motion.times, column) for column in (slide, turn)]
        )
        sticks = placements(scene, motion, "stick", times)
        for at, tool, (s, t) in zip(sticks, tools(scene, motion, times), values, strict=True):
            assert_same(at, tool * tool_at(pin.SE3.Identity(), values=(s, t)).inverse() * offset)


def fetched() -> tuple[Scene, Script]:
    """Return stick in hand, its tip by the ball; they carry it up, to the left, and down, and leave it there."""
    scene = room(stand(), objects=("stick", "ball"))
    south = pin.SE3(
        STICK.rotation, BALL.translation - np.array([0.0, 0.285, 0.0])
    )  # of the stick when its tip is at the ball
    touch = reaching(tool_at(south), above(STICK))
    up = reaching(tool_at(lifted(south, UP / 4)), touch)
    scene = scene.with_held({"stick": "grip"}).with_start(arm=up[3:])
    script = (
        Script(scene)
        .go(touch)
        .take("ball", "pull", PULL, by="stick.tip")
        .go(up)
        .go(moved_base(up, y=0.3))
    )
    script.go(moved_base(touch, y=0.3)).let_go("ball").go(moved_base(touch, y=0.1))
    return scene, script


def test_what_is_held_through_a_stick_follows_its_tip() -> None:
    scene, script = fetched()
    motion = script.motion()
    assert [phase["by"] for phase in motion.to_dict()["phases"]] == [
        {},
        *[{"ball": "stick.tip"}] * 3,
        {},
    ]
    on_tip = (freedom("pull", PULL) * pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.035]))).inverse()
    flipped = pin.SE3(
        np.diag([1.0, -1.0, -1.0]), np.zeros(3)
    )  # of the ball's attachment, which looks down
    for phase in (1, 2, 3):
        times = inside(motion, phase)
        sticks = placements(scene, motion, "stick", times)
        for ball, stick, tool in zip(
            placements(scene, motion, "ball", times),
            sticks,
            tools(scene, motion, times),
            strict=True,
        ):
            assert_same(ball, stick * TIP * on_tip * flipped)
            assert_same(stick, tool * tool_at(pin.SE3.Identity()).inverse())
            assert_same(stick.inverse() * ball, pin.SE3(np.eye(3), np.array([0.0, 0.285, 0.0])))
    assert_same(placements(scene, motion, "ball", inside(motion, 0))[7], BALL, 1e-12)
    for at in placements(scene, motion, "ball", inside(motion, 4)):
        assert_same(at, lifted(BALL, [0.0, 0.3, 0.0]))


def test_a_ball_that_rolls_on_the_tip() -> None:
    """About its own centre: the tip stays on it, wherever the stick's own frame is."""
    scene, script = fetched()
    roll, count = np.pi / 2, len(script.rows)
    angles = [
        roll + 0.4 * np.sin(np.linspace(0.0, 3.0, count)),
        0.3 * np.sin(np.linspace(0.0, 2.0, count)),
    ]
    motion = script.motion(ball__pull_x=angles[0], ball__pull_y=angles[1])
    first = motion.phases[1].first

    def on_tip(x: float, y: float) -> pin.SE3:
        return tool_at(pin.SE3.Identity(), "ball", "pull", (x, y, 0.0)).inverse()

    stick = placements(scene, motion, "stick", motion.times[[first]])[0]
    offset = (stick * TIP * on_tip(angles[0][first], angles[1][first])).inverse() * BALL
    for phase in (1, 2, 3):
        times = inside(motion, phase, 15)
        balls, sticks = (placements(scene, motion, name, times) for name in ("ball", "stick"))
        for k, (ball, stick) in enumerate(zip(balls, sticks, strict=True)):
            x, y = (float(np.interp(times[k], motion.times, column)) for column in angles)
            assert_same(ball, stick * TIP * on_tip(x, y) * offset)


def test_what_is_held_at_the_start_is_where_the_hand_has_it() -> None:
    scene = room(objects=("stick",)).with_held({"stick": "grip"}, at={"stick": (-0.04, 0.5)})
    world = World(scene)
    tool = scene.tool_placement()
    expected = tool * tool_at(pin.SE3.Identity(), values=(-0.04, 0.5)).inverse()
    assert_same(
        pin.XYZQUATToSE3(world.start[world.get_placement_columns("stick")]), expected, 1e-12
    )
    motion = Script(scene).go(moved_base(scene.start, x=-1.0, yaw=2.0)).motion()
    times = inside(motion, 0)
    for at, tool in zip(
        placements(scene, motion, "stick", times), tools(scene, motion, times), strict=True
    ):
        assert_same(at, tool * tool_at(pin.SE3.Identity(), values=(-0.04, 0.5)).inverse())


@cache
def turned() -> tuple[Scene, Trajectory]:
    """Return the stick turned round and round: two turns of the base, and the arm's wrist too."""
    scene = room(table())
    down = reaching(tool_at(STICK), above(STICK))
    script = Script(scene).go(down).take("stick").go(np.array(scene.start))
    there = moved_base(scene.start, x=-2.0, yaw=4 * np.pi)
    there[5:9] += [0.4, 1.0, -0.8, 3.0]
    script.go(there, steps=60).let_go().go(moved_base(there, x=-1.0))
    return scene, script.motion()


def test_it_moves_without_a_jump() -> None:
    """From one instant to the next, above all where one phase ends and the next begins, and where it is taken and left."""
    for scene, motion in (carried(), turned(), (fetched()[0], fetched()[1].motion())):
        for name in scene.objects:
            edges = motion.times[[phase.last for phase in motion.phases[:-1]]]
            for edge in edges:
                near = placements(scene, motion, name, np.array([edge - 1e-7, edge, edge + 1e-7]))
                for other in (near[0], near[2]):
                    assert_same(near[1], other, 1e-5)


def test_the_numbers_of_an_orientation_do_not_jump_either() -> None:
    """Of its two quaternions always the nearer one, so that rows can be interpolated: through two whole turns."""
    scene, motion = turned()
    world, times = World(scene), np.linspace(0.0, motion.times[-1], 3000)
    rows = world.compute_positions(motion, times)[:, world.get_placement_columns("stick")]
    np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), 1.0, atol=1e-12)
    assert np.einsum("kc,kc->k", rows[1:, 3:], rows[:-1, 3:]).min() > 0.999
    assert np.abs(np.diff(rows, axis=0)).max() < 0.02
    assert (
        rows[:, 3:].min(axis=0) < -0.3
    ).sum() >= 2  # it does come round to where the first choice would flip
    half = World(scene).compute_positions(motion, (times[1:] + times[:-1]) / 2)[
        :, world.get_placement_columns("stick")
    ]
    for between, before, after in zip(half[::50], rows[:-1:50], rows[1::50], strict=True):
        middle = pin.XYZQUATToSE3(
            np.concatenate(
                [np.zeros(3), (before + after)[3:] / np.linalg.norm((before + after)[3:])]
            )
        )
        assert (
            np.linalg.norm(pin.log3(middle.rotation.T @ pin.XYZQUATToSE3(between).rotation)) < 2e-3
        )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_answer_does_not_depend_on_what_else_is_asked(seed: int) -> None:
    scene, motion = turned()
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(-1.0, motion.times[-1] + 1.0, rng.integers(1, 9)))
    together = placements(scene, motion, "stick", times)
    for at, time in zip(together, times, strict=True):
        assert_same(at, placements(scene, motion, "stick", np.array([time]))[0])
    assert placements(scene, motion, "stick", np.zeros(0)) == []
    waypoints = placements(scene, motion, "stick", motion.times)
    world = World(scene)
    for row, at in zip(world.compute_positions(motion), waypoints, strict=True):
        assert_same(pin.XYZQUATToSE3(row[world.get_placement_columns("stick")]), at, 1e-12)


def test_beyond_its_ends_a_motion_is_at_its_ends() -> None:
    scene, motion = carried()
    before, after = placements(scene, motion, "stick", np.array([-5.0, motion.times[-1] + 5.0]))
    assert_same(before, STICK, 1e-12)
    assert_same(after, lifted(STICK, [0.0, 0.5, 0.0]))


def test_coordinates_frames_and_shapes_of_what_is_free() -> None:
    scene = with_object(room(table(), objects=("stick", "ball")), "ball", pin.SE3.Random())
    world = World(scene)
    robot = scene.robot.coordinates.names
    parts = ("x", "y", "z", "qx", "qy", "qz", "qw")
    assert world.coordinates.names == (
        *robot,
        *(f"{n}.placement_{part}" for n in ("stick", "ball") for part in parts),
    )
    for name in ("stick", "ball"):
        columns = world.get_placement_columns(name)
        assert world.coordinates.names[columns] == tuple(
            f"{name}.placement_{part}" for part in parts
        )
        np.testing.assert_allclose(
            world.start[columns], to_free_joint_positions(scene.objects[name].placement)
        )
        (joint,) = world.get_joints(name)
        assert world.model.names[joint] == f"{name}.placement"
    rng = np.random.default_rng(0)
    z = np.array(world.start)
    z[len(robot) :] = rng.normal(size=14)
    data, shapes = world.model.createData(), world.collision.createData()
    pin.updateGeometryPlacements(world.model, data, world.collision, shapes, world.coordinates.q(z))
    pin.updateFramePlacements(world.model, data)
    columns = world.get_placement_columns("stick")
    unit = z[columns] / np.r_[1.0, 1.0, 1.0, np.full(4, np.linalg.norm(z[columns][3:]))]
    assert_same(data.oMf[world.model.getFrameId("stick.tip")], pin.XYZQUATToSE3(unit) * TIP)
    own = {
        shape.name: shape.placement
        for shape in scene.objects["stick"].object.collision.geometryObjects
    }
    for shape, where in zip(world.collision.geometryObjects, shapes.oMg, strict=True):
        if shape.name.startswith("stick."):
            assert_same(where, pin.XYZQUATToSE3(unit) * own.pop(shape.name.removeprefix("stick.")))
    assert own == {}


def test_objects_that_hold_each_other() -> None:
    _, script = fetched()
    data = script.motion().to_dict()
    data["phases"][2]["by"]["stick"] = "ball.ball"
    with pytest.raises(InputError, match="cycle"):
        Trajectory.from_dict(data)
