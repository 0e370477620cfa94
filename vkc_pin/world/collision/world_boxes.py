"""Boxes along the world's axes around shapes, at many states, and which of them come near each other."""

from __future__ import annotations

from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["WorldBoxes"]


class WorldBoxes:
    """Boxes around shapes: M that move, at W states, then S that stand.

    Args:
        lower: Of what moves, shape (W, M, 3) [m].
        upper: Shape (W, M, 3) [m].
        standing_lower: Of what stands, shape (S, 3) [m].
        standing_upper: Shape (S, 3) [m].

    Raises:
        BuildError: See `solids.load_compiled`.
    """

    def __init__(
        self, lower: Floats, upper: Floats, standing_lower: Floats, standing_upper: Floats
    ) -> None:
        corners = (
            np.ascontiguousarray(part, float)
            for part in (lower, upper, standing_lower, standing_upper)
        )
        self.compiled: Any = load_compiled().WorldBoxes(*corners)

    def near(
        self,
        first: Ints,
        last: Ints,
        pairs: Ints,
        *,
        moved: Floats,
        moves: Bools,
        phases: Ints,
        limit: float,
    ) -> tuple[Ints, Ints]:
        """Return (k, pair) of all pairs that may come closer than `limit` [m] in a stretch k, by k and then by pair.

        The distance of two shapes, b at the stretch's ends by their boxes, is at least (b + b' −
        relative motion) / 2 in between.

        Args:
            first: States at which stretches begin, shape (K,).
            last: States at which they end, shape (K,); with no motion in between they may be the
                same.
            pairs: Numbers of shapes, shape (P, 2).
            moved: How far any point of each shape moves in a stretch, at most, shape (K, M + S)
                [m].
            moves: Which shapes move in each phase, shape (phases, M + S). Pairs of which neither
                does are left out.
            phases: Of the stretches, shape (K,).
            limit: [m].

        Raises:
            IndexError: There is no such state, phase or shape.
        """
        numbers = (
            np.ascontiguousarray(part, np.int64)
            for part in (np.column_stack([first, last]), phases)
        )
        flags, rows = (
            np.ascontiguousarray(moves).view(np.uint8),
            np.ascontiguousarray(pairs, np.int64),
        )
        at, which = self.compiled.near(
            *numbers, flags, rows, np.ascontiguousarray(moved, float), limit
        )
        return np.asarray(at), np.asarray(which)
