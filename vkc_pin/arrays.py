"""Names for the arrays that functions take and return; their shapes and units are in docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bools", "Floats", "Ints"]

Floats = NDArray[np.float64]
"""Numbers of double precision."""
Ints = NDArray[np.int_]
"""Indices and counts."""
Bools = NDArray[np.bool_]
"""Masks."""
