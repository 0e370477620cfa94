"""Curve: where a motion is at every moment, smooth: cubics in time through knots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.arguments import numbers
from vkc_pin.arrays import Floats, Ints
from vkc_pin.errors import InputError

__all__ = ["Curve"]

_LARGEST = 1e12  # [m] or [rad] of a coordinate, and of its rate [m/s], [rad/s]


@dataclass(frozen=True)
class Curve:
    """Cubics in time between knots, with the same velocity on both sides of each (cubic Hermite splines).

    Controllers that are given positions and velocities go along the same curve (`ros2_control`'s joint trajectory controller,
    "cubic").

    Attributes:
        times: Of the knots, shape (K,), increasing [s].
        positions: Shape (K, n), [m] and [rad].
        rates: Velocities, shape (K, n), [m/s] and [rad/s].

    Raises:
        InputError: Numbers that are not finite or beyond all measure, shapes that do not fit, or times that do not increase.
    """

    times: Floats
    positions: Floats
    rates: Floats

    def __post_init__(self) -> None:
        times, positions, rates = (numbers(getattr(self, name), f"curve.{name}") for name in ("times", "positions", "rates"))
        if times.ndim != 1 or len(times) < 2 or not np.all(np.diff(times) > 0):
            raise InputError("times do not increase", field="curve.times", expected="at least 2 increasing numbers")
        if positions.ndim != 2 or len(positions) != len(times):
            expected = f"({len(times)}, n)"
            raise InputError("wrong shape", field="curve.positions", expected=expected, got=positions.shape)
        if rates.shape != positions.shape:
            raise InputError("wrong shape", field="curve.rates", expected=positions.shape, got=rates.shape)
        for name, array in (("times", times), ("positions", positions), ("rates", rates)):
            if not np.abs(array).max(initial=0.0) <= _LARGEST:
                raise InputError("out of range", field=f"curve.{name}", expected=f"numbers up to {_LARGEST:g}")
            array = np.array(array, float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def at(self, time: ArrayLike) -> Floats:
        """Return the positions, shape (..., n), at times [s], shape (...,); outside the curve, its first or last."""
        return self._cubic(time, 0)

    def velocity(self, time: ArrayLike) -> Floats:
        """Return the velocities, shape (..., n), at times [s], shape (...,); outside the curve 0, as all stands still there."""
        return self._cubic(time, 1)

    def acceleration(self, time: ArrayLike) -> Floats:
        """Return the accelerations, shape (..., n), at times [s], shape (...,); at a knot, that of the cubic after it."""
        return self._cubic(time, 2)

    def _cubic(self, time: ArrayLike, derivative: int) -> Floats:
        moments = np.asarray(time, float)
        k = np.clip(np.searchsorted(self.times, moments, side="right") - 1, 0, len(self.times) - 2)
        h = np.diff(self.times)[k]
        s = (np.clip((moments - self.times[k]) / h, 0.0, 1.0))[..., None]
        h, p, c, d, q = (array[..., None] if array.ndim == k.ndim else array for array in (h, *self._control(k)))
        if derivative == 0:
            r = 1.0 - s
            return np.asarray(r**3 * p + 3.0 * s * r**2 * c + 3.0 * s**2 * r * d + s**3 * q)
        inside = ((moments >= self.times[0]) & (moments <= self.times[-1]))[..., None]
        if derivative == 1:
            r = 1.0 - s
            return np.asarray(np.where(inside, 3.0 / h * (r**2 * (c - p) + 2.0 * s * r * (d - c) + s**2 * (q - d)), 0.0))
        return np.asarray(np.where(inside, 6.0 / h**2 * ((1.0 - s) * (p - 2.0 * c + d) + s * (c - 2.0 * d + q)), 0.0))

    def _control(self, k: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the control points of the cubics with these numbers: each lies in their convex hull."""
        third = (np.diff(self.times)[k] / 3.0)[..., None]
        before, after = self.positions[k], self.positions[k + 1]
        return before, before + third * self.rates[k], after - third * self.rates[k + 1], after

    def bounds(self) -> tuple[Floats, Floats]:
        """Return least and largest position on each cubic at most, shape (K − 1, n) each."""
        points = np.stack(self._control(np.arange(len(self.times) - 1)))
        return np.asarray(points.min(axis=0)), np.asarray(points.max(axis=0))

    def speeds(self) -> tuple[Floats, Floats]:
        """Return the exact largest |velocity| and |acceleration| on each cubic, shape (K − 1, n) each."""
        h = np.diff(self.times)[:, None]
        p, c, d, q = self._control(np.arange(len(h)))
        first, middle, last = (3.0 / h * part for part in (c - p, d - c, q - d))
        bend = first - 2.0 * middle + last
        at = np.divide(first - middle, bend, out=np.full_like(bend, -1.0), where=np.abs(bend) > 1e-12)
        at = np.where((at > 0.0) & (at < 1.0), at, 0.0)  # where the velocity, a parabola, turns round
        between = (1.0 - at) ** 2 * first + 2.0 * at * (1.0 - at) * middle + at**2 * last
        fastest = np.max(np.abs([first, last, between]), axis=0)
        strongest = np.max(np.abs([2.0 / h * (middle - first), 2.0 / h * (last - middle)]), axis=0)
        return np.asarray(fastest), np.asarray(strongest)

    def lengths(self) -> Floats:
        """Return how far each coordinate goes at most on each cubic, shape (K − 1, n): its control points' polygon."""
        p, c, d, q = self._control(np.arange(len(self.times) - 1))
        return np.asarray(np.abs(c - p) + np.abs(d - c) + np.abs(q - d))

    def part(self, begin: float, end: float, columns: Sequence[int] | slice = slice(None)) -> Curve:
        """Return what lies between two of the knots' times [s], of some columns."""
        rows = slice(int(np.searchsorted(self.times, begin)), int(np.searchsorted(self.times, end, side="right")))
        return Curve(self.times[rows], self.positions[rows][:, columns], self.rates[rows][:, columns])

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it."""
        return {"times": self.times.tolist(), "positions": self.positions.tolist(), "rates": self.rates.tolist()}
