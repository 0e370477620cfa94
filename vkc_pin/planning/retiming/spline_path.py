"""Fits a smooth path through waypoints that does not overshoot the limits."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.retiming.cubic_path import (
    FREE_ENDS,
    CubicPath,
    EndSlopes,
    compute_natural_slopes,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.curve import Curve


def fit_path(
    points: Floats,
    scale: Floats,
    limits: tuple[Floats, Floats],
    end_slopes: EndSlopes = FREE_ENDS,
) -> CubicPath:
    """Return a cubic spline through waypoints, parametrised by the length of the polyline.

    Args:
        points: Waypoints, shape (m, n), m ≥ 2, consecutive ones distinct.
        scale: Weight of each coordinate in the length, shape (n,).
        limits: Lower and upper limits, shape (n,) each.
        end_slopes: Given derivatives by the length at the ends; see `fit_path_over`.
    """
    lengths = np.linalg.norm(np.diff(points, axis=0) * scale, axis=1)
    arc_lengths = np.concatenate([[0.0], np.cumsum(lengths)])
    return fit_path_over(arc_lengths, points, limits, end_slopes)


def fit_path_over(
    positions: Floats,
    points: Floats,
    limits: tuple[Floats, Floats],
    end_slopes: EndSlopes = FREE_ENDS,
) -> CubicPath:
    """Return a cubic spline through waypoints at given path positions.

    It is twice differentiable and linear in the waypoints, so that linear constraints that hold at
    all waypoints hold along it. If a coordinate would leave its limits between waypoints, all stay
    between their values at consecutive waypoints (Hyman, Accurate monotonicity preserving cubic
    interpolation, 1983): where only one did, the others would overshoot without it, and a chain
    that is closed at the waypoints would open.

    Args:
        positions: Increasing path positions of the waypoints, shape (m,).
        points: Waypoints, shape (m, n), m ≥ 2.
        limits: Lower and upper limits, shape (n,) each.
        end_slopes: Given derivatives at the ends, which are kept in any case.
    """
    chords = np.diff(points, axis=0) / np.diff(positions)[:, None]
    begin, end = end_slopes
    if len(points) > 2 or begin is not None or end is not None:
        slopes = compute_natural_slopes(positions, points, end_slopes)
    else:
        slopes = np.repeat(chords, 2, axis=0)
    if not _exceeds_limits(points, slopes, positions, limits):
        return CubicPath(positions, points, slopes)
    limited_slopes = _limit_slopes(slopes, chords)
    if begin is not None:
        limited_slopes[0] = begin
    if end is not None:
        limited_slopes[-1] = end
    return CubicPath(positions, points, limited_slopes)


def _limit_slopes(slopes: Floats, chords: Floats) -> Floats:
    """Return slopes at waypoints, shape (m, n), with which no cubic leaves its end values.

    A cubic is monotone if its slopes at both ends have the sign of its chord and are at most three
    times as steep. Where the chords before and after a waypoint differ in sign, its slope is zero.
    """
    before = np.vstack([chords[:1], chords])
    after = np.vstack([chords, chords[-1:]])
    directions = np.sign(after)
    steepest = 3.0 * np.minimum(np.abs(before), np.abs(after))
    limited_slopes = directions * np.clip(directions * slopes, 0.0, steepest)
    return np.where(before * after > 0.0, limited_slopes, 0.0)


def _exceeds_limits(
    points: Floats, slopes: Floats, arc_lengths: Floats, limits: tuple[Floats, Floats]
) -> bool:
    """Return whether the cubic of any coordinate exceeds its limits between two points.

    Waypoints may exceed them, but cubics must not exceed their waypoints there.
    """
    low, high = Curve(arc_lengths, points, slopes).compute_extrema()
    lower = np.minimum(limits[0], np.minimum(points[:-1], points[1:]))
    upper = np.maximum(limits[1], np.maximum(points[:-1], points[1:]))
    return bool(((low < lower) | (high > upper)).any())
