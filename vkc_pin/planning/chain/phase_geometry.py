"""Geometry and pairs of one phase, and which clearances these must keep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.margins import MarginRegion, Margins

__all__ = ["PhaseGeometry"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PhaseGeometry:
    """Geometry and pairs of one phase.

    Attributes:
        shapes: Robot, held links, then what stands in the world (parent joint 0).
        labels: Per geometry, its link or obstacle, e.g. "wrist_3_link", "door.panel", "sofa".
        pairs: Shape (P, 2); of every pair at least the first moves.
        margins: Clearance each pair must keep, shape (P,) [m].
        joint: Parent joint per geometry, shape (G,).
        center, half: Bounding box per geometry, in the geometry's own frame: centre and half
            extents, shape (G, 3) [m].
        rotation, translation: Placement of each geometry in its joint's frame, shapes (G, 3, 3) and
            (G, 3).
        eased: Pair → (first waypoint, last waypoint, margin) [m]: between these it may come closer
            than `margins` says, so close.
        neighbours: Where pairs may come closer than `margins` says; see
            `world.scene.clearance_exemptions`.
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
    neighbours: Sequence[MarginRegion] = ()
    left: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def margins_at(
        self, pairs: Ints, waypoints: Ints, z: Floats | None = None, rows: Ints | None = None
    ) -> Floats:
        """Return the clearances that pairs must keep at waypoints, shape (n,) [m]; -inf: none.

        Args:
            pairs: Shape (n,).
            waypoints: Shape (n,).
            z: Configurations, shape (W, m); None: anywhere but where pairs are neighbours.
            rows: Which of these each pair is looked at in, shape (n,).
        """
        if z is None:
            return self._usual.at(pairs, waypoints, np.empty((1, 0)), np.zeros(len(pairs), int))
        return self.margin_table.at(
            pairs, waypoints, z, np.arange(len(z)) if rows is None else rows
        )

    def placed(self, where: Mapping[int, pin.SE3]) -> PhaseGeometry:
        """Return the same with geometries that stand placed elsewhere in the world."""
        shapes, rotation, translation = (
            list(self.shapes),
            self.rotation.copy(),
            self.translation.copy(),
        )
        for geometry, placement in where.items():
            shapes[geometry] = pin.GeometryObject(shapes[geometry])
            shapes[geometry].placement = placement
            rotation[geometry], translation[geometry] = placement.rotation, placement.translation
        moved = replace(self, shapes=tuple(shapes), rotation=rotation, translation=translation)
        for name in ("_moving_count", "_number", "margin_table"):  # the same wherever they stand
            moved.__dict__[name] = getattr(self, name)
        which = np.array(list(where), int)
        moved.__dict__["boxes"] = self.boxes.placed(which, rotation[which], moved._middle[which])
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

    @cached_property
    def margin_table(self) -> Margins:
        """What pairs must keep, wherever that is less than `margins`."""
        return Margins(self.margins, self.eased, self.neighbours)

    @cached_property
    def _usual(self) -> Margins:
        """What they must keep anywhere but where they are neighbours."""
        return Margins(self.margins, self.eased)

    @cached_property
    def _moving_count(self) -> int:
        """How many geometries, the first, are on joints; the others stand in the world."""
        return int(np.count_nonzero(self.joint))

    @cached_property
    def _middle(self) -> Floats:
        """The centre of each geometry's box in its joint's frame, shape (G, 3) [m]."""
        return np.einsum("gij,gj->gi", self.rotation, self.center) + self.translation

    @cached_property
    def boxes(self) -> Boxes:
        """Boxes around all geometries, to find pairs that may be close."""
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
