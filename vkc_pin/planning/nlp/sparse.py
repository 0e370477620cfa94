"""Matrices for the program: differences of waypoints, and sparse ones, put together from the nonzeros of many waypoints."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import casadi as ca
import numpy as np

from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["assemble", "curvature", "differences", "sparse"]


def sparse(matrix: Floats) -> ca.DM:
    """Return a matrix without its zeros."""
    column, row = np.nonzero(matrix.T)
    return ca.DM(
        ca.Sparsity.triplet(*matrix.shape, row.tolist(), column.tolist()), matrix[row, column]
    )


def assemble(parts: list[ca.MX], at: list[Ints], rows: int, columns: int) -> ca.MX:
    """Return the sparse matrix whose nonzeros are `parts`, one after another, at (row, column) `at`; what meets is added up.

    Args:
        parts: Columns of nonzeros.
        at: For each of these, rows and columns, shape (2, number of nonzeros).
        rows: Number of rows of the matrix.
        columns: Number of its columns.
    """
    where = np.concatenate(at, axis=1)
    order = np.lexsort((where[0], where[1]))
    values = ca.vertcat(*parts)
    place = np.concatenate([[True], np.diff(where[:, order]).any(axis=0)])[: len(order)]
    if place.all():
        values = values[order.tolist()]
    else:
        target = np.empty(len(order), int)
        target[order] = np.cumsum(place) - 1
        values = (
            ca.DM.triplet(
                target.tolist(),
                list(range(len(order))),
                ca.DM.ones(len(order)),
                int(place.sum()),
                len(order),
            )
            @ values
        )
    row, column = where[0][order][place], where[1][order][place]
    pointers = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=columns))])
    pattern = ca.Sparsity(rows, columns, pointers.tolist(), row.tolist())
    return ca.MX(pattern, values)


def differences(segments: int, stops: Sequence[int]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return matrices D, E and vectors d, e: D·z + d·z_0 are the steps of waypoints z_1..z_N, E·z + e·z_0 the steps' changes.

    Changes are those between steps, and from and to rest where the motion starts, pauses and ends.

    Args:
        segments: N.
        stops: Waypoints inside the motion at which it pauses.
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


def curvature(parts: Sequence[Floats]) -> tuple[tuple[Ints, Ints], list[ca.DM]]:
    """Return where the upper half of ∇²Σ_k Σ_r w_kr (A_k z)_r² can differ from zero, and the matrices that give it there of w_k.

    Args:
        parts: The matrices A_k, shape (R_k, N) each.
    """
    row, column = np.triu(sum(np.abs(part).T @ np.abs(part) for part in parts)).nonzero()
    return (row, column), [sparse(2 * (part[:, row] * part[:, column]).T) for part in parts]
