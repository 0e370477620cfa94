"""Turns waypoints into a smooth trajectory that is as fast as its limits allow."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from vkc_pin.planning.base_paths.arcs import interpolate_arcs
from vkc_pin.planning.retiming.braking import make_accelerating_curve, make_braking_curve
from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.planning.retiming.limits import Limits, limit_jerk
from vkc_pin.planning.retiming.spline_path import fit_path, fit_path_over
from vkc_pin.planning.retiming.topp_ra import PathSamples, compute_speeds
from vkc_pin.planning.retiming.torque_bounds import TorqueBounds
from vkc_pin.planning.retiming.wheeled_paths import compute_slip, fit_rolling_paths
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import MIN_INTERVAL, Curve, concatenate_curves, sample_intervals
from vkc_pin.world.trajectory.torques import Torques
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import RollingLimits, make_rolling_limits

_MIN_PIECES = 3  # minimum pieces per step; the path velocity is linear in time in each
_MIN_JOINT_STEP = 1e-6  # [m] or [rad], smaller steps of an object's joint count as none
_MIN_STEP_DURATION = 1e-6  # [s] at full speed; shorter steps count as none
# With jerk limits the motion stops between a step whose time at full speed is below this fraction
# of `jerk_time`, and one that is longer by this factor: a turn on a short path would slow down all.
_SHORT_STEP = 0.1
_ABRUPT_RATIO = 30.0
_WAIT_DURATION = 1e-3  # [s], duration of a step without motion, unless a hand opens or closes in it
_ROUNDING = 1e-9  # relative
# jump in acceleration that is allowed with jerk limits, relative to the acceleration limit
_JUMP_RATIO = 1e-4
# search for speeds within torque limits: iterations, and relative change at convergence
_TORQUE_ITERATIONS = 4
_TORQUE_TOLERANCE = 0.02
# Attempts to keep the limits with velocities at the ends, and relative margin of each
_TIGHTENINGS = 8
_TIGHTENING_MARGIN = 1.002
# Path velocities at the ends that are tried, relative to the speed of the scaled coordinates there
_END_SPEED_RATIOS = (1.0, 0.5, 0.25)
# [m/s], lateral velocity of a wheeled base that needs no more knots, a fifth of what counts as slip
_MAX_SLIP = 2e-4
_MAX_REFINEMENT = 8  # of the knots


Close = Callable[[Floats, Floats], Floats]
"""Moves points between waypoints onto the closure manifold: points, shape (M, n), and the waypoint
of each plus the fraction of the step to the next, shape (M,) → points, shape (M, n)."""


def retime_trajectory(
    scene: Scene,
    trajectory: Trajectory,
    parts: Ints | None = None,
    *,
    jerk_time: float = 0.0,
    close: Close | None = None,
    end_velocities: Floats | None = None,
) -> Trajectory:
    """Return a smooth trajectory through the same waypoints, as fast as its limits allow.

    It starts and ends with given velocities, rests during steps without motion, and stops where a
    joint of an object starts or ceases to move, since the hand changes direction there; with jerk
    limits also before and after a step that is far shorter than its neighbour. A step without
    motion at the begin of a phase, as when a hand opens, keeps its duration. Between stops it
    follows `fit_path` at the speeds of `compute_speeds`, or else straight lines with stops at all
    waypoints; a wheeled base follows `fit_rolling_paths`. The resulting cubics are slowed down
    until they keep the velocity and acceleration limits exactly, and the torque limits if possible.
    `limit_jerk` limits their jerk. For velocities at the ends see `_follow_between_velocities`.

    Args:
        scene: Robot and objects.
        trajectory: Trajectory whose waypoints are kept; its times matter only for waits.
        parts: Number of parts of each straight line between waypoints, shape (T − 1,). The path
            passes through the ends of all parts. Defaults to one.
        jerk_time: See `Options.jerk_time`.
        close: Closes chains where lines are parted, which straight lines of the coordinates open.
        end_velocities: Velocities at the start and the end, shape (2, n). Defaults to the scene's
            start velocity, with objects at rest, and to rest at the end.
    """
    if end_velocities is None:
        end_velocities = np.zeros((2, len(trajectory.names)))
        end_velocities[0, : trajectory.robot_size] = scene.start_velocity
    limits = Limits.from_scene(scene, trajectory.names, jerk_time)
    if parts is None:
        parts = np.ones(len(trajectory.times) - 1, int)
    rolling = make_rolling_limits(scene.robot)
    waypoints = np.concatenate([[0], np.cumsum(parts)])  # indices of the waypoints among all points
    positions = _subdivide(trajectory.positions, waypoints, rolling, close)
    # The length of a step is its time [s] at full speed.
    scale = 1.0 / np.where(np.isfinite(limits.velocity), limits.velocity, 1.0)
    lengths = np.linalg.norm(np.diff(positions, axis=0) * scale, axis=1)
    is_still = lengths <= _MIN_STEP_DURATION
    is_stop = _find_stops(positions[:, trajectory.robot_size :], lengths, is_still, jerk_time)

    wait_durations = {}
    for phase in trajectory.phases:
        first_step = int(waypoints[phase.first])
        wait_durations[first_step] = float(np.diff(trajectory.times)[phase.first])
    torques = Torques(scene, trajectory)
    waypoint_before = np.searchsorted(waypoints, np.arange(waypoints[-1]), side="right") - 1
    phases = torques.phases_of(waypoint_before)
    planned_times = np.interp(np.arange(waypoints[-1] + 1), waypoints, trajectory.times)

    pieces = list[Curve]()
    point_knots = [0]  # indices of all points among the knots of the curve
    for first, last in _split_into_runs(is_stop):
        points = positions[first : last + 1]
        least = [wait_durations.get(step, _WAIT_DURATION) for step in range(first, last)]
        torque_bounds = None
        if torques.torque_limits.is_known:
            torque_bounds = TorqueBounds(torques, phases[first:last])
        velocities = np.zeros_like(end_velocities)
        if first == 0:
            velocities[0] = end_velocities[0]
        if last == len(lengths):
            velocities[1] = end_velocities[1]
        if velocities.any():
            curves = _follow_between_velocities(
                points,
                planned_times[first : last + 1],
                velocities,
                limits,
                scale,
                rolling,
                torque_bounds,
                np.array(least),
            )
        elif is_still[first]:
            curves = [_stop_at_waypoints(points, limits, np.array(least))]
        else:
            curves = _follow_waypoints(points, limits, scale, rolling, torque_bounds)
        for piece, knots in curves:
            point_knots += (point_knots[-1] + knots).tolist()
            pieces.append(piece)
    curve = concatenate_curves(pieces).shift_time(float(trajectory.times[0]))
    waypoint_knots = np.array(point_knots)[waypoints]
    return replace(trajectory, times=curve.times[waypoint_knots], curve=curve)


def _subdivide(
    positions: Floats, waypoints: Ints, rolling: RollingLimits, close: Close | None
) -> Floats:
    """Return waypoints, (T, n), and points on the lines (wheeled bases: arcs) between them.

    `waypoints` are the indices of the waypoints among all points, shape (T,).
    """
    every = np.arange(waypoints[-1] + 1)
    at = np.interp(every, waypoints, np.arange(len(waypoints)))  # waypoint plus fraction of step
    columns = [np.interp(every, waypoints, column) for column in positions.T]
    points = np.stack(columns, axis=-1)
    if len(points) == len(positions):
        return points
    if not rolling.is_omnidirectional:
        step = np.minimum(at.astype(int), len(positions) - 2)
        points[:, :3] = interpolate_arcs(positions[step, :3], positions[step + 1, :3], at - step)
    if close is not None:
        inserted = np.setdiff1d(every, waypoints)
        points[inserted] = close(points[inserted], at[inserted])
    return points


def _find_stops(
    object_positions: Floats, lengths: Floats, is_still: Bools, jerk_time: float
) -> Bools:
    """Return a mask of inner points at which the motion stops, see `retime_trajectory`.

    Args:
        object_positions: Coordinates of objects at all points, shape (M, k).
        lengths: Time of each step at full speed, shape (M − 1,) [s].
        is_still: Mask of steps without motion, shape (M − 1,).
        jerk_time: See `Options.jerk_time`.
    """
    is_moving = np.abs(np.diff(object_positions, axis=0)) > _MIN_JOINT_STEP
    joints_start_or_cease = (is_moving[1:] != is_moving[:-1]).any(axis=1)
    rest_begins_or_ends = is_still[1:] != is_still[:-1]
    shorter, longer = np.sort([lengths[:-1], lengths[1:]], axis=0)
    is_abrupt = shorter < np.minimum(_SHORT_STEP * jerk_time, longer / _ABRUPT_RATIO)
    is_stop: Bools = joints_start_or_cease | rest_begins_or_ends | is_abrupt
    return is_stop


def _split_into_runs(is_stop: Bools) -> Iterator[tuple[int, int]]:
    """Yield the first and last point of each run between stops, a mask of inner points."""
    inner_stops = (np.flatnonzero(is_stop) + 1).tolist()
    yield from itertools.pairwise([0, *inner_stops, len(is_stop) + 1])


def _follow_between_velocities(
    points: Floats,
    planned_times: Floats,
    velocities: Floats,
    limits: Limits,
    scale: Floats,
    rolling: RollingLimits,
    torque_bounds: TorqueBounds | None,
    least: Floats,
) -> list[tuple[Curve, Ints]]:
    """Return curves through waypoints, shape (m, n), with given velocities at both ends, (2, n).

    The path leaves the first waypoint along its velocity, at that speed, and arrives likewise. If
    no timing of it keeps the limits, and always with jerk limits and on wheels, the motion brakes
    to rest along its first velocity and continues from there; at its end it accelerates from rest.
    `least` are the durations [s] of steps without motion, shape (m − 1,).
    """
    if rolling.is_omnidirectional and limits.has_unlimited_jerk:
        result = _retime_between_velocities(
            points, planned_times, velocities, limits, scale, torque_bounds
        )
        if result is not None:
            return [result]
    points = points.copy()
    brake = None
    if velocities[0].any():
        brake = make_braking_curve(points[0], velocities[0], limits, rolling)
        points[0] = brake.positions[-1]
    acceleration = None
    if velocities[1].any():
        acceleration = make_accelerating_curve(points[-1], velocities[1], limits, rolling)
        points[-1] = acceleration.positions[0]
    lengths = np.linalg.norm(np.diff(points, axis=0) * scale, axis=1)
    if (lengths <= _MIN_STEP_DURATION).any():
        curves = [_stop_at_waypoints(points, limits, least)]
    else:
        curves = _follow_waypoints(points, limits, scale, rolling, torque_bounds)
    if brake is not None:
        curve, knots = curves[0]
        curves[0] = (concatenate_curves([brake, curve]), knots + len(brake.times) - 1)
    if acceleration is not None:
        curve, knots = curves[-1]
        curve = concatenate_curves([curve, acceleration])
        curves[-1] = (curve, np.append(knots[:-1], len(curve.times) - 1))
    return curves


def _retime_between_velocities(
    points: Floats,
    planned_times: Floats,
    velocities: Floats,
    limits: Limits,
    scale: Floats,
    torque_bounds: TorqueBounds | None,
) -> tuple[Curve, Ints] | None:
    """Return the fastest curve through waypoints, (m, n), with given velocities at both ends.

    The slope q′ of the path at an end and the path velocity w there have the product q̇ = q′w. If w
    is that of the scaled coordinates, q′ has length 1. Steeper paths with smaller w are tried, too:
    their accelerations q″w² at the end are smaller, since coordinates that do not move there yet
    have more time to follow.

    If none has a timing, the path over the planned times, shape (m,), is followed: at their pace,
    the program has kept the limits.

    Returns:
        The curve and the knots of the waypoints, or None if no path has a timing.
    """
    lengths = np.linalg.norm(np.diff(points, axis=0) * scale, axis=1)
    if (lengths <= _MIN_STEP_DURATION).any():
        return None
    arc_lengths = np.concatenate([[0.0], np.cumsum(lengths)])
    speeds = np.linalg.norm(velocities * scale, axis=1)
    bounds = (limits.lower, limits.upper)

    def follow(positions: Floats, end_speeds: Floats) -> Curve | None:
        first, last = end_speeds.tolist()
        first_slope = velocities[0] / first if first > 0.0 else None
        last_slope = velocities[1] / last if last > 0.0 else None
        path = fit_path_over(positions, points, bounds, (first_slope, last_slope))
        steps = len(points) - 1
        return _follow_between_speeds(path, steps, velocities, (first, last), limits, torque_bounds)

    curves = [follow(arc_lengths, ratio * speeds) for ratio in _END_SPEED_RATIOS]
    found = [curve for curve in curves if curve is not None]
    if not found:
        planned = follow(planned_times, np.where(speeds > 0.0, 1.0, 0.0))
        if planned is None:
            return None
        found = [planned]
    fastest = min(found, key=lambda curve: float(curve.times[-1]))
    return _pass_through(points, fastest)


def _follow_between_speeds(
    path: CubicPath,
    steps: int,
    velocities: Floats,
    end_speeds: tuple[float, float],
    limits: Limits,
    torque_bounds: TorqueBounds | None,
) -> Curve | None:
    """Return the curve along a path of equal steps with given path velocities at its ends, or None.

    It cannot be slowed down, since its ends have their velocities, shape (2, n). If its cubics
    exceed limits between the positions of TOPP-RA, that gets tighter ones.
    """
    places = _choose_places(path, steps)
    given = np.abs(velocities).max(axis=0)  # kept at the ends, whatever the limits are
    slower = 1.0
    for _ in range(_TIGHTENINGS):
        speeds = compute_speeds(
            path,
            places,
            np.maximum(limits.velocity / slower, given),
            limits.acceleration / slower**2,
            end_speeds=end_speeds,
        )
        if speeds is None:
            return None
        pace = _make_pace(places, speeds)
        rates = path(places, 1) * pace.rates
        rates[[0, -1]] = velocities  # bit-exact
        curve = Curve(pace.times, path(places), rates)
        excess = limits.compute_slowdown(curve)
        if excess <= 1.0 + 2.0 * _ROUNDING:
            if torque_bounds is not None and np.abs(torque_bounds.evaluate(curve)).max() > 1.0:
                return None
            return curve
        slower *= _TIGHTENING_MARGIN * excess
    return None


def _follow_waypoints(
    points: Floats,
    limits: Limits,
    scale: Floats,
    rolling: RollingLimits,
    torque_bounds: TorqueBounds | None,
) -> list[tuple[Curve, Ints]]:
    """Return curves through waypoints, shape (m, n), from stop to stop."""
    if not rolling.is_omnidirectional:
        wheeled_limits = limits.with_wheels(rolling)
        curves = _follow_rolling_paths(points, wheeled_limits, scale, rolling, torque_bounds)
        return list(curves)
    bounds = (limits.lower, limits.upper)
    path = fit_path(points, scale, bounds)
    result = _retime_path(path, points, limits, torque_bounds)
    if result is not None:
        return [result]
    if limits.has_unlimited_jerk:
        straight, knots = _stop_at_waypoints(points, limits, np.zeros(len(points) - 1))
        if torque_bounds is not None:
            straight = torque_bounds.slow_down(straight)
        return [(straight, knots)]
    steps = []
    for k in range(len(points) - 1):
        ends = points[k : k + 2]
        path = fit_path(ends, scale, bounds)
        steps.append(_follow_step(path, ends, limits, torque_bounds, k))
    return steps


def _follow_rolling_paths(
    points: Floats,
    limits: Limits,
    scale: Floats,
    rolling: RollingLimits,
    torque_bounds: TorqueBounds | None,
    refinement: int = 1,
) -> Iterator[tuple[Curve, Ints]]:
    """Yield the curves of `_follow_waypoints` for a wheeled base.

    The number of knots is multiplied by `refinement`, and increased where the base would slip.
    """
    bounds = (limits.lower[:-2], limits.upper[:-2])  # without those of the wheels
    first_step = 0
    for path, waypoints in fit_rolling_paths(points, scale, bounds, rolling, refinement):
        steps = len(waypoints) - 1
        bounds_of_path = None
        if torque_bounds is not None:
            bounds_of_path = torque_bounds.select_steps(first_step, steps)
        first_step += steps
        result = _retime_path(path, waypoints, limits, bounds_of_path)
        if result is None:
            for k in range(steps):
                ends = waypoints[k : k + 2]
                ((step, _),) = fit_rolling_paths(ends, scale, bounds, rolling, _MAX_REFINEMENT)
                yield _follow_step(step, ends, limits, bounds_of_path, k)
        elif refinement < _MAX_REFINEMENT and compute_slip(result[0]) > _MAX_SLIP:
            yield from _follow_rolling_paths(
                waypoints, limits, scale, rolling, bounds_of_path, 2 * refinement
            )
        else:
            yield result


def _retime_path(
    path: CubicPath, points: Floats, limits: Limits, torque_bounds: TorqueBounds | None
) -> tuple[Curve, Ints] | None:
    """Return a curve along a path through waypoints, (m, n), and the waypoints' knots, or None.

    Torques are checked only for the fastest curve within the other limits, since few exceed them.
    """
    places = _choose_places(path, len(points) - 1)
    speeds = compute_speeds(path, places, limits.velocity, limits.acceleration)
    if speeds is None:
        return None
    curve, waypoints = _follow_at_speeds(path, places, points, speeds, limits)
    if torque_bounds is None or np.abs(torque_bounds.evaluate(curve)).max() <= 1.0:
        return curve, waypoints
    static, _, _ = torque_bounds.decompose(curve)
    if np.abs(static).max() >= 1.0:  # exceeded even at rest
        return curve, waypoints
    # Viscous torques are linear in the speed, TOPP-RA takes its square: they are linearised in it
    # around the last speeds.
    samples = PathSamples.from_positions(path, places)
    path_torques = torque_bounds.evaluate_along_path(path, samples)
    for _ in range(_TORQUE_ITERATIONS):
        linear = path_torques.linearize(np.interp(samples.positions, places, speeds))
        slower = compute_speeds(path, places, limits.velocity, limits.acceleration, linear)
        if slower is None:
            break
        has_converged = np.allclose(slower, speeds, rtol=_TORQUE_TOLERANCE)
        speeds = slower
        if has_converged:
            break
    curve, waypoints = _follow_at_speeds(path, places, points, speeds, limits)
    return torque_bounds.slow_down(curve), waypoints


def _choose_places(path: CubicPath, steps: int) -> Floats:
    """Return the positions on a path of equal cubics in every step at which speeds are computed."""
    cubics_per_step = (len(path.x) - 1) // steps
    pieces_per_cubic = max(_MIN_PIECES // cubics_per_step, 1)
    fractions = np.arange(pieces_per_cubic) / pieces_per_cubic
    return sample_intervals(path.x, fractions, last=True)


def _follow_at_speeds(
    path: CubicPath, places: Floats, points: Floats, speeds: Floats, limits: Limits
) -> tuple[Curve, Ints]:
    """Return the curve along a path at given speeds, and the waypoints' knots."""
    return _follow_at_pace(path, _make_pace(places, speeds), points, limits)


def _make_pace(places: Floats, speeds: Floats) -> Curve:
    """Return the progress along a path whose speed is linear in time between two places.

    Each distance is the duration times the mean speed.
    """
    durations = 2.0 * np.diff(places) / (speeds[1:] + speeds[:-1])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    return Curve(times, places[:, None], speeds[:, None])


def _follow_at_pace(
    path: CubicPath, pace: Curve, points: Floats, limits: Limits
) -> tuple[Curve, Ints]:
    """Return the curve along a path at a pace, or slower, and the knots of the waypoints."""
    if limits.has_unlimited_jerk:
        places = pace.positions[:, 0]
        rates = path(places, 1) * pace.rates
        curve = limits.slow_down(Curve(pace.times, path(places), rates))
    else:
        curve = limit_jerk(path, pace, len(points) - 1, limits)
    return _pass_through(points, curve)


def _pass_through(points: Floats, curve: Curve) -> tuple[Curve, Ints]:
    """Return a curve with waypoints, (m, n), as knots, bit by bit, and the knots of all but one."""
    size = points.shape[1]  # without the travel of wheels
    positions = np.array(curve.positions[:, :size])
    cubics_per_step = (len(positions) - 1) // (len(points) - 1)
    positions[::cubics_per_step] = points  # bit-exact
    waypoints = np.arange(1, len(points)) * cubics_per_step
    return Curve(curve.times, positions, curve.rates[:, :size]), waypoints


def _follow_step(
    path: CubicPath,
    points: Floats,
    limits: Limits,
    torque_bounds: TorqueBounds | None,
    number: int,
) -> tuple[Curve, Ints]:
    """Return the curve of step `number` between waypoints, (2, n), with progress 3s² − 2s³."""
    length = path.x[-1]
    s = np.linspace(0.0, 1.0, len(path.x))
    places = length * (3.0 - 2.0 * s) * s**2
    speeds = length * 6.0 * (s - s**2) / _WAIT_DURATION
    pace = Curve(s * _WAIT_DURATION, places[:, None], speeds[:, None])
    curve, waypoints = _follow_at_pace(path, pace, points, limits)
    if torque_bounds is not None:
        curve = torque_bounds.select_steps(number, 1).slow_down(curve)
    return curve, waypoints


def _stop_at_waypoints(points: Floats, limits: Limits, least: Floats) -> tuple[Curve, Ints]:
    """Return straight lines through waypoints, shape (m, n), with a stop at each, and their knots.

    3s² − 2s³ has a peak velocity of 1.5, a peak acceleration of 6, which is attained in a jump, and
    a jerk of 12. With jerk limits the acceleration is therefore almost zero. A distance x takes at
    least the time t with 1.5 x/t, 6 x/t² and 12 x/t³ within the limits. `least` are the durations
    [s] that the steps have at least, shape (m − 1,).
    """
    distances = np.abs(np.diff(points, axis=0))
    jump_ratio = 1.0 if limits.has_unlimited_jerk else _JUMP_RATIO
    acceleration = limits.acceleration * jump_ratio
    for_velocity = 1.5 * (distances / limits.velocity).max(axis=1)
    for_acceleration = np.sqrt(6.0 * (distances / acceleration).max(axis=1))
    for_jerk = np.cbrt(12.0 * (distances / limits.jerk).max(axis=1))
    durations = np.maximum.reduce([least, for_velocity, for_acceleration, for_jerk])
    durations = np.maximum(durations, MIN_INTERVAL) * (1.0 + _ROUNDING)
    times = np.concatenate([[0.0], np.cumsum(durations)])
    return Curve(times, points, np.zeros_like(points)), np.arange(1, len(points))
