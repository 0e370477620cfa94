"""Finds the pairs of shapes that violate their margins most, at many configurations of a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.margins import Margins
from vkc_pin.world.collision.placements import ShapePlacements
from vkc_pin.world.collision.shapes import Shapes
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["Clearances", "ClosePairs"]

_ROUNDING = 1e-6  # [m] numerical error of coal's distances
_MIN_ROWS_PER_THREAD = 16  # configurations, about 0.3 ms: fewer do not pay for another thread


class ClosePairs(NamedTuple):
    """C pairs of close shapes, sorted by configuration, then by distance − margin.

    Attributes:
        row: Index of the configuration, shape (C,).
        pair: Index of the pair, shape (C,).
        distance: Signed distance, shape (C,) [m].
        margin: Required clearance, shape (C,) [m].
        normal: Unit normal from the first to the second shape, world frame, shape (C, 3).
        first, second: Witness points (closest, or deepest), world frame, shape (C, 3) each [m].
    """

    row: Ints
    pair: Ints
    distance: Floats
    margin: Floats
    normal: Floats
    first: Floats
    second: Floats


class Clearances:
    """Computes kinematics, bounding volumes and distances of a model's shapes in one compiled call.

    Results depend neither on the number of threads nor on which configurations are evaluated
    together.
    """

    def __init__(
        self, placements: ShapePlacements, boxes: Boxes, shapes: Shapes, margins: Margins
    ) -> None:
        self.placements, self.boxes, self.shapes, self.margins = placements, boxes, shapes, margins
        self._parts = placements.compiled, boxes.compiled, shapes.compiled, margins.compiled
        self._find_closest_pairs, self._find_first_violation = (
            load_compiled().nearest,
            load_compiled().first_blocked,
        )

    def move_fixed(self, boxes: Boxes, where: Mapping[int, pin.SE3]) -> Clearances:
        """Return a copy with some fixed shapes at other placements.

        Args:
            boxes: The bounding boxes at the new placements.
            where: Shape index → new placement in the world frame.
        """
        return Clearances(self.placements, boxes, self.shapes.move_fixed(where), self.margins)

    def find_closest_pairs(
        self,
        q: Floats,
        z: Floats,
        waypoints: Ints,
        *,
        reach: float,
        max_pairs: int | None = None,
        include_fixed: bool = True,
    ) -> ClosePairs:
        """Return, per configuration, the pairs closer than `reach` with least distance − margin.

        Args:
            q: Pinocchio configurations, shape (W, nq).
            z: Minimal coordinates, shape (W, n), which select the margins together with
                `waypoints`.
            waypoints: Indices of waypoints, shape (W,).
            reach: Largest distance [m].
            max_pairs: Maximum number of pairs per configuration. Default: no limit.
            include_fixed: Include pairs of a moving and a fixed shape.
        """
        threads = max(1, min(self.shapes.threads, len(q) // _MIN_ROWS_PER_THREAD))
        limit = -1 if max_pairs is None else max_pairs
        return ClosePairs(
            *self._find_closest_pairs(
                *self._parts, q, z, waypoints, reach, limit, include_fixed, _ROUNDING, threads
            )
        )

    def find_first_violation(
        self, q: Floats, z: Floats, waypoint: int, *, reach: float, allowed: float
    ) -> int:
        """Return the first configuration that violates a margin by more than `allowed` [m], or W.

        Args:
            q: Pinocchio configurations, shape (W, nq).
            z: Minimal coordinates, shape (W, n).
            waypoint: Index of the waypoint, which selects the margins.
            reach: Pairs further apart are ignored [m].
            allowed: Tolerated violation [m].
        """
        return int(
            self._find_first_violation(*self._parts, q, z, waypoint, reach, allowed, _ROUNDING)
        )
