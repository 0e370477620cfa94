"""Samples episodes at a constant rate as observations and actions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from vkc_pin.datasets.episode import Episode, sample_times
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot


def sample_episode(episode: Episode, robot: Robot, rate: float) -> Mapping[str, Floats]:
    """Return observations and actions at every sample, each of shape (N, k).

    Args:
        episode: Episode.
        robot: Its robot.
        rate: Sampling rate [Hz].

    Returns:
        `time` (N,) [s]; `base_pose` x, y [m] and yaw [rad] in the world frame; `base_velocity`;
        `arm_position`, `arm_velocity` [rad], [rad/s]; `hand_pose`: position [m] and quaternion
        x, y, z, w of the tool frame in the world frame; `gripper`: opening [m], 0 if unknown;
        `holding`: 1 while an object is grasped; `object_position`: coordinates of objects [rad]
        or [m]; `states`: all coordinates of robot and objects; `actions`: base, arm and gripper
        at the next sample (N, n + 1).
    """
    motion = episode.trajectory
    times = sample_times(motion, rate)
    positions, velocities, size = motion.at(times), motion.velocity(times), motion.robot_size
    phase = np.clip(
        np.searchsorted(motion.times[[p.last for p in motion.phases]], times),
        0,
        len(motion.phases) - 1,
    )
    openings = np.array([np.nan if p.opening is None else p.opening for p in motion.phases])
    gripper = np.nan_to_num(openings[phase])[:, None]
    holding = np.array([float(bool(p.holds)) for p in motion.phases])[phase][:, None]
    told = np.hstack([positions[:, :size], gripper])
    return {
        "time": times,
        "base_pose": positions[:, :3],
        "base_velocity": velocities[:, :3],
        "arm_position": positions[:, 3:size],
        "arm_velocity": velocities[:, 3:size],
        "hand_pose": _hands(robot, positions[:, :size]),
        "gripper": gripper,
        "holding": holding,
        "object_position": positions[:, size:],
        "states": positions,
        "actions": np.vstack([told[1:], told[-1:]]),
    }


def _hands(robot: Robot, configurations: Floats) -> Floats:
    """Return poses of the tool frame without sign changes of the quaternion, shape (N, 7)."""
    data, frame = robot.model.createData(), robot.model.getFrameId(robot.tool_frame)
    rows = np.empty((len(configurations), 7))
    for row, configuration in zip(rows, configurations, strict=True):
        pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(configuration))
        row[:] = pin.SE3ToXYZQUAT(data.oMf[frame])
    # q and -q are the same rotation: signs are chosen such that none jumps.
    turns = np.sign(np.einsum("ij,ij->i", rows[1:, 3:], rows[:-1, 3:]))
    rows[1:, 3:] *= np.cumprod(np.where(turns == 0.0, 1.0, turns))[:, None]
    return rows
