"""Finds pairs of shapes that may be close, from their bounding boxes, at many configurations.

`clearances` runs the same test inside its compiled loop; this module exposes it separately.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.solids import load_compiled
from vkc_pin.world.collision.threads import count_threads

__all__ = ["Boxes"]

_MIN_ROWS_PER_THREAD = 32  # configurations, about 0.2 ms: fewer do not pay for another thread


class Boxes:
    """Oriented bounding boxes of G shapes: first the moving ones, then those fixed in the world.

    Args:
        joints: Joint of each box, shape (G,); 0 for fixed boxes.
        rotations: Orientations in the frame of the joint or the world, shape (G, 3, 3).
        centers: Centres in the same frame, shape (G, 3) [m].
        halves: Half extents along the boxes' axes, shape (G, 3) [m].
        pairs: Pairs to check, shape (P, 2); at least the first box of each pair moves.
        threads: Maximum number of threads. Default: `threads.count_threads`.
    """

    def __init__(
        self,
        joints: Ints,
        rotations: Floats,
        centers: Floats,
        halves: Floats,
        pairs: Ints,
        *,
        threads: int | None = None,
    ) -> None:
        self.threads = count_threads() if threads is None else threads
        self.pairs = pairs
        self.compiled: Any = load_compiled().Boxes(joints, rotations, centers, halves, pairs)

    def move_fixed(self, which: Ints, rotations: Floats, centers: Floats) -> Boxes:
        """Return a copy with some fixed boxes moved.

        Args:
            which: Indices of the boxes, shape (n,).
            rotations: Orientations in the world frame, shape (n, 3, 3).
            centers: Centres in the world frame, shape (n, 3) [m].
        """
        other = object.__new__(Boxes)
        other.threads, other.pairs = self.threads, self.pairs
        other.compiled = self.compiled.placed(which, rotations, centers)
        return other

    def find_close_pairs(
        self, reach: float, rotations: Floats, translations: Floats, *, include_fixed: bool = True
    ) -> tuple[Ints, Ints, Floats]:
        """Return all pairs that bounding volumes cannot prove to be `reach` [m] apart.

        Bounding spheres are tested first (against boxes, for fixed shapes), then the face normals
        of both boxes.

        Args:
            reach: Distance below which a pair is close [m].
            rotations: Orientations of all joints in the world frame, shape (W, J, 3, 3); 0 is the
                world.
            translations: Positions of all joints in the world frame, shape (W, J, 3) [m].
            include_fixed: Include pairs of a moving and a fixed shape.

        Returns:
            Index of the configuration, index of the pair, and a lower bound of the signed distance
            [m], shape (C,) each, sorted by configuration, then by pair.
        """
        threads = max(1, min(self.threads, len(rotations) // _MIN_ROWS_PER_THREAD))
        rows, pairs, gaps = self.compiled.near(
            reach, rotations, translations, include_fixed, threads
        )
        return np.asarray(rows), np.asarray(pairs), np.asarray(gaps)
