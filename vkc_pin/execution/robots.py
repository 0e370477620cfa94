"""Defines the interface of robots in the closed loop, and a robot that follows motions exactly."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arguments import check_finite_array, check_instance, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.frames import invert_frame, place_base, place_motion, turn_base
from vkc_pin.world.trajectory.robot_state import RobotState as RobotState
from vkc_pin.world.trajectory.splicing import extract_times
from vkc_pin.world.trajectory.trajectory import Trajectory

_SENDING_TIME = 0.02  # [s] from the decision to send a motion to its begin
_SHORTEST = 0.01  # [s] of a motion that is worth correcting
_ROUNDING = 1e-6  # [m], [rad] of a correction that is none


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


class LocalisedRobot:
    """A robot that drives by its odometry, and is localised in the scene meanwhile.

    States are read in the frame of the scene, and motions are sent in that of the odometry, as it
    lies in the scene when they are sent. Small corrections of the localisation are followed: the
    rest of the motion is sent again. After larger ones the robot is off its motion, and
    `execute` plans again from where it is, if its `tracking` is no larger than `step`.

    In terms of ROS (REP 105), the scene is "map", and the odometry's frame "odom".

    Args:
        robot: The robot, whose states and motions are in the frame of its odometry.
        locate: Returns the frame of the odometry in the scene, as the localisation has it now: x, y
            [m], yaw [rad].
        step: Largest correction that is followed, of the base's x and y [m] and its yaw [rad].

    Raises:
        InputError: `robot` lacks a method of `Robot`, `locate` is no function, or `step` is
            negative. Later: `locate` returns something else than three numbers.
    """

    def __init__(
        self, robot: Robot, locate: Callable[[], ArrayLike], *, step: float = 0.005
    ) -> None:
        if not isinstance(robot, Robot):
            expected = "an object with the methods of `Robot`"
            raise InputError("no robot", field="robot", expected=expected, got=format_value(robot))
        if not callable(locate):
            expected, got = "a function without arguments", format_value(locate)
            raise InputError("cannot be called", field="locate", expected=expected, got=got)
        self._robot = robot
        self._locate = locate
        self._step = check_number(step, "step", "a distance [m], [rad]", low=0.0)
        self._sent: tuple[float, Trajectory, Floats] | None = None  # begin, motion, frame
        self._yaw = 0.0  # of the frame, as read last [rad]

    @property
    def time(self) -> float:
        """Time of the robot's clock [s]."""
        return self._robot.time

    def read(self) -> RobotState:
        """Return the state as it was measured last, in the scene."""
        state = self._robot.read()
        frame = self._read_frame()
        return replace(
            state,
            positions=place_base(frame, state.positions),
            velocities=turn_base(frame[2], state.velocities),
        )

    def send(self, motion: Trajectory, begin: float) -> None:
        """Execute a motion in the scene from a time on; see `Robot.send`."""
        check_instance(motion, Trajectory, "motion")
        frame = self._read_frame()
        self._robot.send(place_motion(invert_frame(frame), motion), begin)
        self._sent = begin, motion, frame

    def stop(self) -> None:
        """Come to rest at once, as the robot itself does it."""
        self._sent = None
        self._robot.stop()

    def wait(self, until: float) -> None:
        """Return at a time, at once if it is over; follow corrections of the localisation."""
        self._robot.wait(until)
        if self._sent is not None:
            self._follow(*self._sent)

    def _follow(self, begin: float, motion: Trajectory, sent: Floats) -> None:
        """Send the rest of a motion again if the odometry's frame has moved."""
        frame = self._read_frame()
        first, last = motion.times[[0, -1]].tolist()

        def correct(start: float) -> Trajectory | None:
            """Return the corrected rest from a time on; None if there is nothing to correct."""
            at = first + start - begin
            if not first < at < last - _SHORTEST:
                return None  # a motion that has not begun follows the one before it
            base = motion.at(at)[:3]
            correction = place_base(frame, place_base(invert_frame(sent), base)) - base
            if not _ROUNDING < np.abs(correction).max() <= self._step:
                return None
            return place_motion(invert_frame(frame), extract_times(motion, at, last))

        if send_soon(self._robot, correct) is not None:
            self._sent = begin, motion, frame

    def _read_frame(self) -> Floats:
        """Return the frame of the odometry in the scene now: x, y [m], yaw [rad]."""
        frame = check_finite_array(self._locate(), "locate()")
        if frame.shape != (3,):
            expected, got = "x, y [m], yaw [rad]", format_value(frame.tolist())
            raise InputError("wrong shape", field="locate()", expected=expected, got=got)
        # A yaw that jumps by whole turns has not changed.
        self._yaw += float(wrap_angle(frame[2] - self._yaw))
        return np.array([*frame[:2], self._yaw])


def send_soon(
    robot: Robot, make_motion: Callable[[float], Trajectory | None]
) -> tuple[float, Trajectory] | None:
    """Send a motion that depends on when it begins; on a slow machine, it begins later.

    Args:
        robot: The robot.
        make_motion: Returns the motion for a begin on the robot's clock [s], or None for none.

    Returns:
        Its begin [s] and the motion; None if there is none.
    """
    delay = _SENDING_TIME
    while True:
        begin = robot.time + delay
        motion = make_motion(begin)
        if motion is None:
            return None
        if robot.time < begin:
            robot.send(motion, begin)
            return begin, motion
        delay *= 2.0
