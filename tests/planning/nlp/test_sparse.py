from __future__ import annotations

import casadi as ca
import numpy as np

from vkc_pin.planning.nlp.sparse import assemble, make_curvature, make_differences, make_sparse


def test_parts_go_to_their_places_and_add_up_where_they_meet() -> None:
    first, second = ca.MX.sym("a", 3), ca.MX.sym("b", 3)
    at = [np.array([[2, 0, 1], [1, 0, 3]]), np.array([[0, 2, 2], [0, 1, 0]])]
    matrix = ca.Function("matrix", [first, second], [assemble([first, second], at, 3, 4)])
    expected = np.zeros((3, 4))
    expected[2, 1], expected[0, 0], expected[1, 3], expected[2, 0] = (
        1.0 + 20.0,
        2.0 + 10.0,
        3.0,
        30.0,
    )
    found = matrix([1.0, 2.0, 3.0], [10.0, 20.0, 30.0])
    np.testing.assert_array_equal(np.asarray(found.full()), expected)
    assert found.nnz() == 4


def test_small_matrices() -> None:
    assert make_sparse(np.array([[0.0, 2.0], [0.0, 0.0]])).nnz() == 1


def test_curvature_is_of_weighted_squares() -> None:
    parts = make_differences(7, (3,))[:2]
    weights = [np.random.default_rng(3).uniform(1.0, 2.0, len(part)) for part in parts]
    (row, column), maps = make_curvature(parts)
    values = sum(
        np.asarray((matrix @ ca.DM(weight)).full()).ravel()
        for matrix, weight in zip(maps, weights, strict=True)
    )
    hessian = np.zeros((7, 7))
    hessian[row, column] = values
    expected = sum(
        2 * part.T @ np.diag(weight) @ part for part, weight in zip(parts, weights, strict=True)
    )
    np.testing.assert_allclose(hessian, np.triu(expected), atol=1e-12)
    assert len(row) < 7 * 4, "it is banded"
