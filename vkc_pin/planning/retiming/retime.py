"""Turns waypoints into a smooth trajectory that is as fast as its limits allow."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from vkc_pin.planning.base_paths.arcs import interpolate_arcs
from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.planning.retiming.limits import Limits, limit_jerk
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds
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
# With jerk limits the motion stops between a step whose time at full speed is below this share of
# `jerk_time`, and one that is longer by this factor: a turn on a short path would slow down all.
_SHORT_STEP, _ABRUPT_RATIO = 0.1, 30.0
_WAIT_DURATION = 1e-3  # [s], duration of a step without motion, unless a hand opens or closes in it
_ROUNDING = 1e-9  # relative
# jump in acceleration that is allowed with jerk limits, relative to the acceleration limit
_JUMP_RATIO = 1e-4
# search for speeds within torque limits: iterations, and relative change at convergence
_TORQUE_ITERATIONS, _TORQUE_TOLERANCE = 4, 0.02
# [m/s], lateral velocity of a wheeled base that needs no more knots, a fifth of what counts as slip
_MAX_SLIP = 2e-4
_MAX_REFINEMENT = 8  # of the knots


Close = Callable[[Floats, Floats], Floats]
"""Moves points between waypoints onto the closure manifold: points, shape (M, n), and the waypoint
of each with the fraction of the way to the next, shape (M,) → points, shape (M, n)."""


def retime_trajectory(
    scene: Scene,
    trajectory: Trajectory,
    parts: Ints | None = None,
    *,
    jerk_time: float = 0.0,
    close: Close | None = None,
) -> Trajectory:
    """Return a smooth trajectory through the same waypoints, as fast as its limits allow.

    It starts and ends at rest, rests during steps without motion, and stops where a joint of an
    object starts or ceases to move, since the hand changes direction there; with jerk limits also
    before and after a step that is far shorter than its neighbour. A step without motion
    at the begin of a phase, as when a hand opens, keeps its duration. Between stops it follows
    `fit_path` at the speeds of `compute_speeds`, or else straight lines with stops at all
    waypoints; a wheeled base follows `fit_rolling_paths`. The resulting cubics are slowed down
    until they keep the velocity and acceleration limits exactly, and the torque limits if possible.
    `limit_jerk` limits their jerk.

    Args:
        scene: Robot and objects.
        trajectory: Trajectory whose waypoints are kept; its times matter only for waits.
        parts: Number of parts of each straight line between waypoints, shape (T − 1,). The path
            passes through the ends of all parts. Defaults to one.
        jerk_time: See `Options.jerk_time`.
        close: Closes chains where lines are parted, which straight lines of the coordinates open.
    """
    limits = Limits.from_scene(scene, trajectory.names, jerk_time)
    parts = np.ones(len(trajectory.times) - 1, int) if parts is None else parts
    rolling = make_rolling_limits(scene.robot)
    places = np.concatenate([[0], np.cumsum(parts)])  # indices of the waypoints among all points
    positions = _subdivide(trajectory.positions, places, rolling, close)
    scale = 1.0 / np.where(np.isfinite(limits.velocity), limits.velocity, 1.0)
    lengths = np.linalg.norm(np.diff(positions, axis=0) * scale, axis=1)
    is_still = lengths <= _MIN_STEP_DURATION
    short, long = np.sort([lengths[:-1], lengths[1:]], axis=0)
    is_abrupt = short < np.minimum(_SHORT_STEP * jerk_time, long / _ABRUPT_RATIO)
    wait_durations = {
        int(places[phase.first]): float(np.diff(trajectory.times)[phase.first])
        for phase in trajectory.phases
    }
    pieces, ends, torques = list[Curve](), [0], Torques(scene, trajectory)
    moving_joints = np.abs(np.diff(positions[:, trajectory.robot_size :], axis=0)) > _MIN_JOINT_STEP
    phases = torques.phases_of(np.searchsorted(places, np.arange(places[-1]), side="right") - 1)
    for steps in _split_into_runs(is_still, moving_joints, is_abrupt):
        points = positions[steps[0] : steps[-1] + 2]
        if is_still[steps[0]]:
            least = np.array([wait_durations.get(step, _WAIT_DURATION) for step in steps])
            curves = [(_make_straight_curve(points, limits, least), np.arange(1, len(points)))]
        else:
            is_known = torques.torque_limits.is_known
            torque_bounds = TorqueBounds(torques, phases[steps]) if is_known else None
            curves = _follow_waypoints(points, limits, scale, rolling, torque_bounds)
        for piece, at in curves:
            ends += (ends[-1] + at).tolist()
            pieces.append(piece)
    curve = concatenate_curves(pieces).shift_time(float(trajectory.times[0]))
    return replace(trajectory, times=curve.times[np.array(ends)[places]], curve=curve)


def _subdivide(
    positions: Floats, places: Ints, rolling: RollingLimits, close: Close | None
) -> Floats:
    """Return waypoints, (T, n), and points on the lines (wheeled bases: arcs) between them."""
    every = np.arange(places[-1] + 1)
    at = np.interp(every, places, np.arange(len(places)))
    points = np.stack([np.interp(every, places, column) for column in positions.T], axis=-1)
    if len(points) == len(positions):
        return points
    if not rolling.is_omnidirectional:
        step = np.minimum(at.astype(int), len(positions) - 2)
        points[:, :3] = interpolate_arcs(positions[step, :3], positions[step + 1, :3], at - step)
    if close is not None:
        inserted = np.setdiff1d(every, places)
        points[inserted] = close(points[inserted], at[inserted])
    return points


def _split_into_runs(
    is_still: Bools, moving_joints: Bools, is_abrupt: Bools
) -> Iterator[list[int]]:
    """Yield the steps of each run between stops, see `retime_trajectory`."""
    stops = (moving_joints[1:] != moving_joints[:-1]).any(axis=1) | (is_still[1:] != is_still[:-1])
    stops |= is_abrupt
    edges = [0, *(np.flatnonzero(stops) + 1).tolist(), len(is_still)]
    yield from (list(range(first, last)) for first, last in itertools.pairwise(edges))


def _follow_waypoints(
    points: Floats,
    limits: Limits,
    scale: Floats,
    rolling: RollingLimits,
    torque_bounds: TorqueBounds | None,
) -> list[tuple[Curve, Ints]]:
    """Return curves through waypoints, shape (m, n), from stop to stop."""
    bounds = limits.lower, limits.upper
    if not rolling.is_omnidirectional:
        return list(
            _follow_rolling_paths(
                points, limits.with_wheels(rolling), scale, rolling, torque_bounds
            )
        )
    result = _retime_path(fit_path(points, scale, bounds), points, limits, torque_bounds)
    if result is not None:
        return [result]
    if not limits.has_unlimited_jerk:
        steps = map(np.array, itertools.pairwise(points))
        return [
            _follow_step(fit_path(step, scale, bounds), step, limits, torque_bounds, k)
            for k, step in enumerate(steps)
        ]
    straight = _make_straight_curve(points, limits, np.zeros(len(points) - 1))
    straight = straight if torque_bounds is None else torque_bounds.slow_down(straight)
    return [(straight, np.arange(1, len(points)))]


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
    bounds, begin = (limits.lower[:-2], limits.upper[:-2]), 0
    for path, waypoints in fit_rolling_paths(points, scale, bounds, rolling, refinement):
        bounds_of_path = (
            None if torque_bounds is None else torque_bounds.select_steps(begin, len(waypoints) - 1)
        )
        begin += len(waypoints) - 1
        result = _retime_path(path, waypoints, limits, bounds_of_path)
        if result is None:
            for k in range(len(waypoints) - 1):
                ((path, step),) = fit_rolling_paths(
                    waypoints[k : k + 2], scale, bounds, rolling, _MAX_REFINEMENT
                )
                yield _follow_step(path, step, limits, bounds_of_path, k)
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
    knots = (len(path.x) - 1) // (len(points) - 1)  # a step
    parts = knots * max(_MIN_PIECES // knots, 1)
    places = sample_intervals(path.x, np.arange(parts // knots) / (parts // knots), last=True)
    speeds = compute_speeds(path, places, limits.velocity, limits.acceleration)
    if speeds is None:
        return None
    curve, waypoints = _follow_at_speeds(path, places, points, speeds, limits)
    if (
        torque_bounds is None
        or np.abs(torque_bounds.evaluate(curve)).max() <= 1.0
        or np.abs(torque_bounds.decompose(curve)[0]).max() >= 1.0
    ):
        return curve, waypoints  # torques are kept, or exceeded even at rest
    for _ in range(_TORQUE_ITERATIONS):  # viscous torques are linearised around the last speeds
        linear = partial(torque_bounds.linearize, path, places, speeds)
        slower = compute_speeds(path, places, limits.velocity, limits.acceleration, linear)
        if slower is None:
            break
        converged, speeds = np.allclose(slower, speeds, rtol=_TORQUE_TOLERANCE), slower
        if converged:
            break
    curve, waypoints = _follow_at_speeds(path, places, points, speeds, limits)
    return torque_bounds.slow_down(curve), waypoints


def _follow_at_speeds(
    path: CubicPath, places: Floats, points: Floats, speeds: Floats, limits: Limits
) -> tuple[Curve, Ints]:
    """Return the curve along a path at given speeds, and the waypoints' knots."""
    times = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(places) / (speeds[1:] + speeds[:-1]))])
    return _follow_at_pace(path, Curve(times, places[:, None], speeds[:, None]), points, limits)


def _follow_at_pace(
    path: CubicPath, pace: Curve, points: Floats, limits: Limits
) -> tuple[Curve, Ints]:
    """Return the curve along a path at a pace, or slower, and the knots of the waypoints."""
    if limits.has_unlimited_jerk:
        places = pace.positions[:, 0]
        curve = limits.slow_down(Curve(pace.times, path(places), path(places, 1) * pace.rates))
    else:
        curve = limit_jerk(path, pace, len(points) - 1, limits)
    size, positions = points.shape[1], np.array(curve.positions[:, : points.shape[1]])
    parts = (len(positions) - 1) // (len(points) - 1)
    positions[::parts] = points  # bit-exact
    return Curve(curve.times, positions, curve.rates[:, :size]), np.arange(1, len(points)) * parts


def _follow_step(
    path: CubicPath,
    points: Floats,
    limits: Limits,
    torque_bounds: TorqueBounds | None,
    number: int,
) -> tuple[Curve, Ints]:
    """Return the curve of step `number` between waypoints, (2, n), with progress 3s² − 2s³."""
    length, share = path.x[-1], np.linspace(0.0, 1.0, len(path.x))
    places = length * (3.0 - 2.0 * share) * share**2
    speeds = length * 6.0 * (share - share**2) / _WAIT_DURATION
    pace = Curve(share * _WAIT_DURATION, places[:, None], speeds[:, None])
    curve, at = _follow_at_pace(path, pace, points, limits)
    if torque_bounds is not None:
        curve = torque_bounds.select_steps(number, 1).slow_down(curve)
    return curve, at


def _make_straight_curve(points: Floats, limits: Limits, least: Floats) -> Curve:
    """Return straight lines through waypoints, shape (m, n), with a stop at each waypoint.

    3s² − 2s³ has a peak velocity of 1.5 and a peak acceleration of 6, which is attained in a jump.
    With jerk limits the acceleration is therefore almost zero.
    """
    distances = np.abs(np.diff(points, axis=0))
    acceleration = limits.acceleration * (1.0 if limits.has_unlimited_jerk else _JUMP_RATIO)
    least = np.maximum.reduce(
        [
            least,
            1.5 * (distances / limits.velocity).max(axis=1),
            np.sqrt(6.0 * (distances / acceleration).max(axis=1)),
            np.cbrt(12.0 * (distances / limits.jerk).max(axis=1)),
        ]
    )
    times = np.concatenate([[0.0], np.cumsum(np.maximum(least, MIN_INTERVAL) * (1.0 + _ROUNDING))])
    return Curve(times, points, np.zeros_like(points))
