"""Names the array types of signatures, bounds numbers, and prepares numbers for JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_COORDINATE", "MIN_POSITIVE", "Bools", "Floats", "Ints", "replace_infinite"]

MAX_COORDINATE = 1e4
"""Largest length [m] or angle [rad] in files and arguments."""
MIN_POSITIVE = 1e-6
"""Smallest size, velocity, acceleration or time in files that is not 0, in SI units."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int_]
Bools = NDArray[np.bool_]


def replace_infinite(data: Any) -> Any:
    """Return plain data with None for numbers that JSON does not have: infinite ones and NaN."""
    if isinstance(data, Mapping):
        return {name: replace_infinite(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [replace_infinite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
