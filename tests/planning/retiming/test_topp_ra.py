"""Tests speeds along paths against analytic results."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds

FREE = (np.full(2, -np.inf), np.full(2, np.inf))


def make_line(length: float) -> CubicPath:
    """Return a straight path along the first of two coordinates."""
    return fit_path(np.array([[0.0, 0.0], [length, 0.0]]), np.ones(2), FREE)


def compute_duration(places: np.ndarray, speeds: np.ndarray) -> float:
    return float((2.0 * np.diff(places) / (speeds[1:] + speeds[:-1])).sum())


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


def test_neither_matplotlib_nor_splines_are_imported() -> None:
    """The imports take half a second and serve plots and splines of toppra, which still work."""
    code = """
import sys, numpy as np
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds
path = fit_path(np.array([[0.0], [1.0]]), np.ones(1), (-np.ones(1), np.ones(1)))
assert compute_speeds(path, path.x, np.ones(1), np.ones(1)) is not None
unused = ("matplotlib", "scipy.interpolate", "scipy.sparse")
assert not [name for name in sys.modules if name.startswith(unused)]
from toppra.algorithm.algorithm import plt
import matplotlib.pyplot
assert plt.figure is matplotlib.pyplot.figure
from toppra import SplineInterpolator
assert SplineInterpolator([0.0, 1.0, 2.0], [[0.0], [1.0], [4.0]])(1.5).shape == (1,)
"""
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


def test_further_constraints_hold_along_the_path() -> None:
    """|b w²| ≤ 1 with b = 4 limits the speed to 0.5, |a u| ≤ 1 with a = 2 its change to 0.5."""
    places, limits = np.linspace(0.0, 3.0, 201), (np.full(2, 10.0), np.full(2, 2.0))

    def linear(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rows = np.ones((len(positions), 2))
        return rows * [0.0, 2.0], rows * [4.0, 0.0], rows * 0.0

    speeds = compute_speeds(make_line(3.0), places, *limits, linear)
    assert speeds is not None
    assert compute_duration(places, speeds) == pytest.approx(3.0 / 0.5 + 0.5 / 0.5, rel=1e-2)
    assert speeds.max() == pytest.approx(0.5, rel=1e-6)
