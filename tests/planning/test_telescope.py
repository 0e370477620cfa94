"""Tests that a telescope with one motor is one coordinate, from the start to ROS messages."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.telescopes import FOLLOWERS, SEGMENT, write_coupled_scene, write_telescope_scene
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin.world.trajectory.curve import Curve

NAMES = ("base_x", "base_y", "base_yaw", "lift", "out_1", "yaw_joint", "pitch_joint", "roll_joint")


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> vkc.Plan:
    """Plan to open a drawer between two cheeks with a fixed base."""
    scene = write_telescope_scene(tmp_path_factory.mktemp("telescope"), base="fixed")
    return vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.15})], seed=0)


def test_telescope_opens_a_drawer(opened: vkc.Plan) -> None:
    assert opened.success, opened.summary()
    assert opened.trajectory is not None
    assert opened.trajectory.names[: opened.trajectory.robot_size] == NAMES
    out = opened.trajectory.positions[:, 4]
    assert np.ptp(out) > 0.02, "the drawer is pulled by the telescope"
    assert 0.0 <= out.min() <= out.max() <= SEGMENT


def test_message_has_one_coordinate_for_the_telescope(opened: vkc.Plan) -> None:
    message = opened.to_ros(joints="arm", rate=50.0)
    assert message["joint_names"] == list(NAMES[3:])
    robot = opened.scene.robot
    rows = np.array([point["positions"] for point in message["points"]])
    columns = {
        str(robot.model.names[j]): f * rows[:, k - 3] + b
        for k, j, f, b, _ in robot.coordinates.moves
        if k > 2
    }
    assert {*columns} == {*NAMES[3:], *FOLLOWERS}
    for joint, leader in FOLLOWERS.items():
        np.testing.assert_array_equal(columns[joint], columns[leader])


@pytest.fixture(scope="module")
def coupled(tmp_path_factory: pytest.TempPathFactory) -> vkc.Plan:
    """Plan with joints that follow others backwards, at other rates, or turn as another slides."""
    scene = write_coupled_scene(
        tmp_path_factory.mktemp("coupled"),
        more="joints: {roll_joint: {velocity: 0.9, acceleration: 0.6}}\n",
    )
    plan = vkc.plan(scene, [vkc.Reach(compute_reachable_pose(scene))], seed=0)
    assert plan.success, plan.summary()
    return plan


def test_coupled_joints_are_planned(coupled: vkc.Plan) -> None:
    assert coupled.trajectory is not None
    assert coupled.trajectory.robot_size == 6
    assert np.ptp(coupled.trajectory.positions[:, 3:], axis=0).max() > 0.05


def compute_limit_ratios(plan: vkc.Plan, motion: vkc.Trajectory) -> dict[str, float]:
    """Return the ratio of every joint's motion to its limits; ratios above 1 are violations."""
    file = ElementTree.parse(Path(plan.scene.folder) / "robot.urdf")
    urdf = {}
    for one in file.iter("joint"):
        if (limit := one.find("limit")) is not None:
            urdf[one.get("name")] = {key: float(value) for key, value in limit.attrib.items()}
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
        ratios = (
            np.abs(factor * rates[:, k]).max() / fastest,
            np.abs(factor * changes[:, k]).max() / strongest,
        )
        found[name] = float(max(ratios))
    return found


def test_every_coupled_joint_keeps_its_limits(coupled: vkc.Plan, tmp_path: Path) -> None:
    motion = coupled.trajectory
    assert motion is not None
    assert motion.curve is not None
    ratios = compute_limit_ratios(coupled, motion)
    assert max(ratios, key=ratios.__getitem__) == "roll_joint"
    assert 0.9 < ratios["roll_joint"] <= 1.0 + 1e-9
    curve, factor = motion.curve, 0.97 * np.sqrt(ratios["roll_joint"])
    quick = Curve(curve.times * factor, curve.positions, curve.rates / factor)
    faster = dataclasses.replace(motion, times=motion.times * factor, curve=quick)
    assert compute_limit_ratios(coupled, faster)["roll_joint"] > 1.02
    found = vkc.validate(coupled.scene, coupled.steps, faster, coupled.options).violations
    assert {one.subject for one in found} == {"yaw_joint"}
    saved = dataclasses.replace(coupled, trajectory=faster).save(tmp_path / "faster.npz")
    assert {one.subject for one in judge(saved).found} == {"yaw_joint"}


def compute_reachable_pose(scene: vkc.Scene) -> pin.SE3:
    robot, rng = scene.robot, np.random.default_rng(0)
    z = np.concatenate([[-0.5, 0.4, 0.5], rng.uniform(robot.lower[3:], robot.upper[3:])])
    data, frame = robot.model.createData(), robot.model.getFrameId(robot.tool_frame)
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    return pin.SE3(data.oMf[frame])
