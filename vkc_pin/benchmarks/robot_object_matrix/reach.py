"""Samples poses that a robot can reach."""

from __future__ import annotations

import zlib

import numpy as np
import pinocchio as pin

from vkc_pin.errors import VkcError
from vkc_pin.importing.robots.rest_configuration import Clearances
from vkc_pin.options import Options
from vkc_pin.world.models.robot import Robot

__all__ = ["sample_reachable_poses"]

_AWAY = 1.0  # [m] from the start, along x and along y, that the base drives at most
# configurations for each pose: some of an arm folded tightly are free in one of a hundred
_TRIES = 20_000


def sample_reachable_poses(robot: Robot, name: str, number: int, *, seed: int = 0) -> list[pin.SE3]:
    """Sample tool poses of random configurations in which the robot keeps its default margins.

    The base moves up to 1 m along x and y; unlimited joints stay within ±π.

    Args:
        robot: Robot with collision pairs.
        name: Name, which determines the random numbers together with `seed`.
        number: Number of poses.
        seed: Random seed.

    Raises:
        VkcError: Hardly any configuration is free.
    """
    rng = np.random.default_rng([11, seed, zlib.crc32(name.encode())])
    low, high = (
        np.where(np.isfinite(robot.lower), robot.lower, -np.pi),
        np.where(np.isfinite(robot.upper), robot.upper, np.pi),
    )
    low[:3], high[:3] = (-_AWAY, -_AWAY, -np.pi), (_AWAY, _AWAY, np.pi)
    clearances, data, frame = (
        Clearances(robot),
        robot.model.createData(),
        robot.model.getFrameId(robot.tool_frame),
    )
    poses = list[pin.SE3]()
    for _ in range(number * _TRIES):
        if len(poses) == number:
            return poses
        z = rng.uniform(low, high)
        clearances.place(z[3:])
        if clearances.is_free():
            pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
            pose = data.oMf[frame]
            if pose.translation[2] > Options().dist_safe:
                poses.append(pose.copy())
    raise VkcError(
        f"{name}: only {len(poses)} of {number * _TRIES} random configurations are free of "
        "collision"
    )
