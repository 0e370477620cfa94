from __future__ import annotations

import casadi as ca
import numpy as np

from vkc_pin.program.sparse import assemble, sparse, unit


def test_parts_go_to_their_places_and_add_up_where_they_meet() -> None:
    first, second = ca.MX.sym("a", 3), ca.MX.sym("b", 3)
    at = [np.array([[2, 0, 1], [1, 0, 3]]), np.array([[0, 2, 2], [0, 1, 0]])]
    matrix = ca.Function("matrix", [first, second], [assemble([first, second], at, 3, 4)])
    expected = np.zeros((3, 4))
    expected[2, 1], expected[0, 0], expected[1, 3], expected[2, 0] = 1.0 + 20.0, 2.0 + 10.0, 3.0, 30.0
    found = matrix([1.0, 2.0, 3.0], [10.0, 20.0, 30.0])
    np.testing.assert_array_equal(np.asarray(found.full()), expected)
    assert found.nnz() == 4


def test_small_matrices() -> None:
    assert sparse(np.array([[0.0, 2.0], [0.0, 0.0]])).nnz() == 1
    np.testing.assert_array_equal(np.asarray(unit(2, 3, 1).full()), [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
