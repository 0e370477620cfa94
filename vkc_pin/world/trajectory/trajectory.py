"""Represents motions of robot and objects by waypoints, phases and an optional smooth curve."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic.types import FailFast

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import (
    check_choice,
    check_finite_array,
    check_instance,
    check_integer,
    check_list,
    check_number,
    check_text,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.documents import Document, parse_document
from vkc_pin.world.files.fields import Count, Schema, Text
from vkc_pin.world.trajectory.curve import Curve, sample_evenly
from vkc_pin.world.trajectory.formats import ros, rosbag, tables
from vkc_pin.world.trajectory.phase_span import PhaseSchema, PhaseSpan

MOST_SAMPLES = 1_000_000
"""Largest number of samples of a motion."""


@dataclass(frozen=True)
class Trajectory:
    """Waypoints over time, joined by a smooth curve or by linear interpolation.

    Attributes:
        names: Names of the n coordinates: base x, y, yaw, arm joints, then
            `<object>.<joint>`.
        times: Increasing times of the waypoints, shape (T,) [s].
        positions: Positions, shape (T, n), [m] and [rad]. Angles are not wrapped.
        phases: Consecutive phases that cover the whole motion.
        robot_size: Number of robot coordinates (3 for the base, then the arm).
        curve: Smooth curve through the waypoints. Default: linear interpolation.

    Raises:
        InputError: Names are not unique, numbers are not finite, shapes do not match, times do not
            increase, phases do not cover the motion, or the curve does not lead from the first
            waypoint through all others to the last.
    """

    names: tuple[str, ...]
    times: Floats
    positions: Floats
    phases: tuple[PhaseSpan, ...]
    robot_size: int
    curve: Curve | None = None

    def __repr__(self) -> str:
        names = ", ".join(phase.name for phase in self.phases)
        return f"<Trajectory {self.times[-1]:.1f} s, {len(self.times)} waypoints: {names}>"

    def __post_init__(self) -> None:
        names = _check_names(self.names)
        phases = check_list(self.phases, "Trajectory.phases", "a list of PhaseSpan", PhaseSpan)
        times = check_finite_array(self.times, "Trajectory.times")
        positions = check_finite_array(self.positions, "Trajectory.positions")
        if times.ndim != 1 or len(times) < 2 or not np.all(np.diff(times) > 0):
            raise InputError(
                "times do not increase",
                field="Trajectory.times",
                expected="at least 2 increasing numbers",
            )
        shape = (len(times), len(names))
        if positions.shape != shape:
            raise InputError(
                "wrong shape", field="Trajectory.positions", expected=shape, got=positions.shape
            )
        size = check_integer(self.robot_size, "Trajectory.robot_size", low=3, high=len(names))
        _check_order(phases, len(times) - 1)
        if self.curve is not None:
            check_instance(self.curve, Curve, "Trajectory.curve").check_through(times, positions)
        times.setflags(write=False)
        positions.setflags(write=False)
        checked = {
            "names": names,
            "times": times,
            "positions": positions,
            "phases": phases,
            "robot_size": size,
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def at(self, time: ArrayLike) -> Floats:
        """Return positions, shape (..., n), at `time` [s], shape (...,), clamped to the motion.

        Raises:
            InputError: `time` is not finite.
        """
        time = check_finite_array(time, "time")
        if self.curve is not None:
            return self.curve.at(time)
        columns = [np.interp(time, self.times, column) for column in self.positions.T]
        return np.stack(columns, axis=-1)

    def __call__(self, time: ArrayLike) -> Floats:
        """Return the positions at `time`; see `at`."""
        return self.at(time)

    def velocity(self, time: ArrayLike) -> Floats:
        """Return velocities, shape (..., n) [m/s], [rad/s], at `time` [s], shape (...,).

        Velocities are 0 outside the motion. Without a curve they jump at waypoints, where the next
        segment counts. Raises `InputError` if `time` is not finite.
        """
        time = check_finite_array(time, "time")
        if self.curve is not None:
            return self.curve.velocity(time)
        inside = ((time >= self.times[0]) & (time <= self.times[-1]))[..., None]
        segment = np.clip(
            np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2
        )
        return np.asarray(np.where(inside, self.velocities()[segment], 0.0))

    def acceleration(self, time: ArrayLike) -> Floats:
        """Return accelerations, shape (..., n) [m/s²], [rad/s²], at `time` [s], shape (...,).

        They jump at the curve's knots. Without a curve they are 0, and velocities jump. Raises
        `InputError` if `time` is not finite.
        """
        time = check_finite_array(time, "time")
        if self.curve is not None:
            return self.curve.acceleration(time)
        return np.zeros((*time.shape, len(self.names)))

    def sample(self, rate: float) -> tuple[Floats, Floats]:
        """Sample the motion at `rate` [Hz] and at its end.

        Returns:
            Times, shape (K,) [s], and positions, shape (K, n).

        Raises:
            InputError: `rate` is not positive, or gives too many samples.
        """
        rate = check_number(rate, "rate", "samples a second, more than 0", low=0.0, strict=True)
        duration = float(self.times[-1] - self.times[0])
        if duration * rate > MOST_SAMPLES:
            raise InputError(
                "too many samples",
                field="rate",
                expected=f"at most {MOST_SAMPLES / duration:.4g}",
                got=rate,
            )
        times = sample_evenly(self.times, rate)
        return times, self.at(times)

    def column(self, name: str) -> Floats:
        """Return a coordinate at all waypoints, shape (T,).

        Raises:
            UnknownNameError: There is no such coordinate.
        """
        column = self.names.index(check_choice(name, self.names, "coordinate"))
        return np.array(self.positions[:, column])

    def ranges(self) -> tuple[Floats, Floats]:
        """Return the smallest and largest positions of every segment, shape (T − 1, n) each."""
        if self.curve is None:
            before = self.positions[:-1]
            after = self.positions[1:]
            return np.minimum(before, after), np.maximum(before, after)
        # The knots of a segment are those from its first waypoint to its last.
        begins = np.searchsorted(self.curve.times, self.times[:-1])
        low, high = self.curve.compute_extrema()
        smallest = np.asarray(np.minimum.reduceat(low, begins))
        largest = np.asarray(np.maximum.reduceat(high, begins))
        return smallest, largest

    def velocities(self) -> Floats:
        """Return the mean velocity of every segment, shape (T − 1, n), [m/s] and [rad/s]."""
        return np.asarray(np.diff(self.positions, axis=0) / np.diff(self.times)[:, None])

    def accelerations(self, start_velocity: Floats | None = None) -> Floats:
        """Return the accelerations at waypoints as in eq. 5, shape (T, n), [m/s²] and [rad/s²].

        They are differences of mean velocities over the shorter of both segments' durations. The
        motion starts with a velocity, shape (n,), by default at rest, and ends at rest. For
        accelerations of the curve see `acceleration`.
        """
        durations = np.diff(self.times)
        rest = np.zeros(len(self.names))
        begin = rest if start_velocity is None else start_velocity
        velocity = np.vstack([begin, self.velocities(), rest])
        shorter = np.minimum(durations[1:], durations[:-1])
        spans = np.concatenate([durations[:1], shorter, durations[-1:]])
        return np.asarray(np.diff(velocity, axis=0) / spans[:, None])

    def base_path_length(self) -> float:
        """Return the path length of the base, Σ √(δx² + δy²) [m]."""
        return float(np.linalg.norm(np.diff(self._path[:, :2], axis=0), axis=1).sum())

    def base_path_length_l1(self) -> float:
        """Return Σ |δx| + |δy| [m], the metric of the method's authors."""
        return float(np.abs(np.diff(self._path[:, :2], axis=0)).sum())

    def arm_path_length(self) -> float:
        """Return the sum of the arm joints' absolute displacements, Σ |δq_arm| [rad]."""
        return float(np.abs(np.diff(self._path[:, 3 : self.robot_size], axis=0)).sum())

    @property
    def _path(self) -> Floats:
        """Positions at waypoints or knots, dense enough to measure path lengths, shape (K, n)."""
        return self.positions if self.curve is None else self.curve.positions

    def parts(self) -> list[Trajectory]:
        """Return the motion of each phase, with its original times."""
        found = list[Trajectory]()
        for phase in self.phases:
            rows = slice(phase.first, phase.last + 1)
            times = self.times[rows]
            alone = replace(phase, first=0, last=phase.last - phase.first)
            curve = None
            if self.curve is not None:
                curve = self.curve.part(times[0], times[-1])
            positions = self.positions[rows]
            found.append(
                replace(self, times=times, positions=positions, phases=(alone,), curve=curve)
            )
        return found

    def metrics(self) -> dict[str, float]:
        """Return duration [s] and path lengths of base [m] and arm [rad]."""
        return {
            "duration": float(self.times[-1] - self.times[0]),
            "base_path_length": self.base_path_length(),
            "base_path_length_l1": self.base_path_length_l1(),
            "arm_path_length": self.arm_path_length(),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the trajectory as plain data, e.g. for JSON."""
        data = {
            "names": list(self.names),
            "times": self.times.tolist(),
            "positions": self.positions.tolist(),
            "robot_size": self.robot_size,
            "phases": [phase.to_dict() for phase in self.phases],
        }
        if self.curve is not None:
            data["curve"] = self.curve.to_dict()
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Trajectory:
        """Return the trajectory described by data from `to_dict`.

        Raises:
            InputError: A field is missing or invalid.
        """
        if not isinstance(data, Mapping):
            raise InputError("not a trajectory", expected="an object", got=type(data).__name__)
        return parse_document(Document(dict(data)), TrajectorySchema).make_trajectory()

    def to_csv(self, path: str | Path, **options: Any) -> Path:
        """Write a CSV table of times, positions and phases; see `tables.write_csv`."""
        return tables.write_csv(self.to_dict(), path, **options)

    def to_json(self, path: str | Path) -> Path:
        """Write `to_dict` atomically as JSON; return the path."""
        return tables.write_json(self.to_dict(), path)

    def to_ros(self, **options: Any) -> dict[str, Any]:
        """Convert to plain data with the fields of ROS' `JointTrajectory`; see `ros.to_ros`."""
        return ros.to_ros(self.to_dict(), **options)

    def to_rosbag(self, path: str | Path, **options: Any) -> Path:
        """Write a ROS 2 bag into a new folder; see `rosbag.write_rosbag`. Needs the extra `ros`."""
        return rosbag.write_rosbag(self.to_dict(), path, **options)

    @classmethod
    def from_csv(cls, path: str | Path, **options: Any) -> Trajectory:
        """Read a trajectory from a table written by `to_csv`; see `tables.read_csv`.

        Raises:
            InputError: The file is missing, or something in it does not fit; the error names line
                and column.
        """
        return cls._read(tables.read_csv(path, **options), path)

    @classmethod
    def from_json(cls, path: str | Path) -> Trajectory:
        """Read a trajectory from a file written by `to_json`, `Plan.to_json` or `plan --json`.

        Raises:
            InputError: The file is missing, is no JSON, or something in it does not fit; the error
                names line or field.
        """
        data = tables.read_json(path)
        if isinstance(data, dict) and "trajectory" in data:
            return cls._read(data["trajectory"], path, "trajectory")
        return cls._read(data, path)

    @classmethod
    def from_ros(
        cls,
        message: Mapping[str, Any] | str | Path,
        *,
        like: Trajectory | None = None,
        robot_size: int | None = None,
    ) -> Trajectory:
        """Convert data from `to_ros`, or a file with them, to a trajectory; see `ros.from_ros`.

        Raises:
            InputError: A field is missing or invalid; the error names it.
        """
        motion = None
        if like is not None:
            motion = check_instance(like, Trajectory, "like").to_dict()
        data = ros.from_ros(message, like=motion, robot_size=robot_size)
        return cls._read(data, None if isinstance(message, Mapping) else message)

    @classmethod
    def _read(cls, data: Any, file: str | Path | None, inside: str = "") -> Trajectory:
        """Parse the content of a file's field `inside`; errors name the file."""
        try:
            return cls.from_dict(data)
        except InputError as error:
            field = ".".join(part for part in (inside, error.field) if part) or None
            raise InputError(
                error.problem, file=file, field=field, expected=error.expected, got=error.got
            ) from error


def _check_names(names: Any) -> tuple[str, ...]:
    """Return the names of coordinates. Raises `InputError` if they are not unique texts."""
    field = "Trajectory.names"
    listed: tuple[Any, ...] = check_list(names, field, "a list of names")
    found = tuple(check_text(name, f"{field}[{k}]", "a name") for k, name in enumerate(listed))
    counts = Counter(found)
    for name in found:
        if counts[name] > 1:
            raise InputError("a name occurs twice", field=field, got=name)
    return found


def _check_order(phases: Sequence[PhaseSpan], last: int) -> None:
    """Check that phases follow one another from waypoint 0 to waypoint `last`."""
    reached = 0
    is_ordered = True
    for phase in phases:
        is_ordered = is_ordered and phase.first == reached and phase.last > reached
        reached = phase.last
    if not is_ordered or reached != last:
        raise InputError(
            "phases do not follow one another from the first waypoint to the last",
            field="Trajectory.phases",
            expected=f"0 to {last}",
            got=", ".join(f"{phase.first} to {phase.last}" for phase in phases[:20]) or "none",
        )


class CurveSchema(Schema):
    """A curve in files; `Curve` checks its arrays."""

    times: Any
    positions: Any
    rates: Any


class TrajectorySchema(Schema):
    """A trajectory in files; `Trajectory` checks its arrays."""

    names: Annotated[list[Text], FailFast()]
    times: Any
    positions: Any
    robot_size: Count
    phases: Annotated[list[PhaseSchema], FailFast()]
    curve: CurveSchema | None = None

    def make_trajectory(self) -> Trajectory:
        """Return the trajectory. Raises `InputError` if its parts do not fit together."""
        phases = tuple(phase.make_phase() for phase in self.phases)
        curve = None
        if self.curve is not None:
            curve = Curve(self.curve.times, self.curve.positions, self.curve.rates)
        return Trajectory(
            tuple(self.names), self.times, self.positions, phases, self.robot_size, curve
        )
