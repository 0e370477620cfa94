"""Monotone cubics through waypoints: velocities and accelerations there, and the motion between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["along", "rates"]


def rates(times: NDArray[np.float64], positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return velocities and accelerations at waypoints, shape (T, n) each; it rests before the first and after the last.

    Where a coordinate turns round, its velocity is zero; where it rests before or after, its acceleration is zero as well.
    """
    steps = np.diff(times)[:, None]
    slopes = np.diff(positions, axis=0) / steps
    before, after = slopes[:-1], slopes[1:]
    velocities, accelerations = np.zeros_like(positions), np.zeros_like(positions)
    w1, w2 = 2.0 * steps[1:] + steps[:-1], steps[1:] + 2.0 * steps[:-1]
    same = np.sign(before) * np.sign(after) > 0.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mean = (w1 + w2) / (w1 / before + w2 / after)
    velocities[1:-1] = np.where(same & np.isfinite(mean), mean, 0.0)
    moves = (before != 0.0) & (after != 0.0)
    accelerations[1:-1] = np.where(moves, 2.0 * (after - before) / (steps[1:] + steps[:-1]), 0.0)
    return velocities, accelerations


def along(
    times: NDArray[np.float64], positions: NDArray[np.float64], velocities: NDArray[np.float64], moments: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return positions, velocities and accelerations at `moments` on the cubics through waypoints with these velocities."""
    at = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    h = (times[at + 1] - times[at])[:, None]
    s = (moments - times[at])[:, None] / h
    p, q, u, v = positions[at], positions[at + 1], velocities[at] * h, velocities[at + 1] * h
    b, c = 3.0 * (q - p) - 2.0 * u - v, u + v - 2.0 * (q - p)
    place = p + s * (u + s * (b + s * c))
    place = np.clip(place, np.minimum(p, q), np.maximum(p, q))  # against rounding
    return np.where(s >= 1.0, q, place), (u + s * (2.0 * b + s * 3.0 * c)) / h, (2.0 * b + 6.0 * s * c) / h**2
