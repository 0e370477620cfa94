"""Tests the motion cost, as squares and as path length, and its quadratic model."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.planning.nlp.objective import SMOOTHING_LENGTH, MotionCost
from vkc_pin.planning.nlp.sparse import make_differences

METRIC = np.array([1.0, 1.0, 0.04, 0.01, 0.01, 1.0])
ENDS, STOPS = np.array([6, 10, 19]), (6,)
SMOOTHING = 4.8
MATRICES = make_differences(ENDS[-1], STOPS)


def make_cost(*, length: bool = True) -> MotionCost:
    return MotionCost(METRIC, SMOOTHING, ENDS, STOPS, length=length)


def compute_rates(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps of z_0..z_N and their changes."""
    first, second, start_first, start_second = MATRICES
    return first @ path[1:] + np.outer(start_first, path[0]), second @ path[1:] + np.outer(
        start_second, path[0]
    )


def compute_quadratic(weights: tuple[np.ndarray, np.ndarray], path: np.ndarray) -> float:
    return float(
        sum(np.sum(w * part**2) for w, part in zip(weights, compute_rates(path), strict=True))
    )


def sample_path(seed: int, scale: float = 1.0) -> np.ndarray:
    return np.cumsum(
        np.random.default_rng(seed).normal(scale=0.1 * scale, size=(ENDS[-1] + 1, len(METRIC))),
        axis=0,
    )


def compute_path_length(path: np.ndarray) -> float:
    """Return the path length, phase by phase, from its definition."""
    changes, at = [], []
    for begin, end in itertools.pairwise([0, *STOPS, ENDS[-1]]):
        step = np.diff(path[begin : end + 1], axis=0)
        changes.append(np.diff(np.vstack([0 * step[:1], step, 0 * step[:1]]), axis=0))
        at += [max(t, 1) for t in range(begin, end + 1)]
    bends, total = np.vstack(changes), 0.0
    for begin, end in itertools.pairwise([0, *ENDS]):
        inside = [begin < t <= end for t in at]
        for group in ([0, 1], [2], [3], [4], [5]):
            weight = METRIC[group[0]]
            squares = np.sum(
                np.diff(path[begin : end + 1, group], axis=0) ** 2
            ) + SMOOTHING * np.sum(bends[inside][:, group] ** 2)
            epsilon = SMOOTHING_LENGTH * np.sqrt(weight)
            total += np.sqrt(epsilon**2 + (end - begin) * weight * squares) - epsilon
    return float(total)


@pytest.mark.parametrize("seed", range(3))
def test_squared_cost_equals_equation_1(seed: int) -> None:
    path, total = sample_path(seed), 0.0
    for begin, end in itertools.pairwise([0, *STOPS, ENDS[-1]]):
        step = np.diff(path[begin : end + 1], axis=0)
        bend = np.diff(np.vstack([0 * step[:1], step, 0 * step[:1]]), axis=0)
        total += np.sum(METRIC * step**2) + SMOOTHING * np.sum(METRIC * bend**2)
    squares = make_cost(length=False)
    assert squares.value(*compute_rates(path)) == pytest.approx(total, rel=1e-12)
    assert compute_quadratic(
        squares.weights(*compute_rates(sample_path(9))), path
    ) == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_path_length_equals_its_definition(seed: int) -> None:
    path = sample_path(seed)
    assert make_cost().value(*compute_rates(path)) == pytest.approx(
        compute_path_length(path), rel=1e-12
    )


def test_stationary_motion_costs_nothing() -> None:
    still = np.tile(sample_path(0)[0], (ENDS[-1] + 1, 1))
    for length in (False, True):
        assert make_cost(length=length).value(*compute_rates(still)) == 0.0
    assert np.isfinite(make_cost().weights(*compute_rates(still))[0]).all()


def test_motion_at_constant_speed_costs_its_length() -> None:
    """The base moves 4 m and a joint 2 rad; one phase has nine times the other's waypoints."""
    for ends in ((4, 40), (36, 40)):
        path = np.zeros((41, 6))
        path[:, :2] = np.outer(
            np.interp(np.arange(41), [0, ends[0], 40], [0.0, 1.0, 4.0]), [0.6, 0.8]
        )
        path[:, 3] = np.interp(np.arange(41), [0, ends[0], 40], [0.0, 1.5, 2.0])
        matrices = make_differences(40, ())
        rates = [matrices[k] @ path[1:] + np.outer(matrices[k + 2], path[0]) for k in (0, 1)]
        assert MotionCost(METRIC, 0.0, np.array(ends), (), length=True).value(
            *rates
        ) == pytest.approx(4.0 + 0.1 * 2.0, abs=0.07)


@given(st.integers(0, 10**6), st.integers(0, 10**6), st.floats(0.01, 3.0), st.floats(0.01, 3.0))
def test_quadratic_model_bounds_the_length_from_above(
    one: int, other: int, here: float, there: float
) -> None:
    f, at, away = make_cost(), sample_path(one, here), sample_path(other, there)
    weights = f.weights(*compute_rates(at))
    rise = compute_quadratic(weights, away) - compute_quadratic(weights, at)
    assert rise >= f.value(*compute_rates(away)) - f.value(*compute_rates(at)) - 1e-9
    direction, step = away - at, 1e-6
    slopes = [
        (of(at + step * direction) - of(at - step * direction)) / (2 * step)
        for of in (
            lambda path: f.value(*compute_rates(path)),
            lambda path: compute_quadratic(weights, path),
        )
    ]
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-4, abs=1e-5)


@given(st.integers(0, 10**6), st.integers(0, 10**6), st.booleans())
def test_cost_is_convex(one: int, other: int, length: bool) -> None:
    f, a, b = make_cost(length=length), sample_path(one), sample_path(other)
    assert (
        f.value(*compute_rates((a + b) / 2))
        <= (f.value(*compute_rates(a)) + f.value(*compute_rates(b))) / 2 + 1e-12
    )
