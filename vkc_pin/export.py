"""Trajectories for other programs, and back: CSV, JSON, and the shape of ROS' trajectory_msgs/JointTrajectory.

Times are seconds, positions metres and radians; the base is three coordinates, x, y and yaw in the world frame.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vkc_pin.cubic import along, rates
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.trajectory import PhaseSpan, Trajectory
from vkc_pin.writing import write_atomically

if TYPE_CHECKING:
    from vkc_pin.scene import Scene

__all__ = ["GROUPS", "from_csv", "from_json", "from_ros", "to_csv", "to_json", "to_ros", "units_of"]

GROUPS = ("all", "robot", "base", "arm", "objects")
"""What can be asked for instead of names: everything, base and arm, the base, the arm, or what no motor of the robot moves."""
_TIME, _PHASES = "time", ("phase", "phase_name", "held")  # the first column of a table, and the last ones
_NANO = 1_000_000_000


def to_csv(
    trajectory: Trajectory, path: str | Path, *, joints: str | Sequence[str] = "all", units: Mapping[str, str] | None = None
) -> Path:
    """Write a table, a line a waypoint, whole or not at all; return the path.

    The first line names the columns, with units in brackets where they are known: `time [s]`, `base_x [m]`, `base_y [m]`,
    `base_yaw [rad]`, the arm's joints, the objects' joints, then `phase` (counted from 1), `phase_name` and `held`, as JSON. A
    waypoint between two phases is in the earlier one. Numbers have as many digits as it takes to read back the very same.

    Args:
        trajectory: The motion.
        path: The file.
        joints: One of `GROUPS`, or names of coordinates in the order wanted.
        units: Coordinate → unit, "m" or "rad"; those of the base need not be given.

    Raises:
        UnknownNameError: There is no such group or coordinate.
    """
    columns = _columns(trajectory, joints)
    x, y, yaw = trajectory.names[:3]
    known = {x: "m", y: "m", yaw: "rad", **({} if units is None else units)}
    buffer = io.StringIO()
    table = csv.writer(buffer, lineterminator="\n")
    names = [trajectory.names[k] for k in columns]
    table.writerow([f"{_TIME} [s]", *(f"{name} [{known[name]}]" if name in known else name for name in names), *_PHASES])
    number = 0
    for k, (moment, row) in enumerate(zip(trajectory.times.tolist(), trajectory.positions[:, columns].tolist(), strict=True)):
        number += k > trajectory.phases[number].last
        phase = trajectory.phases[number]
        held = {name: [at, phase.by[name]] if name in phase.by else at for name, at in phase.held.items()}
        table.writerow([repr(moment), *map(repr, row), number + 1, phase.name, json.dumps(held)])
    return write_atomically(path, buffer.getvalue().encode("utf-8"))


def from_csv(path: str | Path, *, robot_size: int | None = None) -> Trajectory:
    """Return the trajectory in a table: what `to_csv` wrote with all of the robot's coordinates in it, or one like it.

    Args:
        path: The file. Without the columns `phase`, `phase_name` and `held`, all of it is one phase in which nothing is held.
        robot_size: How many of the coordinates are the robot's; None: those before the first with a dot in its name.

    Raises:
        InputError: The file is missing, or something in it does not fit; the error names line and column.
    """
    path = Path(path)
    reader = csv.reader(io.StringIO(_text(path), newline=""))
    header = [re.sub(r" \[(s|m|rad)\]$", "", name) for name in next(reader, [])]
    if not header:
        raise InputError("an empty file", file=path, expected="a table with a line of names")
    if header[0] != _TIME:
        raise InputError("not a table of waypoints", file=path, line=1, field="first column", expected=_TIME, got=repr(header[0]))
    told = tuple(header[-3:]) == _PHASES
    names = header[1 : -3 if told else None]
    rows: list[list[float]] = []
    phases: list[PhaseSpan] = []
    for cells in reader:
        number = reader.line_num
        if not cells:
            continue
        if len(cells) != len(header):
            raise InputError("wrong number of columns", file=path, line=number, expected=len(header), got=len(cells))
        rows.append([_number(cell, path, number, name) for cell, name in zip(cells, [_TIME, *names], strict=False)])
        if told:
            _add_phase(phases, cells[-3:], len(rows) - 1, path, number)
    if not told and len(rows) > 1:
        phases = [PhaseSpan("motion", 0, len(rows) - 1)]
    if robot_size is None:
        robot_size = next((k for k, name in enumerate(names) if "." in name), len(names))
    table = np.array(rows, float).reshape(len(rows), 1 + len(names))
    return _made(path, names, table[:, 0], table[:, 1:], phases, robot_size)


def to_json(trajectory: Trajectory, path: str | Path) -> Path:
    """Write `Trajectory.to_dict` as JSON, whole or not at all; return the path."""
    return write_atomically(path, (json.dumps(trajectory.to_dict(), indent=1) + "\n").encode("utf-8"))


def from_json(path: str | Path) -> Trajectory:
    """Return the trajectory in a file that `to_json`, `Plan.to_json` or `vkc-pin plan --json` wrote.

    Raises:
        InputError: The file is missing, is no JSON, or something in it does not fit; the error names line or field.
    """
    path = Path(path)
    data = _json(path)
    inside = "trajectory." if isinstance(data, dict) and "trajectory" in data else ""
    data = data["trajectory"] if inside else data
    if not isinstance(data, dict):
        got = type(data).__name__
        raise InputError("not a trajectory", file=path, field=inside[:-1] or None, expected="an object", got=got)
    try:
        return Trajectory.from_dict(data)
    except InputError as error:
        where = f"{inside}{error.field}" if error.field else None
        raise InputError(error.problem, file=path, field=where, expected=error.expected, got=error.got) from error
    except (TypeError, ValueError, AttributeError, LookupError) as error:
        expected = "what Trajectory.to_dict returns"
        raise InputError("not a trajectory", file=path, field=inside[:-1] or None, expected=expected, got=str(error)) from error


def to_ros(
    trajectory: Trajectory,
    *,
    joints: str | Sequence[str] = "robot",
    rate: float | None = None,
    smooth: bool = True,
    derivatives: int = 2,
    frame: str = "world",
    stamp: float = 0.0,
) -> dict[str, Any]:
    """Return a motion as plain data with the fields of ROS' `trajectory_msgs/JointTrajectory`, e.g. for JSON.

    Velocities are those of monotone cubics through the waypoints: along these no coordinate leaves the range between two
    neighbouring waypoints, and what rests between two of them stays at rest. What was validated is the motion that is linear
    between waypoints; `from_ros` makes one of the points that can be validated as well.

    Args:
        trajectory: The motion.
        joints: One of `GROUPS`, or names of coordinates in the order wanted. The joints of objects are not in it unless asked
            for: no motor moves them.
        rate: Points a second, and one at the end [Hz]; None: the waypoints themselves.
        smooth: Whether points at a rate are on the cubics; otherwise they are on the straight lines between waypoints, where
            velocities jump.
        derivatives: 0: positions only; 1: velocities as well; 2: accelerations as well.
        frame: `header.frame_id`, the frame of the base's coordinates.
        stamp: `header.stamp` [s]; in ROS, zero means at once.

    Returns:
        `header`, `joint_names` and `points`, each with `positions` [m, rad], `velocities` [m/s, rad/s], `accelerations` [m/s²,
        rad/s²], `effort` (empty) and `time_from_start` in `sec` and `nanosec`.

    Raises:
        UnknownNameError: There is no such group or coordinate.
        InputError: `rate`, `derivatives` or `stamp` is out of range.
    """
    if derivatives not in (0, 1, 2):
        raise InputError("out of range", field="derivatives", expected="0, 1 or 2", got=repr(derivatives))
    if not (isinstance(stamp, int | float) and 0.0 <= stamp < 2.0**31):
        raise InputError("out of range", field="stamp", expected="seconds, at least 0", got=repr(stamp))
    columns = _columns(trajectory, joints)
    times, positions = trajectory.times - trajectory.times[0], trajectory.positions[:, columns]
    velocities, accelerations = rates(times, positions)
    if rate is not None:
        if not (isinstance(rate, int | float) and 0.0 < rate < math.inf):
            raise InputError("out of range", field="rate", expected="points a second, more than 0", got=repr(rate))
        moments = np.append(np.arange(math.ceil(times[-1] * rate - 1e-6)) / rate, times[-1])
        if smooth:
            positions, velocities, accelerations = along(times, positions, velocities, moments)
        else:
            positions = trajectory.at(trajectory.times[0] + moments)[:, columns]
            velocities, accelerations = rates(moments, positions)
        times = moments
    empty: list[list[float]] = [[] for _ in times]
    points = zip(
        times.tolist(),
        positions.tolist(),
        velocities.tolist() if derivatives > 0 else empty,
        accelerations.tolist() if derivatives > 1 else empty,
        strict=True,
    )
    return {
        "header": {"stamp": _duration(stamp), "frame_id": frame},
        "joint_names": [trajectory.names[k] for k in columns],
        "points": [
            {"positions": p, "velocities": v, "accelerations": a, "effort": [], "time_from_start": _duration(t)}
            for t, p, v, a in points
        ],
    }


def from_ros(
    message: Mapping[str, Any] | str | Path, *, like: Trajectory | None = None, robot_size: int | None = None
) -> Trajectory:
    """Return the trajectory of data with the fields of `trajectory_msgs/JointTrajectory`; times to 1 ns.

    Args:
        message: The data, or a JSON file with them. All of the robot's coordinates must be in them, the base's first.
        like: A motion whose phases and number of robot coordinates it takes; a phase ends at the point that is next in time to
            where it ended. None: all of it is one phase in which nothing is held.
        robot_size: How many of the coordinates are the robot's, if there is no `like`; None: those before the first with a dot.

    Raises:
        InputError: Something is missing or does not fit; the error names the field.
    """
    file = None if isinstance(message, Mapping) else Path(message)
    data = message if isinstance(message, Mapping) else _json(Path(message))
    names = _field(data, "joint_names", list, file, "")
    times: list[float] = []
    rows: list[list[float]] = []
    for k, point in enumerate(_field(data, "points", list, file, "")):
        where = f"points[{k}]."
        row = _field(point, "positions", list, file, where)
        if len(row) != len(names):
            raise InputError("wrong number of values", file=file, field=where + "positions", expected=len(names), got=len(row))
        for number, value in enumerate(row):
            if isinstance(value, bool) or not isinstance(value, int | float):
                field = f"{where}positions[{number}]"
                raise InputError("not a number", file=file, field=field, expected="a number", got=repr(value))
        since = _field(point, "time_from_start", dict, file, where)
        sec, nanosec = (_field(since, key, int, file, f"{where}time_from_start.") for key in ("sec", "nanosec"))
        rows.append(row)
        times.append(sec + nanosec / _NANO)
    if robot_size is None:
        robot_size = next((k for k, name in enumerate(names) if "." in str(name)), len(names))
    phases = [PhaseSpan("motion", 0, len(rows) - 1)] if len(rows) > 1 else []
    if like is not None:
        robot_size = like.robot_size
        edges = (like.times - like.times[0])[[0, *(phase.last for phase in like.phases)]]
        at = np.abs(np.asarray(times)[:, None] - edges).argmin(axis=0).tolist() if times else []
        ends = zip(like.phases, at, at[1:], strict=False)
        phases = [PhaseSpan(phase.name, first, last, phase.held, phase.by) for phase, first, last in ends]
    table = np.array(rows, float).reshape(len(rows), len(names))
    return _made(file, [str(name) for name in names], np.array(times), table, phases, robot_size)


def units_of(scene: Scene) -> dict[str, str]:
    """Return coordinate → "m" or "rad" of everything that can move in a scene: robot, objects, and the freedoms of grasps."""
    units: dict[str, str] = {}
    things = [("", scene.robot.coordinates)]
    things += [(f"{name}.", placed.object.coordinates) for name, placed in scene.objects.items()]
    for prefix, coordinates in things:
        units |= {prefix + name: unit for name, unit in zip(coordinates.names, coordinates.units, strict=True)}
    for owner, placed in scene.objects.items():
        for attachment in placed.object.attachments.values():
            for name, freedom in zip(attachment.coordinates, attachment.freedoms, strict=True):
                units[f"{owner}.{name}"] = freedom.unit
    return units


def _columns(trajectory: Trajectory, joints: str | Sequence[str]) -> list[int]:
    """Return which coordinates are meant."""
    robot, size = trajectory.robot_size, len(trajectory.names)
    groups = {"all": (0, size), "robot": (0, robot), "base": (0, 3), "arm": (3, robot), "objects": (robot, size)}
    if isinstance(joints, str):
        if joints not in groups:
            raise UnknownNameError("group of joints", joints, GROUPS, field="joints")
        return list(range(*groups[joints]))
    names = list(joints)
    for k, name in enumerate(names):
        if name not in trajectory.names:
            raise UnknownNameError("coordinate", str(name), trajectory.names, field=f"joints[{k}]")
        if name in names[:k]:
            raise InputError("a name occurs twice", field=f"joints[{k}]", got=name)
    return [trajectory.names.index(name) for name in names]


def _duration(seconds: float) -> dict[str, int]:
    sec, nanosec = divmod(round(seconds * _NANO), _NANO)
    return {"sec": sec, "nanosec": nanosec}


def _text(path: Path) -> str:
    if not path.is_file():
        raise InputError("no such file", file=path)
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("not text", file=path, expected="UTF-8", got=str(error)) from None


def _json(path: Path) -> Any:
    try:
        return json.loads(_text(path))
    except json.JSONDecodeError as error:
        raise InputError("not JSON", file=path, line=error.lineno, got=error.msg) from None


def _number(cell: str, path: Path, line: int, column: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError("not a number", file=path, line=line, field=column, expected="a finite number", got=repr(cell))
    return value


def _add_phase(phases: list[PhaseSpan], cells: Sequence[str], row: int, path: Path, line: int) -> None:
    """Take the last cells of a line: the phase's number, its name, and what is held in it."""
    number, name, held = cells
    expected = f"{len(phases)} or {len(phases) + 1}" if phases else "1"
    if number not in expected.split(" or "):
        raise InputError("not the next phase", file=path, line=line, field="phase", expected=expected, got=repr(number))
    if int(number) == len(phases):
        phases[-1] = PhaseSpan(phases[-1].name, phases[-1].first, row, phases[-1].held, phases[-1].by)
        return
    try:
        found = json.loads(held)
        at = {thing: where if isinstance(where, str) else where[0] for thing, where in found.items()}
        by = {thing: where[1] for thing, where in found.items() if not isinstance(where, str)}
    except (ValueError, AttributeError, TypeError, LookupError):
        wanted = 'JSON such as {"door": "handle"}'
        raise InputError("not what is held", file=path, line=line, field="held", expected=wanted, got=repr(held)) from None
    phases.append(PhaseSpan(name, max(row - 1, 0), row, at, by))


def _field(data: Any, key: str, kind: type, file: Path | None, where: str) -> Any:
    """Return a field of a message."""
    expected = {list: "a list", dict: "an object", int: "a whole number"}[kind]
    if not isinstance(data, Mapping) or key not in data:
        raise InputError("this is missing from a JointTrajectory", file=file, field=where + key, expected=expected)
    value = data[key]
    if not isinstance(value, Mapping if kind is dict else kind) or isinstance(value, bool):
        raise InputError("wrong kind of value", file=file, field=where + key, expected=expected, got=repr(value)[:60])
    return value


def _made(
    file: Path | None,
    names: Sequence[str],
    times: NDArray[np.float64],
    positions: NDArray[np.float64],
    phases: Sequence[PhaseSpan],
    robot_size: int,
) -> Trajectory:
    """Return the trajectory; what is wrong with it is the file's fault."""
    try:
        return Trajectory(tuple(names), times, positions, tuple(phases), robot_size)
    except InputError as error:
        raise InputError(error.problem, file=file, field=error.field, expected=error.expected, got=error.got) from error
