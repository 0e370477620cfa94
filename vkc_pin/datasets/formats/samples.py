"""An episode sampled at a steady rate: what a robot observes and is told, as learning takes it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from vkc_pin.datasets.episode import Episode, sample_times
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot

__all__ = ["sample_episode"]


def sample_episode(episode: Episode, robot: Robot, rate: float) -> Mapping[str, Floats]:
    """Return what is observed and told at every moment, each of shape (N, k).

    Args:
        episode: The episode.
        robot: Its robot.
        rate: Moments a second.

    Returns:
        `time` (N,) [s]; `base_pose` x, y [m] and yaw [rad] in the world frame; `base_velocity`;
        `arm_position`, `arm_velocity` [rad], [rad/s]; `hand_pose`: the tool frame's position [m]
        and quaternion x, y, z, w in the world frame; `gripper`: how far it is open [m], 0 where
        that is not known; `holding`: 1 while something is held; `object_position`: the coordinates
        of objects [rad] or [m]; `states`: all coordinates of robot and objects; `actions`: what
        base, arm and gripper are at the next moment (N, n + 1).
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
    """Return where the tool frame is at some configurations, shape (N, 7)."""
    data, frame = robot.model.createData(), robot.model.getFrameId(robot.tool_frame)
    rows = np.empty((len(configurations), 7))
    for row, configuration in zip(rows, configurations, strict=True):
        pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(configuration))
        row[:] = pin.SE3ToXYZQUAT(data.oMf[frame])
    turns = np.sign(
        np.einsum("ij,ij->i", rows[1:, 3:], rows[:-1, 3:])
    )  # q and -q are the same: no jumps between them
    rows[1:, 3:] *= np.cumprod(np.where(turns == 0.0, 1.0, turns))[:, None]
    return rows
