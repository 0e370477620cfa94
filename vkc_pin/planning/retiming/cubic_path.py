"""Represents paths as cubic splines over path positions."""

from __future__ import annotations

from math import perm

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.utils.arrays import Floats, Ints


class CubicPath:
    """A cubic Hermite spline of n coordinates, extrapolated by its outermost cubics.

    It equals `scipy.interpolate.CubicHermiteSpline` bit for bit. Importing that takes longer than
    planning a motion. At distance s behind a knot with value y₀, in an interval of width h and
    chord c with the slopes d₀ and d₁ at its ends,

        y(s) = y₀ + d₀ s + ((c − d₀)/h − b) s² + (b/h) s³,   b = (d₀ + d₁ − 2c)/h

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
        constant = np.asarray(y[:-1], float)
        linear = np.asarray(dydx[:-1], float)
        quadratic = (chords - dydx[:-1]) / widths - bends
        cubic = bends / widths
        self._coefficients = (constant, linear, quadratic, cubic)

    def __call__(self, positions: ArrayLike, order: int = 0, cubics: Ints | None = None) -> Floats:
        """Return a derivative, shape (..., n), at path positions, shape (...,).

        Args:
            positions: Path positions.
            order: Order of the derivative, 0 to 3.
            cubics: Cubic that each belongs to, shape (...,). Defaults to that right of knots.
        """
        at = np.asarray(positions, float)
        interval = cubics
        if interval is None:
            interval = np.searchsorted(self.x[1:-1], at, side="right")
        distance = (at - self.x[interval])[..., None]
        coordinate_count = self._coefficients[0].shape[1]
        derivative = np.zeros((*at.shape, coordinate_count))
        # The derivative of s^k of order r is k!/(k − r)! s^(k − r).
        power = np.ones_like(distance)
        for exponent in range(order, 4):
            coefficient = self._coefficients[exponent][interval]
            derivative += coefficient * power * perm(exponent, order)
            power = power * distance
        return derivative


EndSlopes = tuple[Floats | None, Floats | None]
"""Slopes at the first and the last knot of a spline, shape (n,); None: free."""

FREE_ENDS: EndSlopes = (None, None)
"""Slopes at both ends are free."""


def compute_natural_slopes(x: Floats, y: Floats, end_slopes: EndSlopes = FREE_ENDS) -> Floats:
    """Return the slopes at knots of the cubic spline that is twice differentiable.

    Its second derivative is zero at ends whose slopes are free. With h_k = x_{k+1} - x_k,
    continuity of the second derivative at knot k is

        h_k d_{k-1} + 2 (h_{k-1} + h_k) d_k + h_{k-1} d_{k+1} = 3 (h_k c_{k-1} + h_{k-1} c_k)

    in the slopes d and the chords c. No second derivative at the ends means

        2 h_0 d_0 + h_0 d_1 = 3 h_0 c_0

    and its mirror image. The diagonal of this tridiagonal system is dominant: it is solved by
    elimination without pivoting.

    Args:
        x: Increasing positions of the knots, shape (K,), K ≥ 3, or 2 with a given slope.
        y: Values at the knots, shape (K, n).
        end_slopes: Given slopes at the ends.
    """
    widths = np.diff(x)
    chords = np.diff(y, axis=0) / widths[:, None]
    lower = [*widths[1:], widths[-1]]
    upper = [widths[0], *widths[:-1]]
    inner_diagonal = 2.0 * (widths[:-1] + widths[1:])
    diagonal = [2.0 * widths[0], *inner_diagonal, 2.0 * widths[-1]]
    right_side = np.empty_like(y)
    right_side[0] = 3.0 * (y[1] - y[0])
    right_side[1:-1] = 3.0 * (widths[1:, None] * chords[:-1] + widths[:-1, None] * chords[1:])
    right_side[-1] = 3.0 * (y[-1] - y[-2])
    begin, end = end_slopes
    if begin is not None:
        diagonal[0] = 1.0
        upper[0] = 0.0
        right_side[0] = begin
    if end is not None:
        diagonal[-1] = 1.0
        lower[-1] = 0.0
        right_side[-1] = end
    # Eliminate the lower diagonal.
    for k in range(len(x) - 1):
        factor = lower[k] / diagonal[k]
        diagonal[k + 1] -= factor * upper[k]
        right_side[k + 1] -= factor * right_side[k]
    # Substitute back, in place.
    slopes = right_side
    slopes[-1] /= diagonal[-1]
    for k in range(len(x) - 2, -1, -1):
        slopes[k] = (slopes[k] - upper[k] * slopes[k + 1]) / diagonal[k]
    return slopes
