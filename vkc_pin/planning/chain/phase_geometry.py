"""Describes the geometry of one phase: collision pairs and their clearance margins."""

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
    """Geometry and collision pairs of one phase.

    Attributes:
        shapes: Geometry of the robot, of attached links, then of all that is fixed in the world.
        labels: Link or obstacle of each geometry, e.g. "wrist_3_link", "door.panel", "sofa".
        pairs: Geometry indices, shape (P, 2); at least the first of each pair moves.
        margins: Required clearance of each pair, shape (P,) [m].
        joint: Parent joint of each geometry, shape (G,); 0: fixed in the world.
        center, half: Bounding boxes in the geometries' frames, shape (G, 3) [m].
        rotation, translation: Placements on the joints, shapes (G, 3, 3) and (G, 3).
        reduced_margins: Pair → (first waypoint, last waypoint, margin [m] that applies between
            them).
        margin_regions: Joint ranges in which pairs are exempt from their margins.
        released: Object → its geometries, for objects released where the motion chooses.
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
    reduced_margins: Mapping[int, Sequence[tuple[int, int, float]]] = field(default_factory=dict)
    margin_regions: Sequence[MarginRegion] = ()
    released: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def with_placements(self, placements: Mapping[int, pin.SE3]) -> PhaseGeometry:
        """Return a copy with some static geometries at other placements in the world."""
        shapes = list(self.shapes)
        rotation, translation = self.rotation.copy(), self.translation.copy()
        for geometry, placement in placements.items():
            shapes[geometry] = pin.GeometryObject(shapes[geometry])
            shapes[geometry].placement = placement
            rotation[geometry], translation[geometry] = placement.rotation, placement.translation
        moved = replace(self, shapes=tuple(shapes), rotation=rotation, translation=translation)
        for name in ("_n_moving", "_pair_numbers", "margin_table"):  # independent of the placements
            moved.__dict__[name] = getattr(self, name)
        which = np.array(list(placements), int)
        moved.__dict__["boxes"] = self.boxes.move_fixed(
            which, rotation[which], moved._box_centers[which]
        )
        return moved

    def find_static_near(self, reach: float, lower: Floats, upper: Floats) -> Ints:
        """Return static geometries within `reach` [m] of a box with given corners, (3,)."""
        lows, highs = self._static_boxes
        near = (lows < (upper + reach)[:, None]) & (highs > (lower - reach)[:, None])
        return np.flatnonzero(near.all(axis=0)) + self._n_moving

    def find_pairs(self, first: int, seconds: Ints) -> Ints:
        """Return the existing pairs of a moving geometry with some static ones."""
        numbers = self._pair_numbers[first, seconds - self._n_moving]
        return numbers[numbers >= 0]

    @cached_property
    def margin_table(self) -> Margins:
        """Margins of all pairs with their exceptions."""
        return Margins(self.margins, self.reduced_margins, self.margin_regions)

    @cached_property
    def _n_moving(self) -> int:
        """Number of geometries on joints; these come first, the others are static."""
        return int(np.count_nonzero(self.joint))

    @cached_property
    def _box_centers(self) -> Floats:
        """Centre of each geometry's box in its joint's frame, shape (G, 3) [m]."""
        return np.einsum("gij,gj->gi", self.rotation, self.center) + self.translation

    @cached_property
    def boxes(self) -> Boxes:
        """Boxes of all geometries, for the broad phase."""
        return Boxes(self.joint, self.rotation, self._box_centers, self.half, self.pairs)

    @cached_property
    def _pair_numbers(self) -> Ints:
        """Pair number of each moving with each static geometry, shape (M, S); -1: no pair."""
        moving = self._n_moving
        number = np.full((moving, len(self.joint) - moving), -1)
        (standing,) = np.nonzero(self.joint[self.pairs[:, 1]] == 0)
        number[self.pairs[standing, 0], self.pairs[standing, 1] - moving] = standing
        return number

    @cached_property
    def _static_boxes(self) -> tuple[Floats, Floats]:
        """Lower and upper corners of the static axis-aligned boxes, shape (3, S) each [m]."""
        standing = slice(self._n_moving, None)
        extents = np.einsum("gij,gj->gi", np.abs(self.rotation[standing]), self.half[standing])
        return (self._box_centers[standing] - extents).T, (self._box_centers[standing] + extents).T
