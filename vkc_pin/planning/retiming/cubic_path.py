"""Represents paths as cubic splines over path positions."""

from __future__ import annotations

from math import perm

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.utils.arrays import Floats


class CubicPath:
    """A cubic Hermite spline of n coordinates, extrapolated by its outermost cubics.

    It equals `scipy.interpolate.CubicHermiteSpline` bit for bit. Importing that takes longer than
    planning a motion.

    Args:
        x: Increasing positions of the knots, shape (K,), K ≥ 2.
        y: Coordinates at the knots, shape (K, n).
        dydx: Their derivatives, shape (K, n).
    """

    def __init__(self, x: Floats, y: Floats, dydx: Floats) -> None:
        self.x = np.asarray(x, float)
        widths = np.diff(self.x)[:, None]
        chords = np.diff(y, axis=0) / widths
        bends = (dydx[:-1] + dydx[1:] - 2.0 * chords) / widths
        # Of 1, s, s² and s³, with the distance s from the knot before.
        self._coefficients = (
            np.asarray(y[:-1], float),
            np.asarray(dydx[:-1], float),
            (chords - dydx[:-1]) / widths - bends,
            bends / widths,
        )

    def __call__(self, positions: ArrayLike, order: int = 0) -> Floats:
        """Return a derivative, shape (..., n), at path positions, shape (...,), right of knots.

        Args:
            positions: Path positions.
            order: Order of the derivative, 0 to 3.
        """
        at = np.asarray(positions, float)
        cubic = np.searchsorted(self.x[1:-1], at, side="right")
        distance = (at - self.x[cubic])[..., None]
        found = np.zeros((*at.shape, self._coefficients[0].shape[1]))
        power = np.ones_like(distance)
        for exponent in range(order, 4):
            found += self._coefficients[exponent][cubic] * power * perm(exponent, order)
            power = power * distance
        return found


def compute_natural_slopes(x: Floats, y: Floats) -> Floats:
    """Return the slopes at knots of the cubic spline that is twice differentiable.

    Its second derivative d is zero at both ends. With h_k = x_{k+1} - x_k, continuity of the second
    derivative at knot k is

        h_k d_{k-1} + 2 (h_{k-1} + h_k) d_k + h_{k-1} d_{k+1} = 3 (h_k c_{k-1} + h_{k-1} c_k)

    in the slopes d and the chords c, a tridiagonal system with a dominant diagonal: it is solved by
    elimination without pivoting.

    Args:
        x: Increasing positions of the knots, shape (K,), K ≥ 3.
        y: Values at the knots, shape (K, n).
    """
    widths = np.diff(x)
    chords = np.diff(y, axis=0) / widths[:, None]
    lower = [*widths[1:], widths[-1]]
    upper = [widths[0], *widths[:-1]]
    diagonal = [2.0 * widths[0], *(2.0 * (widths[:-1] + widths[1:])), 2.0 * widths[-1]]
    right = np.empty_like(y)
    right[0] = 3.0 * (y[1] - y[0])
    right[1:-1] = 3.0 * (widths[1:, None] * chords[:-1] + widths[:-1, None] * chords[1:])
    right[-1] = 3.0 * (y[-1] - y[-2])
    for k in range(len(x) - 1):
        factor = lower[k] / diagonal[k]
        diagonal[k + 1] -= factor * upper[k]
        right[k + 1] -= factor * right[k]
    right[-1] /= diagonal[-1]
    for k in range(len(x) - 2, -1, -1):
        right[k] = (right[k] - upper[k] * right[k + 1]) / diagonal[k]
    return right
