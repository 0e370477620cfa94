"""Finds the heights at which a robot's hand can grasp bars from the front."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from vkc_pin.importing.robots.rest_configuration import Clearances, get_arm_bounds
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import get_link_name, triangulate

__all__ = ["find_grasp_heights"]

_HEIGHTS = np.arange(1, 20) / 10.0  # [m] of the bars
_UPRIGHT = np.cos(0.6)  # of the largest slope of the approach
# Distance [m] from the centre of a bar to the front behind it, less the clearance of links, and of
# touch links
_FACE, _TOUCH_FACE = 0.05, 0.065
_SAMPLES, _STARTS, _STEPS = 500, 10, 30
_STEP = 0.5  # largest step of a joint, [m] or [rad]
_PROGRESS = 0.9  # factor by which the error must decrease in three steps
_DAMPING, _TOLERANCE = 1e-6, 1e-3


def find_grasp_heights(
    robot: Robot, *, is_turned: bool = False, seed: int = 0
) -> dict[str, Floats]:
    """Return the heights at which a hand can grasp bars on a vertical face, up to 1.9 m.

    The base is wherever it is needed. Configurations are found by inverse kinematics; their links
    overlap neither each other nor the floor, and stay on the hand's side of the face.

    Args:
        robot: The robot.
        is_turned: Whether the tool frame is turned by half a turn about its z axis.
        seed: Random seed.

    Returns:
        "level" and "upright": heights of bars with this direction, shape (k,) [m].
    """
    rng = np.random.default_rng(seed)
    up = -1.0 if is_turned else 1.0
    axes = {"level": (1, 0), "upright": (0, 1)}
    return {kind: _GraspSearch(robot, *axes[kind], up, rng).run() for kind in axes}


class _GraspSearch:
    """Searches configurations that grasp bars of one direction.

    At level bars the tool's x axis, in which the fingers close, points upwards, and its y axis is
    level; at upright bars it is the other way round.

    Args:
        robot: The robot.
        level: Number of the tool's level axis.
        upright: Number of its upright axis.
        up: Height of this axis, 1 or -1.
        rng: Random number generator.
    """

    def __init__(
        self, robot: Robot, level: int, upright: int, up: float, rng: np.random.Generator
    ) -> None:
        self._robot, self._clearances = robot, Clearances(robot)
        self._data, self._frame = robot.model.createData(), robot.model.getFrameId(robot.tool_frame)
        self._low, self._high = get_arm_bounds(robot)
        self._level, self._upright, self._up = level, upright, up
        random = rng.uniform(self._low, self._high, (_SAMPLES, len(self._low)))
        self._samples = np.vstack([robot.home, random])
        self._errors = np.array([self._measure(arm, 0.0) for arm in self._samples])
        corners = dict[tuple[int, float], list[Floats]]()
        for shape in robot.collision.geometryObjects:
            points = triangulate(shape.geometry)[0] @ shape.placement.rotation.T
            face = _TOUCH_FACE if get_link_name(shape.name) in robot.touch_links else _FACE
            corners.setdefault((shape.parentJoint, face), []).append(
                points + shape.placement.translation
            )
        self._corners = {key: np.vstack(points) for key, points in corners.items()}

    def run(self) -> Floats:
        """Return the heights at which a bar can be grasped [m]."""
        found, before = list[float](), list[Floats]()
        for height in _HEIGHTS:
            errors = np.linalg.norm(self._errors - [height, 0.0, 0.0], axis=1)
            for start in [*before, *self._samples[np.argsort(errors)[:_STARTS]]]:
                arm = self._solve(start, height)
                if arm is not None and self._is_free(arm):
                    found.append(height)
                    before = [arm]
                    break
        return np.array(found)

    def _measure(self, arm: Floats, height: float) -> Floats:
        """Return the errors of a hand at a bar, in height [m] and directions, shape (3,)."""
        self._q = self._robot.coordinates.q(np.concatenate([np.zeros(3), arm]))
        pin.framesForwardKinematics(self._robot.model, self._data, self._q)
        self._pose = self._data.oMf[self._frame]
        vertical = self._pose.rotation[2]
        missing = min(0.0, self._up * vertical[self._upright] - _UPRIGHT)
        return np.array([self._pose.translation[2] - height, vertical[self._level], missing])

    def _differentiate(self) -> Floats:
        """Return the derivatives of the errors by the arm's positions, shape (3, n)."""
        jacobian = pin.computeFrameJacobian(
            self._robot.model, self._data, self._q, self._frame, pin.LOCAL_WORLD_ALIGNED
        )[2:5, 3:]  # of the height, and of rotations about the world's x and y axes
        axes = self._pose.rotation
        level, upright = (
            axes[1, k] * jacobian[1] - axes[0, k] * jacobian[2]
            for k in (self._level, self._upright)
        )
        is_missing = self._up * axes[2, self._upright] < _UPRIGHT
        return np.array([jacobian[0], level, self._up * upright * is_missing])

    def _solve(self, arm: Floats, height: float) -> Floats | None:
        """Return a configuration with the hand at a bar, near the given one, or None."""
        history = list[float]()
        for _ in range(_STEPS):
            errors = self._measure(arm, height)
            history.append(float(np.linalg.norm(errors)))
            if history[-1] < _TOLERANCE:
                return arm
            if len(history) > 3 and history[-1] > _PROGRESS * history[-4]:
                return None
            rows, step, free = self._differentiate(), np.zeros(len(arm)), np.ones(len(arm), bool)
            for _ in range(2):  # again without the joints that would leave their limits
                part = rows[:, free]
                square = part @ part.T + _DAMPING * np.eye(3)
                step[:], step[free] = 0.0, -part.T @ np.linalg.solve(square, errors)
                step *= min(1.0, _STEP / max(float(np.abs(step).max()), 1e-9))
                free &= (arm + step >= self._low) & (arm + step <= self._high)
            arm = np.clip(arm + step, self._low, self._high)
        return None

    def _is_free(self, arm: Floats) -> bool:
        """Return whether all links are free, and on the hand's side of the face."""
        self._clearances.place(arm)
        if self._clearances.least(0.0) < 0.0:
            return False
        self._measure(arm, 0.0)
        approach = np.append(self._pose.rotation[:2, 2], 0.0)
        approach /= np.linalg.norm(approach)
        bar = float(self._pose.translation @ approach)
        return all(
            float((points @ (place.rotation.T @ approach)).max() + place.translation @ approach)
            < bar + face
            for (joint, face), points in self._corners.items()
            for place in (self._data.oMi[joint],)
        )
