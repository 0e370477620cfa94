"""Waypoints as a smooth motion in time, as fast as the limits let it be."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.planning.base_paths.arcs import between
from vkc_pin.planning.retiming.jerk_limits import eased
from vkc_pin.planning.retiming.limits import Limits
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds
from vkc_pin.planning.retiming.torque_bounds import Load
from vkc_pin.planning.retiming.wheeled_paths import fit_rolling_paths, slip
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import MIN_INTERVAL, Curve, concatenate_curves, sample_intervals
from vkc_pin.world.trajectory.dynamics.torques import Torques
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import RollingLimits, make_rolling_limits

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

__all__ = ["retime_trajectory"]

_PARTS = 3  # pieces of a step in which the speed along the path changes evenly
_STILL = 1e-6  # [m] or [rad] of a step in which a joint of an object stays where it is
_SHORT = 1e-6  # share of a second at full speed that a step takes which is none
_SHORTEST = 1e-3  # [s] of a step in which nothing moves, unless a hand opens or closes in it
_ROUNDING = 1e-9  # relative
_JUMP = 1e-4  # of an acceleration, as a share of its limit, that is none
_PASSES, _SETTLED = (
    4,
    0.02,
)  # of the search for speeds that torques allow, and how far apart two are, relative, that end it
# [m/s] aside for which a base on wheels gets no more knots, a fifth of what counts as slipping
_SLIP = 2e-4
_FINEST = 8  # times as many of them, at most


def retime_trajectory(
    scene: Scene, trajectory: Trajectory, parts: Ints | None = None, *, jerk_time: float = 0.0
) -> Trajectory:
    """Return a motion along smooth curves through the same waypoints, from rest to rest, as fast as its limits let it be.

    It rests where it does not move from one waypoint to the next; if a phase begins with that, as
    where a hand opens or closes, for as long as it did. It stops where a joint of an object begins
    or ceases to move: there, the hand that has it turns a corner. Between two rests it goes along
    one path, see `fit_path`, at the speeds of `compute_speeds`; where none are known, straight
    from waypoint to waypoint, with a stop at each. A base on wheels goes along `fit_rolling_paths`. The
    cubics in time through the places at which speeds are known are slowed down until they keep the
    limits of velocity and acceleration exactly, and of torque where these can be kept at all. With
    limits of jerk they are `eased`.

    Args:
        scene: Robot and objects.
        trajectory: The waypoints, with as much time as they please.
        parts: Into how many parts the straight line between two waypoints is cut, at whose ends the
            path passes, too, shape (T − 1,); None: one. The more of them, the less the path leaves
            the straight line.
        jerk_time: See `Options.jerk_time`.
    """
    limits, parts = (
        Limits.of(scene, trajectory.names, jerk_time),
        np.ones(len(trajectory.times) - 1, int) if parts is None else parts,
    )
    rolling = make_rolling_limits(scene.robot)
    places = np.concatenate(
        [[0], np.cumsum(parts)]
    )  # of the waypoints, among all points that the path passes
    positions = _divided(trajectory.positions, places, rolling)
    scale = 1.0 / np.where(np.isfinite(limits.velocity), limits.velocity, 1.0)
    still = np.linalg.norm(np.diff(positions, axis=0) * scale, axis=1) <= _SHORT
    waits = {
        int(places[phase.first]): float(np.diff(trajectory.times)[phase.first])
        for phase in trajectory.phases
    }
    pieces, ends, torques = list[Curve](), [0], Torques(scene, trajectory)
    phases = torques.phases_of(np.searchsorted(places, np.arange(places[-1]), side="right") - 1)
    for steps in _runs(
        still, np.abs(np.diff(positions[:, trajectory.robot_size :], axis=0)) > _STILL
    ):
        points = positions[steps[0] : steps[-1] + 2]
        if still[steps[0]]:
            least = np.array([waits.get(step, _SHORTEST) for step in steps])
            found = [(_straight(points, limits, least), np.arange(1, len(points)))]
        else:
            found = _along(
                points,
                limits,
                scale,
                rolling,
                Load(torques, phases[steps]) if torques.torque_limits.known else None,
            )
        for piece, at in found:
            ends += (ends[-1] + at).tolist()
            pieces.append(piece)
    curve = concatenate_curves(pieces).shift_time(float(trajectory.times[0]))
    return replace(trajectory, times=curve.times[np.array(ends)[places]], curve=curve)


def _divided(positions: Floats, places: Ints, rolling: RollingLimits) -> Floats:
    """Return waypoints, shape (T, n), and points on the straight lines between them, or, of a base on wheels, on the arcs.

    Args:
        positions: The waypoints.
        places: Which of the points they are to be, shape (T,).
        rolling: How the base moves.
    """
    at = np.interp(np.arange(places[-1] + 1), places, np.arange(len(places)))
    points = np.stack(
        [np.interp(np.arange(places[-1] + 1), places, column) for column in positions.T], axis=-1
    )
    if rolling.is_omnidirectional or len(points) == len(positions):
        return points
    step = np.minimum(at.astype(int), len(positions) - 2)
    points[:, :3] = between(positions[step, :3], positions[step + 1, :3], at - step)
    return points


def _runs(still: Bools, moves: Bools) -> Iterator[list[int]]:
    """Yield the steps between rests, or of one: see `retime_trajectory`.

    Args:
        still: In which steps nothing moves, shape (N,).
        moves: In which steps each joint of an object moves, shape (N, k).
    """
    stops = (moves[1:] != moves[:-1]).any(axis=1) | (still[1:] != still[:-1])
    edges = [0, *(np.flatnonzero(stops) + 1).tolist(), len(still)]
    yield from (list(range(first, last)) for first, last in itertools.pairwise(edges))


def _along(
    points: Floats, limits: Limits, scale: Floats, rolling: RollingLimits, load: Load | None
) -> list[tuple[Curve, Ints]]:
    """Return curves through waypoints, shape (m, n), from stop to stop, and which of their knots these are but for the first."""
    bounds = limits.lower, limits.upper
    if not rolling.is_omnidirectional:
        return list(_rolling(points, limits.with_wheels(rolling), scale, rolling, load))
    found = _smooth(fit_path(points, scale, bounds), points, limits, load)
    if found is not None:
        return [found]
    if not limits.jerky:
        steps = [
            _stepping(fit_path(step, scale, bounds), step, limits)
            for step in map(np.array, itertools.pairwise(points))
        ]
        return [
            (curve if load is None else load.part(k, 1).slowed(curve), at)
            for k, (curve, at) in enumerate(steps)
        ]
    straight = _straight(points, limits, np.zeros(len(points) - 1))
    return [(straight if load is None else load.slowed(straight), np.arange(1, len(points)))]


def _rolling(
    points: Floats,
    limits: Limits,
    scale: Floats,
    rolling: RollingLimits,
    load: Load | None,
    finer: int = 1,
) -> Iterator[tuple[Curve, Ints]]:
    """Yield the same of a base on wheels, with so many times the usual knots, or more where it would slip between them."""
    bounds, begin = (limits.lower[:-2], limits.upper[:-2]), 0
    for path, own in fit_rolling_paths(points, scale, bounds, rolling, finer):
        part = None if load is None else load.part(begin, len(own) - 1)
        begin += len(own) - 1
        found = _smooth(path, own, limits, part)
        if found is None:
            for k in range(len(own) - 1):
                ((path, step),) = fit_rolling_paths(own[k : k + 2], scale, bounds, rolling, _FINEST)
                curve, at = _stepping(path, step, limits)
                yield curve if part is None else part.part(k, 1).slowed(curve), at
        elif finer < _FINEST and slip(found[0]) > _SLIP:
            yield from _rolling(own, limits, scale, rolling, part, 2 * finer)
        else:
            yield found


def _smooth(
    path: CubicHermiteSpline, points: Floats, limits: Limits, load: Load | None
) -> tuple[Curve, Ints] | None:
    """Return a curve along a path through waypoints, shape (m, n), see `_along`; None: how fast it can be is not known.

    The path, and the limits, may have further columns that are none of the motion's. Torques are
    looked at when the curve is known that limits of velocity and acceleration allow: hardly any
    exceeds them.
    """
    knots = (len(path.x) - 1) // (len(points) - 1)  # a step
    parts = knots * max(_PARTS // knots, 1)
    places = sample_intervals(path.x, np.arange(parts // knots) / (parts // knots), last=True)
    speeds = compute_speeds(path, places, limits.velocity, limits.acceleration)
    if speeds is None:
        return None
    curve, waypoints = _timed(path, places, points, speeds, limits)
    if (
        load is None
        or np.abs(load.of(curve)).max() <= 1.0
        or np.abs(load.split(curve)[0]).max() >= 1.0
    ):
        return curve, waypoints  # or it is too heavy however slow it is
    for _ in range(
        _PASSES
        # drag is not linear in the square of the speed: it is taken as it is around the speed before
    ):
        linear = partial(load.linear, path, places, speeds)
        slower = compute_speeds(path, places, limits.velocity, limits.acceleration, linear)
        if slower is None:
            break
        settled, speeds = np.allclose(slower, speeds, rtol=_SETTLED), slower
        if settled:
            break
    curve, waypoints = _timed(path, places, points, speeds, limits)
    return load.slowed(curve), waypoints


def _timed(
    path: CubicHermiteSpline, places: Floats, points: Floats, speeds: Floats, limits: Limits
) -> tuple[Curve, Ints]:
    """Return a path through waypoints, shape (m, n), gone along with speeds at places, shape (K,), and the waypoints' knots."""
    times = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(places) / (speeds[1:] + speeds[:-1]))])
    return _paced(path, Curve(times, places[:, None], speeds[:, None]), points, limits)


def _paced(
    path: CubicHermiteSpline, pace: Curve, points: Floats, limits: Limits
) -> tuple[Curve, Ints]:
    """Return a path through waypoints, shape (m, n), gone along at a pace, or slower, and the waypoints' knots."""
    if limits.jerky:
        places = pace.positions[:, 0]
        curve = limits.slowed(Curve(pace.times, path(places), path(places, 1) * pace.rates))
    else:
        curve = eased(path, pace, len(points) - 1, limits)
    size, positions = points.shape[1], np.array(curve.positions[:, : points.shape[1]])
    parts = (len(positions) - 1) // (len(points) - 1)
    positions[::parts] = points  # to the last bit
    return Curve(curve.times, positions, curve.rates[:, :size]), np.arange(1, len(points)) * parts


def _stepping(path: CubicHermiteSpline, points: Floats, limits: Limits) -> tuple[Curve, Ints]:
    """Return a curve along a path from one waypoint to the next, shape (2, n), between which it is 3s² − 2s³ of the way."""
    length, share = path.x[-1], np.linspace(0.0, 1.0, len(path.x))
    places, speeds = (
        length * (3.0 - 2.0 * share) * share**2,
        length * 6.0 * (share - share**2) / _SHORTEST,
    )
    return _paced(path, Curve(share * _SHORTEST, places[:, None], speeds[:, None]), points, limits)


def _straight(points: Floats, limits: Limits, least: Floats) -> Curve:
    """Return the straight way through waypoints, shape (m, n), that takes at least so long a step, shape (m − 1,) [s].

    It rests at each: 3s² − 2s³ has a speed of 1.5 at most, and a change of it by 6, at once, to
    which with limits of jerk there is next to nothing.
    """
    ways = np.abs(np.diff(points, axis=0))
    strongest = limits.acceleration * (1.0 if limits.jerky else _JUMP)
    least = np.maximum.reduce(
        [
            least,
            1.5 * (ways / limits.velocity).max(axis=1),
            np.sqrt(6.0 * (ways / strongest).max(axis=1)),
            np.cbrt(12.0 * (ways / limits.jerk).max(axis=1)),
        ]
    )
    times = np.concatenate([[0.0], np.cumsum(np.maximum(least, MIN_INTERVAL) * (1.0 + _ROUNDING))])
    return Curve(times, points, np.zeros_like(points))
