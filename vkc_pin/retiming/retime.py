"""Waypoints as a smooth motion in time, as fast as the limits let it be."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vkc_pin.arrays import Bools, Floats, Ints
from vkc_pin.motion.curve import SHORTEST, Curve, joined
from vkc_pin.motion.dynamics.torques import Torques
from vkc_pin.motion.trajectory import Trajectory
from vkc_pin.retiming.loads import Load
from vkc_pin.retiming.parametrization import speeds_along
from vkc_pin.retiming.path import path_through
from vkc_pin.scene.scene import Scene

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

__all__ = ["retimed"]

_PARTS = 3  # pieces of a step in which the speed along the path changes evenly
_PASSES, _SETTLED = 4, 0.02  # of the search for speeds that torques allow, and how far apart two are, relative, that end it
_STILL = 1e-6  # [m] or [rad] of a step in which a joint of an object stays where it is
_SHORT = 1e-6  # share of a second at full speed that a step takes which is none
_SHORTEST = 1e-3  # [s] of a step in which nothing moves, unless a hand opens or closes in it
_ROUNDING = 1e-9  # relative


class _Limits(NamedTuple):
    """Limits of coordinates, shape (n,) each, SI units."""

    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats

    @classmethod
    def of(cls, scene: Scene, names: Sequence[str]) -> _Limits:
        """Return the limits (eqs. 4 and 5) of the robot's coordinates and "<object>.<joint>"; freedoms of grasps have none."""
        robot, known = scene.robot, dict[str, tuple[float, ...]]()
        sources = [("", robot.coordinates.names, (robot.lower, robot.upper, robot.velocity, robot.acceleration))]
        for owner, placed in scene.objects.items():
            item = placed.object
            sources.append((f"{owner}.", item.coordinates.names, (item.lower, item.upper, item.velocity, item.acceleration)))
        for prefix, own, values in sources:
            known |= {prefix + name: tuple(row) for name, row in zip(own, np.transpose(values).tolist(), strict=True)}
        return cls(*np.array([known.get(name, (-np.inf, np.inf, np.inf, np.inf)) for name in names]).T)


def retimed(scene: Scene, trajectory: Trajectory, parts: Ints | None = None) -> Trajectory:
    """Return a motion along smooth curves through the same waypoints, from rest to rest, as fast as its limits let it be.

    It rests where it does not move from one waypoint to the next; if a phase begins with that, as where a hand opens or closes,
    for as long as it did. It stops where a joint of an object begins or ceases to move: there, the hand that has it turns a
    corner. Between two rests it goes along one path, see `path_through`, at the speeds of `speeds_along`; where none are known,
    straight from waypoint to waypoint, with a stop at each. The cubics in time through the places at which speeds are known are
    slowed down until they keep the limits of velocity and acceleration exactly, and of torque where these can be kept at all.

    Args:
        scene: Robot and objects.
        trajectory: The waypoints, with as much time as they please.
        parts: Into how many parts the straight line between two waypoints is cut, at whose ends the path passes, too, shape
            (T − 1,); None: one. The more of them, the less the path leaves the straight line.
    """
    limits, parts = _Limits.of(scene, trajectory.names), np.ones(len(trajectory.times) - 1, int) if parts is None else parts
    places = np.concatenate([[0], np.cumsum(parts)])  # of the waypoints, among all points that the path passes
    positions = np.stack([np.interp(np.arange(places[-1] + 1), places, column) for column in trajectory.positions.T], axis=-1)
    scale = 1.0 / np.where(np.isfinite(limits.velocity), limits.velocity, 1.0)
    still = np.linalg.norm(np.diff(positions, axis=0) * scale, axis=1) <= _SHORT
    waits = {int(places[phase.first]): float(np.diff(trajectory.times)[phase.first]) for phase in trajectory.phases}
    pieces, ends, torques = list[Curve](), [0], Torques(scene, trajectory)
    phases = torques.phases_of(np.searchsorted(places, np.arange(places[-1]), side="right") - 1)
    for steps in _runs(still, np.abs(np.diff(positions[:, trajectory.robot_size :], axis=0)) > _STILL):
        rests = bool(still[steps[0]])
        points = positions[steps[0] : steps[-1] + 2]
        known = torques.efforts.known and not rests
        found = None if rests else _smooth(points, limits, scale, Load(torques, phases[steps], _PARTS) if known else None)
        if found is None:
            least = [waits.get(step, _SHORTEST) if rests else 0.0 for step in steps]
            straight = _straight(points, limits, np.array(least))
            found = Load(torques, phases[steps], 1).slowed(straight) if known else straight, np.arange(1, len(points))
        ends += (ends[-1] + found[1]).tolist()
        pieces.append(found[0])
    curve = joined(pieces).shifted(float(trajectory.times[0]))
    return replace(trajectory, times=curve.times[np.array(ends)[places]], curve=curve)


def _runs(still: Bools, moves: Bools) -> Iterator[list[int]]:
    """Yield the steps between rests, or of one: see `retimed`.

    Args:
        still: In which steps nothing moves, shape (N,).
        moves: In which steps each joint of an object moves, shape (N, k).
    """
    stops = (moves[1:] != moves[:-1]).any(axis=1) | (still[1:] != still[:-1])
    edges = [0, *(np.flatnonzero(stops) + 1).tolist(), len(still)]
    yield from (list(range(first, last)) for first, last in itertools.pairwise(edges))


def _smooth(points: Floats, limits: _Limits, scale: Floats, load: Load | None) -> tuple[Curve, Ints] | None:
    """Return a curve through waypoints, shape (m, n), and which of its knots they are but for the first; None: not known.

    Torques are looked at when the curve is known that limits of velocity and acceleration allow: hardly any exceeds them.
    """
    path = path_through(points, scale, (limits.lower, limits.upper))
    shares = np.arange(_PARTS) / _PARTS
    places = np.append((path.x[:-1, None] + np.diff(path.x)[:, None] * shares).ravel(), path.x[-1])
    speeds = speeds_along(path, places, limits.velocity, limits.acceleration)
    if speeds is None:
        return None
    waypoints = np.arange(1, len(points)) * _PARTS
    curve = _timed(path, places, points, speeds, limits)
    if load is None or np.abs(load.of(curve)).max() <= 1.0 or np.abs(load.split(curve)[0]).max() >= 1.0:
        return curve, waypoints  # or it is too heavy however slow it is
    for _ in range(_PASSES):  # drag is not linear in the square of the speed: it is taken as it is around the speed before
        linear = partial(load.linear, path, places, speeds)
        slower = speeds_along(path, places, limits.velocity, limits.acceleration, linear)
        if slower is None:
            break
        settled, speeds = np.allclose(slower, speeds, rtol=_SETTLED), slower
        if settled:
            break
    return load.slowed(_timed(path, places, points, speeds, limits)), waypoints


def _timed(path: CubicHermiteSpline, places: Floats, points: Floats, speeds: Floats, limits: _Limits) -> Curve:
    """Return a path gone along with speeds at places, shape (K,), every `_PARTS`-th of which is one of its points."""
    times = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(places) / (speeds[1:] + speeds[:-1]))])
    knots = path(places)
    knots[::_PARTS] = points  # to the last bit
    return _slowed(Curve(times, knots, path(places, 1) * speeds[:, None]), limits)


def _straight(points: Floats, limits: _Limits, least: Floats) -> Curve:
    """Return the straight way through waypoints, shape (m, n), that takes at least so long a step, shape (m − 1,) [s].

    It rests at each: 3s² − 2s³ has a speed of 1.5 at most, and a change of it by 6.
    """
    ways = np.abs(np.diff(points, axis=0))
    least = np.maximum.reduce(
        [least, 1.5 * (ways / limits.velocity).max(axis=1), np.sqrt(6.0 * (ways / limits.acceleration).max(axis=1))]
    )
    times = np.concatenate([[0.0], np.cumsum(np.maximum(least, SHORTEST) * (1.0 + _ROUNDING))])
    return Curve(times, points, np.zeros_like(points))


def _slowed(curve: Curve, limits: _Limits) -> Curve:
    """Return a curve as it is, or slower by the factor that it takes to keep the limits."""
    fastest, strongest = curve.speeds()
    factor = max(1.0, float((fastest / limits.velocity).max()), float(np.sqrt((strongest / limits.acceleration).max()))) * (
        1.0 + _ROUNDING
    )
    return Curve(curve.times * factor, curve.positions, curve.rates / factor)
