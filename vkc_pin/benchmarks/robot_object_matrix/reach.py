"""Samples poses that a robot can reach."""

from __future__ import annotations

import zlib

import numpy as np
import pinocchio as pin

from vkc_pin.errors import VkcError
from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import ShapeDistances

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
    free, data, frame = (
        _Free(robot),
        robot.model.createData(),
        robot.model.getFrameId(robot.tool_frame),
    )
    poses = list[pin.SE3]()
    for _ in range(number * _TRIES):
        if len(poses) == number:
            return poses
        z = rng.uniform(low, high)
        if free(z):
            pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
            pose = data.oMf[frame]
            if pose.translation[2] > Options().dist_safe:
                poses.append(pose.copy())
    raise VkcError(
        f"{name}: only {len(poses)} of {number * _TRIES} random configurations are free of "
        "collision"
    )


class _Free:
    """Checks whether a configuration keeps the robot's default margins."""

    def __init__(self, robot: Robot) -> None:
        options, shapes = Options(), robot.collision.geometryObjects
        self._distances = ShapeDistances(robot.model, robot.coordinates.q, shapes)
        margins = robot.own_margins(options.self_distance)
        self._pairs, self._margins = list(margins), np.array(list(margins.values()))
        self._numbers, self._floor = (
            np.array(self._pairs, np.int64).reshape(-1, 2),
            options.dist_safe,
        )
        self._carried = np.array([shape.parentJoint > 1 for shape in shapes])

    def __call__(self, z: Floats) -> bool:
        self._distances.set_configuration(z)
        if (self._distances.compute_lowest_points()[self._carried] < self._floor).any():
            return False
        close = np.flatnonzero(self._distances.compute_lower_bounds(self._numbers) < self._margins)
        return all(
            self._distances.compute_distance([self._pairs[k]]) >= self._margins[k] for k in close
        )
