"""Names for the arrays that functions take and return, and how large numbers may be; shapes and units are in docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_COORDINATE", "Bools", "Floats", "Ints"]

MAX_COORDINATE = 1e4
"""Largest length [m] or angle [rad] that a file or an argument may name."""

Floats = NDArray[np.float64]
"""Numbers of double precision."""
Ints = NDArray[np.int_]
"""Indices and counts."""
Bools = NDArray[np.bool_]
"""Masks."""
