"""Tests the linear solver against dense algebra and within Ipopt."""

from __future__ import annotations

import ctypes
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

from vkc_pin.planning.solver.subproblem import make_linear_solver_options
from vkc_pin.utils.optional_imports import import_compiled

LIBRARY = ctypes.CDLL(import_compiled("vkc_pin.planning.solver._kkt").__file__)
OWN_SOLVER = make_linear_solver_options()
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


def get_lower_triangle(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of a lower triangle, with all of its diagonal."""
    rows, columns = np.nonzero((np.tril(matrix) != 0.0) | np.eye(len(matrix), dtype=bool))
    return rows.astype(np.int32), columns.astype(np.int32), matrix[rows, columns]


class Factorization:
    """The factorization behind the interface of MA27. Each thread has one system at a time."""

    def __init__(self, matrix: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> None:
        self.size, self.info = np.array([len(matrix)], np.int32), np.zeros(20, np.int32)
        self.analysis, self.factors, self.unused = (np.zeros(1, np.int32) for _ in range(3))
        entries, places = np.array([len(rows)], np.int32), (rows + 1, columns + 1)
        arguments = [self.size, entries, *places, None, None, self.analysis, None, self.unused]
        call("ma27ad_", *arguments, None, None, None, self.info, np.zeros(1))
        assert self.info[0] == 0

    def factor(self, values: np.ndarray) -> int:
        """Return MA27's flag: 0, -1 for an unknown system or -5 for a singular one."""
        places = [self.factors, None, self.analysis, None, self.unused, None, None, None]
        call("ma27bd_", *[None] * 4, values, None, *places, self.info)
        return int(self.info[0])

    @property
    def negative(self) -> int:
        return int(self.info[14])

    def solve(self, b: np.ndarray) -> np.ndarray:
        x = np.array(b, float)
        call("ma27cd_", self.size, None, None, self.factors, *[None] * 3, x, *[None] * 4)
        return x


def call(name: str, *arguments: np.ndarray | None) -> None:
    pointers = [None if a is None else ctypes.c_void_p(a.ctypes.data) for a in arguments]
    getattr(LIBRARY, name)(*pointers)


def factorize(matrix: np.ndarray) -> tuple[Factorization, bool]:
    rows, columns, values = get_lower_triangle(matrix)
    factorization = Factorization(matrix, rows, columns)
    return factorization, factorization.factor(values) == 0


def check_solution(factorization: Factorization, matrix: np.ndarray) -> None:
    """Compare inertia and solution with dense algebra."""
    assert factorization.negative == np.count_nonzero(np.linalg.eigvalsh(matrix) < 0.0)
    expected = np.random.default_rng(0).normal(size=len(matrix))
    error = matrix @ (factorization.solve(matrix @ expected) - expected)
    scale = np.abs(matrix).sum(axis=1).max() * np.abs(expected).max()
    assert np.abs(error).max() < 1e-10 * scale


def make_system(seed: int, waypoints: int, size: int, equalities: int, planes: int) -> np.ndarray:
    """Return a trajectory-like system: coupled blocks, their constraints, and some slacks."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(waypoints, size, size))
    changes = np.kron(np.diff(np.eye(waypoints), n=2, axis=0), np.eye(size))
    hessian = block_diag(*(root @ root.T + 0.1 * np.eye(size) for root in roots))
    hessian += 10.0 * changes.T @ changes
    rows = block_diag(*rng.normal(size=(waypoints, equalities + planes, size)))
    slacks = np.diag(10.0 ** rng.uniform(-4.0, 4.0, waypoints * planes))
    has_slack = np.arange(len(rows)) % max(equalities + planes, 1) >= equalities
    rows = np.hstack([rows, -np.eye(len(rows))[:, has_slack]])
    upper = np.vstack([block_diag(hessian, slacks), rows])
    return np.hstack([upper, np.vstack([rows.T, np.zeros((len(rows), len(rows)))])])


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
    check_solution(factorization, matrix)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 12), st.floats(0.1, 1.0))
def test_any_matrix_is_solved_or_reported_singular(seed: int, size: int, density: float) -> None:
    rng = np.random.default_rng(seed)
    matrix = np.where(rng.uniform(size=(size, size)) < density, rng.normal(size=(size, size)), 0.0)
    matrix += matrix.T
    factorization, done = factorize(matrix)
    # A pivot is zero in every singular matrix and, since there is no pivoting, in some others.
    if not done:
        assert min(abs(np.linalg.det(matrix[:k, :k])) for k in range(1, size + 1)) < 1e-8 or np.any(
            np.diag(matrix) == 0.0
        )
        return
    assert factorization.negative == np.count_nonzero(np.linalg.eigvalsh(matrix) < 0.0)


def test_refactoring_does_not_depend_on_earlier_values() -> None:
    first, second = make_system(1, 4, 5, 2, 2), make_system(1, 4, 5, 2, 2)
    second[np.diag_indices(20)] += 3.0
    b = np.arange(len(first), dtype=float)
    reused, _ = factorize(first)
    assert reused.factor(get_lower_triangle(second)[2]) == 0
    x = reused.solve(b)
    fresh = Factorization(first, *get_lower_triangle(first)[:2])
    assert reused.factor(get_lower_triangle(first)[2]) == -1  # another system has taken its place
    assert fresh.factor(get_lower_triangle(second)[2]) == 0
    np.testing.assert_array_equal(fresh.solve(b), x)


def test_dependent_rows_and_nan_are_singular_and_the_next_system_is_solved() -> None:
    matrix = make_system(2, 3, 4, 2, 0)
    doubled = matrix.copy()
    doubled[-1], doubled[:, -1] = doubled[-2], doubled[:, -2]
    rows, columns, values = get_lower_triangle(matrix)
    invalid = values.copy()
    invalid[0] = np.nan
    factorization = Factorization(matrix, rows, columns)
    for singular in (doubled[rows, columns], invalid):
        assert factorization.factor(singular) == -5
        assert np.isnan(factorization.solve(np.ones(len(matrix)))).all()
    assert factorization.factor(values) == 0
    check_solution(factorization, matrix)


@pytest.mark.parametrize("size", [3, 9, 20])
def test_pivots_of_rounding_size_are_singular(size: int) -> None:
    """The last pivot is tested, also if only other panels update it; no other pivot is small."""
    noise = np.random.default_rng(size).normal(size=(size, size - 1))
    root = np.eye(size, size - 1) + 0.1 * noise
    gram = root @ root.T
    assert not factorize(gram)[1]
    assert factorize(gram + 1e-6 * np.eye(size))[1]


def test_duplicate_and_upper_entries_are_summed() -> None:
    matrix = make_system(4, 3, 4, 1, 2)[::-1, ::-1]  # dual rows first
    rows, columns, values = get_lower_triangle(matrix)
    flipped = np.arange(len(rows)) % 2 == 0
    places = np.where(flipped, columns, rows), np.where(flipped, rows, columns)
    twice = [np.concatenate([part, part]) for part in places]
    factorization = Factorization(matrix, *twice)
    # with the last values alone, no row would be primal
    assert factorization.factor(np.concatenate([1.5 * values, -0.5 * values])) == 0
    check_solution(factorization, matrix)


def test_ipopt_is_deterministic_and_thread_safe() -> None:
    """The inertia is wrong at first, and other systems are factorized in between."""
    x = ca.MX.sym("x", 40)
    f = ca.sumsqr(x[1:] - ca.sin(3.0 * x[:-1])) - 0.5 * ca.sumsqr(x[::3])
    program = {"x": x, "f": f, "g": x[:-1] * x[1:]}
    warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3}

    def solve(_: int) -> bytes:
        solver = ca.nlpsol("solver", "ipopt", program, {**QUIET, **OWN_SOLVER, **warm})
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
    lower, upper = bounds
    x = ca.MX.sym("x", 6)
    f = ca.sumsqr(x[1:] - x[:-1] ** 2) + ca.sumsqr(1.0 - x[:-1]) + ca.cos(3.0 * x[5])
    line = x[0] + x[1] - 1.0
    g = ca.vertcat(line, x[2] * x[3] - 0.5, 2.0 * line, x[4] - ca.sin(x[5]))
    found = []
    for options in ({"ipopt.linear_solver": "mumps"}, OWN_SOLVER):
        solver = ca.nlpsol("solver", "ipopt", {"x": x, "f": f, "g": g}, {**QUIET, **options})
        result = solver(x0=np.full(6, 0.3), lbg=lower, ubg=upper, lbx=-5.0, ubx=5.0)
        assert solver.stats()["success"]
        found.append(np.ravel(result["x"]))
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)
