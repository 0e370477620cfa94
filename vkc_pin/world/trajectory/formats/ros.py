"""Converts motions to and from data with the fields of ROS' `trajectory_msgs/JointTrajectory`.

A motion is plain data as returned by `Trajectory.to_dict`. Times are in seconds, positions in
metres and radians. The base has three coordinates, x, y and yaw in the world frame.
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

__all__ = ["estimate_rates", "evaluate_cubics", "from_ros", "to_ros"]

_MAX_VALUES = 1_000_000  # positions in a message: some 300 MB
_NANO = 1_000_000_000
_MIN_GAP = 1e-4  # [s] between sampled times and the ends of rests, which replace closer samples


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
    """Return a motion as data with the fields of ROS' `trajectory_msgs/JointTrajectory`.

    Points of a motion with a curve lie on that curve, which was validated. Without a curve,
    velocities are those of monotone cubics, on which every coordinate stays between its values at
    neighbouring waypoints; `from_ros` converts the points to a motion that can be validated.

    Args:
        motion: Motion.
        joints: One of `GROUPS`, or names of coordinates in the wanted order.
        rate: Points per second [Hz]; the end of the motion and both ends of all rests are added.
            Default: the knots of the curve, or else the waypoints.
        smooth: Whether points at a rate lie on cubics if there is no curve. Otherwise they lie on
            straight lines, and velocities jump.
        derivatives: 0: positions only; 1: velocities, too; 2: accelerations, too. Default: 1 with a
            curve, since controllers then interpolate the same cubics, else 2.
        frame: `header.frame_id`, the frame of the base's coordinates.
        stamp: `header.stamp` [s]; ROS executes a trajectory of stamp 0 at once.

    Returns:
        `header`, `joint_names` and `points`, each with `positions` [m, rad], `velocities` [m/s,
        rad/s], `accelerations` [m/s², rad/s²], `effort` (empty) and `time_from_start` in `sec` and
        `nanosec`.

    Raises:
        UnknownNameError: There is no such group or coordinate.
        InputError: `joints` is empty or repeats a name; `rate`, `derivatives` or `stamp` is out of
            range.
    """
    smooth, frame = check_bool(smooth, "smooth"), check_text(frame, "frame")
    has_curve = motion.get("curve") is not None
    source = motion["curve"] if has_curve else motion
    if derivatives is None:
        derivatives = 1 if has_curve else 2
    derivatives = check_integer(derivatives, "derivatives", low=0, high=2)
    if (stamp := check_number(stamp, "stamp", "seconds, at least 0", low=0.0)) >= 2.0**31:
        raise InputError(
            "out of range", field="stamp", expected="seconds, less than 2^31", got=stamp
        )
    columns = select_columns(motion, joints)
    every = np.array(source["positions"], float)
    times, positions = np.array(source["times"], float), every[:, columns]
    times = times - times[0]
    moments = times
    if rate is not None:
        rate = check_number(rate, "rate", "points a second, more than 0", low=0.0, strict=True)
        most = _MAX_VALUES // max(len(columns), 1)  # a group may be empty
        if times[-1] * rate > most:
            expected = f"at most {most} points, {most / times[-1]:.4g} a second "
            expected += f"for this motion of {times[-1]:.4g} s"
            raise InputError("too many points", field="rate", expected=expected, got=rate)
        moments = _add_rests(sample_evenly(times, rate), times, every)
    if has_curve:
        # At the times of the message: its cubics would else exceed limits where knots are close.
        moments = np.minimum(np.round(moments * _NANO) / _NANO, times[-1])
        curve = Curve(times, positions, np.array(source["rates"], float)[:, columns])
        parts = [read(moments) for read in (curve.at, curve.velocity, curve.acceleration)]
    elif smooth and rate is not None:
        velocities, _ = estimate_rates(times, positions)
        parts = [*evaluate_cubics(times, positions, velocities, moments)]
    else:
        rows = [np.interp(moments, times, column) for column in positions.T]
        positions = np.reshape(rows, (len(columns), len(moments))).T
        parts = [positions, *estimate_rates(moments, positions)]
    for k in range(derivatives + 1, 3):
        parts[k] = parts[k][:, :0]
    points = zip(moments.tolist(), *(part.tolist() for part in parts), strict=True)
    return {
        "header": {"stamp": _make_duration(stamp), "frame_id": frame},
        "joint_names": [motion["names"][k] for k in columns],
        "points": [
            {
                "positions": p,
                "velocities": v,
                "accelerations": a,
                "effort": [],
                "time_from_start": _make_duration(t),
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
    """Return the motion in data with the fields of `trajectory_msgs/JointTrajectory`.

    Args:
        message: Data, or a JSON file with them, with all of the robot's coordinates, base first.
        like: Motion with the phases, the waypoints and the number of robot coordinates. Its
            waypoints are the points that are nearest in time; others are knots of the curve only,
            if there are velocities. Default: one phase without holds, every point a waypoint.
        robot_size: Number of robot coordinates without `like`. Default: those before the first
            with a dot in its name.
    """
    file = None
    if not isinstance(message, Mapping):
        file = check_path(message, "message", "a JointTrajectory as data, or a JSON file")
    data = message if file is None else read_json(file)
    names = _get_field(data, "joint_names", list, file, "")
    times: list[float] = []
    rows: list[list[float]] = []
    rates: list[list[float]] = []
    for k, point in enumerate(_get_field(data, "points", list, file, "")):
        where = f"points[{k}]."
        row = _get_field(point, "positions", list, file, where)
        rows.append(_check_row(row, len(names), file, f"{where}positions"))
        since, inside = _get_field(point, "time_from_start", dict, file, where), "time_from_start."
        seconds = {
            key: check_number(
                _get_field(since, key, int, file, where + inside), f"{where}{inside}{key}"
            )
            for key in ("sec", "nanosec")
        }
        times.append(seconds["sec"] + seconds["nanosec"] / _NANO)
        rate = point.get("velocities", ())
        if isinstance(rate, list) and rate and not point.get("accelerations"):
            rates.append(_check_row(rate, len(names), file, f"{where}velocities"))
    size = None if robot_size is None else check_integer(robot_size, "robot_size", low=3)
    if like is not None:
        size = like["robot_size"]
    elif size is None:
        size = infer_robot_size(names, file=file, field="joint_names")
    has_curve = bool(rates) and len(rates) == len(rows)
    waypoints = list(range(len(rows)))
    phases = [make_single_phase(len(rows))] if len(rows) > 1 else []
    if like is not None:
        moments = np.array(like["times"], float)
        between = (np.array(times[1:]) + np.array(times[:-1])) / 2.0
        at = np.searchsorted(between, moments - moments[0])  # the points that are nearest in time
        if has_curve:
            waypoints = np.union1d(at, [0, len(rows) - 1]).tolist()
            at = np.searchsorted(waypoints, at)
        edges = at[[0, *(phase["last"] for phase in like["phases"])]].tolist()
        ends = zip(like["phases"], edges, edges[1:], strict=False)
        phases = [{**phase, "first": first, "last": last} for phase, first, last in ends]
    motion = {
        "names": names,
        "times": [times[k] for k in waypoints],
        "positions": [rows[k] for k in waypoints],
        "robot_size": size,
        "phases": phases,
    }
    if has_curve:
        motion["curve"] = {"times": times, "positions": rows, "rates": rates}
    return motion


def _check_row(values: list[Any], size: int, file: Path | None, field: str) -> list[float]:
    if len(values) != size:
        raise InputError(
            "wrong number of values", file=file, field=field, expected=size, got=len(values)
        )
    for k, value in enumerate(values):
        if not is_number(value):
            got = format_value(value)
            raise InputError(
                "not a number", file=file, field=f"{field}[{k}]", expected="a number", got=got
            )
    return values


def _add_rests(moments: Floats, times: Floats, positions: Floats) -> Floats:
    """Add the times at which all positions, (T, n), begin and end to rest."""
    still = ~np.diff(positions, axis=0).any(axis=1)
    rests = times[np.append(still, False) | np.append(False, still)]
    after = np.searchsorted(rests, moments - _MIN_GAP)  # the first that is not well before each
    apart = np.append(rests, np.inf)[after] > moments + _MIN_GAP
    return np.sort(np.concatenate([moments[apart], rests]))


def estimate_rates(times: Floats, positions: Floats) -> tuple[Floats, Floats]:
    """Return velocities and accelerations at waypoints, shape (T, n) each, at rest at both ends.

    Velocities are those of SciPy's monotone cubics; next to a rest, accelerations are zero.
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


def evaluate_cubics(
    times: Floats, positions: Floats, velocities: Floats, moments: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return positions, velocities and accelerations at `moments` on cubics through waypoints."""
    from scipy.interpolate import CubicHermiteSpline

    cubics = CubicHermiteSpline(times, positions, velocities)
    at = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    ends = np.stack([positions[at], positions[at + 1]])
    place = np.clip(cubics(moments), ends.min(axis=0), ends.max(axis=0))  # against rounding
    place[moments >= times[-1]] = positions[-1]
    return place, cubics(moments, 1), cubics(moments, 2)


def _make_duration(seconds: float) -> dict[str, int]:
    sec, nanosec = divmod(round(seconds * _NANO), _NANO)
    return {"sec": sec, "nanosec": nanosec}


def _get_field(data: Any, key: str, kind: type, file: Path | None, where: str) -> Any:
    expected = {list: "a list", dict: "an object", int: "a whole number"}[kind]
    if not isinstance(data, Mapping) or key not in data:
        problem = "this is missing from a JointTrajectory"
        raise InputError(problem, file=file, field=where + key, expected=expected)
    value = data[key]
    if not isinstance(value, Mapping if kind is dict else kind) or isinstance(value, bool):
        got, problem = format_value(value), "wrong type of value"
        raise InputError(problem, file=file, field=where + key, expected=expected, got=got)
    return value
