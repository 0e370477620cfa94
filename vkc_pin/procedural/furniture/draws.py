"""Draws random sizes and choices, rounded so that they are the same on every machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

__all__ = ["Sampler"]

T = TypeVar("T")


class Sampler:
    """Random sizes and choices from a random number generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def sample_length(self, low: float, high: float) -> float:
        """Return a length [m] or angle [rad] between two, rounded to three decimals."""
        return round(float(self._rng.uniform(low, high)), 3)

    def sample_integer(self, low: int, high: int) -> int:
        """Return an integer from `low` to `high`, both included."""
        return int(self._rng.integers(low, high + 1))

    def sample_bool(self, probability: float) -> bool:
        """Return True with a probability."""
        return bool(self._rng.random() < probability)

    def choose(self, choices: Sequence[T]) -> T:
        """Return one of the choices."""
        return choices[int(self._rng.integers(len(choices)))]
