"""Defines the interface of robots in the closed loop, and a robot that follows motions exactly."""

from __future__ import annotations

import time
from typing import Protocol, runtime_checkable

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_instance, check_number
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.robot_state import RobotState as RobotState
from vkc_pin.world.trajectory.trajectory import Trajectory


@runtime_checkable
class Robot(Protocol):
    """A robot, or its driver, as the closed loop sees it. All times are those of its clock [s]."""

    @property
    def time(self) -> float:
        """The time now."""

    def read(self) -> RobotState:
        """Return the state as it was measured last."""

    def send(self, motion: Trajectory, begin: float) -> None:
        """Execute a motion whose first waypoint is due at `begin`.

        Until then the robot goes on with the motion before. Motions that were sent to begin later
        are discarded. Raises `InputError` if `begin` is in the past.
        """

    def stop(self) -> None:
        """Come to rest at once, as the robot itself does it."""

    def wait(self, until: float) -> None:
        """Return at a time; at once if it is over."""


class IdealRobot:
    """A robot that follows motions exactly.

    Its clock is that of the computer, or with `is_simulated` one that stands still while the
    program computes: then planning takes no time.

    Args:
        scene: Scene in whose start the robot stands.
        is_simulated: Whether the clock advances in `wait` alone.
    """

    def __init__(self, scene: Scene, *, is_simulated: bool = False) -> None:
        self._start = check_instance(scene, Scene, "scene").start
        self._is_simulated = is_simulated
        self._clock = 0.0
        self._began = time.perf_counter()
        self._motions: list[tuple[float, Trajectory]] = []

    @property
    def time(self) -> float:
        """Time of the robot's clock [s]."""
        return self._clock if self._is_simulated else time.perf_counter() - self._began

    @property
    def motions(self) -> tuple[tuple[float, Trajectory], ...]:
        """Begin [s] and motion of all motions that were sent and not discarded."""
        return tuple(self._motions)

    def read(self) -> RobotState:
        """Return the state now."""
        return self.compute_state(self.time)

    def compute_state(self, moment: float) -> RobotState:
        """Return the state at a time of the robot's clock [s]."""
        for begin, motion in reversed(self._motions):
            if moment >= begin:
                size = motion.robot_size
                at = moment - begin + float(motion.times[0])
                positions = motion.at(at)[:size]
                velocities = motion.velocity(at)[:size]
                return RobotState(moment, positions, velocities)
        return RobotState(moment, self._start.copy(), np.zeros_like(self._start))

    def send(self, motion: Trajectory, begin: float) -> None:
        """Execute a motion from a time on; see `Robot.send`."""
        check_instance(motion, Trajectory, "motion")
        now = self.time
        if begin < now:
            raise InputError(
                "this is over", field="begin", expected=f"a time from {now:g} s on", got=begin
            )
        self._motions = [(other, known) for other, known in self._motions if other < begin]
        self._motions.append((check_number(begin, "begin", "a time [s]"), motion))

    def stop(self) -> None:
        """Stay where it is."""
        self._start = self.read().positions
        self._motions = []

    def wait(self, until: float) -> None:
        """Return at a time."""
        if self._is_simulated:
            self._clock = max(self._clock, until)
        else:
            time.sleep(max(until - self.time, 0.0))
