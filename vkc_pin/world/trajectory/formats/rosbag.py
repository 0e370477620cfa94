"""Writes motions as ROS 2 bags with trajectories, base path and velocity, and object joint states.

A motion is plain data as returned by `Trajectory.to_dict`. Messages are built from the data that
`ros.to_ros` returns.
"""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

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
    "base/path": "nav_msgs/msg/Path",
    "base/cmd_vel": "geometry_msgs/msg/TwistStamped",
    "objects/joint_states": "sensor_msgs/msg/JointState",
    "phases": "std_msgs/msg/String",
}
"""Recorded topics: suffix of the topic name → message type."""
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
    stamp: float = 0.0,
    force: bool = False,
) -> Path:
    """Write a motion as a ROS 2 bag, a folder with metadata.yaml and a database; return its path.

    Trajectories and the path are single messages at the beginning. Velocities of the base, in its
    own frame, and joint states of objects follow at a rate. "phases" states as JSON, where each
    phase begins, its holds and gripper opening. Topics of absent parts (arm, objects) are left out.

    Args:
        motion: Motion.
        path: Folder to create.
        rate: Points per second of trajectories and path [Hz]; see `to_ros`.
        states: Messages per second of base velocities and object states [Hz].
        namespace: Beginning of the topic names.
        frame: `header.frame_id`, the frame of the base's coordinates.
        base_frame: `header.frame_id` of the base's velocities.
        stamp: `header.stamp` of the trajectories, at which the recording begins [s].
        force: Whether to replace an existing folder.

    Raises:
        InputError: The package `rosbags` is not installed, the folder exists or cannot be created,
            or an argument is invalid.
    """
    import_rosbags()
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    states = check_number(states, "states", "messages a second, more than 0", low=0.0, strict=True)
    begin = _check_namespace(namespace)
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    own = check_text(base_frame, "base_frame")
    messages = _make_messages(
        motion, store.types, rate, states, frame=frame, base_frame=own, stamp=stamp
    )
    found = sorted(messages, key=lambda item: item[1])
    with write_folder_atomically(path, force=force) as staging, _report_database_errors(path):
        inside = staging / Path(path).absolute().name  # names the database
        with Writer(inside, version=_FORMAT) as writer:
            ends = [end for end in TOPICS if any(end == own for own, _, _ in found)]
            topics = {
                end: writer.add_connection(f"{begin}/{end}", TOPICS[end], typestore=store)
                for end in ends
            }
            for end, when, message in found:
                writer.write(topics[end], when, bytes(store.serialize_cdr(message, TOPICS[end])))
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
    parts = check_text(name, "namespace").strip("/").split("/") if name != "" else [""]
    if parts != [""] and not all(part.isascii() and part.isidentifier() for part in parts):
        expected = "words separated by slashes, e.g. /vkc"
        raise InputError("not a topic name", field="namespace", expected=expected, got=name)
    return "".join(f"/{part}" for part in parts if part)


def _make_messages(
    motion: Mapping[str, Any],
    types: Any,
    rate: float | None,
    states: float,
    *,
    frame: str,
    base_frame: str,
    stamp: float,
) -> Iterator[tuple[str, int, Any]]:
    """Yield suffix of the topic, time of recording [ns] and message."""
    base = to_ros(motion, joints="base", rate=rate, frame=frame, stamp=stamp)
    begin = _count_nanoseconds(base["header"]["stamp"])
    duration = _count_nanoseconds(base["points"][-1]["time_from_start"])
    if begin + duration >= MOST_SECONDS * _NANO:
        problem = "the motion ends later than messages of ROS can state"
        expected = f"seconds, less than 2^31 − {duration / _NANO:.4g}"
        raise InputError(problem, field="stamp", expected=expected, got=stamp)
    arm = to_ros(motion, joints="arm", rate=rate, frame=frame, stamp=stamp)
    for end, found in (("arm/joint_trajectory", arm), ("base/joint_trajectory", base)):
        if found["joint_names"]:
            yield end, begin, _make_trajectory(types, found)
    header, stamped = types["std_msgs/msg/Header"], types["geometry_msgs/msg/PoseStamped"]
    poses = [
        stamped(
            header(_make_time(types, begin + _count_nanoseconds(p["time_from_start"])), frame),
            _make_pose(types, p),
        )
        for p in base["points"]
    ]
    yield (
        "base/path",
        begin,
        types["nav_msgs/msg/Path"](header(_make_time(types, begin), frame), poses),
    )
    _, times, positions, velocities = sample_states(motion, "base", states)
    for time, pose, velocity in zip(times, positions, velocities, strict=True):
        when = begin + round(time * _NANO)
        twist = _make_twist(types, pose[2], velocity, header(_make_time(types, when), base_frame))
        yield "base/cmd_vel", when, twist
    names, times, positions, velocities = sample_states(motion, "objects", states)
    for time, position, velocity in zip(times, positions, velocities, strict=True):
        if not names:
            break
        when = begin + round(time * _NANO)
        state = types["sensor_msgs/msg/JointState"](
            header(_make_time(types, when), frame), names, position, velocity, np.empty(0)
        )
        yield "objects/joint_states", when, state
    for phase in motion["phases"]:
        when = begin + round((motion["times"][phase["first"]] - motion["times"][0]) * _NANO)
        yield "phases", when, types["std_msgs/msg/String"](json.dumps(phase))


def _make_trajectory(types: Any, found: Mapping[str, Any]) -> Any:
    header, duration = found["header"], types["builtin_interfaces/msg/Duration"]
    kind = types["trajectory_msgs/msg/JointTrajectoryPoint"]
    keys = ("positions", "velocities", "accelerations", "effort")
    points = [
        kind(*(np.array(point[key], float) for key in keys), duration(**point["time_from_start"]))
        for point in found["points"]
    ]
    named = types["std_msgs/msg/Header"](
        _make_time(types, _count_nanoseconds(header["stamp"])), header["frame_id"]
    )
    return types["trajectory_msgs/msg/JointTrajectory"](named, found["joint_names"], points)


def _make_pose(types: Any, point: Mapping[str, Any]) -> Any:
    x, y, yaw = point["positions"]
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))
    return types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x, y, 0.0), turn)


def _make_twist(types: Any, yaw: float, velocity: Floats, header: Any) -> Any:
    """Return a velocity of the base in its own frame."""
    vx, vy, turn = velocity.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    vector = types["geometry_msgs/msg/Vector3"]
    linear, angular = vector(c * vx + s * vy, c * vy - s * vx, 0.0), vector(0.0, 0.0, turn)
    twist = types["geometry_msgs/msg/Twist"](linear, angular)
    return types["geometry_msgs/msg/TwistStamped"](header, twist)


def _make_time(types: Any, nanoseconds: int) -> Any:
    return types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, _NANO))


def _count_nanoseconds(when: Mapping[str, int]) -> int:
    return when["sec"] * _NANO + when["nanosec"]
