"""Computes the fastest speed along a path (time-optimal path parametrisation)."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.utils.arrays import Floats, Ints

# Offsets of constrained points from the ends of segments, where accelerations jump, relative to the
# length; the second one is tried if the first fails.
_KNOT_OFFSETS = (1e-3, 1e-2)
_MAX_SPEED = 1e8  # of paths that no velocity limits
# Modules that `toppra` imports and that are not used here
_UNUSED = ("matplotlib", "matplotlib.pyplot", "scipy.interpolate", "scipy.sparse")


def compute_speeds(
    path: CubicPath,
    positions: Floats,
    velocity: Floats,
    acceleration: Floats,
    linear: Callable[[Floats], tuple[Floats, Floats, Floats]] | None = None,
    end_speeds: tuple[float, float] = (0.0, 0.0),
) -> Floats | None:
    """Return the fastest speeds along a path at given positions, by default from rest to rest.

    Between two positions the speed is linear in time. Along a path q(s), with the path velocity w
    and acceleration u,

        q̇ = q′ w,   q̈ = q′ u + q″ w²

    so that all limits are linear in u and w². The speeds are those of TOPP-RA (Pham and Pham, A new
    approach to time-optimal path parameterization based on reachability analysis, 2018), computed
    by the library `toppra`.

    Args:
        path: Path of n coordinates.
        positions: Increasing path positions, including both ends and all knots, shape (K,).
        velocity: Velocity limits, shape (n,) [m/s], [rad/s]; inf: none.
        acceleration: Acceleration limits, shape (n,) [m/s²], [rad/s²]; inf: none.
        linear: Further constraints: returns a, b, c at positions, shape (K, m) each, with |a u + b
            w² + c| ≤ 1 for the path velocity w and acceleration u. Defaults to none.
        end_speeds: Path velocities at the start and the end [1/s].

    Returns:
        Path velocities, shape (K,) [1/s], or None if they cannot be computed.
    """
    _import_toppra()
    from toppra.algorithm import TOPPRA

    limited = np.flatnonzero(np.isfinite(velocity) & np.isfinite(acceleration))
    if not len(limited):
        return None
    constraint = _make_toppra_constraint(velocity[limited], acceleration[limited], linear)
    toppra_path = _to_toppra_path(path, limited)
    for offset in _KNOT_OFFSETS:
        grid = _replace_knots(path.x, positions, offset)
        solver = TOPPRA([constraint], toppra_path, gridpoints=grid, solver_wrapper="seidel")
        _, speeds, _ = solver.compute_parameterization(*end_speeds)
        if speeds is None:
            continue
        is_moving = np.isfinite(speeds).all() and (speeds[1:-1] > 0.0).all()
        if is_moving:
            # At constant acceleration w² is linear in the position.
            return np.sqrt(np.interp(positions, grid, np.asarray(speeds) ** 2))
    return None


@cache
def _import_toppra() -> None:
    """Import `toppra` without modules whose import takes as long as a plan.

    Its classes for splines, plots and other solvers, which are not used here, would need them.
    """
    placeholders = {name: _Placeholder(name) for name in _UNUSED if name not in sys.modules}
    if "matplotlib" in placeholders:
        placeholders["matplotlib"].__dict__["pyplot"] = placeholders["matplotlib.pyplot"]
    sys.modules |= placeholders
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)  # of its docstrings, at the first import
            logger = logging.getLogger(import_module("toppra").__name__)
    finally:
        for name in placeholders:
            del sys.modules[name]
    if logger.level == logging.NOTSET:  # failures are handled here
        logger.setLevel(logging.CRITICAL)


class _Placeholder(ModuleType):
    """Module that imports the real one when it is used."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is not self:
            return getattr(import_module(self.__name__), name)
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*arguments: Any, **settings: Any) -> Any:
            return getattr(import_module(self.__name__), name)(*arguments, **settings)

        return call


def _replace_knots(knots: Floats, positions: Floats, offset: float) -> Floats:
    """Return the grid with each interior knot replaced by two points beside it."""
    widths = np.diff(knots)
    gaps = np.minimum(widths[1:], widths[:-1]) * offset
    inside = knots[1:-1]
    others = np.setdiff1d(positions, inside)
    return np.sort(np.concatenate([others, inside - gaps, inside + gaps]))


def _to_toppra_path(path: CubicPath, columns: Ints) -> Any:
    """Return some coordinates of a path as a geometric path of `toppra`."""
    from toppra.interpolator import AbstractGeometricPath

    class Path(AbstractGeometricPath):
        dof = len(columns)
        path_interval = np.array([path.x[0], path.x[-1]])

        def __call__(self, positions: Any, order: int = 0) -> Any:
            return path(positions, order)[..., columns]

    return Path()


def _make_toppra_constraint(
    velocity: Floats,
    acceleration: Floats,
    linear: Callable[[Floats], tuple[Floats, Floats, Floats]] | None,
) -> Any:
    """Return the constraints of `compute_speeds` for `toppra`.

    Velocity limits bound w² by the smallest (limit / |q′|)². Acceleration limits are the rows
    |q′ u + q″ w²| / limit ≤ 1 of the linear constraints, |a u + b w² + c| ≤ 1. These hold at both
    ends of each grid interval.
    """
    from toppra.constraint import LinearConstraint
    from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate

    class Constraint(LinearConstraint):
        dof = len(velocity)

        def __init__(self) -> None:
            super().__init__()
            self.identical = True

        def compute_constraint_params(self, path: Any, gridpoints: Floats) -> Any:
            tangents = path(gridpoints, 1)
            curvatures = path(gridpoints, 2)
            with np.errstate(divide="ignore"):
                speeds = (velocity / np.abs(tangents)).min(axis=1)
            max_squares = np.minimum(speeds, _MAX_SPEED) ** 2
            bounds_of_squares = np.column_stack([np.zeros(len(speeds)), max_squares])
            a = tangents / acceleration
            b = curvatures / acceleration
            c = np.zeros_like(tangents)
            if linear is not None:
                further_a, further_b, further_c = linear(gridpoints)
                a = np.column_stack([a, further_a])
                b = np.column_stack([b, further_b])
                c = np.column_stack([c, further_c])
            signs = np.vstack([np.eye(a.shape[1]), -np.eye(a.shape[1])])
            coefficients = canlinear_colloc_to_interpolate(
                a, b, c, signs, np.ones(len(signs)), None, None, gridpoints, identical=True
            )
            return *coefficients[:-1], bounds_of_squares

    return Constraint()
