"""Computes the fastest speed along a path (time-optimal path parametrisation)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.optional_imports import import_compiled

_MAX_SPEED = 1e8  # of paths that no velocity limits
# Ratio of squared speeds below which both ends of an interval are at rest. Rounding left 2e-10 at
# most on 12 000 random paths; where they can be followed, the ratio was 2e-4 at least.
_AT_REST = 1e-9


class PathSamples(NamedTuple):
    """Samples of a path at which limits are evaluated.

    Accelerations jump at knots. An inner knot therefore has two samples: of the cubic before it,
    and of the cubic behind it.

    Attributes:
        positions: Path positions in order, shape (S,).
        cubics: Cubic of each, shape (S,).
        begins: Sample at the begin of each interval, shape (K − 1,); the next one is at its end.
    """

    positions: Floats
    cubics: Ints
    begins: Ints

    @classmethod
    def from_positions(cls, path: CubicPath, positions: Floats) -> PathSamples:
        """Return the samples of intervals between positions.

        Args:
            path: The path.
            positions: Increasing path positions, including both ends and all knots, shape (K,).
        """
        inner_knots = path.x[1:-1]
        cubics_before = np.searchsorted(inner_knots, positions, side="left")
        cubics_behind = np.searchsorted(inner_knots, positions, side="right")
        counts = 1 + cubics_behind - cubics_before
        begins = np.cumsum(counts)[:-1] - 1
        cubics = np.repeat(cubics_behind, counts)
        cubics[begins + 1] = cubics_before[1:]
        return cls(np.repeat(positions, counts), cubics, begins)


def compute_speeds(
    path: CubicPath,
    positions: Floats,
    velocity: Floats,
    acceleration: Floats,
    linear: tuple[Floats, Floats, Floats] | None = None,
    end_speeds: tuple[float, float] = (0.0, 0.0),
) -> Floats | None:
    """Return the fastest speeds along a path at given positions, by default from rest to rest.

    Between two positions the speed is linear in time. Along a path q(s), with the path velocity w
    and acceleration u,

        q̇ = q′ w,   q̈ = q′ u + q″ w²

    so that all limits are linear in u and w². They hold at both ends of each interval, with the
    curvatures q″ of its cubic. The speeds are those of TOPP-RA (Pham and Pham, A new approach to
    time-optimal path parameterization based on reachability analysis, 2018): backwards from the
    end, it computes from which w² the end can be reached, and then accelerates as much as these
    allow.

    Args:
        path: Path of n coordinates.
        positions: Increasing path positions, including both ends and all knots, shape (K,).
        velocity: Velocity limits, shape (n,) [m/s], [rad/s]; inf: none.
        acceleration: Acceleration limits, shape (n,) [m/s²], [rad/s²]; inf: none.
        linear: Further constraints: a, b, c at the S samples of `PathSamples.from_positions`, shape
            (S, m) each, with |a u + b w² + c| ≤ 1. Defaults to none.
        end_speeds: Path velocities at the start and the end [1/s].

    Returns:
        Path velocities, shape (K,) [1/s], or None if no speeds keep the limits or there are no
            limits.

    Raises:
        BuildError: The compiled module is missing.
    """
    if not (np.isfinite(velocity) | np.isfinite(acceleration)).any():
        return None
    samples = PathSamples.from_positions(path, positions)
    tangents = path(samples.positions, 1, samples.cubics)
    curvatures = path(samples.positions, 2, samples.cubics)
    a = tangents / acceleration
    b = curvatures / acceleration
    c = np.zeros_like(a)
    if linear is not None:
        further_a, further_b, further_c = linear
        a = np.hstack([a, further_a])
        b = np.hstack([b, further_b])
        c = np.hstack([c, further_c])
    with np.errstate(divide="ignore"):
        max_speeds = (velocity / np.abs(tangents)).min(axis=1)
    max_squares = np.minimum(max_speeds, _MAX_SPEED) ** 2
    max_squares_at_positions = np.append(max_squares[samples.begins], max_squares[-1])
    first, last = end_speeds
    compiled = import_compiled("vkc_pin.planning.retiming._speeds")
    squares = compiled.fastest_squares(
        positions, max_squares_at_positions, samples.begins, a, b, c, first**2, last**2
    )
    if squares is None:
        return None
    largest_of_interval = np.maximum(squares[1:], squares[:-1])
    if (largest_of_interval <= _AT_REST * squares.max()).any():
        return None
    return np.sqrt(squares)
