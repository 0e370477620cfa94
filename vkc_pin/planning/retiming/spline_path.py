"""Fits a smooth path through waypoints that does not overshoot the limits."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.retiming.cubic_path import CubicPath, compute_natural_slopes
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.curve import Curve


def fit_path(points: Floats, scale: Floats, limits: tuple[Floats, Floats]) -> CubicPath:
    """Return a cubic spline through waypoints, parametrised by the length of the polyline.

    It is twice differentiable and linear in the waypoints, so that linear constraints that hold at
    all waypoints hold along it. If a coordinate would leave its limits between waypoints, all stay
    between their values at consecutive waypoints (Hyman, Accurate monotonicity preserving cubic
    interpolation, 1983): where only one did, the others would overshoot without it, and a chain
    that is closed at the waypoints would open.

    Args:
        points: Waypoints, shape (m, n), m ≥ 2, consecutive ones distinct.
        scale: Weight of each coordinate in the length, shape (n,).
        limits: Lower and upper limits, shape (n,) each.
    """
    lengths = np.linalg.norm(np.diff(points, axis=0) * scale, axis=1)
    arc_lengths = np.concatenate([[0.0], np.cumsum(lengths)])
    steps = np.diff(points, axis=0)
    chords = steps / lengths[:, None]
    slopes = (
        compute_natural_slopes(arc_lengths, points)
        if len(points) > 2
        else np.repeat(chords, 2, axis=0)
    )
    if not _exceeds_limits(points, slopes, lengths, limits):
        return CubicPath(arc_lengths, points, slopes)
    before, after = np.vstack([chords[:1], chords]), np.vstack([chords, chords[-1:]])
    directions, steepest = np.sign(after), 3.0 * np.minimum(np.abs(before), np.abs(after))
    monotone = np.where(
        before * after > 0.0, directions * np.clip(directions * slopes, 0.0, steepest), 0.0
    )
    return CubicPath(arc_lengths, points, monotone)


def _exceeds_limits(
    points: Floats, slopes: Floats, lengths: Floats, limits: tuple[Floats, Floats]
) -> bool:
    """Return whether the cubic of any coordinate exceeds its limits between two points."""
    low, high = Curve(np.concatenate([[0.0], np.cumsum(lengths)]), points, slopes).compute_extrema()
    is_low = low < np.minimum(limits[0], np.minimum(points[:-1], points[1:]))
    is_high = high > np.maximum(limits[1], np.maximum(points[:-1], points[1:]))
    return bool((is_low | is_high).any())
