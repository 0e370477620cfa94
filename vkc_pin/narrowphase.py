"""Signed distances of pairs of shapes, asked of coal one by one."""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["Distances"]


class Distances:
    """Distances between some of many pairs, at one configuration after the other.

    They are tight: at coal's own 1e-6 the gradients of planes are off by up to 5e-3; this takes no longer. Penetration keeps
    its tolerance: below 1e-6 it fails for cylinders. And they start afresh every time: what coal (`coal.ComputeDistance`) and
    Pinocchio keep from a pair's last distance would let the next depend, in its last digits, on what was asked before.

    Args:
        shapes: First those that move, then those that stand in the world (parent joint 0).
        pairs: Indices of shapes, shape (P, 2).
    """

    def __init__(self, shapes: Sequence[pin.GeometryObject], pairs: NDArray[np.int_]) -> None:
        self._shapes, self._pairs = shapes, pairs
        self._standing: dict[int, coal.Transform3s] = {}
        self._where: dict[int, coal.Transform3s] = {}
        self._placements: Sequence[pin.SE3] = ()
        self._request = coal.DistanceRequest()
        self._request.gjk_tolerance = 1e-8

    def at(self, placements: Sequence[pin.SE3]) -> Distances:
        """Go on to another configuration, and return this; `placements` are those of the shapes that move, in the world."""
        self._placements = placements
        self._where.clear()
        return self

    def forget(self, shape: int) -> None:
        """Take note that a shape that stands has been placed elsewhere."""
        self._standing.pop(shape, None)

    def of(self, pair: int) -> coal.DistanceResult:
        """Return distance, witness points and normal of a pair at the configuration."""
        first, second = self._pairs[pair].tolist()
        one, other, result = self._shapes[first].geometry, self._shapes[second].geometry, coal.DistanceResult()
        coal.distance(one, self._transform(first), other, self._transform(second), self._request, result)
        return result

    def _transform(self, shape: int) -> coal.Transform3s:
        stands = shape >= len(self._placements)
        known = self._standing if stands else self._where
        if shape not in known:
            placement = self._shapes[shape].placement if stands else self._placements[shape]
            known[shape] = coal.Transform3s(placement.rotation, placement.translation)
        return known[shape]
