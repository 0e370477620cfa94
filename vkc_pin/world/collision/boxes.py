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
        joints: Joint that carries each box, shape (G,); 0 for fixed boxes.
        rotations: Box orientations in the frame of their joint or the world, shape (G, 3, 3).
        centers: Box centres in the same frame, shape (G, 3) [m].
        halves: Half extents along the boxes' own axes, shape (G, 3) [m].
        pairs: Pairs of boxes to check, shape (P, 2); at least the first box of each pair moves.
        threads: Maximum number of threads. Default: `threads.count_threads`.

    Attributes:
        pairs: Pairs of boxes that are checked, shape (P, 2).

    Raises:
        ValueError: Moving boxes do not come first, or array shapes do not match.
        IndexError: A pair refers to a box that does not exist.
        BuildError: See `solids.load_compiled`.
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
        """Return a copy with some fixed boxes at other placements.

        Args:
            which: Indices of the boxes, shape (n,).
            rotations: New orientations in the world frame, shape (n, 3, 3).
            centers: New centres in the world frame, shape (n, 3) [m].
        """
        other = object.__new__(Boxes)
        other.threads, other.pairs = self.threads, self.pairs
        other.compiled = self.compiled.placed(which, rotations, centers)
        return other

    def find_close_pairs(
        self, reach: float, rotations: Floats, translations: Floats, *, include_fixed: bool = True
    ) -> tuple[Ints, Ints, Floats]:
        """Return all pairs that bounding volumes cannot prove to be `reach` apart.

        Bounding spheres are tested first (against boxes, for fixed shapes), then the face normals
        of both boxes. Results do not depend on which configurations are evaluated together.

        Args:
            reach: Distance [m] below which a pair counts as close.
            rotations: Orientations of all joints in the world frame, shape (W, J, 3, 3); joint 0 is
                the world.
            translations: Positions of all joints in the world frame, shape (W, J, 3) [m].
            include_fixed: Whether to include pairs of a moving and a fixed shape.

        Returns:
            Configuration index, pair index, and a lower bound of the signed distance [m], each of
            shape (C,), sorted by configuration, then by pair.

        Raises:
            IndexError: A box is attached to a joint that is not among the J.
        """
        threads = max(1, min(self.threads, len(rotations) // _MIN_ROWS_PER_THREAD))
        rows, pairs, gaps = self.compiled.near(
            reach, rotations, translations, include_fixed, threads
        )
        return np.asarray(rows), np.asarray(pairs), np.asarray(gaps)
