"""Tests speeds along paths against analytic results, and against the library toppra."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toppra.algorithm import TOPPRA
from toppra.constraint import LinearConstraint
from toppra.constraint.linear_constraint import canlinear_colloc_to_interpolate
from toppra.interpolator import AbstractGeometricPath

from vkc_pin.planning.retiming.cubic_path import CubicPath, compute_natural_slopes
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import PathSamples, compute_speeds

FREE = (np.full(2, -np.inf), np.full(2, np.inf))
Linear = tuple[np.ndarray, np.ndarray, np.ndarray]


def make_line(length: float) -> CubicPath:
    """Return a straight path along the first of two coordinates."""
    return fit_path(np.array([[0.0, 0.0], [length, 0.0]]), np.ones(2), FREE)


def make_smooth_path(rng: np.random.Generator) -> CubicPath:
    """Return a path of 1 to 8 coordinates without jumps in curvature."""
    count = int(rng.integers(3, 12))
    knots = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, 2.0, count))])
    values = np.cumsum(rng.normal(size=(len(knots), rng.integers(1, 9))), axis=0)
    return CubicPath(knots, values, compute_natural_slopes(knots, values))


def make_kinked_path(rng: np.random.Generator) -> CubicPath:
    """Return a path whose curvature jumps at all knots."""
    smooth = make_smooth_path(rng)
    slopes = smooth(smooth.x, 1)
    return CubicPath(smooth.x, smooth(smooth.x), slopes + 0.3 * rng.normal(size=slopes.shape))


def choose_positions(path: CubicPath, pieces: int) -> np.ndarray:
    """Return positions that divide each cubic into equal pieces."""
    knots = np.arange(len(path.x))
    return np.interp(np.arange(pieces * knots[-1] + 1) / pieces, knots, path.x)


def draw_rows(rng: np.random.Generator, positions: np.ndarray) -> Linear:
    """Return coefficients a, b, c of 3 constraints, linear in the position; rest is feasible."""
    fractions = ((positions - positions[0]) / np.ptp(positions))[:, None]
    begin, end = rng.uniform(-0.9, 0.9, (2, 3, 1, 3))
    a, b, c = begin + (end - begin) * fractions
    return a, b, c


def compute_duration(positions: np.ndarray, speeds: np.ndarray) -> float:
    return float((2.0 * np.diff(positions) / (speeds[1:] + speeds[:-1])).sum())


def compute_ratios(
    path: CubicPath,
    positions: np.ndarray,
    speeds: np.ndarray,
    acceleration: np.ndarray,
    linear: Linear | None = None,
) -> np.ndarray:
    """Return |a u + b w² + c| at both ends of all intervals."""
    samples = PathSamples.from_positions(path, positions)
    a = path(samples.positions, 1, samples.cubics) / acceleration
    b = path(samples.positions, 2, samples.cubics) / acceleration
    c = np.zeros_like(a)
    if linear is not None:
        a, b, c = (np.hstack(pair) for pair in zip((a, b, c), linear, strict=True))
    squares = speeds[:, None] ** 2
    u = np.diff(squares, axis=0) / (2.0 * np.diff(positions)[:, None])
    begins, ends = samples.begins, samples.begins + 1
    at_begins = a[begins] * u + b[begins] * squares[:-1] + c[begins]
    at_ends = a[ends] * u + b[ends] * squares[1:] + c[ends]
    return np.abs(np.concatenate([at_begins, at_ends]))


def compute_speeds_by_toppra(
    path: CubicPath,
    positions: np.ndarray,
    velocity: np.ndarray,
    acceleration: np.ndarray,
    linear: Linear | None = None,
    end_speeds: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray | None:
    """Return the result of `compute_speeds` for a path whose curvature does not jump.

    `linear` are coefficients at the positions.
    """

    class Path(AbstractGeometricPath):
        dof = len(velocity)
        path_interval = np.array([path.x[0], path.x[-1]])

        def __call__(self, positions: Any, order: int = 0) -> Any:
            return path(positions, order)

    class Limits(LinearConstraint):
        dof = len(velocity)

        def __init__(self) -> None:
            super().__init__()
            self.identical = True

        def compute_constraint_params(self, geometric: Any, grid: np.ndarray) -> Any:
            tangents = path(grid, 1)
            with np.errstate(divide="ignore"):
                fastest = (velocity / np.abs(tangents)).min(axis=1)
            squares = np.column_stack([np.zeros(len(grid)), np.minimum(fastest, 1e8) ** 2])
            rows = [tangents / acceleration, path(grid, 2) / acceleration, 0.0 * tangents]
            if linear is not None:
                rows = [np.hstack(pair) for pair in zip(rows, linear, strict=True)]
            signs = np.vstack([np.eye(rows[0].shape[1]), -np.eye(rows[0].shape[1])])
            bounds = np.ones(len(signs))
            interpolated = canlinear_colloc_to_interpolate(
                *rows, signs, bounds, None, None, grid, identical=True
            )
            return *interpolated[:-1], squares

    solver = TOPPRA([Limits()], Path(), gridpoints=positions, solver_wrapper="seidel")
    _, speeds, _ = solver.compute_parameterization(*end_speeds)
    return None if speeds is None else np.asarray(speeds)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10**9), st.booleans(), st.booleans())
def test_speeds_are_those_of_toppra(seed: int, has_rows: bool, is_moving: bool) -> None:
    rng = np.random.default_rng(seed)
    path = make_smooth_path(rng)
    positions = choose_positions(path, int(rng.integers(3, 9)))
    size = path(0.0).shape[0]
    velocity, acceleration = rng.uniform(0.3, 3.0, (2, size))
    at_positions, at_samples = None, None
    if has_rows:
        at_positions = draw_rows(rng, positions)
        places = np.searchsorted(positions, PathSamples.from_positions(path, positions).positions)
        a, b, c = at_positions
        at_samples = (a[places], b[places], c[places])
    ends = (0.0, 0.0)
    if is_moving:
        fastest = (velocity / np.abs(path(positions[[0, -1]], 1))).min(axis=1)
        first, last = rng.uniform(0.0, 0.5, 2) * fastest
        ends = (float(first), float(last))
    limits = (velocity, acceleration)
    speeds = compute_speeds(path, positions, *limits, at_samples, ends)
    expected = compute_speeds_by_toppra(path, positions, *limits, at_positions, ends)
    assert (speeds is None) == (expected is None)
    if speeds is None or expected is None:
        return
    # Its tolerance is 1e-8, so that it has slightly larger speeds where they are almost zero.
    duration = compute_duration(positions, speeds)
    assert duration == pytest.approx(compute_duration(positions, expected), rel=5e-3)
    assert speeds[[0, -1]] == pytest.approx(ends)
    assert compute_ratios(path, positions, speeds, acceleration, at_samples).max() <= 1.0 + 1e-9


def test_inner_knots_have_samples_of_both_cubics() -> None:
    path = make_kinked_path(np.random.default_rng(0))
    positions = choose_positions(path, 3)
    samples = PathSamples.from_positions(path, positions)
    cubics = np.repeat(np.arange(len(path.x) - 1), 3)
    ends = samples.begins + 1
    assert samples.cubics[samples.begins].tolist() == cubics.tolist()
    assert samples.cubics[ends].tolist() == cubics.tolist()
    assert samples.positions[samples.begins].tolist() == positions[:-1].tolist()
    assert samples.positions[ends].tolist() == positions[1:].tolist()


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**9))
def test_limits_hold_on_both_sides_of_knots(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = make_kinked_path(rng)
    positions = choose_positions(path, 3)
    velocity, acceleration = rng.uniform(0.3, 3.0, (2, path(0.0).shape[0]))
    linear = draw_rows(rng, PathSamples.from_positions(path, positions).positions)
    speeds = compute_speeds(path, positions, velocity, acceleration, linear)
    assert speeds is not None
    assert (np.abs(path(positions, 1)) * speeds[:, None] <= velocity * (1.0 + 1e-9)).all()
    ratios = compute_ratios(path, positions, speeds, acceleration, linear)
    assert ratios.max() <= 1.0 + 1e-9


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**9), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_speeds_do_not_depend_on_units(seed: int, time_unit: float, path_unit: float) -> None:
    rng = np.random.default_rng(seed)
    path = make_kinked_path(rng)
    positions = choose_positions(path, 3)
    velocity, acceleration = rng.uniform(0.3, 3.0, (2, path(0.0).shape[0]))
    speeds = compute_speeds(path, positions, velocity, acceleration)
    other = CubicPath(path.x * path_unit, path(path.x), path(path.x, 1) / path_unit)
    limits = (velocity * time_unit, acceleration * time_unit**2)
    others = compute_speeds(other, positions * path_unit, *limits)
    assert speeds is not None
    assert others is not None
    duration = compute_duration(positions, speeds)
    rescaled = compute_duration(positions * path_unit, others) * time_unit
    assert rescaled == pytest.approx(duration, rel=1e-5)


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("count", [4, 1000])
def test_braking_as_strongly_as_possible_is_feasible(length: float, count: int) -> None:
    """At constant deceleration a, v² = 2 a L: from a greater speed there is no stopping."""
    positions = np.linspace(0.0, length, count)
    limits = np.full(2, np.inf), np.array([0.7, np.inf])
    fastest = float(np.sqrt(2.0 * 0.7 * length))
    path = make_line(length)
    speeds = compute_speeds(path, positions, *limits, end_speeds=(fastest, 0.0))
    assert speeds == pytest.approx(fastest * np.sqrt(1.0 - positions / length), rel=1e-5, abs=0.0)
    for ends in ((1.00001 * fastest, 0.0), (0.0, 1.00001 * fastest)):
        assert compute_speeds(path, positions, *limits, end_speeds=ends) is None


def test_limits_of_velocities_at_the_ends() -> None:
    positions = np.linspace(0.0, 3.0, 31)
    limits = np.array([0.5, 1.0]), np.ones(2)
    speeds = compute_speeds(make_line(3.0), positions, *limits, end_speeds=(0.5, 0.5))
    assert speeds == pytest.approx(np.full(31, 0.5))
    for ends in ((0.501, 0.0), (0.0, 0.501)):
        assert compute_speeds(make_line(3.0), positions, *limits, end_speeds=ends) is None


def test_coordinates_may_be_limited_in_velocity_or_acceleration_alone() -> None:
    points = np.array([[0.0, 0.0], [3.0, 3.0]])
    path = fit_path(points, np.ones(2), FREE)
    length = path.x[-1]
    positions = np.linspace(0.0, length, 301)
    limits = np.array([0.5, np.inf]), np.array([np.inf, 1.0])
    speeds = compute_speeds(path, positions, *limits)
    assert speeds is not None
    assert compute_duration(positions, speeds) == pytest.approx(3.0 / 0.5 + 0.5, rel=1e-2)


def time_turn(tangent: float, length: float) -> tuple[float, float]:
    """Return the duration of a motion to and fro, and the path velocity where it turns.

    The coordinate goes to `length` and back, within an acceleration of `length`.
    """
    knots = np.array([0.0, 1.0, 2.0])
    slopes = np.array([[1.0], [tangent], [-1.0]])
    path = CubicPath(knots, length * np.array([[0.0], [1.0], [0.0]]), length * slopes)
    positions = choose_positions(path, 100)
    speeds = compute_speeds(path, positions, np.array([100.0]), np.array([length]))
    assert speeds is not None
    return compute_duration(positions, speeds), float(speeds[100])


def test_path_velocity_where_the_only_coordinate_turns() -> None:
    """It brakes from the middle to the turn and accelerates back: q″ = -4 there, q″ w² = -1."""
    duration, speed = time_turn(0.0, 1.0)
    assert speed == pytest.approx(0.5, rel=1e-2)
    assert duration == pytest.approx(4.0, rel=3e-2)


@pytest.mark.parametrize("tangent", [1e-20, -1e-20, 1e-16, -1e-16])
def test_tangents_may_be_zero_but_for_rounding(tangent: float) -> None:
    """Limits then hardly depend on the path acceleration."""
    for length in np.geomspace(0.05, 20.0, 40):
        expected = time_turn(0.0, length)
        assert time_turn(tangent, length) == pytest.approx(expected, rel=1e-6)


def test_torques_exceeded_at_rest_allow_no_speeds() -> None:
    positions = np.linspace(0.0, 1.0, 31)
    ones = np.ones((31, 1))
    limits = np.ones(2), np.ones(2)
    for constant, is_feasible in ((0.99, True), (1.01, False), (-1.01, False)):
        linear = (ones, 0.0 * ones, constant * ones)
        speeds = compute_speeds(make_line(1.0), positions, *limits, linear)
        assert (speeds is not None) == is_feasible


@pytest.mark.parametrize(
    ("length", "fastest", "strongest", "shortest"),
    [(1.0, 10.0, 2.0, 2.0 * np.sqrt(1.0 / 2.0)), (3.0, 0.5, 1.0, 3.0 / 0.5 + 0.5 / 1.0)],
)
def test_duration_of_a_straight_path(
    length: float, fastest: float, strongest: float, shortest: float
) -> None:
    """Full acceleration, a phase at full speed if the path is long enough, and braking."""
    places = np.linspace(0.0, length, 201)
    limits = np.array([fastest, np.inf]), np.array([strongest, np.inf])
    speeds = compute_speeds(make_line(length), places, *limits)
    assert speeds is not None
    assert compute_duration(places, speeds) == pytest.approx(shortest, rel=1e-2)
    assert speeds[[0, -1]].tolist() == [0.0, 0.0]
    assert speeds.max() <= fastest * (1 + 1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**5))
def test_limits_hold_along_the_path(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = fit_path(np.cumsum(rng.normal(size=(6, 2)), axis=0), np.ones(2), FREE)
    places = np.interp(np.arange(41) / 8, np.arange(6), path.x)
    velocity, acceleration = rng.uniform(0.5, 3.0, 2), rng.uniform(0.5, 3.0, 2)
    speeds = compute_speeds(path, places, velocity, acceleration)
    assert speeds is not None
    assert (speeds[1:-1] > 0.0).all()
    assert (np.abs(path(places, 1)) * speeds[:, None] <= velocity * (1 + 1e-3)).all()
    change = np.diff(speeds**2) / (2.0 * np.diff(places))
    middle = (places[1:] + places[:-1]) / 2.0
    squared = (speeds[1:] ** 2 + speeds[:-1] ** 2) / 2.0
    found = path(middle, 1) * change[:, None] + path(middle, 2) * squared[:, None]
    assert (np.abs(found) <= acceleration * 1.3).all()


def test_no_speeds_without_limits() -> None:
    unlimited = np.full(2, np.inf)
    assert compute_speeds(make_line(1.0), np.array([0.0, 1.0]), unlimited, unlimited) is None


def test_no_library_of_splines_is_imported() -> None:
    """Its import would take longer than timing a motion."""
    code = """
import sys, numpy as np
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds
path = fit_path(np.array([[0.0], [1.0]]), np.ones(1), (-np.ones(1), np.ones(1)))
assert compute_speeds(path, np.linspace(0.0, 1.0, 4), np.ones(1), np.ones(1)) is not None
import vkc_pin.planning.planner
unused = ("matplotlib", "scipy", "toppra")
assert not [name for name in sys.modules if name.startswith(unused)]
"""
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


def test_further_constraints_hold_along_the_path() -> None:
    """|b w²| ≤ 1 with b = 4 limits the speed to 0.5, |a u| ≤ 1 with a = 2 its change to 0.5."""
    places, limits = np.linspace(0.0, 3.0, 201), (np.full(2, 10.0), np.full(2, 2.0))
    rows = np.ones((len(places), 2))
    linear = (rows * [0.0, 2.0], rows * [4.0, 0.0], rows * 0.0)
    speeds = compute_speeds(make_line(3.0), places, *limits, linear)
    assert speeds is not None
    assert compute_duration(places, speeds) == pytest.approx(3.0 / 0.5 + 0.5 / 0.5, rel=1e-2)
    assert speeds.max() == pytest.approx(0.5, rel=1e-6)
