"""Tests ROS 2 recordings of trajectories."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import make_fake_plan
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

import vkc_pin as vkc
from vkc_pin.planning.plan import Plan
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.formats.rosbag import TOPICS
from vkc_pin.world.trajectory.trajectory import Trajectory

Messages = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def plan() -> Plan:
    """A plan whose motion is a curve, as those that are planned."""
    made = make_fake_plan()
    motion = made.trajectory
    rates = np.gradient(motion.positions, motion.times, axis=0)
    rates[[0, 6, -1]] = 0.0
    curve = Curve(motion.times, motion.positions, rates)
    again = Trajectory(
        motion.names, motion.times, motion.positions, motion.phases, motion.robot_size, curve
    )
    object.__setattr__(made, "trajectory", again)
    return made


def read(folder: Path) -> Messages:
    """Return topic → messages, each with when it was recorded [ns]."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    found: Messages = {}
    with Reader(folder) as reader:
        for connection, when, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (when, store.deserialize_cdr(data, connection.msgtype))
            )
    return found


def convert_message(message: Any) -> dict[str, Any]:
    """Return a JointTrajectory as `to_ros` has it."""
    keys = ("positions", "velocities", "accelerations", "effort")
    return {
        "header": {
            "stamp": {"sec": message.header.stamp.sec, "nanosec": message.header.stamp.nanosec},
            "frame_id": message.header.frame_id,
        },
        "joint_names": list(message.joint_names),
        "points": [
            {
                **{key: getattr(point, key).tolist() for key in keys},
                "time_from_start": {
                    "sec": point.time_from_start.sec,
                    "nanosec": point.time_from_start.nanosec,
                },
            }
            for point in message.points
        ],
    }


def test_trajectories_equal_those_of_to_ros(plan: Plan, tmp_path: Path) -> None:
    found = read(plan.to_rosbag(tmp_path / "bag", rate=100.0, frame="map", stamp=1.25))
    assert set(found) == {f"/vkc/{end}" for end in TOPICS}
    for group in ("arm", "base"):
        ((when, message),) = found[f"/vkc/{group}/joint_trajectory"]
        assert when == 1_250_000_000
        assert convert_message(message) == plan.to_ros(
            joints=group, rate=100.0, frame="map", stamp=1.25
        )


def test_base_velocities_lead_along_the_path(plan: Plan, tmp_path: Path) -> None:
    found, motion = read(plan.to_rosbag(tmp_path / "bag", rate=50.0, states=500.0)), plan.trajectory
    ((_, path),) = found["/vkc/base/path"]
    assert path.header.frame_id == "world"
    for pose in path.poses:
        time = pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec
        x, y, yaw = motion.at(time)[:3]
        where, turn = pose.pose.position, pose.pose.orientation
        assert np.allclose([where.x, where.y, where.z], [x, y, 0.0], atol=1e-7)
        assert np.isclose(np.cos(yaw - 2.0 * np.arctan2(turn.z, turn.w)), 1.0)
    # Driving as the velocities say, in the base's own frame, it gets to where the motion ends.
    speeds = found["/vkc/base/cmd_vel"]
    moments = 1e-9 * np.array([when for when, _ in speeds])
    own = np.array([[m.twist.linear.x, m.twist.linear.y, m.twist.angular.z] for _, m in speeds])
    assert {message.header.frame_id for _, message in speeds} == {"base_link"}
    steps, place = np.diff(moments), np.array(motion.at(0.0)[:3])
    for step, (ahead, aside, turning) in zip(steps, (own[1:] + own[:-1]) / 2.0, strict=True):
        middle = place[2] + step * turning / 2.0
        place += step * np.array(
            [
                np.cos(middle) * ahead - np.sin(middle) * aside,
                np.sin(middle) * ahead + np.cos(middle) * aside,
                turning,
            ]
        )
    assert np.abs(place - motion.positions[-1, :3]).max() < 1e-3
    assert np.abs(own[-1]).max() < 1e-9  # it stands at the end


def test_object_states_and_phases(plan: Plan, tmp_path: Path) -> None:
    found, motion = (
        read(plan.to_rosbag(tmp_path / "bag", states=20.0, namespace="")),
        plan.trajectory,
    )
    states = found["/objects/joint_states"]
    times = np.array(
        [message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec for _, message in states]
    )
    assert np.allclose(times, 1e-9 * np.array([when for when, _ in states]))
    assert np.allclose(np.diff(times)[:-1], 0.05)
    assert list(states[0][1].name) == ["door.hinge", "door.knob", "door.handle_free"]
    assert np.allclose(
        [message.position for _, message in states],
        motion.at(times)[:, motion.robot_size :],
        atol=1e-7,
    )
    assert np.allclose(
        [message.velocity for _, message in states],
        motion.velocity(times)[:, motion.robot_size :],
        atol=1e-6,
    )
    phases = [(when, json.loads(message.data)) for when, message in found["/phases"]]
    assert [when for when, _ in phases] == [
        round(1e9 * motion.times[phase.first]) for phase in motion.phases
    ]
    assert [phase["held"] for _, phase in phases] == [{}, {"door": "handle"}]


def test_existing_folder_is_kept(plan: Plan, tmp_path: Path) -> None:
    folder = plan.to_rosbag(tmp_path / "deep" / "bag")
    before = sorted((file.name, file.read_bytes()) for file in folder.iterdir())
    assert [name for name, _ in before] == [".vkc-pin.json", "bag.db3", "metadata.yaml"]
    with pytest.raises(vkc.InputError, match="already exists"):
        plan.to_rosbag(folder, rate=10.0)
    assert sorted((file.name, file.read_bytes()) for file in folder.iterdir()) == before
    assert (
        len(read(plan.to_rosbag(folder, rate=10.0, force=True))["/vkc/base/path"][0][1].poses) == 61
    )
    assert [file.name for file in folder.parent.iterdir()] == ["bag"]


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"rate": 0.0}, "rate"),
        ({"states": -1.0}, "states"),
        ({"namespace": "/a b"}, "namespace"),
        ({"frame": 1}, "frame"),
    ],
)
def test_invalid_arguments_are_rejected(
    plan: Plan, tmp_path: Path, options: dict[str, Any], field: str
) -> None:
    with pytest.raises(vkc.InputError) as caught:
        plan.to_rosbag(tmp_path / "bag", **options)
    assert caught.value.field == field
    assert not list(tmp_path.iterdir())


def test_missing_package_names_the_extra(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(vkc.InputError, match="rosbags") as caught:
        plan.to_rosbag(tmp_path / "bag")
    assert caught.value.expected == 'pip install "vkc-pin[ros]"'
    assert not list(tmp_path.iterdir())
