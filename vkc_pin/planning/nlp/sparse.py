"""Builds difference matrices and sparse matrices assembled from the nonzeros of many waypoints."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import casadi as ca
import numpy as np

from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["assemble", "make_curvature", "make_differences", "make_sparse"]


def make_sparse(matrix: Floats) -> ca.DM:
    """Return a matrix as a sparse one without its zeros."""
    column, row = np.nonzero(matrix.T)
    return ca.DM(
        ca.Sparsity.triplet(*matrix.shape, row.tolist(), column.tolist()), matrix[row, column]
    )


def assemble(parts: list[ca.MX], at: list[Ints], rows: int, columns: int) -> ca.MX:
    """Return the sparse matrix with nonzeros `parts` at (row, column) `at`; duplicates are summed.

    Args:
        parts: Columns of nonzeros.
        at: Rows and columns of each part, shape (2, number of nonzeros).
        rows: Number of rows of the matrix.
        columns: Number of its columns.
    """
    positions = np.concatenate(at, axis=1)
    order = np.lexsort((positions[0], positions[1]))
    values = ca.vertcat(*parts)
    is_first = np.concatenate([[True], np.diff(positions[:, order]).any(axis=0)])[: len(order)]
    if is_first.all():
        values = values[order.tolist()]
    else:
        target = np.empty(len(order), int)
        target[order] = np.cumsum(is_first) - 1
        values = (
            ca.DM.triplet(
                target.tolist(),
                list(range(len(order))),
                ca.DM.ones(len(order)),
                int(is_first.sum()),
                len(order),
            )
            @ values
        )
    row, column = positions[0][order][is_first], positions[1][order][is_first]
    pointers = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=columns))])
    pattern = ca.Sparsity(rows, columns, pointers.tolist(), row.tolist())
    return ca.MX(pattern, values)


def make_differences(segments: int, stops: Sequence[int]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return matrices D, E and vectors d, e that map z_1..z_N and z_0 to steps and their changes.

    D·z + d·z_0 are the steps, E·z + e·z_0 their changes: between steps, and from and to rest where
    the motion starts, pauses and ends.

    Args:
        segments: N.
        stops: Interior waypoints at which the motion pauses.
    """
    first = np.eye(segments) - np.eye(segments, k=-1)  # δz_t = z_t − z_{t−1}
    start = np.zeros(segments)
    start[0] = -1.0
    ends = itertools.pairwise([0, *stops, segments])
    changes = np.vstack(
        [
            np.diff(np.eye(segments)[begin:end], axis=0, prepend=0.0, append=0.0)
            for begin, end in ends
        ]
    )
    return first, changes @ first, start, changes @ start


def make_curvature(parts: Sequence[Floats]) -> tuple[tuple[Ints, Ints], list[ca.DM]]:
    """Return the pattern of ∇²Σ_k Σ_r w_kr (A_k z)_r², upper triangle, and its matrices.

    Args:
        parts: The matrices A_k, shape (R_k, N) each.

    Returns:
        Rows and columns of the possible nonzeros, and for each k the matrix that maps w_k to them.
    """
    row, column = np.triu(sum(np.abs(part).T @ np.abs(part) for part in parts)).nonzero()
    return (row, column), [make_sparse(2 * (part[:, row] * part[:, column]).T) for part in parts]
