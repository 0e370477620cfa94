"""Tests cubic paths against SciPy's splines."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from vkc_pin.planning.retiming.cubic_path import CubicPath, compute_natural_slopes


def make_knots(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.uniform(0.01, 1.0, count))
    values, slopes = rng.normal(size=(2, count, 3))
    return x, values, slopes


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 40), order=st.integers(0, 3))
def test_path_equals_scipys_spline(seed: int, count: int, order: int) -> None:
    x, values, slopes = make_knots(seed, count)
    at = np.concatenate([x, x[::-1], np.linspace(x[0] - 0.5, x[-1] + 0.5, 30)]).reshape(2, -1)
    expected = CubicHermiteSpline(x, values, slopes)(at, order)
    np.testing.assert_array_equal(CubicPath(x, values, slopes)(at, order), expected)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 40))
def test_natural_slopes_equal_scipys(seed: int, count: int) -> None:
    x, values, _ = make_knots(seed, count)
    expected = CubicSpline(x, values, bc_type="natural")(x, 1)
    slopes = compute_natural_slopes(x, values)
    np.testing.assert_allclose(slopes, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


def test_path_takes_single_positions() -> None:
    path = CubicPath(*make_knots(0, 5))
    assert path(1.0).shape == (3,)
    np.testing.assert_array_equal(path(path.x[2]), path([path.x[2]])[0])
