"""Tests the motion cost, as squares and as path length, and its quadratic model."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.planning.nlp.objective import SMOOTHING_LENGTH, MotionCost

METRIC = np.array([1.0, 1.0, 0.04, 0.01, 0.01, 1.0])
ENDS, STOPS = np.array([6, 10, 19]), (6,)
SMOOTHING = 4.8


def make_cost(*, length: bool = True) -> MotionCost:
    return MotionCost(METRIC, SMOOTHING, ENDS, STOPS, length=length)


def compute_rates(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps of z_0..z_N, and their changes from and to rest in each run."""
    runs = [path[begin : end + 1] for begin, end in itertools.pairwise([0, *STOPS, ENDS[-1]])]
    changes = [np.diff(np.diff(run, axis=0), axis=0, prepend=0.0, append=0.0) for run in runs]
    return np.diff(path, axis=0), np.vstack(changes)


def compute_quadratic(weights: tuple[np.ndarray, np.ndarray], path: np.ndarray) -> float:
    rates = compute_rates(path)
    return float(sum(np.sum(w * part**2) for w, part in zip(weights, rates, strict=True)))


def sample_path(seed: int, scale: float = 1.0) -> np.ndarray:
    steps = np.random.default_rng(seed).normal(size=(ENDS[-1] + 1, len(METRIC)))
    return 0.1 * scale * np.cumsum(steps, axis=0)


def compute_path_length(path: np.ndarray) -> float:
    """Return the path length, phase by phase, from its definition."""
    steps, changes = compute_rates(path)
    stops = [0, *STOPS, ENDS[-1]]
    at = [max(t, 1) for begin, end in itertools.pairwise(stops) for t in range(begin, end + 1)]
    total = 0.0
    for begin, end in itertools.pairwise([0, *ENDS]):
        inside = [begin < t <= end for t in at]
        for group in ([0, 1], [2], [3], [4], [5]):
            weight = METRIC[group[0]]
            squares = np.sum(steps[begin:end, group] ** 2)
            squares += SMOOTHING * np.sum(changes[inside][:, group] ** 2)
            epsilon = SMOOTHING_LENGTH * np.sqrt(weight)
            total += np.sqrt(epsilon**2 + (end - begin) * weight * squares) - epsilon
    return float(total)


@pytest.mark.parametrize("seed", range(3))
def test_costs_equal_their_definitions(seed: int) -> None:
    """The squared cost is that of equation 1."""
    path = sample_path(seed)
    steps, changes = compute_rates(path)
    total = np.sum(METRIC * steps**2) + SMOOTHING * np.sum(METRIC * changes**2)
    squares = make_cost(length=False)
    assert squares.value(steps, changes) == pytest.approx(total, rel=1e-12)
    weights = squares.weights(*compute_rates(sample_path(9)))
    assert compute_quadratic(weights, path) == pytest.approx(total, rel=1e-12)
    length = compute_path_length(path)
    assert make_cost().value(steps, changes) == pytest.approx(length, rel=1e-12)


def test_stationary_motion_costs_nothing() -> None:
    still = compute_rates(np.tile(sample_path(0)[0], (ENDS[-1] + 1, 1)))
    for length in (False, True):
        assert make_cost(length=length).value(*still) == 0.0
    assert np.isfinite(make_cost().weights(*still)[0]).all()


def test_motion_at_constant_speed_costs_its_length() -> None:
    """The base moves 4 m and a joint 2 rad; one phase has nine times the other's waypoints."""
    for middle in (4, 36):
        x, joint = (
            np.interp(np.arange(41), [0, middle, 40], values)
            for values in ([0.0, 1.0, 4.0], [0.0, 1.5, 2.0])
        )
        path = np.outer(x, [0.6, 0.8, 0.0, 0.0, 0.0, 0.0])
        path[:, 3] = joint
        steps = np.diff(path, axis=0)
        changes = np.diff(steps, axis=0, prepend=0.0, append=0.0)
        cost = MotionCost(METRIC, 0.0, np.array([middle, 40]), (), length=True)
        assert cost.value(steps, changes) == pytest.approx(4.0 + 0.1 * 2.0, abs=0.07)


@given(st.integers(0, 10**6), st.integers(0, 10**6), st.floats(0.01, 3.0), st.floats(0.01, 3.0))
def test_quadratic_model_bounds_the_length_from_above(
    one: int, other: int, here: float, there: float
) -> None:
    f, at, away = make_cost(), sample_path(one, here), sample_path(other, there)
    weights = f.weights(*compute_rates(at))
    rise = compute_quadratic(weights, away) - compute_quadratic(weights, at)
    assert rise >= f.value(*compute_rates(away)) - f.value(*compute_rates(at)) - 1e-9
    direction, step = away - at, 1e-6
    ahead, behind = at + step * direction, at - step * direction
    slopes = [
        (f.value(*compute_rates(ahead)) - f.value(*compute_rates(behind))) / (2 * step),
        (compute_quadratic(weights, ahead) - compute_quadratic(weights, behind)) / (2 * step),
    ]
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-4, abs=1e-5)


@given(st.integers(0, 10**6), st.integers(0, 10**6), st.booleans())
def test_cost_is_convex(one: int, other: int, length: bool) -> None:
    f, a, b = make_cost(length=length), sample_path(one), sample_path(other)
    middle, *ends = (f.value(*compute_rates(path)) for path in ((a + b) / 2, a, b))
    assert middle <= sum(ends) / 2 + 1e-12
