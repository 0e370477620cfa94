"""Names the array types of signatures, and limits coordinates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_COORDINATE", "Bools", "Floats", "Ints"]

MAX_COORDINATE = 1e4
"""Largest length [m] or angle [rad] in files and arguments."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int_]
Bools = NDArray[np.bool_]
