"""Which pairs of shapes may be close: bounding boxes, at many configurations at once.

`clearances` asks them in compiled code; here is what they say, alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.solids import load_compiled
from vkc_pin.world.collision.threads import count_threads

__all__ = ["Boxes"]

_WORTH = 32  # configurations, some 0.2 ms, for which another thread is worth starting


class Boxes:
    """Boxes around shapes that move on joints, then around shapes that stand in the world, G in all.

    Args:
        joints: Which joint carries each box, from 1; 0: it stands, shape (G,).
        rotations: Of the boxes, in their joint's frame or in the world, shape (G, 3, 3).
        centers: Of the boxes, in the same frame, shape (G, 3) [m].
        halves: Half extents along the boxes' own axes, shape (G, 3) [m].
        pairs: Which of them to look at, shape (P, 2); of every pair at least the first moves.
        threads: How many look at most; None: see `count_threads`.

    Attributes:
        pairs: Which pairs it looks at, shape (P, 2).

    Raises:
        ValueError: Those that move are not the first, or arrays do not fit together.
        IndexError: There is no such box.
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

    def placed(self, which: Ints, rotations: Floats, centers: Floats) -> Boxes:
        """Return the same with some that stand, shape (n,), placed elsewhere: shapes (n, 3, 3) and (n, 3) [m]."""
        other = object.__new__(Boxes)
        other.threads, other.pairs = self.threads, self.pairs
        other.compiled = self.compiled.placed(which, rotations, centers)
        return other

    def near(
        self, reach: float, rotations: Floats, translations: Floats, *, standing: bool = True
    ) -> tuple[Ints, Ints, Floats]:
        """Return (configuration, pair) of all pairs that bounding volumes cannot prove to be `reach` apart, in this order.

        First balls (against boxes where they stand in the world), then what the face normals of
        both boxes separate. The third array has lower bounds of the signed distances [m]. It makes
        no difference how many configurations are looked at together.

        Args:
            reach: [m].
            rotations: Of all joints in the world, shape (W, J, 3, 3); joint 0, the world, is among
                the J.
            translations: Of all joints in the world, shape (W, J, 3) [m].
            standing: Whether what stands in the world counts, too; otherwise only pairs of which
                both move.

        Raises:
            IndexError: A box is on none of these joints.
        """
        threads = max(1, min(self.threads, len(rotations) // _WORTH))
        at, pairs, gaps = self.compiled.near(reach, rotations, translations, standing, threads)
        return np.asarray(at), np.asarray(pairs), np.asarray(gaps)
