"""Sparse matrices for the program, put together from the nonzeros of many waypoints."""

from __future__ import annotations

import casadi as ca
import numpy as np

from vkc_pin.arrays import Floats, Ints

__all__ = ["assemble", "sparse", "unit"]


def sparse(matrix: Floats) -> ca.DM:
    """Return a small matrix without its zeros."""
    return ca.sparsify(ca.DM(matrix))


def unit(rows: int, columns: int, index: int) -> ca.DM:
    """Return a matrix whose only entry is a 1 at (index, index)."""
    return ca.DM.triplet([index], [index], ca.DM(1.0), rows, columns)


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
            ca.DM.triplet(target.tolist(), list(range(len(order))), ca.DM.ones(len(order)), int(place.sum()), len(order)) @ values
        )
    row, column = where[0][order][place], where[1][order][place]
    pointers = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=columns))])
    pattern = ca.Sparsity(rows, columns, pointers.tolist(), row.tolist())
    return ca.MX(pattern, values)
