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
    size = motion.robot_size
    times = sample_times(motion, rate)
    positions = motion.at(times)
    velocities = motion.velocity(times)
    ends = motion.times[[phase.last for phase in motion.phases]]
    phases = np.clip(np.searchsorted(ends, times), 0, len(motion.phases) - 1)
    openings = [0.0 if phase.opening is None else phase.opening for phase in motion.phases]
    gripper = np.array(openings)[phases][:, None]
    is_holding = [float(bool(phase.holds)) for phase in motion.phases]
    holding = np.array(is_holding)[phases][:, None]
    commanded = np.hstack([positions[:, :size], gripper])
    return {
        "time": times,
        "base_pose": positions[:, :3],
        "base_velocity": velocities[:, :3],
        "arm_position": positions[:, 3:size],
        "arm_velocity": velocities[:, 3:size],
        "hand_pose": _compute_hand_poses(robot, positions[:, :size]),
        "gripper": gripper,
        "holding": holding,
        "object_position": positions[:, size:],
        "states": positions,
        "actions": np.vstack([commanded[1:], commanded[-1:]]),
    }


def _compute_hand_poses(robot: Robot, configurations: Floats) -> Floats:
    """Return poses of the tool frame without sign changes of the quaternion, shape (N, 7)."""
    data = robot.model.createData()
    frame = robot.model.getFrameId(robot.tool_frame)
    rows = np.empty((len(configurations), 7))
    for row, configuration in zip(rows, configurations, strict=True):
        pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(configuration))
        row[:] = pin.SE3ToXYZQUAT(data.oMf[frame])
    # q and -q are the same rotation: signs are chosen such that none jumps.
    signs = np.sign(np.einsum("ij,ij->i", rows[1:, 3:], rows[:-1, 3:]))
    signs[signs == 0.0] = 1.0
    rows[1:, 3:] *= np.cumprod(signs)[:, None]
    return rows
