"""Trajectory: waypoints of robot and objects over time, linear in the coordinates between them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.arguments import instance, items, known, mapping, number, numbers, text, whole
from vkc_pin.arrays import Floats
from vkc_pin.errors import InputError
from vkc_pin.motion import ros, tables
from vkc_pin.scene.hold import Hold, holds_of, in_order

__all__ = ["PhaseSpan", "Trajectory"]


@dataclass(frozen=True)
class PhaseSpan:
    """A stretch of a trajectory in which the same things are held.

    Attributes:
        name: What happens in it, e.g. "reach door.handle".
        first, last: Its waypoints; `last` is the next phase's `first`.
        holds: All that is held in it, each hold after the one it depends on.
        opening: How far the gripper is open in it [m]; None: as the robot rests. If it was otherwise in the phase before, the
            fingers move from the first waypoint to the second.

    Raises:
        InputError: Something is held through what is not, or an opening is none.
    """

    name: str
    first: int
    last: int
    holds: tuple[Hold, ...] = ()
    opening: float | None = None

    def __post_init__(self) -> None:
        text(self.name, "PhaseSpan.name")
        for name in ("first", "last"):
            object.__setattr__(self, name, whole(getattr(self, name), f"PhaseSpan.{name}", low=0))
        object.__setattr__(self, "holds", in_order(self.holds))
        if self.opening is not None:
            object.__setattr__(self, "opening", number(self.opening, "PhaseSpan.opening", "a distance [m]", low=0.0, high=1.0))

    @property
    def held(self) -> dict[str, str]:
        """Object → attachment, for all that is held in it."""
        return {hold.object: hold.attachment for hold in self.holds}

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it; `by` names the link, "<object>.<link>", for what is held through another object."""
        by = {hold.object: hold.frame for hold in self.holds if hold.by}
        data = {"name": self.name, "first": self.first, "last": self.last, "held": self.held, "by": by}
        return data if self.opening is None else {**data, "opening": self.opening}


@dataclass(frozen=True)
class Trajectory:
    """Waypoints over time.

    Attributes:
        names: The coordinates' names, n of them: base x, y, yaw, arm joints, then `<object>.<joint>`.
        times: Of the waypoints, shape (T,), increasing [s].
        positions: Shape (T, n), [m] and [rad]; angles are not wrapped, so that they interpolate.
        phases: Which stretch of it does what; each begins where the one before ends, and together they cover it all.
        robot_size: How many of the coordinates are the robot's (3 for the base, then the arm).

    Raises:
        InputError: Names that occur twice, numbers that are not finite, shapes that do not fit, times that do not increase,
            or phases that leave a gap.
    """

    names: tuple[str, ...]
    times: Floats
    positions: Floats
    phases: tuple[PhaseSpan, ...]
    robot_size: int

    def __post_init__(self) -> None:
        listed: tuple[Any, ...] = items(self.names, "Trajectory.names", "a list of names")
        names = tuple(text(name, f"Trajectory.names[{k}]", "a name") for k, name in enumerate(listed))
        phases = items(self.phases, "Trajectory.phases", "a list of PhaseSpan", PhaseSpan)
        times, positions = _numbers(self.times, "times"), _numbers(self.positions, "positions")
        counts = Counter(names)
        if (twice := next((name for name in names if counts[name] > 1), None)) is not None:
            raise InputError("a name occurs twice", field="Trajectory.names", got=twice)
        if times.ndim != 1 or len(times) < 2 or not np.all(np.diff(times) > 0):
            raise InputError("times do not increase", field="Trajectory.times", expected="at least 2 increasing numbers")
        shape = (len(times), len(names))
        if positions.shape != shape:
            raise InputError("wrong shape", field="Trajectory.positions", expected=shape, got=positions.shape)
        size = whole(self.robot_size, "Trajectory.robot_size", low=3, high=len(names))
        edges = [0, *(phase.last for phase in phases)]
        if edges[-1] != len(times) - 1 or any(
            phase.first != before or phase.last <= before for phase, before in zip(phases, edges, strict=False)
        ):
            problem = "phases do not follow one another from the first waypoint to the last"
            got = ", ".join(f"{phase.first} to {phase.last}" for phase in phases[:20]) or "none"
            raise InputError(problem, field="Trajectory.phases", expected=f"0 to {len(times) - 1}", got=got)
        for array in (times, positions):
            array.setflags(write=False)
        for key, value in (
            ("names", names),
            ("times", times),
            ("positions", positions),
            ("phases", phases),
            ("robot_size", size),
        ):
            object.__setattr__(self, key, value)

    def at(self, time: ArrayLike) -> Floats:
        """Return the positions, shape (..., n), at `time` [s], shape (...,); outside the motion, its first or last.

        Raises:
            InputError: `time` is none.
        """
        time = numbers(time, "time")
        columns = [np.interp(time, self.times, column) for column in self.positions.T]
        return np.stack(columns, axis=-1)

    def column(self, name: str) -> Floats:
        """Return one coordinate over the waypoints, shape (T,).

        Raises:
            UnknownNameError: There is no such coordinate.
        """
        return np.array(self.positions[:, self.names.index(known(name, self.names, "coordinate"))])

    def velocities(self) -> Floats:
        """Return the velocity of every segment, shape (T − 1, n), [m/s] and [rad/s]."""
        return np.asarray(np.diff(self.positions, axis=0) / np.diff(self.times)[:, None])

    def accelerations(self) -> Floats:
        """Return the acceleration at every waypoint, shape (T, n), [m/s²] and [rad/s²].

        It is the velocity step there over the shorter of the two segments' durations; the motion starts and ends at rest.
        """
        durations = np.diff(self.times)
        velocity = np.vstack([np.zeros(len(self.names)), self.velocities(), np.zeros(len(self.names))])
        spans = np.concatenate([durations[:1], np.minimum(durations[1:], durations[:-1]), durations[-1:]])
        return np.asarray(np.diff(velocity, axis=0) / spans[:, None])

    def base_effort(self) -> float:
        """Return the distance the base travels over the floor, Σ √(δx² + δy²) [m]."""
        return float(np.linalg.norm(np.diff(self.positions[:, :2], axis=0), axis=1).sum())

    def base_effort_l1(self) -> float:
        """Return Σ |δx| + |δy| [m], which the method's authors log."""
        return float(np.abs(np.diff(self.positions[:, :2], axis=0)).sum())

    def arm_effort(self) -> float:
        """Return the sum of the arm joints' absolute displacements, Σ |δq_arm| [rad]."""
        return float(np.abs(np.diff(self.positions[:, 3 : self.robot_size], axis=0)).sum())

    def parts(self) -> list[Trajectory]:
        """Return the motion of each phase, with its own times."""
        spans = [slice(phase.first, phase.last + 1) for phase in self.phases]
        alone = [replace(phase, first=0, last=phase.last - phase.first) for phase in self.phases]
        own = [(self.times[span], self.positions[span], (phase,)) for span, phase in zip(spans, alone, strict=True)]
        return [replace(self, times=times, positions=positions, phases=phases) for times, positions, phases in own]

    def metrics(self) -> dict[str, float]:
        """Return duration [s], base_effort and base_effort_l1 [m], and arm_effort [rad]."""
        return {
            "duration": float(self.times[-1] - self.times[0]),
            "base_effort": self.base_effort(),
            "base_effort_l1": self.base_effort_l1(),
            "arm_effort": self.arm_effort(),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it, e.g. for JSON."""
        return {
            "names": list(self.names),
            "times": self.times.tolist(),
            "positions": self.positions.tolist(),
            "robot_size": self.robot_size,
            "phases": [phase.to_dict() for phase in self.phases],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Trajectory:
        """Return the trajectory that `to_dict` made `data` of.

        Raises:
            InputError: Something is missing from it or does not fit.
        """
        phases = []
        if not isinstance(data, Mapping):
            raise InputError("not a trajectory", expected="an object", got=type(data).__name__)
        listed: tuple[Any, ...] = items(_part(data, "phases"), "phases", "a list of phases")
        for k, item in enumerate(listed):
            phase = mapping(item, f"phases[{k}]")
            held = holds_of(_part(phase, "held"), phase.get("by"))
            name, first, last = (_part(phase, key) for key in ("name", "first", "last"))
            phases.append(PhaseSpan(name, first, last, held, phase.get("opening")))
        names, times, positions, size = (_part(data, key) for key in ("names", "times", "positions", "robot_size"))
        return cls(names, times, positions, tuple(phases), size)

    def to_csv(self, path: str | Path, **options: Any) -> Path:
        """Write a table with a line a waypoint: times [s], positions [m] and [rad], phases; see `tables.write_csv`."""
        return tables.write_csv(self.to_dict(), path, **options)

    def to_json(self, path: str | Path) -> Path:
        """Write `to_dict` as JSON, whole or not at all; return the path."""
        return tables.write_json(self.to_dict(), path)

    def to_ros(self, **options: Any) -> dict[str, Any]:
        """Return plain data with the fields of ROS' `trajectory_msgs/JointTrajectory`; see `ros.to_ros`."""
        return ros.to_ros(self.to_dict(), **options)

    @classmethod
    def from_csv(cls, path: str | Path, **options: Any) -> Trajectory:
        """Return the trajectory in a table such as `to_csv` writes; see `tables.read_csv`.

        Raises:
            InputError: The file is missing, or something in it does not fit; the error names line and column.
        """
        return cls._read(tables.read_csv(path, **options), path)

    @classmethod
    def from_json(cls, path: str | Path) -> Trajectory:
        """Return the trajectory in a file that `to_json`, `Plan.to_json` or `vkc-pin plan --json` wrote.

        Raises:
            InputError: The file is missing, is no JSON, or something in it does not fit; the error names line or field.
        """
        data = tables.read_json(path)
        if isinstance(data, dict) and "trajectory" in data:
            return cls._read(data["trajectory"], path, "trajectory")
        return cls._read(data, path)

    @classmethod
    def from_ros(
        cls, message: Mapping[str, Any] | str | Path, *, like: Trajectory | None = None, robot_size: int | None = None
    ) -> Trajectory:
        """Return the trajectory of data such as `to_ros` returns, or of a JSON file with them; see `ros.from_ros`.

        Raises:
            InputError: Something is missing or does not fit; the error names the field.
        """
        motion = None if like is None else instance(like, Trajectory, "like").to_dict()
        data = ros.from_ros(message, like=motion, robot_size=robot_size)
        return cls._read(data, None if isinstance(message, Mapping) else message)

    @classmethod
    def _read(cls, data: Any, file: str | Path | None, inside: str = "") -> Trajectory:
        """Return the trajectory that a file holds, in its field `inside`; what is wrong with it is the file's fault."""
        try:
            return cls.from_dict(data)
        except InputError as error:
            field = ".".join(part for part in (inside, error.field) if part) or None
            raise InputError(error.problem, file=file, field=field, expected=error.expected, got=error.got) from error


def _part(data: Mapping[str, Any], name: str) -> Any:
    """Return an entry of data. Raises `InputError` if it is not there."""
    if name not in data:
        raise InputError("this is missing from a trajectory", field=name)
    return data[name]


def _numbers(values: Any, name: str) -> Floats:
    """Return a copy of an array of finite numbers."""
    array = numbers(values, f"Trajectory.{name}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise InputError("not finite", field=f"Trajectory.{name}{where}", expected="finite numbers", got=array[tuple(where)])
    return array
