"""The shortest paths of a car that drives ahead and back, in closed form.

J. A. Reeds and L. A. Shepp, Optimal paths for a car that goes both forwards and backwards, Pacific
Journal of Mathematics 145 (2), 1990: they are among 48 words of at most five pieces, arcs of the
least radius and straight lines. A formula each gives the pieces of some (8.1 to 8.4 and 8.7 to 8.11
there); going backwards in time, mirroring and reversing give the rest. The formulas are compiled
(`reeds_shepp.hpp`): a search for seeds asks for thousands of lengths. Here poses are those of the
goal as the start sees it, in units of the radius.
"""

from __future__ import annotations

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import compiled_module

__all__ = ["lengths_of", "shortest_words"]

_SAME = 1e-9


def lengths_of(goals: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return how far the shortest paths lead [m], and how far they turn [rad], shape (B,) each.

    Args:
        goals: As the start sees them, in units of the radius, shape (B, 3).
        radius: [m].

    Raises:
        BuildError: The compiled module is missing.
    """
    far, turned = np.abs(_words(goals)).sum(axis=1).T
    return radius * far, turned


def shortest_words(goal: Floats, radius: float) -> list[tuple[float, float]]:
    """Return the pieces of the shortest path to a goal, shape (3,): lengths [m, back < 0] and turns [rad, left > 0].

    Raises:
        BuildError: The compiled module is missing.
    """
    return [
        (radius * length, turn)
        for length, turn in _words(goal[None])[0].tolist()
        if abs(length) > _SAME
    ]


def _words(goals: Floats) -> Floats:
    """Return what the pieces of paths to goals lead, in radii, and turn, shape (B, 5, 2); pieces that are not needed are 0."""
    return np.asarray(
        compiled_module("vkc_pin.planning.base_paths._driving").shortest_words(
            np.ascontiguousarray(goals, float)
        )
    )
