"""Tests that a telescope with one motor is one coordinate, from the start to ROS messages."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from helpers.judging import check
from helpers.robots import compute_placement
from helpers.telescopes import SEGMENT, write_coupled_scene, write_telescope_scene
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
    assert opened.trajectory.names[: opened.trajectory.robot_size] == NAMES
    out = opened.trajectory.positions[:, 4]
    assert np.ptp(out) > 0.02, "the drawer is pulled by the telescope"
    assert 0.0 <= out.min() <= out.max() <= SEGMENT
    message = opened.to_ros(joints="arm", rate=50.0)
    assert message["joint_names"] == list(NAMES[3:])


@pytest.fixture(scope="module")
def coupled(tmp_path_factory: pytest.TempPathFactory) -> vkc.Plan:
    """Plan with joints that follow others backwards, at other rates, or turn as another slides."""
    folder = tmp_path_factory.mktemp("coupled")
    limits = "joints: {roll_joint: {velocity: 0.9, acceleration: 0.6}}\n"
    scene = write_coupled_scene(folder, more=limits)
    robot, rng = scene.robot, np.random.default_rng(0)
    z = np.concatenate([[-0.5, 0.4, 0.5], rng.uniform(robot.lower[3:], robot.upper[3:])])
    target = compute_placement(robot, robot.tool_frame, z)
    plan = vkc.plan(scene, [vkc.Reach(target)], seed=0)
    assert plan.success, plan.summary()
    assert plan.trajectory.robot_size == 6
    return plan


def compute_limit_ratios(plan: vkc.Plan, motion: vkc.Trajectory) -> dict[str, float]:
    """Return the ratio of every joint's motion to its limits; ratios above 1 are violations."""
    file = ElementTree.parse(Path(plan.scene.folder) / "robot.urdf")
    limits = {
        joint.get("name"): {key: float(value) for key, value in limit.attrib.items()}
        for joint in file.iter("joint")
        for limit in joint.iter("limit")
    }
    times, robot = np.arange(*motion.times[[0, -1]], 1e-3), plan.scene.robot
    places, rates, changes = motion(times), motion.velocity(times), motion.acceleration(times)
    found = dict[str, float]()
    for k, joint, factor, offset, _ in robot.coordinates.moves[3:]:
        name = str(robot.model.names[joint])
        own, place = limits[name], factor * places[:, k] + offset
        assert own["lower"] - 1e-9 <= place.min() <= place.max() <= own["upper"] + 1e-9
        fastest, strongest = (0.9, 0.6) if name == "roll_joint" else (own["velocity"], np.inf)
        speed, change = (np.abs(factor * each[:, k]).max() for each in (rates, changes))
        found[name] = float(max(speed / fastest, change / strongest))
    return found


def test_every_coupled_joint_keeps_its_limits(coupled: vkc.Plan, tmp_path: Path) -> None:
    motion = coupled.trajectory
    assert motion.curve is not None
    assert np.ptp(motion.positions[:, 3:], axis=0).max() > 0.05
    ratios = compute_limit_ratios(coupled, motion)
    assert max(ratios, key=ratios.__getitem__) == "roll_joint"
    assert 0.9 < ratios["roll_joint"] <= 1.0 + 1e-9
    curve, factor = motion.curve, 0.97 * np.sqrt(ratios["roll_joint"])
    quick = Curve(curve.times * factor, curve.positions, curve.rates / factor)
    faster = dataclasses.replace(motion, times=motion.times * factor, curve=quick)
    assert compute_limit_ratios(coupled, faster)["roll_joint"] > 1.02
    plan = dataclasses.replace(coupled, trajectory=faster)
    for violations in (check(plan).violations, judge(plan.save(tmp_path / "faster.npz")).found):
        assert {one.subject for one in violations} == {"yaw_joint"}
