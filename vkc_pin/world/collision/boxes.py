"""Finds pairs of shapes that may be close, from their bounding boxes.

The compiled loop of `distances` tests those of `Boxes`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.collision.solids import load_compiled


class Boxes:
    """Oriented bounding boxes of G shapes: first the moving ones, then those fixed in the world.

    Args:
        joints: Joint of each box, shape (G,); 0 for fixed boxes.
        rotations: Orientations in the frame of the joint or the world, shape (G, 3, 3).
        centers: Centres in the same frame, shape (G, 3) [m].
        halves: Half extents along the boxes' axes, shape (G, 3) [m].
        pairs: Pairs to check, shape (P, 2); at least the first box of each pair moves.
    """

    def __init__(
        self, joints: Ints, rotations: Floats, centers: Floats, halves: Floats, pairs: Ints
    ) -> None:
        self.compiled: Any = load_compiled().Boxes(joints, rotations, centers, halves, pairs)

    def move_fixed(self, which: Ints, rotations: Floats, centers: Floats) -> Boxes:
        """Return a copy with some fixed boxes moved.

        Args:
            which: Indices of the boxes, shape (n,).
            rotations: Orientations in the world frame, shape (n, 3, 3).
            centers: Centres in the world frame, shape (n, 3) [m].
        """
        other = object.__new__(Boxes)
        other.compiled = self.compiled.placed(which, rotations, centers)
        return other


class WorldBoxes:
    """Axis-aligned boxes in the world frame: of M moving shapes at W states, and of S fixed ones.

    Args:
        lower, upper: Corners of the moving shapes' boxes, shape (W, M, 3) [m].
        fixed_lower, fixed_upper: Corners of the fixed shapes' boxes, shape (S, 3) [m].
    """

    def __init__(
        self, lower: Floats, upper: Floats, fixed_lower: Floats, fixed_upper: Floats
    ) -> None:
        self.compiled: Any = load_compiled().WorldBoxes(
            np.ascontiguousarray(lower, float),
            np.ascontiguousarray(upper, float),
            np.ascontiguousarray(fixed_lower, float),
            np.ascontiguousarray(fixed_upper, float),
        )

    def find_close_pairs(
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
        """Return all pairs that may come closer than `limit` during an interval.

        With b and b' the distances of the boxes at the ends of an interval, two shapes are at least
        (b + b' − relative motion) / 2 apart during it.

        Args:
            first: State at the start of each interval, shape (K,).
            last: State at its end, shape (K,); equal without motion.
            pairs: Pairs of shape indices, shape (P, 2).
            moved: Largest motion of a point of each shape in each interval, shape (K, M + S) [m].
            moves: Whether each shape moves in each phase, shape (phases, M + S). Pairs without
                motion are omitted.
            phases: Phase of each interval, shape (K,).
            limit: Distance [m].

        Returns:
            Indices of interval and pair, shape (C,) each, sorted by interval, then by pair.
        """
        ends = np.column_stack([first, last])
        flags = np.ascontiguousarray(moves).view(np.uint8)
        interval_indices, pair_indices = self.compiled.near(
            np.ascontiguousarray(ends, np.int64),
            np.ascontiguousarray(phases, np.int64),
            flags,
            np.ascontiguousarray(pairs, np.int64),
            np.ascontiguousarray(moved, float),
            limit,
        )
        return np.asarray(interval_indices), np.asarray(pair_indices)
