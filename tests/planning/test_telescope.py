"""A telescope that one motor moves is one coordinate, from the start to what a controller gets."""

from __future__ import annotations

import csv
import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import program_of
from helpers.telescopes import FOLLOWERS, SEGMENT, coupled_scene, telescope_scene
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin.baselines.arm_kinematics import ArmKinematics
from vkc_pin.planning.chain.chain import consolidate
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.placements import sample_motion
from vkc_pin.world.trajectory.world_model import World

NAMES = ("base_x", "base_y", "base_yaw", "lift", "out_1", "yaw_joint", "pitch_joint", "roll_joint")


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> vkc.Plan:
    """A drawer is pulled open, between two cheeks, by a robot whose base stands still."""
    scene = telescope_scene(tmp_path_factory.mktemp("telescope"), base="fixed")
    return vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.15})], seed=0)


def test_a_drawer_is_opened_with_it(opened: vkc.Plan) -> None:
    """By the word of the validation, and by that of the oracle, which moves all segments by its own reading of the files."""
    assert opened.success, opened.summary()
    assert opened.trajectory is not None
    assert opened.trajectory.names[: opened.trajectory.robot_size] == NAMES
    out = opened.trajectory.positions[:, 4]
    assert np.ptp(out) > 0.02, "the drawer is pulled by the telescope"
    assert 0.0 <= out.min() <= out.max() <= SEGMENT


def test_all_segments_move_in_pictures(opened: vkc.Plan) -> None:
    assert opened.trajectory is not None
    world = World(opened.scene)
    moved = sample_motion(world, opened.trajectory)
    joints = [world.model.getJointId(f"out_{k}") for k in range(1, 5)]
    assert moved.moving[joints].all()
    ways = np.array(
        [
            [
                place.translation[0] - moved.local[joint][0].translation[0]
                for place in moved.local[joint]
            ]
            for joint in joints
        ]
    )
    assert np.ptp(ways[0]) > 0.02
    np.testing.assert_allclose(ways[1:], np.broadcast_to(ways[0], ways[1:].shape), atol=1e-12)


def test_a_table_has_one_column(opened: vkc.Plan, tmp_path: Path) -> None:
    assert opened.trajectory is not None
    file = opened.trajectory.to_csv(tmp_path / "motion.csv")
    with Path(file).open(encoding="utf-8") as lines:
        head = next(csv.reader(line for line in lines if not line.startswith("#")))
    assert (
        [name for name in head if "out_" in name]
        == [name for name in head if "out_1" in name]
        != []
    )


def test_a_message_has_the_coordinate_alone(opened: vkc.Plan) -> None:
    """Where what follows is then, `Coordinates.moves` says, as the page on exporting has it."""
    message = opened.to_ros(joints="arm", rate=50.0)
    assert message["joint_names"] == list(NAMES[3:])
    robot = opened.scene.robot
    rows = np.array([point["positions"] for point in message["points"]])
    ways = {
        str(robot.model.names[j]): f * rows[:, k - 3] + b
        for k, j, f, b, _ in robot.coordinates.moves
        if k > 2
    }
    assert {*ways} == {*NAMES[3:], *FOLLOWERS}
    for joint, leader in FOLLOWERS.items():
        np.testing.assert_array_equal(ways[joint], ways[leader])


def test_it_counts_as_what_its_segments_go(opened: vkc.Plan) -> None:
    """In searches a metre of the coordinate is four metres of the hand, and in the cost 16 times their square."""
    chain = consolidate(opened.scene, {})
    out, lift = NAMES.index("out_1"), NAMES.index("lift")
    assert chain.metric[out] == pytest.approx(4.0 * chain.metric[lift])
    problem = program_of(opened.scene, list(opened.steps))
    assert problem.motion_cost.metric[out] == pytest.approx(16.0 * problem.motion_cost.metric[lift])
    model = chain.robot.model
    q = chain.robot.coordinates.q(np.concatenate([np.zeros(3), chain.robot.home]))
    jacobian = pin.computeFrameJacobian(
        model, model.createData(), q, model.getFrameId("tool"), pin.LOCAL_WORLD_ALIGNED
    )
    assert np.linalg.norm(jacobian[:3, out]) == pytest.approx(4.0)


def test_inverse_kinematics_of_the_arm_alone_moves_all_segments(opened: vkc.Plan) -> None:
    """That of the baseline, by Pink, from near the last waypoint."""
    assert opened.trajectory is not None
    problem = program_of(opened.scene, list(opened.steps))
    arm, goal = (
        ArmKinematics(problem, KeyframeSampler(problem, np.random.default_rng(0))),
        opened.trajectory.positions[-1],
    )
    begin = goal + np.array([0.0, 0.0, 0.0, 0.05, -0.03, 0.1, 0.1, 0.1, 0.0])
    z, solved = arm.solve(begin, problem.segments)
    assert solved
    ends = []
    for row in (goal, z):
        rotations, translations = problem.chain.joint_placements(row[None])
        ends.append((rotations[0, -2], translations[0, -2]))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-4)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=1e-4)
    np.testing.assert_array_equal(z[:3], goal[:3])


@pytest.fixture(scope="module")
def coupled(tmp_path_factory: pytest.TempPathFactory) -> vkc.Plan:
    """The hand is brought somewhere by joints that follow backwards, at other rates, turning as another slides."""
    scene = coupled_scene(
        tmp_path_factory.mktemp("coupled"),
        more="joints: {roll_joint: {velocity: 0.9, acceleration: 0.6}}\n",
    )
    plan = vkc.plan(scene, [vkc.Reach(reachable(scene))], seed=0)
    assert plan.success, plan.summary()
    return plan


def test_what_follows_in_all_ways_is_planned_and_judged(coupled: vkc.Plan) -> None:
    """The oracle has the robot where the planner has it."""
    assert coupled.trajectory is not None
    assert coupled.trajectory.robot_size == 6
    assert np.ptp(coupled.trajectory.positions[:, 3:], axis=0).max() > 0.05


def shares(plan: vkc.Plan, motion: vkc.Trajectory) -> dict[str, float]:
    """Return how much of its own limits every joint of the arm uses, a thousand times a second; more than 1: it breaks them."""
    file = ElementTree.parse(Path(plan.scene.folder) / "robot.urdf")
    urdf = {str(joint.get("name")): {key: float(value) for key, value in limit.attrib.items()}
            for joint in file.iter("joint") if (limit := joint.find("limit")) is not None}  # fmt: skip
    times, robot, found = (
        np.arange(*motion.times[[0, -1]], 1e-3),
        plan.scene.robot,
        dict[str, float](),
    )
    places, rates, changes = motion(times), motion.velocity(times), motion.acceleration(times)
    for k, joint, factor, offset, _ in robot.coordinates.moves[3:]:
        name = str(robot.model.names[joint])
        own, place = urdf[name], factor * places[:, k] + offset
        assert own["lower"] - 1e-9 <= place.min() <= place.max() <= own["upper"] + 1e-9
        fastest, strongest = (0.9, 0.6) if name == "roll_joint" else (own["velocity"], np.inf)
        used = (
            np.abs(factor * rates[:, k]).max() / fastest,
            np.abs(factor * changes[:, k]).max() / strongest,
        )
        found[name] = float(max(used))
    return found


def test_along_the_curve_every_joint_keeps_its_own_limits(
    coupled: vkc.Plan, tmp_path: Path
) -> None:
    """And is as fast as that lets it be: three per cent faster, validation and oracle both name the coordinate."""
    motion = coupled.trajectory
    assert motion is not None
    assert motion.curve is not None
    used = shares(coupled, motion)
    assert max(used, key=used.__getitem__) == "roll_joint"
    assert 0.9 < used["roll_joint"] <= 1.0 + 1e-9
    curve, factor = motion.curve, 0.97 * np.sqrt(used["roll_joint"])
    quick = Curve(curve.times * factor, curve.positions, curve.rates / factor)
    faster = dataclasses.replace(motion, times=motion.times * factor, curve=quick)
    assert shares(coupled, faster)["roll_joint"] > 1.02
    found = vkc.validate(coupled.scene, coupled.steps, faster, coupled.options).violations
    assert {one.subject for one in found} == {"yaw_joint"}
    saved = dataclasses.replace(coupled, trajectory=faster).save(tmp_path / "faster.npz")
    assert {one.subject for one in judge(saved).found} == {"yaw_joint"}


def reachable(scene: vkc.Scene) -> pin.SE3:
    """Return where the tool is in a random posture."""
    robot, rng = scene.robot, np.random.default_rng(0)
    z = np.concatenate([[-0.5, 0.4, 0.5], rng.uniform(robot.lower[3:], robot.upper[3:])])
    data, frame = robot.model.createData(), robot.model.getFrameId(robot.tool_frame)
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    return pin.SE3(data.oMf[frame])
