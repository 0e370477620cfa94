"""Names the array types of signatures, bounds numbers, and prepares numbers for JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_COORDINATE = 1e4
"""Largest length [m] or angle [rad] in files and arguments."""
MIN_POSITIVE = 1e-6
"""Smallest size, velocity, acceleration or time in files that is not 0, in SI units."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int_]
Bools = NDArray[np.bool_]


def find_unique_rows(rows: NDArray[Any]) -> tuple[Ints, Ints]:
    """Return the first index of each distinct row, in lexicographic order, and each row's group.

    It is `numpy.unique` along the first axis, which takes four times as long.
    """
    order = np.lexsort(rows.T[::-1])
    differs = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    group = np.empty(len(rows), int)
    group[order] = np.append(0, np.cumsum(differs))[: len(rows)]
    return order[np.append(True, differs)[: len(rows)]], group


def replace_infinite(data: Any) -> Any:
    """Return plain data with None for numbers that JSON does not have: infinite ones and NaN."""
    if isinstance(data, Mapping):
        return {name: replace_infinite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [replace_infinite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
