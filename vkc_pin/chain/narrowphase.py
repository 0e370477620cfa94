"""Signed distances of pairs of shapes, asked of coal one by one."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import coal
import pinocchio as pin

__all__ = ["Distances"]


class Distances:
    """Distances between some of many pairs, at one configuration after the other.

    They are tight: at coal's own 1e-6 the gradients of planes are off by up to 5e-3; this takes no longer. Penetration keeps
    its tolerance: below 1e-6 it fails for cylinders. And they start afresh every time: what coal (`coal.ComputeDistance`) and
    Pinocchio keep from a pair's last distance would let the next depend, in its last digits, on what was asked before.

    Args:
        shapes: First those that move, then those that stand in the world (parent joint 0).
        placements: Of those that move, in the world; at another configuration the same objects say so.
    """

    def __init__(self, shapes: Sequence[pin.GeometryObject], placements: Sequence[pin.SE3]) -> None:
        self._shapes = [shape.geometry for shape in shapes]
        self._standing, self._moving, self._count = _Standing(shapes), _Moving(placements), len(placements)
        self._request = coal.DistanceRequest()
        self._request.gjk_tolerance = 1e-8

    def moved(self) -> Distances:
        """Take note that the placements are those at another configuration, and return this."""
        self._moving.clear()
        return self

    def placed(self, where: Mapping[int, pin.SE3]) -> Distances:
        """Return the same with shapes that stand placed elsewhere in the world; both look at what moves in the same place."""
        other = copy.copy(self)
        other._standing = _Standing(self._standing.shapes)
        other._standing.update(self._standing)
        other._standing.update((shape, coal.Transform3s(at.rotation, at.translation)) for shape, at in where.items())
        return other

    def of(self, first: int, second: int) -> coal.DistanceResult:
        """Return distance, witness points and normal of a shape that moves and another at the configuration."""
        moving, shapes, result = self._moving, self._shapes, coal.DistanceResult()
        where = moving[second] if second < self._count else self._standing[second]
        coal.distance(shapes[first], moving[first], shapes[second], where, self._request, result)
        return result


class _Standing(dict[int, coal.Transform3s]):
    """Where what stands is, as coal wants it."""

    def __init__(self, shapes: Sequence[pin.GeometryObject]) -> None:
        super().__init__()
        self.shapes = shapes

    def __missing__(self, shape: int) -> coal.Transform3s:
        placement = self.shapes[shape].placement
        where = self[shape] = coal.Transform3s(placement.rotation, placement.translation)
        return where


class _Moving(dict[int, coal.Transform3s]):
    """Where what moves is at a configuration, as coal wants it, of what has been asked for there."""

    def __init__(self, placements: Sequence[pin.SE3]) -> None:
        super().__init__()
        self._placements = placements  # whose memory the arrays look into
        # To look at a placement's numbers, and to write over a transform, takes a fifth of the time of making either.
        self._known = [(placed.rotation, placed.translation, coal.Transform3s()) for placed in placements]

    def __missing__(self, shape: int) -> coal.Transform3s:
        rotation, translation, where = self._known[shape]
        where.setTransform(rotation, translation)
        self[shape] = where
        return where
