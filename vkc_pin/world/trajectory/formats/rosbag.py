"""Writes motions as ROS 2 bags with trajectories, base path and velocity, and object joint states.

A motion is plain data as returned by `Trajectory.to_dict`. Messages are built from the data that
`ros.to_ros` returns.
"""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_number, check_text
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.files.writing import write_folder_atomically
from vkc_pin.world.trajectory.formats.ros import MOST_SECONDS, sample_states, to_ros

TOPICS: Mapping[str, str] = {
    "arm/joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
    "base/joint_trajectory": "trajectory_msgs/msg/JointTrajectory",
    "robot_trajectory": "moveit_msgs/msg/RobotTrajectory",
    "base/path": "nav_msgs/msg/Path",
    "base/cmd_vel": "geometry_msgs/msg/TwistStamped",
    "objects/joint_states": "sensor_msgs/msg/JointState",
    "phases": "std_msgs/msg/String",
}
"""Recorded topics: suffix of the topic name → message type."""
ROBOT_TRAJECTORY = """\
trajectory_msgs/JointTrajectory joint_trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory
"""
"""Definition of MoveIt's message type `RobotTrajectory`, which rosbags does not know."""
_FORMAT = 8  # of rosbag2, the last that older readers accept
_NANO = 1_000_000_000


def write_rosbag(
    motion: Mapping[str, Any],
    path: str | Path,
    *,
    rate: float | None = None,
    states: float = 50.0,
    namespace: str = "/vkc",
    frame: str = "world",
    base_frame: str = "base_link",
    base_joint: str = "world_joint",
    stamp: float = 0.0,
    force: bool = False,
) -> Path:
    """Write a motion as a ROS 2 bag, a folder with metadata.yaml and a database; return its path.

    Trajectories and the path are single messages at the beginning. Velocities of the base, in its
    own frame, and joint states of objects follow at a rate. "robot_trajectory" is arm and base as
    MoveIt states them: the base is a joint of several degrees of freedom. "phases" states as JSON,
    where each phase begins, its holds and gripper opening. Topics of absent parts (arm, objects)
    are left out.

    Args:
        motion: Motion.
        path: Folder to create.
        rate: Points per second of trajectories and path [Hz]; see `to_ros`.
        states: Messages per second of base velocities and object states [Hz].
        namespace: Beginning of the topic names.
        frame: `header.frame_id`, the frame of the base's coordinates.
        base_frame: `header.frame_id` of the base's velocities.
        base_joint: Name of the base's planar joint in "robot_trajectory": that of the SRDF's
            `virtual_joint`.
        stamp: `header.stamp` of the trajectories, at which the recording begins [s].
        force: Whether to replace an existing folder.

    Raises:
        InputError: The package `rosbags` is not installed, the folder exists or cannot be created,
            or an argument is invalid.
    """
    import_rosbags()
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    states = check_number(states, "states", "messages a second, more than 0", low=0.0, strict=True)
    prefix = _check_namespace(namespace)
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(ROBOT_TRAJECTORY, TOPICS["robot_trajectory"]))
    messages = list(
        _make_messages(
            motion,
            store.types,
            rate,
            states,
            frame=frame,
            base_frame=check_text(base_frame, "base_frame"),
            base_joint=check_text(base_joint, "base_joint"),
            stamp=stamp,
        )
    )
    messages.sort(key=lambda message: message.time)
    used_topics = {message.topic for message in messages}
    with write_folder_atomically(path, force=force) as staging, _report_database_errors(path):
        inside = staging / Path(path).absolute().name  # names the database
        with Writer(inside, version=_FORMAT) as writer:
            connections = {}
            for topic, kind in TOPICS.items():
                if topic in used_topics:
                    name = f"{prefix}/{topic}"
                    connections[topic] = writer.add_connection(name, kind, typestore=store)
            for topic, time, content in messages:
                data = bytes(store.serialize_cdr(content, TOPICS[topic]))
                writer.write(connections[topic], time, data)
        for file in inside.iterdir():
            file.rename(staging / file.name)
        inside.rmdir()
    return Path(path)


@contextlib.contextmanager
def _report_database_errors(path: str | Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:  # such as a full disk
        raise InputError("cannot write this", file=path, got=str(error)) from error


def import_rosbags() -> Any:
    """Return the package `rosbags`."""
    return import_optional("rosbags", "ros", purpose="recording for ROS")


def _check_namespace(name: str) -> str:
    """Return a namespace with a slash before each of its words; none for an empty one."""
    if name == "":
        return ""
    words = check_text(name, "namespace").strip("/").split("/")
    if words == [""]:
        return ""
    if not all(word.isascii() and word.isidentifier() for word in words):
        expected = "words separated by slashes, e.g. /vkc"
        raise InputError("not a topic name", field="namespace", expected=expected, got=name)
    return "".join(f"/{word}" for word in words)


class _Message(NamedTuple):
    """Suffix of the topic, time of recording [ns], and content."""

    topic: str
    time: int
    content: Any


def _make_messages(
    motion: Mapping[str, Any],
    types: Any,
    rate: float | None,
    states: float,
    *,
    frame: str,
    base_frame: str,
    base_joint: str,
    stamp: float,
) -> Iterator[_Message]:
    base = to_ros(motion, joints="base", rate=rate, frame=frame, stamp=stamp)
    begin = _count_nanoseconds(base["header"]["stamp"])
    duration = _count_nanoseconds(base["points"][-1]["time_from_start"])
    if begin + duration >= MOST_SECONDS * _NANO:
        problem = "the motion ends later than messages of ROS can state"
        expected = f"seconds, less than 2^31 − {duration / _NANO:.4g}"
        raise InputError(problem, field="stamp", expected=expected, got=stamp)
    arm = to_ros(motion, joints="arm", rate=rate, frame=frame, stamp=stamp)
    if arm["joint_names"]:
        yield _Message("arm/joint_trajectory", begin, _make_trajectory(types, arm))
    if base["joint_names"]:
        yield _Message("base/joint_trajectory", begin, _make_trajectory(types, base))
    whole = types[TOPICS["robot_trajectory"]](
        _make_trajectory(types, arm), _make_base_trajectory(types, base, base_joint)
    )
    yield _Message("robot_trajectory", begin, whole)
    yield _Message("base/path", begin, _make_path(types, base["points"], begin, frame))
    _, times, positions, velocities = sample_states(motion, "base", states)
    for time, pose, velocity in zip(times, positions, velocities, strict=True):
        recorded = begin + round(time * _NANO)
        header = _make_header(types, recorded, base_frame)
        twist = _make_twist(types, pose[2], velocity, header)
        yield _Message("base/cmd_vel", recorded, twist)
    names, times, positions, velocities = sample_states(motion, "objects", states)
    for time, position, velocity in zip(times, positions, velocities, strict=True):
        if not names:
            break
        recorded = begin + round(time * _NANO)
        header = _make_header(types, recorded, frame)
        no_efforts = np.empty(0)
        state = types["sensor_msgs/msg/JointState"](header, names, position, velocity, no_efforts)
        yield _Message("objects/joint_states", recorded, state)
    for phase in motion["phases"]:
        seconds = motion["times"][phase["first"]] - motion["times"][0]
        recorded = begin + round(seconds * _NANO)
        yield _Message("phases", recorded, types["std_msgs/msg/String"](json.dumps(phase)))


def _make_trajectory(types: Any, data: Mapping[str, Any]) -> Any:
    make_point = types["trajectory_msgs/msg/JointTrajectoryPoint"]
    make_duration = types["builtin_interfaces/msg/Duration"]
    points = []
    for point in data["points"]:
        numbers = make_point(
            np.array(point["positions"], float),
            np.array(point["velocities"], float),
            np.array(point["accelerations"], float),
            np.array(point["effort"], float),
            make_duration(**point["time_from_start"]),
        )
        points.append(numbers)
    stamp = _count_nanoseconds(data["header"]["stamp"])
    header = _make_header(types, stamp, data["header"]["frame_id"])
    return types["trajectory_msgs/msg/JointTrajectory"](header, data["joint_names"], points)


def _make_base_trajectory(types: Any, data: Mapping[str, Any], joint: str) -> Any:
    """Return the motion of the base as that of a planar joint.

    As MoveIt has it, velocities and accelerations are those of x, y and yaw, in the frame of the
    poses and not in that of the base.
    """
    make_point = types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"]
    make_duration = types["builtin_interfaces/msg/Duration"]
    make_vector = types["geometry_msgs/msg/Vector3"]
    make_transform = types["geometry_msgs/msg/Transform"]
    make_twist = types["geometry_msgs/msg/Twist"]

    def make_rates(rates: Sequence[float]) -> list[Any]:
        if not rates:
            return []
        x, y, yaw = rates
        return [make_twist(make_vector(x, y, 0.0), make_vector(0.0, 0.0, yaw))]

    points = []
    for point in data["points"]:
        pose = _make_pose(types, point)
        x, y, _ = point["positions"]
        transform = make_transform(make_vector(x, y, 0.0), pose.orientation)
        numbers = make_point(
            [transform],
            make_rates(point["velocities"]),
            make_rates(point["accelerations"]),
            make_duration(**point["time_from_start"]),
        )
        points.append(numbers)
    stamp = _count_nanoseconds(data["header"]["stamp"])
    header = _make_header(types, stamp, data["header"]["frame_id"])
    return types["trajectory_msgs/msg/MultiDOFJointTrajectory"](header, [joint], points)


def _make_path(types: Any, points: Sequence[Mapping[str, Any]], begin: int, frame: str) -> Any:
    make_stamped = types["geometry_msgs/msg/PoseStamped"]
    poses = []
    for point in points:
        time = begin + _count_nanoseconds(point["time_from_start"])
        poses.append(make_stamped(_make_header(types, time, frame), _make_pose(types, point)))
    return types["nav_msgs/msg/Path"](_make_header(types, begin, frame), poses)


def _make_pose(types: Any, point: Mapping[str, Any]) -> Any:
    x, y, yaw = point["positions"]
    position = types["geometry_msgs/msg/Point"](x, y, 0.0)
    # A rotation by yaw about z
    sine = math.sin(yaw / 2.0)
    cosine = math.cos(yaw / 2.0)
    orientation = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, sine, cosine)
    return types["geometry_msgs/msg/Pose"](position, orientation)


def _make_twist(types: Any, yaw: float, velocity: Floats, header: Any) -> Any:
    """Return a velocity of the base in its own frame."""
    vx, vy, yaw_rate = velocity.tolist()
    c = math.cos(yaw)
    s = math.sin(yaw)
    make_vector = types["geometry_msgs/msg/Vector3"]
    linear = make_vector(c * vx + s * vy, c * vy - s * vx, 0.0)
    angular = make_vector(0.0, 0.0, yaw_rate)
    twist = types["geometry_msgs/msg/Twist"](linear, angular)
    return types["geometry_msgs/msg/TwistStamped"](header, twist)


def _make_header(types: Any, nanoseconds: int, frame: str) -> Any:
    seconds, rest = divmod(nanoseconds, _NANO)
    stamp = types["builtin_interfaces/msg/Time"](seconds, rest)
    return types["std_msgs/msg/Header"](stamp, frame)


def _count_nanoseconds(time: Mapping[str, int]) -> int:
    return time["sec"] * _NANO + time["nanosec"]
