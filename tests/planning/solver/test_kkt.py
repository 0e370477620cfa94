"""Tests of Ipopt's linear solver against dense algebra, and within Ipopt."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.solver.subproblem import make_linear_solver_options
from vkc_pin.utils.optional_imports import import_compiled

KKT = import_compiled("vkc_pin.planning.solver._kkt")
OWN = make_linear_solver_options()
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


def lower_triangle(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of a lower triangle, with all of its diagonal."""
    rows, columns = np.nonzero((np.tril(matrix) != 0.0) | np.eye(len(matrix), dtype=bool))
    return rows.astype(np.int32), columns.astype(np.int32), matrix[rows, columns]


def factorize(matrix: np.ndarray) -> tuple[Any, bool]:
    rows, columns, values = lower_triangle(matrix)
    factorization = KKT.Factorization(len(matrix), rows, columns)
    return factorization, factorization.factor(values)


def make_system(seed: int, waypoints: int, size: int, equalities: int, planes: int) -> np.ndarray:
    """Return a trajectory-like system: coupled blocks, their constraints, and some slacks."""
    rng = np.random.default_rng(seed)
    n, m = waypoints * size, waypoints * (equalities + planes)
    hessian = np.zeros((n, n))
    for k in range(waypoints):
        block, root = slice(k * size, (k + 1) * size), rng.normal(size=(size, size))
        hessian[block, block] += root @ root.T + 0.1 * np.eye(size)
        if k > 1:
            change = np.zeros((size, n))
            change[:, block] = np.eye(size)
            change[:, slice((k - 1) * size, k * size)] = -2.0 * np.eye(size)
            change[:, slice((k - 2) * size, (k - 1) * size)] = np.eye(size)
            hessian += 10.0 * change.T @ change
    rows = np.zeros((m, n))
    for row in range(m):
        k = row // (equalities + planes)
        rows[row, k * size : (k + 1) * size] = rng.normal(size=size)
    slack = np.flatnonzero(np.arange(m) % (equalities + planes) >= equalities)
    total = n + len(slack) + m
    matrix = np.zeros((total, total))
    matrix[:n, :n] = hessian
    matrix[np.arange(n, n + len(slack)), np.arange(n, n + len(slack))] = 10.0 ** rng.uniform(
        -4.0, 4.0, len(slack)
    )
    matrix[n + len(slack) :, :n] = rows
    matrix[n + len(slack) + slack, n + np.arange(len(slack))] = -1.0
    return np.tril(matrix) + np.tril(matrix, -1).T


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 6),
    st.integers(2, 6),
    st.integers(0, 2),
    st.integers(0, 3),
)
def test_trajectory_systems_are_solved_with_correct_inertia(
    seed: int, waypoints: int, size: int, equalities: int, planes: int
) -> None:
    matrix = make_system(seed, waypoints, size, min(equalities, size), planes)
    factorization, done = factorize(matrix)
    assert done
    assert factorization.negative == np.count_nonzero(np.linalg.eigvalsh(matrix) < 0.0)
    wanted = np.random.default_rng(seed).normal(size=len(matrix))
    x = matrix @ wanted
    factorization.solve(x)
    residual = np.abs(matrix @ (x - wanted)).max() / (
        np.abs(matrix).sum(axis=1).max() * np.abs(wanted).max()
    )
    assert residual < 1e-10


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 12), st.floats(0.1, 1.0))
def test_any_matrix_is_solved_or_reported_singular(seed: int, size: int, density: float) -> None:
    rng = np.random.default_rng(seed)
    matrix = np.where(rng.uniform(size=(size, size)) < density, rng.normal(size=(size, size)), 0.0)
    matrix += matrix.T
    factorization, done = factorize(matrix)
    # a pivot is zero, as it is in every singular matrix and, since pivots are taken as they come,
    # in some others
    if not done:
        assert min(abs(np.linalg.det(matrix[:k, :k])) for k in range(1, size + 1)) < 1e-8 or np.any(
            np.diag(matrix) == 0.0
        )
        return
    assert factorization.negative == np.count_nonzero(np.linalg.eigvalsh(matrix) < 0.0)


def test_refactoring_does_not_depend_on_earlier_values() -> None:
    first, second = make_system(1, 4, 5, 2, 2), make_system(1, 4, 5, 2, 2)
    second[np.diag_indices(20)] += 3.0
    rows, columns, _ = lower_triangle(first)
    again, anew = (KKT.Factorization(len(first), rows, columns) for _ in range(2))
    assert again.factor(lower_triangle(first)[2])
    assert again.factor(lower_triangle(second)[2])
    assert anew.factor(lower_triangle(second)[2])
    b = np.arange(len(first), dtype=float)
    x, y = b.copy(), b.copy()
    again.solve(x)
    anew.solve(y)
    np.testing.assert_array_equal(x, y)


def test_dependent_rows_are_singular_and_the_next_system_is_solved() -> None:
    matrix = make_system(2, 3, 4, 2, 0)
    doubled = matrix.copy()
    doubled[-1], doubled[:, -1] = doubled[-2], doubled[:, -2]
    rows, columns, values = lower_triangle(matrix)
    factorization = KKT.Factorization(len(matrix), rows, columns)
    assert not factorization.factor(doubled[rows, columns])
    with pytest.raises(ValueError, match="once it is factored"):
        factorization.solve(np.ones(len(matrix)))
    assert factorization.factor(values)
    x = matrix @ np.ones(len(matrix))
    factorization.solve(x)
    np.testing.assert_allclose(x, 1.0, atol=1e-8)


@pytest.mark.parametrize("size", [3, 9, 20])
def test_pivots_of_rounding_size_are_singular(size: int) -> None:
    """The last pivot is tested, also if only other panels update it."""
    root = np.eye(size, size - 1) + 0.1 * np.random.default_rng(size).normal(
        size=(size, size - 1)
    )  # no other pivot is small
    gram = root @ root.T
    assert not factorize(gram)[1]
    assert factorize(gram + 1e-6 * np.eye(size))[1]


def test_dual_rows_may_come_first() -> None:
    """Their numbering makes no difference: they follow the rows that they couple."""
    matrix = make_system(5, 4, 5, 2, 3)[::-1, ::-1]
    factorization, done = factorize(matrix)
    assert done
    assert factorization.negative == np.count_nonzero(np.linalg.eigvalsh(matrix) < 0.0)
    x = matrix @ np.ones(len(matrix))
    factorization.solve(x)
    np.testing.assert_allclose(x, 1.0, atol=1e-7)


def test_nan_is_no_pivot() -> None:
    matrix = make_system(3, 2, 3, 1, 0)
    rows, columns, values = lower_triangle(matrix)
    values[0] = np.nan
    assert not KKT.Factorization(len(matrix), rows, columns).factor(values)


def test_duplicate_and_upper_entries_are_summed() -> None:
    matrix = make_system(4, 3, 4, 1, 2)[::-1, ::-1]  # dual rows first
    rows, columns, values = lower_triangle(matrix)
    flipped = np.arange(len(rows)) % 2 == 0
    places = np.where(flipped, columns, rows), np.where(flipped, rows, columns)
    twice = [np.concatenate([part, part]) for part in places]
    factorization = KKT.Factorization(len(matrix), *twice)
    assert factorization.factor(np.concatenate([1.5 * values, -0.5 * values])), (
        "by the last values alone no row is primal"
    )
    x = matrix @ np.ones(len(matrix))
    factorization.solve(x)
    np.testing.assert_allclose(x, 1.0, atol=1e-8)


@pytest.mark.parametrize(
    ("size", "rows", "columns", "message"),
    [
        (0, [], [], "there are rows"),
        (2, [0, 1], [0], "as many rows as columns"),
        (2, [0, 2], [0, 1], "in the matrix"),
        (2, [0, 1], [0, -1], "in the matrix"),
    ],
)
def test_entries_outside_the_matrix_are_rejected(
    size: int, rows: list[int], columns: list[int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        KKT.Factorization(size, np.array(rows, np.int32), np.array(columns, np.int32))


def test_number_of_values_is_checked() -> None:
    factorization = KKT.Factorization(1, np.zeros(1, np.int32), np.zeros(1, np.int32))
    with pytest.raises(ValueError, match="one value for each entry"):
        factorization.factor(np.ones(2))
    assert factorization.factor(np.ones(1))
    with pytest.raises(ValueError, match="as many numbers"):
        factorization.solve(np.ones(2))


def test_ipopt_is_deterministic_and_thread_safe() -> None:
    """The result holds for a wrong inertia at first, and with other systems in between."""
    x = ca.MX.sym("x", 40)
    f = ca.sumsqr(x[1:] - ca.sin(3.0 * x[:-1])) - 0.5 * ca.sumsqr(x[::3])
    program = {"x": x, "f": f, "g": x[:-1] * x[1:]}
    warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3}

    def solve(_: int) -> bytes:
        solver = ca.nlpsol("solver", "ipopt", program, {**QUIET, **OWN, **warm})
        result = solver(x0=np.linspace(-1.0, 1.0, 40), lbg=-0.5, ubg=0.5, lbx=-2.0, ubx=2.0)
        return bytes(np.ravel(result["x"]).tobytes())

    alone = solve(0)
    with ThreadPoolExecutor(4) as threads:
        assert set(threads.map(solve, range(16))) == {alone}


@pytest.mark.parametrize(
    "bounds", [(0.0, 0.0), (-np.inf, 0.0), (0.0, np.inf)], ids=["equal", "below", "above"]
)
def test_ipopt_finds_the_same_solution_as_with_mumps(bounds: tuple[float, float]) -> None:
    """The program has an indefinite Hessian and two dependent rows."""
    x = ca.MX.sym("x", 6)
    f = ca.sumsqr(x[1:] - x[:-1] ** 2) + ca.sumsqr(1.0 - x[:-1]) + ca.cos(3.0 * x[5])
    g = ca.vertcat(
        x[0] + x[1] - 1.0, x[2] * x[3] - 0.5, 2.0 * (x[0] + x[1] - 1.0), x[4] - ca.sin(x[5])
    )
    found = []
    for options in ({"ipopt.linear_solver": "mumps"}, OWN):
        solver = ca.nlpsol("solver", "ipopt", {"x": x, "f": f, "g": g}, {**QUIET, **options})
        result = solver(
            x0=np.full(6, 0.3), lbg=[bounds[0]] * 4, ubg=[bounds[1]] * 4, lbx=-5.0, ubx=5.0
        )
        assert solver.stats()["success"]
        found.append(np.ravel(result["x"]))
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)
