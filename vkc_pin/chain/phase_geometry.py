"""Geometry and pairs of one phase, and which of these may be close at many configurations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Bools, Floats, Ints
from vkc_pin.distances.boxes import Boxes

__all__ = ["Neighbours", "PhaseGeometry"]


class Neighbours(NamedTuple):
    """Pairs that may be closer than others as long as some coordinates are within limits; see `scene.neighbours`.

    Attributes:
        pairs: Which, shape (k,).
        margin: What they keep there [m]; -inf: nothing.
        columns: The coordinates in z, shape (m,).
        lower, upper: Their limits, shape (m,) each.
    """

    pairs: Ints
    margin: float
    columns: Ints
    lower: Floats
    upper: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class PhaseGeometry:
    """Geometry and pairs of one phase.

    Attributes:
        shapes: Robot, held links, then what stands in the world (parent joint 0).
        labels: Per geometry, its link or obstacle, e.g. "wrist_3_link", "door.panel", "sofa".
        pairs: Shape (P, 2); of every pair at least the first moves.
        margins: Clearance each pair must keep, shape (P,) [m].
        joint: Parent joint per geometry, shape (G,).
        center, half: Bounding box per geometry, in the geometry's own frame: centre and half extents, shape (G, 3) [m].
        rotation, translation: Placement of each geometry in its joint's frame, shapes (G, 3, 3) and (G, 3).
        eased: Pair → (first waypoint, last waypoint, margin) [m]: between these it may come closer than `margins` says, so close.
        neighbours: Pairs that may come closer than `margins` says where some coordinates have some values.
        left: Object → its geometries, for what the motion leaves behind at a place that it chooses.
    """

    shapes: Sequence[pin.GeometryObject]
    labels: tuple[str, ...]
    pairs: Ints
    margins: Floats
    joint: Ints
    center: Floats
    half: Floats
    rotation: Floats
    translation: Floats
    eased: Mapping[int, Sequence[tuple[int, int, float]]] = field(default_factory=dict)
    neighbours: Sequence[Neighbours] = ()
    left: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def margins_at(self, pairs: Ints, waypoints: Ints, z: Floats | None = None, rows: Ints | None = None) -> Floats:
        """Return the clearances that pairs must keep at waypoints, shape (n,) [m]; -inf: none.

        Args:
            pairs: Shape (n,).
            waypoints: Shape (n,).
            z: Configurations, shape (W, m); None: anywhere but where pairs are neighbours.
            rows: Which of these each pair is looked at in, shape (n,).
        """
        margins = self.margins[pairs]
        some = np.flatnonzero(self._is_eased[pairs])  # few, and mostly none
        for pair in dict.fromkeys(pairs[some].tolist()):
            which = some[pairs[some] == pair]
            for first, last, margin in self.eased[pair]:
                inside = which[(first <= waypoints[which]) & (waypoints[which] <= last)]
                margins[inside] = np.minimum(margins[inside], margin)
        if z is None:
            return margins
        for near in self.neighbours:
            values = z[:, near.columns]
            holds: Bools = np.all((near.lower <= values) & (values <= near.upper), axis=1)
            which = np.flatnonzero(np.isin(pairs, near.pairs) & holds[rows])
            margins[which] = np.minimum(margins[which], near.margin)
        return margins

    def placed(self, where: Mapping[int, pin.SE3]) -> PhaseGeometry:
        """Return the same with geometries that stand placed elsewhere in the world."""
        shapes, rotation, translation = list(self.shapes), self.rotation.copy(), self.translation.copy()
        for geometry, placement in where.items():
            shapes[geometry] = pin.GeometryObject(shapes[geometry])
            shapes[geometry].placement = placement
            rotation[geometry], translation[geometry] = placement.rotation, placement.translation
        moved = replace(self, shapes=tuple(shapes), rotation=rotation, translation=translation)
        for name in ("_moving_count", "_number"):  # the same wherever they stand
            moved.__dict__[name] = getattr(self, name)
        which = np.array(list(where), int)
        moved.__dict__["_pairs_near"] = self._pairs_near.placed(which, rotation[which], moved._middle[which])
        return moved

    def within(self, reach: float, lower: Floats, upper: Floats) -> Ints:
        """Return what stands and may be within `reach` [m] of a box along the world's axes, corners of shape (3,) [m]."""
        lows, highs = self._boxes
        near = (lows < (upper + reach)[:, None]) & (highs > (lower - reach)[:, None])
        return np.flatnonzero(near.all(axis=0)) + self._moving_count

    def pairs_of(self, first: int, seconds: Ints) -> Ints:
        """Return the pairs of a geometry that moves with some that stand, those that there are."""
        numbers = self._number[first, seconds - self._moving_count]
        return numbers[numbers >= 0]

    def maybe_within(
        self, reach: float, rotations: Floats, translations: Floats, *, standing: bool = True
    ) -> tuple[Ints, Ints, Floats]:
        """Return (configuration, pair) of all pairs that bounding volumes cannot prove to be `reach` [m] apart, in this order.

        First balls (against boxes where they stand in the world), then what the face normals of both boxes separate. The third
        array has lower bounds of the signed distances [m].

        Args:
            reach: [m].
            rotations: Of all joints in the world, shape (W, J, 3, 3).
            translations: Of all joints in the world, shape (W, J, 3) [m].
            standing: Whether what stands in the world counts, too; otherwise only pairs of which both move.
        """
        return self._pairs_near.near(reach, rotations, translations, standing=standing)

    @cached_property
    def _is_eased(self) -> Bools:
        """Whether each pair may come closer for a while, shape (P,)."""
        found = np.zeros(len(self.pairs), bool)
        found[list(self.eased)] = True
        return found

    @cached_property
    def _moving_count(self) -> int:
        """How many geometries, the first, are on joints; the others stand in the world."""
        return int(np.count_nonzero(self.joint))

    @cached_property
    def _middle(self) -> Floats:
        """The centre of each geometry's box in its joint's frame, shape (G, 3) [m]."""
        return np.einsum("gij,gj->gi", self.rotation, self.center) + self.translation

    @cached_property
    def _pairs_near(self) -> Boxes:
        """The boxes, to find pairs that may be close."""
        return Boxes(self.joint, self.rotation, self._middle, self.half, self.pairs)

    @cached_property
    def _number(self) -> Ints:
        """Which pair a geometry that moves is with one that stands, shape (M, S); -1: none."""
        moving = self._moving_count
        number = np.full((moving, len(self.joint) - moving), -1)
        (standing,) = np.nonzero(self.joint[self.pairs[:, 1]] == 0)
        number[self.pairs[standing, 0], self.pairs[standing, 1] - moving] = standing
        return number

    @cached_property
    def _boxes(self) -> tuple[Floats, Floats]:
        """The lower and upper corners of boxes along the world's axes around what stands, shape (3, S) each [m]."""
        standing = slice(self._moving_count, None)
        extents = np.einsum("gij,gj->gi", np.abs(self.rotation[standing]), self.half[standing])
        return (self._middle[standing] - extents).T, (self._middle[standing] + extents).T
