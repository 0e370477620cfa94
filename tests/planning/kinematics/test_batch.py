"""Tests that batch evaluation equals evaluation one by one."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from vkc_pin.planning.kinematics.batch import BatchFunction


def make_function() -> ca.Function:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    matrix = ca.vertcat(
        ca.horzcat(x[0] * y[0], ca.sin(x[1])),
        ca.horzcat(x[2], y[1] ** 2),
        ca.horzcat(ca.sumsqr(x), y[0]),
    )
    return ca.Function("f", [x, y], [ca.densify(matrix), ca.sumsqr(x) + y[1]])


FUNCTION = make_function()


def evaluate_one_by_one(x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    found = [FUNCTION(a, b) for a, b in zip(x, np.broadcast_to(y, (len(x), 2)), strict=True)]
    columns = zip(*found, strict=True)
    return [np.array([part.full().ravel(order="F") for part in parts]) for parts in columns]


def test_batch_evaluation_equals_single_evaluations() -> None:
    """Batch sizes vary; inputs are single rows, not contiguous, or integers."""
    function, rng = BatchFunction(make_function()), np.random.default_rng(0)
    for batch in [*range(1, 330, 16), 3, 1, 2]:
        x, y = rng.normal(size=(batch, 3)), rng.normal(size=(batch, 2))
        integers = np.arange(6 * batch)[::-1].reshape(batch, 6)[:, ::2] % 7
        for inputs in ((x, y), (x, y[0]), (integers, np.asfortranarray(y))):
            before = [part.copy() for part in inputs]
            results = function(*inputs)
            for found, expected in zip(results, evaluate_one_by_one(*before), strict=True):
                np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)
            for part, unmodified in zip(inputs, before, strict=True):
                np.testing.assert_array_equal(part, unmodified)


def test_results_are_copies() -> None:
    function, rng = BatchFunction(make_function()), np.random.default_rng(0)
    first, second, y = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.normal(size=(4, 2))
    result, _ = function(first, y)
    before = result.copy()
    function(second, y)
    np.testing.assert_array_equal(result, before)
    result[...] = np.nan
    np.testing.assert_array_equal(function(first, y)[0], before)


@pytest.mark.parametrize("shapes", [[(4, 3), (5, 2)], [(4, 2), (4, 2)], [(4, 3), (4, 3)], [(4, 3)]])
def test_wrong_shapes_are_rejected(shapes: list[tuple[int, ...]]) -> None:
    with pytest.raises(ValueError, match=r"shape|argument"):
        BatchFunction(make_function())(*(np.zeros(shape) for shape in shapes))
