"""Builds difference matrices and sparse matrices assembled from the nonzeros of many waypoints."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from vkc_pin.utils.arrays import Floats, Ints


def get_pattern(matrix: ca.SX) -> tuple[Ints, Ints]:
    """Return rows and columns of a matrix's nonzeros, in the order of `matrix.nonzeros()`."""
    rows, columns = matrix.sparsity().get_triplet()
    return np.array(rows, int), np.array(columns, int)


def make_sparse(matrix: Floats) -> ca.DM:
    """Return a matrix as a sparse one without its zeros."""
    column, row = np.nonzero(matrix.T)
    pattern = ca.Sparsity.triplet(*matrix.shape, row.tolist(), column.tolist())
    return ca.DM(pattern, matrix[row, column])


def assemble(parts: list[ca.MX], at: list[Ints], rows: int, columns: int) -> ca.MX:
    """Return a sparse matrix of nonzeros `parts` at (row, column) `at`; duplicates are summed."""
    positions = np.concatenate(at, axis=1)
    values = ca.vertcat(*parts)
    count = positions.shape[1]
    # CasADi stores nonzeros column by column.
    order = np.lexsort((positions[0], positions[1]))
    differs_from_last = np.diff(positions[:, order]).any(axis=0)
    is_first = np.concatenate([[True], differs_from_last])[:count]  # of its duplicates
    if is_first.all():
        values = values[order.tolist()]
    else:
        # A matrix of ones adds the duplicates: entry k is part of nonzero target[k].
        target = np.empty(count, int)
        target[order] = np.cumsum(is_first) - 1
        nonzero_count = int(is_first.sum())
        sums = ca.DM.triplet(
            target.tolist(), list(range(count)), ca.DM.ones(count), nonzero_count, count
        )
        values = sums @ values
    row, column = positions[:, order[is_first]]
    pointers = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=columns))])
    pattern = ca.Sparsity(rows, columns, pointers.tolist(), row.tolist())
    return ca.MX(pattern, values)


class Differences(NamedTuple):
    """Matrices D, E, U and vectors d, e that map a motion to its steps and their changes.

    D·z + d·z_0 are the steps δz_t = z_t − z_{t−1} of z_1..z_N. E·z + e·z_0 + U·u are their changes
    δz_{t+1} − δz_t: between steps, and from and to rest, δz = 0, where the motion stops. The first
    change is from u_0 = v_0·dt_1, the step of the start velocity, the last one to u_1 = v_N·dt_N,
    that of the velocity at the end.

    Attributes:
        first: D, shape (N, N).
        second: E, shape (N + 1 + stops, N).
        start_first: d, shape (N,).
        start_second: e, shape (N + 1 + stops,).
        end_second: U, shape (N + 1 + stops, 2).
    """

    first: Floats
    second: Floats
    start_first: Floats
    start_second: Floats
    end_second: Floats


def make_differences(segments: int, stops: Sequence[int]) -> Differences:
    """Return the matrices of the differences of a motion of N segments.

    With the matrix A that maps the steps to their changes, E = A·D and e = A·d.
    """
    first = np.eye(segments) - np.eye(segments, k=-1)
    start = np.zeros(segments)
    start[0] = -1.0
    changes_of_runs = []
    for begin, end in itertools.pairwise([0, *stops, segments]):
        steps = np.eye(segments)[begin:end]
        changes_of_runs.append(np.diff(steps, axis=0, prepend=0.0, append=0.0))
    changes = np.vstack(changes_of_runs)
    ends = np.zeros((len(changes), 2))
    ends[0, 0] = -1.0
    ends[-1, 1] = 1.0
    return Differences(first, changes @ first, start, changes @ start, ends)


def make_curvature(parts: Sequence[Floats]) -> tuple[tuple[Ints, Ints], list[ca.DM]]:
    """Return the pattern of ∇²Σ_k Σ_r w_kr (A_k z)_r², upper triangle, and its matrices.

    That is rows and columns of the nonzeros, and for each A_k the matrix that maps w_k to them: the
    entry (i, j) of the Hessian is Σ_k Σ_r 2 (A_k)_ri (A_k)_rj w_kr.
    """
    magnitude = sum(np.abs(part).T @ np.abs(part) for part in parts)
    row, column = np.triu(magnitude).nonzero()
    matrices = []
    for part in parts:
        products = part[:, row] * part[:, column]
        matrices.append(make_sparse(2 * products.T))
    return (row, column), matrices
