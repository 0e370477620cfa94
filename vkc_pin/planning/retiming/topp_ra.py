"""How fast a path can be gone along, from rest to rest: time-optimal path parametrization (TOPP-RA)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

__all__ = ["compute_speeds"]

_ASIDE = (
    1e-3,
    1e-2,
)  # share of a segment beside its ends at which accelerations are limited: at the end they jump


def compute_speeds(
    path: CubicHermiteSpline,
    places: Floats,
    velocity: Floats,
    acceleration: Floats,
    linear: Callable[[Floats], tuple[Floats, Floats, Floats]] | None = None,
) -> Floats | None:
    """Return how fast a path can be gone along at some places, from rest to rest, shape (K,) [1/s]; None: it is not known.

    Between two places the speed changes evenly in time. It is TOPP-RA's (Pham and Pham, A new
    approach to time-optimal path parameterization based on reachability analysis, 2018), as the
    library `toppra` computes it.

    Args:
        path: The path, of n coordinates.
        places: Along it, increasing, from its begin to its end, all knots of the path among them,
            shape (K,).
        velocity: Limits, shape (n,) [m/s], [rad/s]; inf: none.
        acceleration: Limits, shape (n,) [m/s²], [rad/s²]; inf: none.
        linear: Returns a, b, c at places, shape (K, m) each, with |a u + b w² + c| ≤ 1 for the
            path's velocity w and acceleration u; None: nothing but limits bounds it.
    """
    from toppra.algorithm import TOPPRA
    from toppra.constraint import (
        DiscretizationType,
        JointAccelerationConstraint,
        JointVelocityConstraint,
    )

    both = np.flatnonzero(np.isfinite(velocity) & np.isfinite(acceleration))
    if not len(both):
        return None
    _silence()
    rates = JointVelocityConstraint(np.column_stack([-velocity[both], velocity[both]]))
    limits = np.column_stack([-acceleration[both], acceleration[both]])
    changes = JointAccelerationConstraint(
        limits, discretization_scheme=DiscretizationType.Interpolation
    )
    for aside in _ASIDE:
        grid = _beside(path.x, places, aside)
        bounds = (
            [rates, changes] if linear is None else [rates, changes, _linear(linear, len(both))]
        )
        found = TOPPRA(bounds, _geometric(path, both), gridpoints=grid, solver_wrapper="seidel")
        _, speeds, _ = found.compute_parameterization(0.0, 0.0)
        if speeds is not None and np.isfinite(speeds).all() and (speeds[1:-1] > 0.0).all():
            return np.sqrt(np.interp(places, grid, np.asarray(speeds) ** 2))
    return None


def _beside(knots: Floats, places: Floats, aside: float) -> Floats:
    """Return places with two in the stead of every knot inside, a share of the segment aside: accelerations jump at knots."""
    gaps = np.minimum(np.diff(knots)[1:], np.diff(knots)[:-1]) * aside
    inside = knots[1:-1]
    return np.sort(np.concatenate([np.setdiff1d(places, inside), inside - gaps, inside + gaps]))


def _geometric(path: CubicHermiteSpline, columns: Ints) -> Any:
    """Return some coordinates of a path as `toppra` knows paths."""
    from toppra.interpolator import AbstractGeometricPath

    class Path(AbstractGeometricPath):
        dof = len(columns)
        path_interval = np.array([path.x[0], path.x[-1]])

        def __call__(self, places: Any, order: int = 0) -> Any:
            return path(places, order)[..., columns]

    return Path()


def _linear(linear: Callable[[Floats], tuple[Floats, Floats, Floats]], size: int) -> Any:
    """Return what else bounds the speed as `toppra` knows such constraints, at both ends of every piece of its grid."""
    from toppra.constraint import LinearConstraint
    from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate

    class Bound(LinearConstraint):
        dof, identical = size, True

        def __init__(self) -> None:
            super().__init__()
            self.identical = True

        def compute_constraint_params(
            self, path: Any, gridpoints: Floats, *_: Any, **__: Any
        ) -> Any:
            a, b, c = linear(gridpoints)
            both = np.vstack([np.eye(a.shape[1]), -np.eye(a.shape[1])])
            return canlinear_colloc_to_interpolate(
                a, b, c, both, np.ones(len(both)), None, None, gridpoints, identical=True
            )

    return Bound()


def _silence() -> None:
    """Let `toppra` say nothing of what it does not find, unless somebody has said that it should: it is told of here."""
    logger = logging.getLogger("toppra")
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.CRITICAL)
