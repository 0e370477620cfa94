"""Recordings of ROS 2 hold what controllers are sent, to the nanosecond, and come back."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import fake_plan
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

import vkc_pin as vkc
from vkc_pin import cli
from vkc_pin.planning.plan import Plan
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.formats.rosbag import TOPICS
from vkc_pin.world.trajectory.trajectory import Trajectory

Messages = dict[str, list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def plan() -> Plan:
    """A plan whose motion is a curve, as those that are planned."""
    made = fake_plan()
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


def as_data(message: Any) -> dict[str, Any]:
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


@pytest.mark.parametrize("rate", [None, 100.0])
def test_trajectories_are_those_of_to_ros(plan: Plan, tmp_path: Path, rate: float | None) -> None:
    found = read(plan.to_rosbag(tmp_path / "bag", rate=rate, frame="map", stamp=1.25))
    assert set(found) == {f"/vkc/{end}" for end in TOPICS}
    for group in ("arm", "base"):
        ((when, message),) = found[f"/vkc/{group}/joint_trajectory"]
        assert when == 1_250_000_000
        assert as_data(message) == plan.to_ros(joints=group, rate=rate, frame="map", stamp=1.25)


def test_a_motion_comes_back(plan: Plan, tmp_path: Path) -> None:
    found = read(plan.to_rosbag(tmp_path / "bag"))
    data = [as_data(found[f"/vkc/{group}/joint_trajectory"][0][1]) for group in ("base", "arm")]
    points = [
        {**one, **{key: one[key] + other[key] for key in ("positions", "velocities")}}
        for one, other in zip(data[0]["points"], data[1]["points"], strict=True)
    ]
    back = Trajectory.from_ros(
        {"joint_names": data[0]["joint_names"] + data[1]["joint_names"], "points": points}
    )
    times = np.linspace(0.0, plan.trajectory.times[-1], 101)
    assert (
        np.abs(back.at(times) - plan.trajectory.at(times)[:, : plan.trajectory.robot_size]).max()
        < 1e-6
    )


def test_the_base_drives_along_its_path(plan: Plan, tmp_path: Path) -> None:
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


def test_objects_and_phases(plan: Plan, tmp_path: Path) -> None:
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


def test_what_a_motion_does_not_have_is_left_out(plan: Plan, tmp_path: Path) -> None:
    motion = plan.trajectory
    alone = Trajectory(motion.names[:3], motion.times, motion.positions[:, :3], motion.phases, 3)
    assert set(read(alone.to_rosbag(tmp_path / "bag"))) == {
        f"/vkc/{end}" for end in TOPICS if end[:3] not in ("arm", "obj")
    }


def test_a_folder_that_is_there_is_kept(plan: Plan, tmp_path: Path) -> None:
    folder = plan.to_rosbag(tmp_path / "deep" / "bag")
    before = sorted((file.name, file.read_bytes()) for file in folder.iterdir())
    assert [name for name, _ in before] == [".vkc-pin.json", "bag.db3", "metadata.yaml"]
    with pytest.raises(vkc.InputError, match="there already"):
        plan.to_rosbag(folder, rate=10.0)
    assert sorted((file.name, file.read_bytes()) for file in folder.iterdir()) == before
    assert (
        len(read(plan.to_rosbag(folder, rate=10.0, force=True))["/vkc/base/path"][0][1].poses) == 61
    )
    assert [file.name for file in folder.parent.iterdir()] == ["bag"]


def test_a_folder_of_another_kind_is_not_replaced(plan: Plan, tmp_path: Path) -> None:
    (tmp_path / "thesis" / "chapters").mkdir(parents=True)
    (tmp_path / "thesis" / "chapters" / "1.tex").write_text("years of work")
    with pytest.raises(vkc.InputError, match=r"would delete .*got chapters/1\.tex\)") as caught:
        plan.to_rosbag(tmp_path / "thesis", force=True)
    assert caught.value.file == tmp_path / "thesis"
    assert (tmp_path / "thesis" / "chapters" / "1.tex").read_text() == "years of work"
    assert [path.name for path in tmp_path.iterdir()] == ["thesis"]


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"rate": 0.0}, "rate"),
        ({"states": -1.0}, "states"),
        ({"namespace": "/a b"}, "namespace"),
        ({"namespace": 3}, "namespace"),
        ({"stamp": -1.0}, "stamp"),
        ({"frame": 1}, "frame"),
    ],
)
def test_wrong_arguments_are_named(
    plan: Plan, tmp_path: Path, options: dict[str, Any], field: str
) -> None:
    with pytest.raises(vkc.InputError) as caught:
        plan.to_rosbag(tmp_path / "bag", **options)
    assert caught.value.field == field
    assert not list(tmp_path.iterdir())


def test_without_the_package_the_error_names_the_extra(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(vkc.InputError, match="rosbags") as caught:
        plan.to_rosbag(tmp_path / "bag")
    assert caught.value.expected == 'pip install "vkc-pin[ros]"'
    # The command says so before it plans.
    assert (
        cli.main(
            [
                "plan",
                "door",
                "--set",
                "door.hinge=1.2",
                "--quiet",
                "--rosbag",
                str(tmp_path / "bag"),
            ]
        )
        == 2
    )
    assert "vkc-pin[ros]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_command_line(plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    saved, bag = plan.save(tmp_path / "door.npz"), tmp_path / "bag"
    assert cli.main(["export", str(saved), "--rosbag", str(bag), "--rate", "10"]) == 0
    assert f"wrote {bag}" in capsys.readouterr().out
    assert len(read(bag)["/vkc/base/path"][0][1].poses) == 61
    assert cli.main(["export", str(saved), "--rosbag", str(bag)]) == 2
    assert "--rosbag: this is there already" in capsys.readouterr().err
    assert (
        cli.main(["export", str(saved), "--rosbag", str(tmp_path / "other"), "--joints", "arm"])
        == 2
    )
    assert "--joints" in capsys.readouterr().err
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bag", "door.npz"]
