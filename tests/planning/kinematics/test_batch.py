"""Tests that batch evaluation equals evaluation one by one."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from vkc_pin.planning.kinematics.batch import _MAX_BUFFERS, BatchFunction


def make() -> ca.Function:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    matrix = ca.vertcat(
        ca.horzcat(x[0] * y[0], ca.sin(x[1])),
        ca.horzcat(x[2], y[1] ** 2),
        ca.horzcat(ca.sumsqr(x), y[0]),
    )
    return ca.Function("f", [x, y], [ca.densify(matrix), ca.sumsqr(x) + y[1]])


def one_by_one(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    function = make()
    found = [function(a, b) for a, b in zip(x, np.broadcast_to(y, (len(x), 2)), strict=True)]
    return np.array([np.asarray(m).ravel(order="F") for m, _ in found]), np.array(
        [np.asarray(s).ravel() for _, s in found]
    )


@pytest.mark.parametrize("batch", [1, 2, 7, 300])
def test_rows_are_those_of_the_function_with_entries_by_column(batch: int) -> None:
    rng = np.random.default_rng(batch)
    x, y = rng.normal(size=(batch, 3)), rng.normal(size=(batch, 2))
    matrix, number = BatchFunction(make())(x, y)
    expected = one_by_one(x, y)
    assert matrix.shape == (batch, 6)
    assert number.shape == (batch, 1)
    np.testing.assert_allclose(matrix, expected[0], rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(number, expected[1], rtol=0.0, atol=1e-14)


def test_one_row_for_all() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(5, 3)), rng.normal(size=2)
    np.testing.assert_allclose(
        BatchFunction(make())(x, y)[0], one_by_one(x, y)[0], rtol=0.0, atol=1e-14
    )


def test_results_are_the_callers_own() -> None:
    function, rng = BatchFunction(make()), np.random.default_rng(0)
    first, second, y = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.normal(size=(4, 2))
    kept, _ = function(first, y)
    kept_before, given_before = kept.copy(), first.copy()
    function(second, y)
    np.testing.assert_array_equal(kept, kept_before)
    np.testing.assert_array_equal(first, given_before)
    kept[...] = np.nan
    np.testing.assert_array_equal(function(first, y)[0], kept_before)


def test_sizes_may_change_from_call_to_call() -> None:
    function, rng = BatchFunction(make()), np.random.default_rng(0)
    for batch in [*range(1, 2 * _MAX_BUFFERS), 3, 1, 2 * _MAX_BUFFERS - 1, 3]:
        x, y = rng.normal(size=(batch, 3)), rng.normal(size=(batch, 2))
        np.testing.assert_allclose(function(x, y)[0], one_by_one(x, y)[0], rtol=0.0, atol=1e-14)


def test_arrays_need_not_be_contiguous_nor_of_floats() -> None:
    x, y = (
        np.arange(24)[::-1].reshape(4, 6)[:, ::2],
        np.asfortranarray(np.arange(8.0).reshape(4, 2)),
    )
    np.testing.assert_allclose(
        BatchFunction(make())(x, y)[0], one_by_one(x, y)[0], rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize("shapes", [[(4, 3), (5, 2)], [(4, 2), (4, 2)], [(4, 3), (4, 3)], [(4, 3)]])
def test_wrong_shapes_are_refused(shapes: list[tuple[int, ...]]) -> None:
    with pytest.raises(ValueError, match=r"shape|argument"):
        BatchFunction(make())(*(np.zeros(shape) for shape in shapes))
