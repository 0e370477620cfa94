"""Tests ROS 2 recordings of trajectories."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.fake_plan import make_fake_plan
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from vkc_pin import Plan
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.formats.rosbag import TOPICS

Messages = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def plan() -> Plan:
    """Return a plan whose trajectory has a curve, as planned trajectories do."""
    plan = make_fake_plan()
    motion = plan.trajectory
    rates = np.gradient(motion.positions, motion.times, axis=0)
    rates[[0, 6, -1]] = 0.0
    curve = Curve(motion.times, motion.positions, rates)
    return dataclasses.replace(plan, trajectory=dataclasses.replace(motion, curve=curve))


def read_bag(folder: Path) -> Messages:
    """Return topic → messages with their recording times [ns]."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    # As moveit_msgs 2.2 defines it.
    text = (
        "trajectory_msgs/JointTrajectory joint_trajectory\n"
        "trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory\n"
    )
    store.register(get_types_from_msg(text, "moveit_msgs/msg/RobotTrajectory"))
    found: Messages = {}
    with Reader(folder) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, store.deserialize_cdr(data, connection.msgtype))
            )
    return found


def convert_message(message: Any) -> Any:
    """Return a message in the format of `to_ros`."""
    if isinstance(message, np.ndarray | list):
        return [convert_message(item) for item in message]
    if hasattr(message, "__msgtype__"):
        fields = {name: convert_message(value) for name, value in vars(message).items()}
        return {name: value for name, value in fields.items() if name != "__msgtype__"}
    return message


def read_time(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def test_trajectories_equal_those_of_to_ros(plan: Plan, tmp_path: Path) -> None:
    found = read_bag(plan.to_rosbag(tmp_path / "bag", rate=100.0, frame="map", stamp=1.25))
    assert set(found) == {f"/vkc/{end}" for end in TOPICS}
    for group in ("arm", "base"):
        ((recorded, message),) = found[f"/vkc/{group}/joint_trajectory"]
        assert recorded == 1_250_000_000
        assert convert_message(message) == plan.to_ros(
            joints=group, rate=100.0, frame="map", stamp=1.25
        )


def test_robot_trajectory_has_arm_and_planar_base(plan: Plan, tmp_path: Path) -> None:
    options: dict[str, Any] = {"rate": 50.0, "frame": "odom", "stamp": 2.5}
    bag = plan.to_rosbag(tmp_path / "bag", base_joint="virtual_joint", **options)
    ((recorded, message),) = read_bag(bag)["/vkc/robot_trajectory"]
    assert recorded == 2_500_000_000
    arm = convert_message(message.joint_trajectory)
    assert arm == plan.to_ros(joints="arm", **options)
    base = message.multi_dof_joint_trajectory
    assert list(base.joint_names) == ["virtual_joint"]
    assert base.header.frame_id == "odom"
    assert convert_message(base.header) == arm["header"]
    motion = plan.trajectory
    times = [read_time(point.time_from_start) for point in base.points]
    assert times == [read_time(point.time_from_start) for point in message.joint_trajectory.points]
    for time, point in zip(times, base.points, strict=True):
        (transform,) = point.transforms
        (twist,) = point.velocities
        x, y, yaw = motion.at(time)[:3]
        move = transform.translation
        turn = transform.rotation
        np.testing.assert_allclose([move.x, move.y, move.z], [x, y, 0.0], atol=1e-7)
        np.testing.assert_allclose(
            [turn.x, turn.y, turn.z, turn.w],
            [0.0, 0.0, np.sin(yaw / 2.0), np.cos(yaw / 2.0)],
            atol=1e-7,
        )
        # Rates of x, y and yaw in the world, as MoveIt reads them.
        rates = [twist.linear.x, twist.linear.y, twist.angular.z]
        np.testing.assert_allclose(rates, motion.velocity(time)[:3], atol=1e-6)
        assert len(point.accelerations) == 0


def test_base_velocities_follow_the_path(plan: Plan, tmp_path: Path) -> None:
    found = read_bag(plan.to_rosbag(tmp_path / "bag", rate=50.0, states=500.0))
    motion = plan.trajectory
    ((_, path),) = found["/vkc/base/path"]
    assert path.header.frame_id == "world"
    for pose in path.poses:
        x, y, yaw = motion.at(read_time(pose.header.stamp))[:3]
        position, orientation = pose.pose.position, pose.pose.orientation
        assert np.allclose([position.x, position.y, position.z], [x, y, 0.0], atol=1e-7)
        assert np.isclose(np.cos(yaw - 2.0 * np.arctan2(orientation.z, orientation.w)), 1.0)
    # The velocities in the base frame integrate to the last pose of the motion.
    speeds = found["/vkc/base/cmd_vel"]
    moments = 1e-9 * np.array([when for when, _ in speeds])
    twists = np.array([[m.twist.linear.x, m.twist.linear.y, m.twist.angular.z] for _, m in speeds])
    assert {message.header.frame_id for _, message in speeds} == {"base_link"}
    steps, means = np.diff(moments), (twists[1:] + twists[:-1]) / 2.0
    turns = steps * means[:, 2]
    headings = motion.at(0.0)[2] + np.cumsum(turns) - turns / 2.0
    moved = (steps * (means[:, 0] + 1j * means[:, 1]) * np.exp(1j * headings)).sum()
    reached = np.array([moved.real, moved.imag, turns.sum()]) + motion.at(0.0)[:3]
    assert np.abs(reached - motion.positions[-1, :3]).max() < 1e-3
    assert np.abs(twists[-1]).max() < 1e-9  # at rest at the end


def test_object_states_and_phases(plan: Plan, tmp_path: Path) -> None:
    found = read_bag(plan.to_rosbag(tmp_path / "bag", states=20.0, namespace=""))
    motion = plan.trajectory
    recorded, states = zip(*found["/objects/joint_states"], strict=True)
    times = np.array([read_time(state.header.stamp) for state in states])
    assert np.allclose(times, 1e-9 * np.array(recorded))
    assert np.allclose(np.diff(times)[:-1], 0.05)
    assert list(states[0].name) == ["door.hinge", "door.knob", "door.handle_free"]
    for name, expected in (("position", motion.at(times)), ("velocity", motion.velocity(times))):
        values = [getattr(state, name) for state in states]
        assert np.allclose(values, expected[:, motion.robot_size :], atol=1e-6)
    phases = [(when, json.loads(message.data)["held"]) for when, message in found["/phases"]]
    begins = [round(1e9 * motion.times[phase.first]) for phase in motion.phases]
    assert phases == list(zip(begins, [{}, {"door": "handle"}], strict=True))


def test_existing_folder_is_replaced_only_with_force(plan: Plan, tmp_path: Path) -> None:
    folder = plan.to_rosbag(tmp_path / "deep" / "bag")
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert before.keys() == {".vkc-pin.json", "bag.db3", "metadata.yaml"}
    with expect_error("already exists"):
        plan.to_rosbag(folder, rate=10.0)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    ((_, path),) = read_bag(plan.to_rosbag(folder, rate=10.0, force=True))["/vkc/base/path"]
    assert len(path.poses) == len(plan.to_ros(joints="base", rate=10.0)["points"])
    assert [file.name for file in folder.parent.iterdir()] == ["bag"]


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"rate": 0.0}, "rate"),
        ({"states": -1.0}, "states"),
        ({"namespace": "/a b"}, "namespace"),
        ({"frame": 1}, "frame"),
        ({"base_joint": 1}, "base_joint"),
        ({"states": 1e9}, "states"),
        ({"stamp": 2.0**31 - 5.0}, "stamp"),  # the motion takes 6 s
    ],
)
def test_invalid_arguments_are_rejected(
    plan: Plan, tmp_path: Path, options: dict[str, Any], field: str
) -> None:
    with expect_error(field=field):
        plan.to_rosbag(tmp_path / "bag", **options)
    assert not list(tmp_path.iterdir())


def test_recordings_may_end_in_the_last_second_of_ros(plan: Plan, tmp_path: Path) -> None:
    found = read_bag(plan.to_rosbag(tmp_path / "bag", stamp=2.0**31 - 6.5))
    when, _ = found["/vkc/base/cmd_vel"][-1]
    assert 1e-9 * when == pytest.approx(2.0**31 - 0.5)


def test_missing_package_names_the_extra(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with expect_error(r'rosbags.*pip install "rosbags'):
        plan.to_rosbag(tmp_path / "bag")
    assert not list(tmp_path.iterdir())
