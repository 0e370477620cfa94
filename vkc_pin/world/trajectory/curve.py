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
_OFF = 1e-9  # accepted distance of the curve from a waypoint [m] or [rad]
_LARGEST = 1e12  # largest position [m], [rad] and velocity [m/s], [rad/s]


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
        times, positions, rates = (
            check_array(getattr(self, name), f"curve.{name}")
            for name in ("times", "positions", "rates")
        )
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
            if not np.abs(array).max(initial=0.0) <= _LARGEST:
                raise InputError(
                    "out of range", field=f"curve.{name}", expected=f"numbers up to {_LARGEST:g}"
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
        moments = np.asarray(time, float)
        k = np.clip(np.searchsorted(self.times, moments, side="right") - 1, 0, len(self.times) - 2)
        h = np.diff(self.times)[k]
        s = (np.clip((moments - self.times[k]) / h, 0.0, 1.0))[..., None]
        h, p, c, d, q = (
            array[..., None] if array.ndim == k.ndim else array for array in (h, *self._control(k))
        )
        if derivative == 0:
            return _bernstein(s, p, c, d, q)
        inside = ((moments >= self.times[0]) & (moments <= self.times[-1]))[..., None]
        if derivative == 1:
            r = 1.0 - s
            return np.asarray(
                np.where(
                    inside, 3.0 / h * (r**2 * (c - p) + 2.0 * s * r * (d - c) + s**2 * (q - d)), 0.0
                )
            )
        return np.asarray(
            np.where(
                inside, 6.0 / h**2 * ((1.0 - s) * (p - 2.0 * c + d) + s * (c - 2.0 * d + q)), 0.0
            )
        )

    def _control(self, k: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the Bézier control points of cubics; each cubic lies in their convex hull."""
        third = (np.diff(self.times)[k] / 3.0)[..., None]
        before, after = self.positions[k], self.positions[k + 1]
        return before, before + third * self.rates[k], after - third * self.rates[k + 1], after

    def compute_extrema(self) -> tuple[Floats, Floats]:
        """Compute the exact smallest and largest positions on each cubic, shape (K − 1, n) each."""
        p, c, d, q = self._control(np.arange(len(self.times) - 1))
        first, middle, last = c - p, d - c, q - d
        bend, sides = first - 2.0 * middle + last, [p, q]
        root = np.sqrt(np.maximum(middle**2 - first * last, 0.0))
        for sign in (-1.0, 1.0):
            # Zeros of the velocity, first·(1−s)² + 2·middle·s(1−s) + last·s².
            straight = first - middle + sign * root
            other = first - middle - sign * root
            at = np.divide(
                straight,
                bend,
                out=np.divide(first, other, out=np.zeros_like(p), where=other != 0.0),
                where=bend != 0.0,
            )
            sides.append(_bernstein(np.clip(at, 0.0, 1.0), p, c, d, q))
        return np.asarray(np.min(sides, axis=0)), np.asarray(np.max(sides, axis=0))

    def compute_max_rates(self) -> tuple[Floats, Floats]:
        """Compute the exact largest |velocity| and |acceleration| of cubics, (K − 1, n) each."""
        h = np.diff(self.times)[:, None]
        p, c, d, q = self._control(np.arange(len(h)))
        first, middle, last = (3.0 / h * part for part in (c - p, d - c, q - d))
        bend = first - 2.0 * middle + last
        at = np.divide(
            first - middle, bend, out=np.full_like(bend, -1.0), where=np.abs(bend) > 1e-12
        )
        at = np.where((at > 0.0) & (at < 1.0), at, 0.0)  # vertex of the velocity, a parabola
        between = (1.0 - at) ** 2 * first + 2.0 * at * (1.0 - at) * middle + at**2 * last
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

    def compute_jerks(self) -> tuple[Floats, Floats]:
        """Compute |jerk| of each cubic, shape (K − 1, n), and acceleration jumps at knots, (K, n).

        Before the first and after the last knot the motion is at rest.
        """
        h = np.diff(self.times)[:, None]
        begin, end = self.compute_accelerations()
        none = np.zeros((1, self.positions.shape[1]))
        jumps = np.concatenate([begin, none]) - np.concatenate([none, end])
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
            expected, got = positions.shape[1], self.positions.shape[1]
            raise InputError(
                "wrong number of coordinates", field="curve.positions", expected=expected, got=got
            )
        at = np.minimum(np.searchsorted(self.times, times), len(self.times) - 1)
        if at[0] != 0 or at[-1] != len(self.times) - 1 or not np.array_equal(self.times[at], times):
            raise InputError(
                "a waypoint is none of its knots",
                field="curve.times",
                expected="the times of all waypoints",
            )
        apart = np.abs(self.positions[at] - positions).max(axis=1)
        if not apart.max() <= _OFF:
            where, got = f"positions[{int(np.argmax(apart))}]", f"{apart.max():g} apart"
            raise InputError(
                "the curve does not lead through a waypoint",
                field=where,
                expected=f"at most {_OFF:g}",
                got=got,
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
    times, first = [pieces[0].times], pieces[0]
    for piece in pieces[1:]:
        times.append(times[-1][-1] + piece.times[1:] - piece.times[0])
    rest = pieces[1:]
    positions = np.concatenate([first.positions, *(piece.positions[1:] for piece in rest)])
    rates = np.concatenate([first.rates, *(piece.rates[1:] for piece in rest)])
    return Curve(np.concatenate(times), positions, rates)
