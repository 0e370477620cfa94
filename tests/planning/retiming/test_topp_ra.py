"""Tests speeds along paths against analytic results."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds

FREE = (np.full(2, -np.inf), np.full(2, np.inf))


def compute_duration(places: np.ndarray, speeds: np.ndarray) -> float:
    return float((2.0 * np.diff(places) / (speeds[1:] + speeds[:-1])).sum())


@pytest.mark.parametrize(("length", "fastest", "strongest"), [(1.0, 10.0, 2.0), (3.0, 0.5, 1.0)])
def test_duration_of_a_straight_path(length: float, fastest: float, strongest: float) -> None:
    """Full acceleration, a phase at full speed if the path is long enough, and braking."""
    path = fit_path(np.array([[0.0, 0.0], [length, 0.0]]), np.ones(2), FREE)
    places = np.linspace(0.0, length, 201)
    speeds = compute_speeds(
        path, places, np.array([fastest, np.inf]), np.array([strongest, np.inf])
    )
    assert speeds is not None
    ramp = fastest / strongest
    shortest = (
        2.0 * np.sqrt(length / strongest) if fastest * ramp > length else length / fastest + ramp
    )
    assert compute_duration(places, speeds) == pytest.approx(shortest, rel=1e-2)
    assert speeds[[0, -1]].tolist() == [0.0, 0.0]
    assert speeds.max() <= fastest * (1 + 1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**5))
def test_limits_hold_along_the_path(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = fit_path(np.cumsum(rng.normal(size=(6, 2)), axis=0), np.ones(2), FREE)
    places = np.unique(
        np.concatenate([np.linspace(a, b, 9) for a, b in zip(path.x, path.x[1:], strict=False)])
    )
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
    path = fit_path(np.array([[0.0, 0.0], [1.0, 0.0]]), np.ones(2), FREE)
    assert compute_speeds(path, path.x, np.full(2, np.inf), np.full(2, np.inf)) is None


def test_matplotlib_is_not_imported() -> None:
    """The import takes half a second and serves only the plots of toppra, which still work."""
    code = """
import sys, numpy as np
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.planning.retiming.topp_ra import compute_speeds
free = np.full(1, np.inf)
path = fit_path(np.array([[0.0], [1.0]]), np.ones(1), (-free, free))
assert compute_speeds(path, np.linspace(0.0, 1.0, 9), np.ones(1), np.ones(1)) is not None
assert not [name for name in sys.modules if name.startswith("matplotlib")]
from toppra.algorithm.algorithm import plt
import matplotlib.pyplot
assert plt.figure is matplotlib.pyplot.figure
"""
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


def test_further_constraints_hold_along_the_path() -> None:
    """|b w²| ≤ 1 with b = 4 limits the speed to 0.5, |a u| ≤ 1 with a = 2 its change to 0.5."""
    path = fit_path(np.array([[0.0, 0.0], [3.0, 0.0]]), np.ones(2), FREE)
    places, limits = np.linspace(0.0, 3.0, 201), (np.full(2, 10.0), np.full(2, 2.0))

    def linear(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rows = np.ones((len(positions), 2))
        return rows * [0.0, 2.0], rows * [4.0, 0.0], rows * 0.0

    speeds = compute_speeds(path, places, *limits, linear)
    assert speeds is not None
    assert compute_duration(places, speeds) == pytest.approx(3.0 / 0.5 + 0.5 / 0.5, rel=1e-2)
    assert speeds.max() == pytest.approx(0.5, rel=1e-6)
