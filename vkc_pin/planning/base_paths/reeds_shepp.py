"""Computes the shortest paths of a car that drives forwards and backwards, in closed form.

J. A. Reeds and L. A. Shepp, Optimal paths for a car that goes both forwards and backwards, Pacific
Journal of Mathematics 145 (2), 1990 (formulas 8.1 to 8.4 and 8.7 to 8.11). They are compiled, since
a search for initial guesses needs thousands of lengths. Goals are relative to the start, in radii.
"""

from __future__ import annotations

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_compiled

_SAME = 1e-9


def compute_lengths(goals: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return lengths [m] and turns [rad] of the shortest paths to goals, shape (B,) each.

    Args:
        goals: Goals relative to the start, in units of the radius, shape (B, 3).
        radius: Smallest turning radius [m].

    Raises:
        BuildError: The compiled module is missing.
    """
    length, turned = np.abs(_compute_words(goals)).sum(axis=1).T
    return radius * length, turned


def find_shortest_path_pieces(goal: Floats, radius: float) -> list[tuple[float, float]]:
    """Return the pieces of the shortest path to a goal, shape (3,): lengths [m] and turns [rad].

    Lengths are negative backwards, turns positive to the left.

    Raises:
        BuildError: The compiled module is missing.
    """
    pieces = []
    for length, turn in _compute_words(goal[None])[0].tolist():
        if abs(length) > _SAME:
            pieces.append((radius * length, turn))
    return pieces


def _compute_words(goals: Floats) -> Floats:
    """Return lengths in radii and turns of the pieces of paths, (B, 5, 2); 0 if unused."""
    driving = import_compiled("vkc_pin.planning.base_paths._driving")
    return np.asarray(driving.shortest_words(np.ascontiguousarray(goals, float)))
