"""Which pairs of shapes fall shortest of their margins, at many configurations of a model at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.margins import Margins
from vkc_pin.world.collision.placements import ShapePlacements
from vkc_pin.world.collision.shapes import Shapes
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["Clearances", "ClosePairs"]

_ROUNDING = 1e-6  # [m] of coal
_WORTH = 16  # configurations, some 0.3 ms, for which another thread is worth starting


class ClosePairs(NamedTuple):
    """Pairs that are close, C in all, by configuration and then by distance − margin.

    Attributes:
        row: Of the configurations, shape (C,).
        pair: Shape (C,).
        distance: Signed, shape (C,) [m].
        margin: What the pair must keep there, shape (C,) [m].
        normal: From its first shape to its second, world frame, shape (C, 3).
        first, second: The points that are closest, or deepest, on either, world frame, shape (C, 3)
            each [m].
    """

    row: Ints
    pair: Ints
    distance: Floats
    margin: Floats
    normal: Floats
    first: Floats
    second: Floats


class Clearances:
    """Shapes on a model's joints and others that stand: kinematics, bounding volumes and distances in one call.

    It makes no difference how many configurations are looked at together, nor by how many threads.

    Attributes:
        placements: Where the shapes that move are.
        boxes: Around all shapes; which pairs there are.
        shapes: All shapes.
        margins: What the pairs must keep.
    """

    def __init__(
        self, placements: ShapePlacements, boxes: Boxes, shapes: Shapes, margins: Margins
    ) -> None:
        self.placements, self.boxes, self.shapes, self.margins = placements, boxes, shapes, margins
        self._parts = placements.compiled, boxes.compiled, shapes.compiled, margins.compiled
        self._nearest, self._first_blocked = load_compiled().nearest, load_compiled().first_blocked

    def placed(self, boxes: Boxes, where: Mapping[int, pin.SE3]) -> Clearances:
        """Return the same with some shapes that stand placed elsewhere in the world, where `boxes` has them already."""
        return Clearances(self.placements, boxes, self.shapes.placed(where), self.margins)

    def nearest(
        self,
        q: Floats,
        z: Floats,
        waypoints: Ints,
        *,
        reach: float,
        most: int | None = None,
        standing: bool = True,
    ) -> ClosePairs:
        """Return, for each configuration, the pairs closer than `reach` that fall shortest of their margins.

        Args:
            q: Pinocchio's configurations, shape (W, nq).
            z: Coordinates that margins are looked up by, shape (W, n).
            waypoints: The same, shape (W,).
            reach: Pairs further apart are left out [m].
            most: How many to return for each configuration; None: all.
            standing: Whether what stands counts, too; otherwise only pairs of which both move.

        Raises:
            ValueError: Arrays do not fit together.
        """
        threads = max(1, min(self.shapes.threads, len(q) // _WORTH))
        limit = -1 if most is None else most
        return ClosePairs(
            *self._nearest(
                *self._parts, q, z, waypoints, reach, limit, standing, _ROUNDING, threads
            )
        )

    def first_blocked(
        self, q: Floats, z: Floats, waypoint: int, *, reach: float, allowed: float
    ) -> int:
        """Return the first configuration in which a pair closer than `reach` falls short of its margin by more than `allowed`.

        If there is none, the number of configurations. Nothing is looked at after it, nor any pair
        after that one.

        Args:
            q: Pinocchio's configurations, shape (W, nq).
            z: Coordinates that margins are looked up by, shape (W, n).
            waypoint: At which margins are looked up.
            reach: [m].
            allowed: [m].

        Raises:
            ValueError: Arrays do not fit together.
        """
        return int(self._first_blocked(*self._parts, q, z, waypoint, reach, allowed, _ROUNDING))

    def lines(
        self,
        places: Sequence[Ints],
        z: Floats,
        waypoint: int,
        *,
        weights: Floats,
        step: float,
        reach: float,
        allowed: float,
    ) -> Any:
        """Return what looks at straight lines from configuration to configuration: up to the first in which `first_blocked` is.

        Compiled searches are made with it. It must not outlive what this was made of.

        Args:
            places: Where in Pinocchio's configurations the numbers of z go; see
                `world.models.coordinates.Coordinates.places`.
            z: A configuration, shape (n,).
            waypoint: At which margins are looked up.
            weights: For each coordinate that moves, the first ones of z, how much it counts, shape
                (m,).
            step: How far each coordinate, times its weight, goes at most from one configuration to
                the next.
            reach: Pairs further apart do not count [m].
            allowed: By how much pairs may fall short of their margins [m].

        Raises:
            ValueError: Arrays do not fit together.
        """
        where = [np.ascontiguousarray(part, np.int64) for part in places]
        moved = np.ascontiguousarray(z, float), np.ascontiguousarray(weights, float)
        return load_compiled().Lines(
            *self._parts, *where, *moved, step, waypoint, reach, allowed, _ROUNDING
        )
