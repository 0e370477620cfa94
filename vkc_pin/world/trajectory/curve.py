"""Represents smooth motions as cubic Hermite splines in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_array
from vkc_pin.utils.arrays import Floats, Ints

MIN_INTERVAL = 1e-9
"""Shortest time between knots [s]."""
_MAX_DISTANCE = 1e-9  # accepted distance of the curve from a waypoint [m] or [rad]
_MAX_VALUE = 1e12  # largest position [m], [rad] and velocity [m/s], [rad/s]
_MIN_BEND = 1e-12  # [m/s] or [rad/s] of a velocity, below which it is linear in time


@dataclass(frozen=True)
class Curve:
    """A cubic Hermite spline in time.

    Controllers that receive positions and velocities interpolate the same curve, e.g. the joint
    trajectory controller of `ros2_control` ("cubic").

    Attributes:
        times: Increasing times of the knots, shape (K,) [s].
        positions: Positions at the knots, shape (K, n), [m] and [rad].
        rates: Velocities at the knots, shape (K, n), [m/s] and [rad/s].

    Raises:
        InputError: Numbers are not finite or out of range, shapes do not match, or times do not
            increase.
    """

    times: Floats
    positions: Floats
    rates: Floats

    def __post_init__(self) -> None:
        times = check_array(self.times, "curve.times")
        positions = check_array(self.positions, "curve.positions")
        rates = check_array(self.rates, "curve.rates")
        if times.ndim != 1 or len(times) < 2 or not np.all(np.diff(times) >= MIN_INTERVAL):
            expected = f"at least 2 numbers, each {MIN_INTERVAL:g} s after the one before or more"
            raise InputError("times do not increase", field="curve.times", expected=expected)
        if positions.ndim != 2 or len(positions) != len(times):
            expected = f"({len(times)}, n)"
            raise InputError(
                "wrong shape", field="curve.positions", expected=expected, got=positions.shape
            )
        if rates.shape != positions.shape:
            raise InputError(
                "wrong shape", field="curve.rates", expected=positions.shape, got=rates.shape
            )
        for name, array in (("times", times), ("positions", positions), ("rates", rates)):
            if not np.abs(array).max(initial=0.0) <= _MAX_VALUE:
                raise InputError(
                    "out of range", field=f"curve.{name}", expected=f"numbers up to {_MAX_VALUE:g}"
                )
            array = np.array(array, float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def at(self, time: ArrayLike) -> Floats:
        """Return positions, shape (..., n), at times [s], shape (...,), clamped to the curve."""
        return self._cubic(time, 0)

    def velocity(self, time: ArrayLike) -> Floats:
        """Return velocities, shape (..., n), at times [s], shape (...,); 0 outside the curve."""
        return self._cubic(time, 1)

    def acceleration(self, time: ArrayLike) -> Floats:
        """Return accelerations, shape (..., n), at times [s], shape (...,), right of knots."""
        return self._cubic(time, 2)

    def _cubic(self, time: ArrayLike, derivative: int) -> Floats:
        """Return positions, or their first or second derivative, at times of shape (...,).

        At the fraction s of the duration h of a cubic with the control points p, c, d, q, and with
        r = 1 - s, the derivatives by time are

            3/h (r² (c - p) + 2 s r (d - c) + s² (q - d))
            6/h² (r (p - 2 c + d) + s (c - 2 d + q))
        """
        moments = np.asarray(time, float)
        k = np.clip(np.searchsorted(self.times, moments, side="right") - 1, 0, len(self.times) - 2)
        h = np.diff(self.times)[k]
        s = (np.clip((moments - self.times[k]) / h, 0.0, 1.0))[..., None]
        h = h[..., None]
        p, c, d, q = self._control(k)
        if derivative == 0:
            return _bernstein(s, p, c, d, q)
        r = 1.0 - s
        if derivative == 1:
            values = 3.0 / h * (r**2 * (c - p) + 2.0 * s * r * (d - c) + s**2 * (q - d))
        else:
            values = 6.0 / h**2 * (r * (p - 2.0 * c + d) + s * (c - 2.0 * d + q))
        inside = ((moments >= self.times[0]) & (moments <= self.times[-1]))[..., None]
        return np.asarray(np.where(inside, values, 0.0))

    def _control(self, k: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the Bézier control points of cubics; each cubic lies in their convex hull."""
        third = (np.diff(self.times)[k] / 3.0)[..., None]
        p = self.positions[k]
        q = self.positions[k + 1]
        c = p + third * self.rates[k]
        d = q - third * self.rates[k + 1]
        return p, c, d, q

    def compute_extrema(self) -> tuple[Floats, Floats]:
        """Compute the exact smallest and largest positions on each cubic, shape (K − 1, n) each.

        They are at the ends, or where the velocity is zero. At the fraction s, this is h/3 times

            first (1 - s)² + 2 middle s (1 - s) + last s²

        with first = c - p, middle = d - c and last = q - d. The zeros are

            s = (first - middle ± root) / (first - 2 middle + last)
              = first / (first - middle ∓ root),    root² = middle² - first last

        of which the second form holds for a parabola that is a line, too.
        """
        p, c, d, q = self._control(np.arange(len(self.times) - 1))
        first = c - p
        middle = d - c
        last = q - d
        bend = first - 2.0 * middle + last
        root = np.sqrt(np.maximum(middle**2 - first * last, 0.0))
        extrema = [p, q]
        for sign in (-1.0, 1.0):
            numerator = first - middle + sign * root
            denominator = first - middle - sign * root
            zero = np.divide(first, denominator, out=np.zeros_like(p), where=denominator != 0.0)
            zero = np.divide(numerator, bend, out=zero, where=bend != 0.0)
            extrema.append(_bernstein(np.clip(zero, 0.0, 1.0), p, c, d, q))
        return np.asarray(np.min(extrema, axis=0)), np.asarray(np.max(extrema, axis=0))

    def compute_max_rates(self) -> tuple[Floats, Floats]:
        """Compute the exact largest |velocity| and |acceleration| of cubics, (K − 1, n) each.

        The velocity first (1 - s)² + 2 middle s (1 - s) + last s² is a parabola in the fraction s,
        with its vertex at s = (first - middle) / (first - 2 middle + last). The acceleration is
        linear, so that it is largest at an end.
        """
        h = np.diff(self.times)[:, None]
        p, c, d, q = self._control(np.arange(len(h)))
        first = 3.0 / h * (c - p)
        middle = 3.0 / h * (d - c)
        last = 3.0 / h * (q - d)
        bend = first - 2.0 * middle + last
        is_bent = np.abs(bend) > _MIN_BEND
        vertex = np.divide(first - middle, bend, out=np.full_like(bend, -1.0), where=is_bent)
        s = np.where((vertex > 0.0) & (vertex < 1.0), vertex, 0.0)
        between = (1.0 - s) ** 2 * first + 2.0 * s * (1.0 - s) * middle + s**2 * last
        fastest = np.max(np.abs([first, last, between]), axis=0)
        strongest = np.max(np.abs([2.0 / h * (middle - first), 2.0 / h * (last - middle)]), axis=0)
        return np.asarray(fastest), np.asarray(strongest)

    def compute_accelerations(self) -> tuple[Floats, Floats]:
        """Compute the accelerations at the begin and the end of each cubic, (K − 1, n) each."""
        h = np.diff(self.times)[:, None]
        p, c, d, q = self._control(np.arange(len(h)))
        begin = 6.0 / h**2 * ((d - c) - (c - p))
        end = 6.0 / h**2 * ((q - d) - (d - c))
        return begin, end

    def compute_jerks(self, start_acceleration: Floats | None = None) -> tuple[Floats, Floats]:
        """Compute |jerk| of each cubic, shape (K − 1, n), and acceleration jumps at knots, (K, n).

        Before the first knot there is a given acceleration, shape (n,), by default none, and after
        the last one none.
        """
        h = np.diff(self.times)[:, None]
        begin, end = self.compute_accelerations()
        none = np.zeros((1, self.positions.shape[1]))
        before = none if start_acceleration is None else start_acceleration[None]
        jumps = np.concatenate([begin, none]) - np.concatenate([before, end])
        return np.abs(end - begin) / h, np.abs(jumps)

    def part(self, begin: float, end: float, columns: Sequence[int] | slice = slice(None)) -> Curve:
        """Return the part between the times of two knots [s], restricted to columns."""
        rows = slice(
            int(np.searchsorted(self.times, begin)),
            int(np.searchsorted(self.times, end, side="right")),
        )
        return Curve(
            self.times[rows], self.positions[rows][:, columns], self.rates[rows][:, columns]
        )

    def check_through(self, times: Floats, positions: Floats) -> None:
        """Check that the curve leads from the first waypoint through all others to the last.

        Args:
            times: Times of the waypoints, shape (T,) [s].
            positions: Positions of the waypoints, shape (T, n).

        Raises:
            InputError: A waypoint is not one of the knots. Times must be equal to the last bit.
        """
        if self.positions.shape[1] != positions.shape[1]:
            raise InputError(
                "wrong number of coordinates",
                field="curve.positions",
                expected=positions.shape[1],
                got=self.positions.shape[1],
            )
        last = len(self.times) - 1
        at = np.minimum(np.searchsorted(self.times, times), last)
        has_ends = at[0] == 0 and at[-1] == last
        if not has_ends or not np.array_equal(self.times[at], times):
            raise InputError(
                "a waypoint is none of its knots",
                field="curve.times",
                expected="the times of all waypoints",
            )
        apart = np.abs(self.positions[at] - positions).max(axis=1)
        if not apart.max() <= _MAX_DISTANCE:
            raise InputError(
                "the curve does not lead through a waypoint",
                field=f"positions[{int(np.argmax(apart))}]",
                expected=f"at most {_MAX_DISTANCE:g}",
                got=f"{apart.max():g} apart",
            )

    def shift_time(self, time: float) -> Curve:
        """Return the curve delayed by `time` [s]."""
        return Curve(self.times + time, self.positions, self.rates)

    def to_dict(self) -> dict[str, Any]:
        """Return the curve as plain data."""
        return {
            "times": self.times.tolist(),
            "positions": self.positions.tolist(),
            "rates": self.rates.tolist(),
        }


def _bernstein(s: Floats, p: Floats, c: Floats, d: Floats, q: Floats) -> Floats:
    """Evaluate cubics with these control points at the fraction `s` of their durations."""
    r = 1.0 - s
    return np.asarray(r**3 * p + 3.0 * s * r**2 * c + 3.0 * s**2 * r * d + s**3 * q)


def sample_evenly(times: Floats, rate: float) -> Floats:
    """Return times at a rate [Hz] from the first to the last of `times` [s], and the last time."""
    duration = times[-1] - times[0]
    return np.append(times[0] + np.arange(np.ceil(duration * rate - 1e-6)) / rate, times[-1])


def divide_intervals(times: Floats, counts: Ints) -> Floats:
    """Return times [s], and those that divide each interval evenly into `counts` parts."""
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    part = np.arange(counts.sum()) - starts
    inside = np.repeat(times[:-1], counts) + part * np.repeat(np.diff(times) / counts, counts)
    return np.append(inside, times[-1])


def sample_intervals(knots: Floats, shares: Floats, *, last: bool = False) -> Floats:
    """Return times at fractions of every interval between knots, in order.

    Args:
        knots: Times of the knots, shape (K,) [s].
        shares: Fractions from 0 to 1, shape (k,).
        last: Whether to append the last knot.
    """
    inside = (knots[:-1, None] + np.diff(knots)[:, None] * shares).ravel()
    return np.append(inside, knots[-1]) if last else inside


def concatenate_curves(pieces: Sequence[Curve]) -> Curve:
    """Concatenate curves; each begins at the position and velocity where its predecessor ends."""
    first = pieces[0]
    times = [first.times]
    positions = [first.positions]
    rates = [first.rates]
    for piece in pieces[1:]:
        end = times[-1][-1]
        times.append(end + piece.times[1:] - piece.times[0])
        positions.append(piece.positions[1:])
        rates.append(piece.rates[1:])
    return Curve(np.concatenate(times), np.concatenate(positions), np.concatenate(rates))
