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
_MAX_TIME = 2**32  # [s] and [ns]: ROS has 32 bits for each
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
    knots, all_positions = _get_knots(motion)
    _check_times(stamp, float(knots[-1]))
    times = knots
    if rate is not None:
        rate = _check_rate(rate, knots, len(columns))
        counts = np.maximum(np.ceil(np.diff(knots) * rate - 1e-6), 1.0)
        times = divide_intervals(knots, counts.astype(int))
    if is_smooth:
        curve = _make_curve(motion, columns)
    else:
        lines = [np.interp(times, knots, column) for column in all_positions.T]
        positions = np.reshape(lines, (-1, len(times))).T[:, columns]
        curve = Curve(times, positions, _estimate_velocities(times, positions))
    # At the times of the message: its cubics would else exceed limits where knots are close.
    stated_times = _round_times(times)
    positions = curve.at(stated_times)
    velocities = curve.velocity(stated_times)
    accelerations = curve.acceleration(stated_times)
    at_knots = np.searchsorted(times, curve.times)
    accelerations[at_knots] = _choose_accelerations(curve, _find_rests(motion, curve.times))
    if derivatives < 1:
        velocities = velocities[:, :0]
    if derivatives < 2:
        accelerations = accelerations[:, :0]
    points = []
    for k, time in enumerate(stated_times.tolist()):
        point = {
            "positions": positions[k].tolist(),
            "velocities": velocities[k].tolist(),
            "accelerations": accelerations[k].tolist(),
            "effort": [],
            "time_from_start": _make_duration(time),
        }
        points.append(point)
    return {
        "header": {"stamp": _make_duration(stamp), "frame_id": frame},
        "joint_names": [motion["names"][k] for k in columns],
        "points": points,
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
    knots, _ = _get_knots(motion)
    rate = _check_rate(rate, knots, len(columns), field="states")
    rests = knots[_find_ends(_find_rests(motion, knots))]
    even = sample_evenly(knots, rate)
    half_period = 0.5 / rate
    # The first rest that is not half a period or more before each time
    next_rest = np.searchsorted(rests, even - half_period)
    is_apart = np.append(rests, np.inf)[next_rest] > even + half_period
    times = _round_times(np.union1d(even[is_apart], rests))
    curve = _make_curve(motion, columns)
    names = [motion["names"][k] for k in columns]
    return names, times, curve.at(times), curve.velocity(times)


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
        for key, column in rows.items():
            column.append(_read_row(point, key, order, file, k))
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
    if like is not None:
        waypoints, phases = _place_phases(np.array(times), like, has_curve, file)
    else:
        waypoints = list(range(len(points)))
        phases = [make_single_phase(len(points))] if len(points) > 1 else []
    motion = {
        "names": names,
        "times": [times[k] for k in waypoints],
        "positions": positions[waypoints].tolist(),
        "robot_size": size,
        "phases": phases,
    }
    if has_curve:
        knot_times, knot_positions, knot_rates = interpolate_points(
            np.array(times), positions, rows["velocities"], rows["accelerations"]
        )
        motion["curve"] = {
            "times": knot_times.tolist(),
            "positions": knot_positions.tolist(),
            "rates": knot_rates.tolist(),
        }
    return motion


def _place_phases(
    times: Floats, like: Mapping[str, Any], has_curve: bool, file: Path | None
) -> tuple[list[int], list[dict[str, Any]]]:
    """Return the points that are waypoints, and the phases of another motion between them."""
    like_times = np.array(like["times"], float)
    like_times -= like_times[0]
    # The points that are nearest in time to the waypoints of `like`
    middles = (times[1:] + times[:-1]) / 2.0
    nearest = np.searchsorted(middles, like_times)
    waypoints = np.arange(len(times))
    if has_curve:
        waypoints = np.union1d(nearest, waypoints[[0, -1]])
        nearest = np.searchsorted(waypoints, nearest)
    last_of_phases = [phase["last"] for phase in like["phases"]]
    edges = nearest[[0, *last_of_phases]].tolist()
    if edges[-1] != len(waypoints) - 1 or (np.diff(edges) <= 0).any():
        ends = like_times[last_of_phases]
        raise InputError(
            "there are no points at the times at which the phases of `like` end",
            file=file,
            field="points",
            expected=f"points at {format_value(ends.round(3).tolist())} s",
            got=f"{len(times)} points from {times[0]:.3f} to {times[-1]:.3f} s",
        )
    phases = []
    for phase, first, last in zip(like["phases"], edges, edges[1:], strict=False):
        phases.append({**phase, "first": first, "last": last})
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
    times, all_positions = _get_knots(motion)
    positions = all_positions[:, columns]
    if motion.get("curve") is None:
        return Curve(times, positions, _estimate_velocities(times, positions))
    rates = np.array(motion["curve"]["rates"], float)
    return Curve(times, positions, rates[:, columns])


def _find_rests(motion: Mapping[str, Any], times: Floats) -> Bools:
    """Return whether nothing moves, robot or object, between each of the times and the next [s]."""
    knots, positions = _get_knots(motion)
    is_still: Bools = np.logical_not(np.diff(positions, axis=0).any(axis=1))
    if motion.get("curve") is not None:
        at_rest = ~np.any(motion["curve"]["rates"], axis=1)
        is_still &= at_rest[:-1] & at_rest[1:]
    middles = (times[1:] + times[:-1]) / 2.0
    return np.asarray(is_still[np.searchsorted(knots, middles) - 1])


def _find_ends(is_rest: Bools) -> Bools:
    """Return whether each of K knots begins or ends one of the intervals that rest, shape (K,)."""
    begins = np.append(is_rest, False)
    ends = np.append(False, is_rest)
    return np.asarray(begins | ends)


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
    max_points = _MAX_VALUES // max(columns, 1)  # a group may be empty
    duration = times[-1] - times[0]
    if duration * rate > max_points:
        expected = f"at most {max_points} points, {max_points / duration:.4g} a second "
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
    chosen[_find_ends(is_rest)] = 0.0
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
        raise InputError(
            "coordinates of the robot are missing",
            file=file,
            field="joint_names",
            expected=", ".join(missing),
            got=names,
        )
    return sorted(range(len(names)), key=lambda k: known.index(names[k]))


def _read_time(point: Any, file: Path | None, where: str) -> float:
    since = _get_field(point, "time_from_start", dict, file, where)
    inside = f"{where}time_from_start."
    sec = _get_field(since, "sec", int, file, inside)
    nanosec = _get_field(since, "nanosec", int, file, inside)
    for key, value in (("sec", sec), ("nanosec", nanosec)):
        if not abs(value) < _MAX_TIME:
            raise InputError(
                "out of range",
                file=file,
                field=inside + key,
                expected=f"less than {_MAX_TIME}",
                got=format_value(value),
            )
    return float(sec + nanosec / _NANO)


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
        raise InputError(
            "wrong number of values",
            file=file,
            field=field,
            expected=len(order),
            got=len(values),
        )
    for k, value in enumerate(values):
        if not is_number(value) or not abs(value) <= _LARGEST:
            raise InputError(
                "not a number",
                file=file,
                field=f"{field}[{k}]",
                expected=f"a number up to {_LARGEST:g}",
                got=format_value(value),
            )
    return np.array([values[k] for k in order], float)


def _check_points(
    times: list[float], rows: Mapping[str, Sequence[Floats | None]], file: Path | None
) -> None:
    """Check that times increase, and that controllers can interpolate between the points."""
    for k in range(1, len(times)):
        # Half of the shortest interval, since times are rounded.
        if not times[k] - times[k - 1] >= MIN_INTERVAL / 2.0:
            raise InputError(
                "times do not increase",
                file=file,
                field=f"points[{k}].time_from_start",
                expected=f"more than {times[k - 1]:.9f} s",
                got=f"{times[k]:.9f} s",
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
    has_kind = isinstance(value, Mapping if kind is dict else kind)
    if not has_kind or isinstance(value, bool):
        raise InputError(
            "wrong type of value",
            file=file,
            field=where + key,
            expected=expected,
            got=format_value(value),
        )
    return value
