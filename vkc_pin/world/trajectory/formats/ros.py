"""Converts motions to and from plain data with the fields of ROS' trajectory_msgs/JointTrajectory.

A motion is plain data as returned by `Trajectory.to_dict`. Times are in seconds, positions in metres
and radians. The base has three coordinates, x, y and yaw in the world frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arguments import check_bool, check_integer, check_number, check_text, is_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.trajectory.curve import Curve, sample_evenly
from vkc_pin.world.trajectory.formats.tables import (
    infer_robot_size,
    make_single_phase,
    read_json,
    select_columns,
)

__all__ = ["along", "from_ros", "rates", "to_ros"]

_MOST = 1_000_000  # positions in a message: some 300 MB
_NANO = 1_000_000_000
# [s] between points at a rate and one where all comes to rest, up to which the latter alone is
# there
_NEXT = 1e-4


def to_ros(
    motion: Mapping[str, Any],
    *,
    joints: str | Sequence[str] = "robot",
    rate: float | None = None,
    smooth: bool = True,
    derivatives: int | None = None,
    frame: str = "world",
    stamp: float = 0.0,
) -> dict[str, Any]:
    """Return a motion as plain data with the fields of ROS' `trajectory_msgs/JointTrajectory`, e.g. for JSON.

    Of a motion with a curve, points lie on it, with its velocities: what was validated. Of one
    without, velocities are those of monotone cubics through the waypoints: along these no
    coordinate leaves the range between two neighbouring waypoints, and what rests between two of
    them stays at rest; `from_ros` makes a motion of the points that can be validated.

    Args:
        motion: What to convert.
        joints: One of `GROUPS`, or names of coordinates in the order wanted. The joints of objects
            are not in it unless asked for: no motor moves them.
        rate: Points a second [Hz], and one at the end and wherever all comes to rest or leaves it,
            so that rests last as long as they did; None: the knots of the curve, or else the
            waypoints.
        smooth: Of a motion without a curve: whether points at a rate are on cubics through its
            waypoints; otherwise they are on the straight lines between these, where velocities
            jump.
        derivatives: 0: positions only; 1: velocities as well; 2: accelerations as well. None: 1 if
            there is a curve, since controllers that are given no more go along the very cubics of
            it, and otherwise 2.
        frame: `header.frame_id`, the frame of the base's coordinates.
        stamp: `header.stamp` [s]; in ROS, zero means at once.

    Returns:
        `header`, `joint_names` and `points`, each with `positions` [m, rad], `velocities` [m/s,
        rad/s], `accelerations` [m/s², rad/s²], `effort` (empty) and `time_from_start` in `sec` and
        `nanosec`.

    Raises:
        UnknownNameError: There is no such group or coordinate.
        InputError: `joints` names none, or one twice; `rate`, `derivatives` or `stamp` is out of
            range.
    """
    curve, smooth, frame = (
        motion.get("curve"),
        check_bool(smooth, "smooth"),
        check_text(frame, "frame"),
    )
    derivatives = (
        (2 if curve is None else 1)
        if derivatives is None
        else check_integer(derivatives, "derivatives", low=0, high=2)
    )
    if (stamp := check_number(stamp, "stamp", "seconds, at least 0", low=0.0)) >= 2.0**31:
        raise InputError(
            "out of range", field="stamp", expected="seconds, less than 2^31", got=stamp
        )
    columns = select_columns(motion, joints)
    source = motion if curve is None else curve
    times, positions = (
        np.array(source["times"], float),
        np.array(source["positions"], float)[:, columns],
    )
    times = times - times[0]
    cubics = (
        None
        if curve is None
        else Curve(times, positions, np.array(curve["rates"], float)[:, columns])
    )
    if rate is not None:
        rate = check_number(rate, "rate", "points a second, more than 0", low=0.0, strict=True)
        most = _MOST // max(len(columns), 1)  # a group may be empty
        if times[-1] * rate > most:
            expected = f"at most {most} points, {most / times[-1]:.4g} a second for this motion of {times[-1]:.4g} s"
            raise InputError("too many points", field="rate", expected=expected, got=rate)
    moments = (
        times
        if rate is None
        else _with_rests(sample_evenly(times, rate), times, np.array(source["positions"], float))
    )
    if cubics is not None:
        positions, velocities, accelerations = (
            read(moments) for read in (cubics.at, cubics.velocity, cubics.acceleration)
        )
    elif smooth and rate is not None:
        positions, velocities, accelerations = along(
            times, positions, rates(times, positions)[0], moments
        )
    else:
        rows = [np.interp(moments, times, column) for column in positions.T]
        positions = np.reshape(rows, (len(columns), len(moments))).T
        velocities, accelerations = rates(moments, positions)
    parts = [
        positions,
        *(
            rows[:, : len(columns) * (derivatives > k)]
            for k, rows in enumerate((velocities, accelerations))
        ),
    ]
    points = zip(moments.tolist(), *(part.tolist() for part in parts), strict=True)
    return {
        "header": {"stamp": _duration(stamp), "frame_id": frame},
        "joint_names": [motion["names"][k] for k in columns],
        "points": [
            {
                "positions": p,
                "velocities": v,
                "accelerations": a,
                "effort": [],
                "time_from_start": _duration(t),
            }
            for t, p, v, a in points
        ],
    }


def from_ros(
    message: Mapping[str, Any] | str | Path,
    *,
    like: Mapping[str, Any] | None = None,
    robot_size: int | None = None,
) -> dict[str, Any]:
    """Return the motion in data with the fields of `trajectory_msgs/JointTrajectory`; times to 1 ns.

    Args:
        message: The data, or a JSON file with them. All of the robot's coordinates must be in them,
            the base's first.
        like: A motion whose phases and number of robot coordinates it takes; a phase ends at the
            point that is next in time to where it ended. None: all of it is one phase in which
            nothing is held.
        robot_size: How many of the coordinates are the robot's, if there is no `like`; None: those
            before the first with a dot.

    Raises:
        InputError: Something is missing or does not fit; the error names the field.
    """
    file = (
        None
        if isinstance(message, Mapping)
        else check_path(message, "message", "a JointTrajectory as data, or a JSON file")
    )
    data = read_json(file) if file is not None else message
    names = _field(data, "joint_names", list, file, "")
    times: list[float] = []
    rows: list[list[float]] = []
    slopes: list[list[float]] = []
    for k, point in enumerate(_field(data, "points", list, file, "")):
        where = f"points[{k}]."
        row = _field(point, "positions", list, file, where)
        if len(row) != len(names):
            raise InputError(
                "wrong number of values",
                file=file,
                field=where + "positions",
                expected=len(names),
                got=len(row),
            )
        for place, value in enumerate(row):
            if not is_number(value):
                field = f"{where}positions[{place}]"
                raise InputError(
                    "not a number",
                    file=file,
                    field=field,
                    expected="a number",
                    got=format_value(value),
                )
        since = _field(point, "time_from_start", dict, file, where)
        sec, nanosec = (
            _field(since, key, int, file, f"{where}time_from_start.") for key in ("sec", "nanosec")
        )
        rows.append(row)
        slopes.append(_rates(point, len(names), file, where))
        times.append(
            check_number(sec, f"{where}time_from_start.sec")
            + check_number(nanosec, f"{where}time_from_start.nanosec") / _NANO
        )
    size = (
        infer_robot_size(names)
        if robot_size is None
        else check_integer(robot_size, "robot_size", low=3)
    )
    phases = [make_single_phase(len(rows))] if len(rows) > 1 else []
    if like is not None:
        size, began = like["robot_size"], np.array(like["times"], float)
        edges = (began - began[0])[[0, *(phase["last"] for phase in like["phases"])]]
        at = np.abs(np.asarray(times)[:, None] - edges).argmin(axis=0).tolist() if times else []
        ends = zip(like["phases"], at, at[1:], strict=False)
        phases = [{**phase, "first": first, "last": last} for phase, first, last in ends]
    cubic = (
        {"curve": {"times": times, "positions": rows, "rates": slopes}}
        if slopes and all(slopes)
        else {}
    )
    return {
        "names": names,
        "times": times,
        "positions": rows,
        "robot_size": size,
        "phases": phases,
        **cubic,
    }


def _rates(point: Any, size: int, file: Path | None, where: str) -> list[float]:
    """Return a point's velocities if it defines cubics, that is, has no accelerations; else []."""
    values = point.get("velocities", ())
    if not isinstance(values, list) or not len(values) or point.get("accelerations"):
        return []
    if len(values) != size:
        raise InputError(
            "wrong number of values",
            file=file,
            field=where + "velocities",
            expected=size,
            got=len(values),
        )
    for place, value in enumerate(values):
        if not is_number(value):
            field = f"{where}velocities[{place}]"
            raise InputError(
                "not a number", file=file, field=field, expected="a number", got=format_value(value)
            )
    return values


def _with_rests(moments: Floats, times: Floats, positions: Floats) -> Floats:
    """Add the times at which positions, (T, n), begin and end to rest; they replace close moments."""
    still = ~np.diff(positions, axis=0).any(axis=1)
    rests = times[np.append(still, False) | np.append(False, still)]
    after = np.searchsorted(rests, moments - _NEXT)  # the first that is not well before each
    return np.sort(
        np.concatenate([moments[np.append(rests, np.inf)[after] > moments + _NEXT], rests])
    )


def rates(times: Floats, positions: Floats) -> tuple[Floats, Floats]:
    """Estimate velocities and accelerations at waypoints, shape (T, n) each, with rests at the ends.

    Velocities are those of SciPy's monotone cubics, except at the ends. They are zero where a
    coordinate reverses. Next to a rest the acceleration is zero as well.
    """
    from scipy.interpolate import PchipInterpolator

    steps = np.diff(times)[:, None]
    slopes = np.diff(positions, axis=0) / steps
    velocities, accelerations = np.zeros_like(positions), np.zeros_like(positions)
    with np.errstate(over="ignore"):  # the reciprocal of a slope next to nothing
        velocities[1:-1] = PchipInterpolator(times, positions)(times[1:-1], 1)
    before, after = slopes[:-1], slopes[1:]
    moves = (before != 0.0) & (after != 0.0)
    accelerations[1:-1] = np.where(moves, 2.0 * (after - before) / (steps[1:] + steps[:-1]), 0.0)
    return velocities, accelerations


def along(
    times: Floats, positions: Floats, velocities: Floats, moments: Floats
) -> tuple[Floats, Floats, Floats]:
    """Evaluate positions, velocities and accelerations at `moments` on cubics through waypoints."""
    from scipy.interpolate import CubicHermiteSpline

    cubics = CubicHermiteSpline(times, positions, velocities)
    at = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    low, high = (
        np.minimum(positions[at], positions[at + 1]),
        np.maximum(positions[at], positions[at + 1]),
    )
    place = np.clip(cubics(moments), low, high)  # against rounding
    place[moments >= times[-1]] = positions[-1]
    return place, cubics(moments, 1), cubics(moments, 2)


def _duration(seconds: float) -> dict[str, int]:
    sec, nanosec = divmod(round(seconds * _NANO), _NANO)
    return {"sec": sec, "nanosec": nanosec}


def _field(data: Any, key: str, kind: type, file: Path | None, where: str) -> Any:
    expected = {list: "a list", dict: "an object", int: "a whole number"}[kind]
    if not isinstance(data, Mapping) or key not in data:
        raise InputError(
            "this is missing from a JointTrajectory",
            file=file,
            field=where + key,
            expected=expected,
        )
    value = data[key]
    if not isinstance(value, Mapping if kind is dict else kind) or isinstance(value, bool):
        raise InputError(
            "wrong type of value",
            file=file,
            field=where + key,
            expected=expected,
            got=format_value(value),
        )
    return value
