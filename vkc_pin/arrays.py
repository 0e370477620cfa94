"""Names for the arrays that functions take and return; their shapes and units are in docstrings."""

from __future__ import annotations

from vkc_pin.arrays import Bools, Floats, Ints

__all__ = ["Bools", "Floats", "Ints"]

Floats = Floats
"""Numbers of double precision."""
Ints = Ints
"""Indices and counts."""
Bools = Bools
"""Masks."""
