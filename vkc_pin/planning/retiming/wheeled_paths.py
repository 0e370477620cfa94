"""Smooth paths of a base on wheels through waypoints: it rolls all along, not only from one to the next."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.trajectory.curve import Curve, sample_intervals
from vkc_pin.world.trajectory.wheels import RollingLimits, rotate_into_base_frame

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

__all__ = ["fit_rolling_paths", "slip"]

_PARTS = 3  # pieces of a step, at least
_TURN = 0.05  # [rad] of a piece, at most
_ROUNDS = 12  # of Newton's method
# error of a place that is as bad as a bump of the way, so that none comes of rounding where the
# base stands
_STIFF = 1e-3
_LEVER = 0.5  # [m/rad]: bump of the way that is as bad as one of the heading
_LOOKS = 8  # moments on each cubic of a curve
_NOWHERE = 1e-9  # [m] that is no way
_OFF = 1e-5  # [m] by which the places may be missed; the rest is spread over the step
_ROUNDING = 2e-6  # [m] of a place that no bump is worth if it makes a turn too tight
_TIGHT = 3e-4  # share by which a turn may be tighter than the least radius, to allow for rounding


def fit_rolling_paths(
    points: Floats,
    scale: Floats,
    limits: tuple[Floats, Floats],
    rolling: RollingLimits,
    finer: int = 1,
) -> list[tuple[CubicHermiteSpline, Floats]]:
    """Return paths through waypoints, one from each stop to the next, on which a base rolls, each with its waypoints.

    How far it has driven, ℓ, and where it heads, θ, are cubics between waypoints, as all other
    coordinates are, and its place is the integral of (cos θ, sin θ) dℓ. For that to lead to the
    next waypoint, the length of the step and bumps of ℓ and θ inside it, in 16s²(1 − s)², are found
    by Newton's method, as small as can be: the arc from the one waypoint to the next is near. Knots
    are so close to each other that cubics through them roll, too.

    A base that is steered stops, and turns its wheels, where it cannot go from arc to arc without
    turning too tightly. From stop to stop there may be one step only, which is the arc itself.

    Args:
        points: (x, y, yaw) of the base, and other coordinates, shape (m, n), m ≥ 2; the arcs
            between them are what it can drive.
        scale: What a unit of each coordinate counts for the length, shape (n,).
        limits: Lower and upper, shape (n,) each.
        rolling: The limits of the base.
        finer: How many times as many knots there are as usual.

    Returns:
        Paths, see `fit_path`, with as many knots in every step, of the n coordinates, and of
        how far left and right wheels have gone [m], which are none of the motion's, but have a
        limit of their own.
    """
    if rolling.turning_radius > 0.0 and (backs := _backs(points, rolling)):
        pieces = [
            points[first : last + 1]
            for first, last in itertools.pairwise([0, *backs, len(points) - 1])
        ]
    else:
        path, wrong = _rolled(points, scale, limits, rolling, finer)
        if len(points) == 2 or not wrong.any():
            return [(path, points)]
        corner = _corner(points, wrong, rolling)
        pieces = [points[: corner + 1], points[corner:]]
    return [
        found
        for piece in pieces
        for found in fit_rolling_paths(piece, scale, limits, rolling, finer)
    ]


def slip(curve: Curve) -> float:
    """Return how fast the base moves aside at most [m/s]."""
    moments = sample_intervals(curve.times, np.arange(_LOOKS) / _LOOKS)
    (vx, vy), yaw = curve.velocity(moments)[:, :2].T, curve.at(moments)[:, 2]
    _, aside = rotate_into_base_frame(vx, vy, yaw)
    return float(np.abs(aside).max())


def _backs(points: Floats, rolling: RollingLimits) -> list[int]:
    """Return the waypoints at which the base changes between ahead and back, where one that is steered always stops."""
    ahead = rolling.compute_steps(points)[0] > 0.0
    return (1 + np.flatnonzero(ahead[1:] != ahead[:-1])).tolist()


def _corner(points: Floats, wrong: Bools, rolling: RollingLimits) -> int:
    """Return the waypoint to stop at: of the ends of wrong steps the one at which the base changes most how it drives."""
    along, _, turn = rolling.compute_steps(points)
    ways = np.column_stack([along, max(rolling.turning_radius, rolling.track / 2) * turn])
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    bends = np.linalg.norm(np.diff(ways, axis=0), axis=1)
    return 1 + int(np.argmax(np.where(wrong[1:] | wrong[:-1], bends, -1.0)))


def _rolled(
    points: Floats, scale: Floats, limits: tuple[Floats, Floats], rolling: RollingLimits, finer: int
) -> tuple[CubicHermiteSpline, Bools]:
    """Return the path, see `fit_rolling_paths`, without a stop, and in which steps it is none that the base can drive."""
    from scipy.interpolate import CubicHermiteSpline

    along, _, turn = rolling.compute_steps(points)
    driven = np.concatenate([[0.0], np.cumsum(along / np.sinc(turn / (2 * np.pi)))])
    bounds = (
        np.append(limits[0], np.inf),
        np.append(limits[1], -np.inf),
    )  # it goes back nowhere but where it turns round
    path = fit_path(np.column_stack([points, driven]), np.append(scale, 0.0), bounds)
    parts = finer * max(_PARTS, int(np.ceil(np.abs(turn).max() / _TURN)))
    slopes = path(path.x, 1)[:, [2, -1]]
    if rolling.turning_radius > 0.0:
        slopes[:, 0] = _bends(turn, np.diff(driven), rolling.turning_radius) * slopes[:, 1]
    steps = _Steps(points[:, :3], slopes, np.diff(path.x), np.diff(driven), parts)
    # An arc is where it should be but for rounding, of which bumps would make tight turns where a
    # step is short.
    left = steps.missing() if len(points) == 2 else steps.fit()
    if rolling.turning_radius > 0.0 and (bent := steps.tight(rolling.turning_radius)).any():
        left = steps.plain(bent)
    at = sample_intervals(path.x, np.arange(parts) / parts, last=True)
    base, slopes, wheels = steps.at_knots(left)
    half = rolling.track / 2 * np.array([-1.0, 1.0])
    values = np.column_stack([base, path(at)[:, 3:-1], wheels[0][:, None] + half * base[:, 2:]])
    rates = np.column_stack(
        [slopes, path(at, 1)[:, 3:-1], wheels[1][:, None] + half * slopes[:, 2:]]
    )
    return CubicHermiteSpline(at, values, rates), (np.abs(left) > _OFF) | steps.tight(
        rolling.turning_radius
    )


def _bends(turns: Floats, ways: Floats, radius: float) -> Floats:
    """Return how much a path bends at waypoints, shape (m,) [rad/m], so that no step between turns tighter than need be.

    A step that bends by κ in the middle of what it goes, and by a and b at its ends, bends by 3/2·κ
    − (a + b)/4 half-way: no more than 1/r if both are at least 3κ − 2/r. Where steps before and
    after ask for no less than that, it is the mean of both.

    Args:
        turns: Of the steps, shape (m − 1,) [rad].
        ways: How far they go, shape (m − 1,) [m].
        radius: The least of the turns, r [m].
    """
    bends = radius * turns / np.where(np.abs(ways) > _NOWHERE, ways, np.inf)
    least, most = np.minimum(3.0 * bends - 2.0, 1.0), np.maximum(3.0 * bends + 2.0, -1.0)
    lengths = np.maximum(np.abs(ways), _NOWHERE)
    mean = (bends[:-1] * lengths[1:] + bends[1:] * lengths[:-1]) / (lengths[1:] + lengths[:-1])
    inner = np.clip(mean, np.maximum(least[:-1], least[1:]), np.minimum(most[:-1], most[1:]))
    return np.concatenate([bends[:1], inner, bends[-1:]]) / radius


class _Steps:
    """The steps of a base from pose to pose, over s from 0 to 1 each.

    Args:
        poses: (x, y, yaw), shape (N + 1, 3).
        slopes: Of yaw and of the way driven along the path, at the poses, shape (N + 1, 2).
        spans: Of the steps along the path, shape (N,).
        ways: How far it drives in each, shape (N,) [m].
        parts: Pieces of a step, between whose ends the knots will be.
    """

    def __init__(
        self, poses: Floats, slopes: Floats, spans: Floats, ways: Floats, parts: int
    ) -> None:
        self.poses, self.spans, self.parts = poses, spans[:, None], parts
        self.yaw, self.way = (
            [column[:-1, None] * self.spans, column[1:, None] * self.spans] for column in slopes.T
        )
        self.ways = self._driven = ways[:, None]
        self.hops, self.bumps = np.zeros((len(ways), 1)), np.zeros((len(ways), 1))
        nodes, weights = np.polynomial.legendre.leggauss(5)
        self._inside = ((np.arange(parts)[:, None] + (nodes + 1) / 2) / parts).ravel()
        self._weights = np.tile(weights / (2 * parts), parts)

    def heading(self, s: Floats) -> tuple[Floats, Floats]:
        """Return the yaw, and its slope, at places s, shape (K,): (N, K) each."""
        before, change = self.poses[:-1, 2:], np.diff(self.poses[:, 2:], axis=0)
        value, slope = _hermite(s, change, *self.yaw)
        return before + value + self.bumps * _bump(s)[0], slope + self.bumps * _bump(s)[1]

    def driven(self, s: Floats) -> tuple[Floats, Floats]:
        """Return how far it has driven in each step at places s, and the slope of that, (N, K) each."""
        (value, slope), (bump, rise) = _hermite(s, self.ways, *self.way), _bump(s)
        return value + self.hops * bump, slope + self.hops * rise

    def fit(self) -> Floats:
        """Let the steps lead from each place to the next; return what is missing, x + iy, shape (N,) [m]."""
        s, w = self._inside, self._weights
        cost = np.array([0.0, _STIFF**2, (_STIFF * _LEVER) ** 2])
        for _ in range(_ROUNDS):
            turned, missing = np.exp(1j * self.heading(s)[0]), self.missing()
            longer, further = turned @ (w * 6.0 * (s - s**2)), turned @ (w * _bump(s)[1])
            bent = 1j * (self.driven(s)[1] * turned) @ (w * _bump(s)[0])
            effects = np.stack([longer, further, bent], axis=1)
            slopes = np.stack([effects.real, effects.imag], axis=1)
            found = np.stack([0.0 * self.ways, self.hops, self.bumps], axis=1)[..., 0]
            across = np.swapaxes(slopes, 1, 2)
            wanted = (across @ np.stack([missing.real, missing.imag], axis=1)[..., None])[
                ..., 0
            ] - cost * found
            change = np.linalg.solve(across @ slopes + np.diag(cost), wanted[..., None])
            self.ways, self.hops, self.bumps = (
                self.ways + change[:, 0],
                self.hops + change[:, 1],
                self.bumps + change[:, 2],
            )
            if np.abs(change).max() < 1e-12:
                break
        return self.missing()

    def plain(self, which: Bools) -> Floats:
        """Take back what `fit` did to some steps, shape (N,), if next to nothing is missing without it; return what is then.

        A bump that makes up for rounding bends a short step as much as a turn.
        """
        fitted = self.ways, self.hops, self.bumps
        self.ways, self.hops, self.bumps = self._driven, 0.0 * self.hops, 0.0 * self.bumps
        back = (which & (np.abs(self.missing()) < _ROUNDING))[:, None]
        plain = self.ways, self.hops, self.bumps
        self.ways, self.hops, self.bumps = (
            np.where(back, new, old) for new, old in zip(plain, fitted, strict=True)
        )
        return self.missing()

    def missing(self) -> Floats:
        """Return how much further it should come in each step, x + iy, shape (N,) [m]."""
        dx, dy = np.diff(self.poses[:, :2], axis=0).T
        return np.asarray(dx + 1j * dy - self._moving() @ self._weights)

    def _moving(self) -> Floats:
        return np.asarray(self.driven(self._inside)[1] * np.exp(1j * self.heading(self._inside)[0]))

    def at_knots(self, left: Floats) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """Return poses at the knots and their slopes, shape (K, 3), and how far it has driven there, with slopes, shape (K,)."""
        s = np.arange(self.parts + 1) / self.parts
        pieces = (
            (self._moving() * self._weights).reshape(len(self.spans), self.parts, -1).sum(axis=2)
        )
        gone = np.concatenate([np.zeros((len(pieces), 1)), np.cumsum(pieces, axis=1)], axis=1)
        place = (
            (self.poses[:-1, :1] + 1j * self.poses[:-1, 1:2])
            + gone
            + left[:, None] * (3.0 - 2.0 * s) * s**2
        )
        (yaw, turning), (way, speed) = self.heading(s), self.driven(s)
        begun = np.concatenate([[[0.0]], np.cumsum(self.ways, axis=0)[:-1]])
        moving = speed * np.exp(1j * yaw)
        values = [_joined(part) for part in (place.real, place.imag, yaw, begun + way)]
        slopes = [_joined(part / self.spans) for part in (moving.real, moving.imag, turning, speed)]
        return np.column_stack(values[:3]), np.column_stack(slopes[:3]), (values[3], slopes[3])

    def tight(self, radius: float) -> Bools:
        """Return which steps turn tighter than on a radius [m], shape (N,)."""
        s = np.linspace(0.0, 1.0, 8 * self.parts + 1)
        (_, turning), (_, speed) = self.heading(s), self.driven(s)
        return np.asarray(
            (radius * np.abs(turning) > (1.0 + _TIGHT) * np.abs(speed) + 1e-9).any(axis=1)
        )


def _hermite(s: Floats, change: Floats, before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """Return what cubics from 0 to `change` with these slopes at their ends, (N, 1) each, have at s, and their slopes, (N, K)."""
    value = change * (3.0 - 2.0 * s) * s**2 + before * s * (1.0 - s) ** 2 - after * s**2 * (1.0 - s)
    slope = (
        change * 6.0 * (s - s**2)
        + before * (1.0 - 4.0 * s + 3.0 * s**2)
        + after * (3.0 * s**2 - 2.0 * s)
    )
    return value, slope


def _bump(s: Floats) -> tuple[Floats, Floats]:
    """Return 16s²(1 − s)², which is flat at both ends and 1 between, and its slope."""
    return 16.0 * (s * (1.0 - s)) ** 2, 32.0 * s * (1.0 - s) * (1.0 - 2.0 * s)


def _joined(parts: Floats) -> Floats:
    """Return values at the knots of every step, shape (N, parts + 1), as one row without those that are there twice."""
    return np.append(parts[:, :-1].ravel(), parts[-1, -1])
