"""Random sizes and choices, rounded so that they are the same on every machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

__all__ = ["Sampler"]

T = TypeVar("T")


class Sampler:
    """Random sizes and choices from a generator of random numbers."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def sample_length(self, low: float, high: float) -> float:
        """Return a length or angle between two, to the millimetre or milliradian."""
        return round(float(self._rng.uniform(low, high)), 3)

    def sample_integer(self, low: int, high: int) -> int:
        """Return a whole number from the lowest to the highest."""
        return int(self._rng.integers(low, high + 1))

    def sample_bool(self, share: float) -> bool:
        """Return True in a share of all draws."""
        return bool(self._rng.random() < share)

    def choose(self, choices: Sequence[T]) -> T:
        """Return one of some choices."""
        return choices[int(self._rng.integers(len(choices)))]
