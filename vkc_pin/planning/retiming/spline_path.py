"""A smooth path through waypoints that goes nowhere they do not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.trajectory.curve import Curve

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

__all__ = ["fit_path"]


def fit_path(points: Floats, scale: Floats, limits: tuple[Floats, Floats]) -> CubicHermiteSpline:
    """Return cubics through waypoints, over the length of the way between them.

    They are the spline that is twice differentiable. It is linear in the waypoints, so that what
    these all satisfy, such as a closed chain, it satisfies but for the curvature of that. A
    coordinate that would leave its limits nowhere leaves the range between two waypoints instead
    (Hyman, Accurate monotonicity preserving cubic interpolation, 1983).

    Args:
        points: Shape (m, n), m ≥ 2, no two consecutive ones the same.
        scale: What a unit of each coordinate counts for the length, shape (n,).
        limits: Lower and upper, shape (n,) each.
    """
    from scipy.interpolate import CubicHermiteSpline, CubicSpline

    lengths = np.linalg.norm(np.diff(points, axis=0) * scale, axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    steps = np.diff(points, axis=0)
    chords = steps / lengths[:, None]
    slopes = (
        CubicSpline(at, points, bc_type="natural")(at, 1)
        if len(points) > 2
        else np.repeat(chords, 2, axis=0)
    )
    leaves = _leaves(points, slopes, lengths, limits)
    before, after = np.vstack([chords[:1], chords]), np.vstack([chords, chords[-1:]])
    ways, steepest = np.sign(after), 3.0 * np.minimum(np.abs(before), np.abs(after))
    within = np.where(before * after > 0.0, ways * np.clip(ways * slopes, 0.0, steepest), 0.0)
    return CubicHermiteSpline(at, points, np.where(leaves, within, slopes))


def _leaves(
    points: Floats, slopes: Floats, lengths: Floats, limits: tuple[Floats, Floats]
) -> Bools:
    """Return which coordinates of cubics lie outside limits between two points that do not, shape (n,)."""
    low, high = Curve(np.concatenate([[0.0], np.cumsum(lengths)]), points, slopes).compute_extrema()
    lower, upper = np.minimum(points[:-1], points[1:]), np.maximum(points[:-1], points[1:])
    return np.asarray(
        ((low < np.minimum(limits[0], lower)) | (high > np.maximum(limits[1], upper))).any(axis=0)
    )
