"""Converts motions to and from data with the fields of ROS' `trajectory_msgs/JointTrajectory`.

A motion is plain data as returned by `Trajectory.to_dict`. Times are in seconds, positions in
metres and radians. The base has three coordinates, x, y and yaw in the world frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arguments import check_bool, check_integer, check_number, check_text, is_number
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.trajectory.curve import (
    MIN_INTERVAL,
    Curve,
    divide_intervals,
    sample_evenly,
)
from vkc_pin.world.trajectory.formats.interpolation import interpolate_points
from vkc_pin.world.trajectory.formats.tables import (
    infer_robot_size,
    make_single_phase,
    read_json,
    select_columns,
)

_MAX_VALUES = 1_000_000  # positions in a message: some 300 MB
_NANO = 1_000_000_000
_MOST_TIME = 2**32  # [s] and [ns]: ROS has 32 bits for each
MOST_SECONDS = 2**31
"""Times of messages are less [s]: their seconds are signed integers of 32 bits."""
_ROWS = ("positions", "velocities", "accelerations")  # of a point
_LARGEST = 1e12  # [m], [rad] and their derivatives


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

    Controllers interpolate positions by lines, and cubics with velocities, which are the motion
    itself. A motion without a curve gets velocities of monotone cubics, on which every coordinate
    stays between its values at neighbouring waypoints.

    With accelerations, controllers interpolate quintics. Where the curve's accelerations jump by
    up to J, quintics of duration h are up to 0.04·J·h² away from it, and exceed its accelerations
    by up to J/2: use them for motions with limits on jerk, which have no such jumps.

    Args:
        motion: Motion.
        joints: One of `GROUPS`, or names of coordinates in the wanted order.
        rate: Smallest number of points per second [Hz]: the time between two knots of the curve, or
            two waypoints, is divided evenly. Default: the knots of the curve, or else the
            waypoints.
        smooth: Whether points lie on cubics if there is no curve. Otherwise they lie on straight
            lines, and velocities jump.
        derivatives: 0: positions only; 1: velocities, too; 2: accelerations, too. Default: 1, or 0
            on straight lines.
        frame: `header.frame_id`, the frame of the base's coordinates.
        stamp: `header.stamp` [s]; ROS executes a trajectory of stamp 0 at once.

    Returns:
        `header`, `joint_names` and `points`, each with `positions` [m, rad], `velocities` [m/s,
        rad/s], `accelerations` [m/s², rad/s²], `effort` (empty) and `time_from_start` in `sec` and
        `nanosec`.

    Raises:
        UnknownNameError: There is no such group or coordinate.
        InputError: `joints` is empty or repeats a name; `rate`, `derivatives` or `stamp` is out of
            range, or the motion is too long for a message.
    """
    smooth = check_bool(smooth, "smooth")
    frame = check_text(frame, "frame")
    is_smooth = smooth or motion.get("curve") is not None
    if derivatives is None:
        derivatives = 1 if is_smooth else 0
    derivatives = check_integer(derivatives, "derivatives", low=0, high=2)
    stamp = check_number(stamp, "stamp", "seconds, at least 0", low=0.0)
    columns = select_columns(motion, joints)
    knots = _get_knots(motion)[0]
    _check_times(stamp, float(knots[-1]))
    moments = knots
    if rate is not None:
        rate = _check_rate(rate, knots, len(columns))
        counts = np.maximum(np.ceil(np.diff(knots) * rate - 1e-6), 1.0)
        moments = divide_intervals(knots, counts.astype(int))
    if is_smooth:
        curve = _make_curve(motion, columns)
    else:
        lines = [np.interp(moments, knots, column) for column in _get_knots(motion)[1].T]
        positions = np.reshape(lines, (-1, len(moments))).T[:, columns]
        curve = Curve(moments, positions, _estimate_velocities(moments, positions))
    # At the times of the message: its cubics would else exceed limits where knots are close.
    stated = _round_times(moments)
    accelerations = curve.acceleration(stated)
    at_knots = np.searchsorted(moments, curve.times)
    accelerations[at_knots] = _choose_accelerations(curve, _find_rests(motion, curve.times))
    parts = [curve.at(stated), curve.velocity(stated), accelerations]
    for k in range(derivatives + 1, 3):
        parts[k] = parts[k][:, :0]
    points = zip(stated.tolist(), *(part.tolist() for part in parts), strict=True)
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


def sample_states(
    motion: Mapping[str, Any], joints: str, rate: float
) -> tuple[list[str], Floats, Floats, Floats]:
    """Sample a motion evenly, and at the times at which it begins and ends to rest.

    Args:
        motion: Motion.
        joints: One of `GROUPS`.
        rate: Samples per second [Hz]. One less than half a period away from a rest is replaced.

    Returns:
        Names of the n coordinates, times from the start, shape (T,) [s], positions and velocities,
        shape (T, n) each.
    """
    columns = select_columns(motion, joints)
    knots = _get_knots(motion)[0]
    rate = _check_rate(rate, knots, len(columns), field="states")
    is_rest = _find_rests(motion, knots)
    rests = knots[np.append(is_rest, False) | np.append(False, is_rest)]
    even = sample_evenly(knots, rate)
    half = 0.5 / rate
    after = np.searchsorted(rests, even - half)  # the first that is not well before each
    is_apart = np.append(rests, np.inf)[after] > even + half
    moments = _round_times(np.union1d(even[is_apart], rests))
    curve = _make_curve(motion, columns)
    names = [motion["names"][k] for k in columns]
    return names, moments, curve.at(moments), curve.velocity(moments)


def from_ros(
    message: Mapping[str, Any] | str | Path,
    *,
    like: Mapping[str, Any] | None = None,
    robot_size: int | None = None,
) -> dict[str, Any]:
    """Return the motion in data with the fields of `trajectory_msgs/JointTrajectory`.

    The motion is that of a `joint_trajectory_controller`: see `interpolate_points`. `effort` is
    not part of it. Without any velocities, it has no curve, and all its segments are lines.

    Args:
        message: Data, or a JSON file with them, with all of the robot's coordinates.
        like: Motion with the phases, the waypoints, and the order and number of coordinates. Its
            waypoints are the points that are nearest in time; others are knots of the curve only,
            if there are velocities. Default: one phase without holds, every point a waypoint, and
            coordinates as in the message, base first.
        robot_size: Number of robot coordinates without `like`. Default: those before the first
            with a dot in its name.

    Raises:
        UnknownNameError: `like` has no such coordinate.
        InputError: A field is missing or invalid, coordinates of the robot are missing, no point is
            near the end of a phase of `like`, or two neighbouring points have accelerations, but
            not both have velocities: ros2_controllers 4.42.1 commands the position 0 between them.
    """
    file = None
    if not isinstance(message, Mapping):
        file = check_path(message, "message", "a JointTrajectory as data, or a JSON file")
    data = message if file is None else read_json(file)
    listed = _get_field(data, "joint_names", list, file, "")
    order = _sort_names(listed, like, file)
    names = [listed[k] for k in order]
    points = _get_field(data, "points", list, file, "")
    times: list[float] = []
    rows: dict[str, list[Floats | None]] = {key: [] for key in _ROWS}
    for k, point in enumerate(points):
        for key, found in rows.items():
            found.append(_read_row(point, key, order, file, k))
        times.append(_read_time(point, file, f"points[{k}]."))
    _check_points(times, rows, file)
    size = None if robot_size is None else check_integer(robot_size, "robot_size", low=3)
    if like is not None:
        size = like["robot_size"]
    elif size is None:
        size = infer_robot_size(names, file=file, field="joint_names")
    has_velocity = np.array([row is not None for row in rows["velocities"]], bool)
    has_curve = bool((has_velocity[1:] & has_velocity[:-1]).any())
    stated = [row for row in rows["positions"] if row is not None]  # every point has some
    positions: Floats = np.reshape(stated, (len(points), len(names)))
    waypoints = list(range(len(points)))
    if like is not None:
        waypoints, phases = _place_phases(np.array(times), like, has_curve, file)
    else:
        phases = [make_single_phase(len(points))] if len(points) > 1 else []
    motion = {
        "names": names,
        "times": [times[k] for k in waypoints],
        "positions": positions[waypoints].tolist(),
        "robot_size": size,
        "phases": phases,
    }
    if has_curve:
        knots = interpolate_points(
            np.array(times), positions, rows["velocities"], rows["accelerations"]
        )
        keys = ("times", "positions", "rates")
        motion["curve"] = {key: part.tolist() for key, part in zip(keys, knots, strict=True)}
    return motion


def _place_phases(
    times: Floats, like: Mapping[str, Any], has_curve: bool, file: Path | None
) -> tuple[list[int], list[dict[str, Any]]]:
    """Return the points that are waypoints, and the phases of another motion between them."""
    moments = np.array(like["times"], float)
    between = (times[1:] + times[:-1]) / 2.0
    at = np.searchsorted(between, moments - moments[0])  # the points that are nearest in time
    waypoints = np.arange(len(times))
    if has_curve:
        waypoints = np.union1d(at, waypoints[[0, -1]])
        at = np.searchsorted(waypoints, at)
    edges = at[[0, *(phase["last"] for phase in like["phases"])]].tolist()
    ends = moments[[phase["last"] for phase in like["phases"]]] - moments[0]
    if edges[-1] != len(waypoints) - 1 or (np.diff(edges) <= 0).any():
        raise InputError(
            "there are no points at the times at which the phases of `like` end",
            file=file,
            field="points",
            expected=f"points at {format_value(ends.round(3).tolist())} s",
            got=f"{len(times)} points from {times[0]:.3f} to {times[-1]:.3f} s",
        )
    spans = zip(like["phases"], edges, edges[1:], strict=False)
    phases = [{**phase, "first": first, "last": last} for phase, first, last in spans]
    return waypoints.tolist(), phases


def _get_knots(motion: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return times from the start and all positions of the curve's knots, or of the waypoints."""
    curve = motion.get("curve")
    source = motion if curve is None else curve
    times = np.array(source["times"], float)
    times -= times[0]
    if curve is None:
        times = np.round(times * _NANO) / _NANO  # a message then has the very same waypoints
    return times, np.array(source["positions"], float)


def _make_curve(motion: Mapping[str, Any], columns: Sequence[int]) -> Curve:
    """Return the curve of some coordinates, or else monotone cubics through the waypoints."""
    times, every = _get_knots(motion)
    positions = every[:, columns]
    if motion.get("curve") is None:
        return Curve(times, positions, _estimate_velocities(times, positions))
    return Curve(times, positions, np.array(motion["curve"]["rates"], float)[:, columns])


def _find_rests(motion: Mapping[str, Any], times: Floats) -> Bools:
    """Return whether nothing moves, robot or object, between each of the times and the next [s]."""
    knots, every = _get_knots(motion)
    is_still: Bools = np.logical_not(np.diff(every, axis=0).any(axis=1))
    if motion.get("curve") is not None:
        at_rest = ~np.any(motion["curve"]["rates"], axis=1)
        is_still &= at_rest[:-1] & at_rest[1:]
    middles = (times[1:] + times[:-1]) / 2.0
    return np.asarray(is_still[np.searchsorted(knots, middles) - 1])


def _check_times(stamp: float, duration: float) -> None:
    """Check that a message can state the times of its header and of its last point [s]."""
    expected = "seconds, less than 2^31"
    if stamp >= MOST_SECONDS:
        raise InputError("out of range", field="stamp", expected=expected, got=stamp)
    if duration >= MOST_SECONDS:
        problem = "too long for a message of ROS"
        raise InputError(problem, field="motion", expected=expected, got=f"{duration:g}")


def _check_rate(rate: float, times: Floats, columns: int, *, field: str = "rate") -> float:
    rate = check_number(rate, field, "points a second, more than 0", low=0.0, strict=True)
    most = _MAX_VALUES // max(columns, 1)  # a group may be empty
    duration = times[-1] - times[0]
    if duration * rate > most:
        expected = f"at most {most} points, {most / duration:.4g} a second "
        expected += f"for this motion of {duration:.4g} s"
        raise InputError("too many points", field=field, expected=expected, got=rate)
    return rate


def _round_times(times: Floats) -> Floats:
    """Round times to those that a message can state, but not beyond the last one."""
    return np.minimum(np.round(times * _NANO) / _NANO, times[-1])


def _estimate_velocities(times: Floats, positions: Floats) -> Floats:
    """Return velocities at waypoints, shape (T, n), those of SciPy's monotone cubics.

    Both ends are at rest.
    """
    from scipy.interpolate import PchipInterpolator

    velocities = np.zeros_like(positions)
    with np.errstate(over="ignore"):  # the reciprocal of a slope next to nothing
        velocities[1:-1] = PchipInterpolator(times, positions)(times[1:-1], 1)
    return velocities


def _choose_accelerations(curve: Curve, is_rest: Bools) -> Floats:
    """Return one acceleration at each knot, shape (K, n), where those of the cubics jump.

    A quintic of duration h whose acceleration at one end is wrong by d is off by max s³(1−s)²/2 of
    d·h², which is 0.0173·d·h². With accelerations a and b before and after the knot, and durations
    h and k, both quintics are equally far off at (a·h² + b·k²)/(h² + k²). A rest remains one.
    """
    after, before = curve.compute_accelerations()  # at the begin and the end of each cubic
    squares = np.diff(curve.times)[:, None] ** 2
    chosen = np.concatenate([after[:1], before])
    inner = before[:-1] * squares[:-1] + after[1:] * squares[1:]
    chosen[1:-1] = inner / (squares[:-1] + squares[1:])
    chosen[np.append(is_rest, False) | np.append(False, is_rest)] = 0.0
    return chosen


def _sort_names(names: list[Any], like: Mapping[str, Any] | None, file: Path | None) -> list[int]:
    """Return the columns of a message in the order of `like`, or else as they are."""
    for k, name in enumerate(names):
        field = f"joint_names[{k}]"
        if not isinstance(name, str):
            got = format_value(name)
            raise InputError("not text", file=file, field=field, expected="a name", got=got)
        if name in names[:k]:
            raise InputError("a name occurs twice", file=file, field=field, got=name)
    if like is None:
        return list(range(len(names)))
    known = like["names"]
    for k, name in enumerate(names):
        if name not in known:
            raise UnknownNameError("coordinate", name, known, file=file, field=f"joint_names[{k}]")
    missing = [name for name in known[: like["robot_size"]] if name not in names]
    if missing:
        problem, expected = "coordinates of the robot are missing", ", ".join(missing)
        raise InputError(problem, file=file, field="joint_names", expected=expected, got=names)
    return sorted(range(len(names)), key=lambda k: known.index(names[k]))


def _read_time(point: Any, file: Path | None, where: str) -> float:
    since = _get_field(point, "time_from_start", dict, file, where)
    inside = f"{where}time_from_start."
    found = {key: _get_field(since, key, int, file, inside) for key in ("sec", "nanosec")}
    for key, value in found.items():
        if not abs(value) < _MOST_TIME:
            expected, got = f"less than {_MOST_TIME}", format_value(value)
            field = inside + key
            raise InputError("out of range", file=file, field=field, expected=expected, got=got)
    return float(found["sec"] + found["nanosec"] / _NANO)


def _read_row(
    point: Any, key: str, order: Sequence[int], file: Path | None, number: int
) -> Floats | None:
    """Return the positions or their derivatives at a point; none if a derivative is not stated."""
    where = f"points[{number}]."
    if key != "positions" and point.get(key) is None:
        return None
    values = _get_field(point, key, list, file, where)
    if key != "positions" and not values:
        return None
    field = where + key
    if len(values) != len(order):
        problem, count = "wrong number of values", len(order)
        raise InputError(problem, file=file, field=field, expected=count, got=len(values))
    for k, value in enumerate(values):
        if not is_number(value) or not abs(value) <= _LARGEST:
            expected = f"a number up to {_LARGEST:g}"
            got = format_value(value)
            raise InputError(
                "not a number", file=file, field=f"{field}[{k}]", expected=expected, got=got
            )
    return np.array([values[k] for k in order], float)


def _check_points(
    times: list[float], rows: Mapping[str, Sequence[Floats | None]], file: Path | None
) -> None:
    """Check that times increase, and that controllers can interpolate between the points."""
    for k in range(1, len(times)):
        where = f"points[{k}]"
        if not times[k] - times[k - 1] >= MIN_INTERVAL / 2.0:  # half, against rounding
            field = f"{where}.time_from_start"
            expected = f"more than {times[k - 1]:.9f} s"
            got = f"{times[k]:.9f} s"
            raise InputError(
                "times do not increase", file=file, field=field, expected=expected, got=got
            )
        ends = slice(k - 1, k + 1)
        has_velocities = all(row is not None for row in rows["velocities"][ends])
        has_accelerations = all(row is not None for row in rows["accelerations"][ends])
        if has_accelerations and not has_velocities:
            lacking = k if rows["velocities"][k] is None else k - 1
            raise InputError(
                "accelerations without velocities: ros2_controllers commands the position 0 there",
                file=file,
                field=f"points[{lacking}].velocities",
                expected="velocities, or no accelerations",
            )


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
