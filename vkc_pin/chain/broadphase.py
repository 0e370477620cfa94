"""Which pairs may be close: bounding volumes of all geometries of a phase, for many configurations at once.

What moves are a few tens of shapes, what stands may be thousands. So first the boxes, along the world's axes, around what each
joint carries are compared with those of all that stands. Only what is left is looked at pair by pair.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats, Ints

__all__ = ["PhaseGeometry"]

_AT_ONCE = 1_000_000  # comparisons of boxes
_ROWS = 128  # configurations: what is computed of so many stays in the processor's cache


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
    left: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def margins_at(self, pairs: Ints, waypoints: Ints) -> Floats:
        """Return the clearances that pairs must keep at waypoints, both of shape (n,), shape (n,) [m]."""
        margins = self.margins[pairs]
        for pair, moments in self.eased.items():
            (which,) = np.nonzero(pairs == pair)
            for first, last, margin in moments:
                inside = which[(first <= waypoints[which]) & (waypoints[which] <= last)]
                margins[inside] = np.minimum(margins[inside], margin)
        return margins

    def placed(self, where: Mapping[int, pin.SE3]) -> PhaseGeometry:
        """Return the same with geometries that stand placed elsewhere in the world."""
        shapes, rotation, translation = list(self.shapes), self.rotation.copy(), self.translation.copy()
        for geometry, placement in where.items():
            shapes[geometry] = pin.GeometryObject(shapes[geometry])
            shapes[geometry].placement = placement
            rotation[geometry], translation[geometry] = placement.rotation, placement.translation
        moved = replace(self, shapes=tuple(shapes), rotation=rotation, translation=translation)
        for name in ("_moving_count", "_radius", "_half", "_own", "_groups", "_number"):  # the same wherever they stand
            moved.__dict__[name] = getattr(self, name)
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
        boxes = len(self._groups[1]) * (len(self.joint) - self._moving_count)
        step = max(1, min(_ROWS, _AT_ONCE // max(boxes, 1)))
        starts = range(0, len(rotations), step)
        parts = [self._near(reach, rotations[w : w + step], translations[w : w + step], standing) for w in starts]
        if len(parts) == 1:
            return parts[0]
        at = np.concatenate([w + number * step for number, (w, _, _) in enumerate(parts)])
        return at, np.concatenate([k for _, k, _ in parts]), np.concatenate([gaps for _, _, gaps in parts])

    def _near(self, reach: float, rotations: Floats, translations: Floats, standing: bool) -> tuple[Ints, Ints, Floats]:
        """Return the same as `maybe_within`. From here on the axes of the world come first: that is several times as fast."""
        moving, joint = slice(self._moving_count), self.joint[: self._moving_count]
        rotated = rotations.transpose(2, 3, 0, 1).take(joint, axis=3)
        turns = _products(rotated, self._turn[:, :, None, moving])
        centers = _turned(rotated, self._local[:, None, moving]) + translations.transpose(2, 0, 1).take(joint, axis=2)
        own, a, b, radii = self._own  # of which both move, whose balls are within reach of each other
        between = centers.take(a, axis=2) - centers.take(b, axis=2)
        w, k = np.nonzero((between * between).sum(axis=0) < (radii + reach) ** 2)
        moves = w, own[k]
        none = np.zeros(0, int), np.zeros(0, int)
        stands = self._standing_within(reach, centers, turns) if standing else none
        w, k = (np.concatenate(parts) for parts in zip(moves, stands, strict=True))
        gaps = self._gaps(w, k, len(moves[0]), centers, turns)
        near = np.flatnonzero(gaps < reach)
        near = near[np.argsort(w[near] * len(self.pairs) + k[near])]
        return w[near], k[near], gaps[near]

    def _standing_within(self, reach: float, centers: Floats, turns: Floats) -> tuple[Ints, Ints]:
        """Return (configuration, pair) of what moves and whose balls are within `reach` of boxes that stand.

        Args:
            reach: [m].
            centers: Of what moves in the world, shape (3, W, M) [m].
            turns: Its rotations in the world, shape (3, 3, W, M).
        """
        members, starts, sizes = self._groups
        if not len(members):
            return np.zeros(0, int), np.zeros(0, int)
        middles = centers.take(members, axis=2)
        extents = _turned(np.abs(turns.take(members, axis=3)), self._half[:, None, members])
        lower = np.minimum.reduceat(middles - extents, starts, axis=2) - reach
        upper = np.maximum.reduceat(middles + extents, starts, axis=2) + reach
        lows, highs = self._boxes
        least, most = lower.min(axis=(1, 2))[:, None], upper.max(axis=(1, 2))[:, None]
        (some,) = ((least < highs) & (most > lows)).all(axis=0).nonzero()
        lows, highs = lows.take(some, axis=1)[:, None, None], highs.take(some, axis=1)[:, None, None]
        near = ((lower[..., None] < highs) & (upper[..., None] > lows)).all(axis=0)
        w, group, standing = near.nonzero()
        count = sizes[group]
        entry = np.repeat(np.arange(len(w)), count)
        a = members[np.arange(len(entry)) + (starts[group] - np.cumsum(count) + count)[entry]]
        w, standing = w[entry], some[standing[entry]]
        k = self._number[a, standing]
        (are,) = np.nonzero(k >= 0)
        w, a, k, b = w[are], a[are], k[are], standing[are] + self._moving_count
        between = centers[:, w, a] - self._local.take(b, axis=1)
        inside = _turned(self._turn.take(b, axis=2).swapaxes(0, 1), between)
        outside = np.maximum(np.abs(inside) - self._half.take(b, axis=1), 0.0)
        (balls,) = np.nonzero((outside * outside).sum(axis=0) < (self._radius[a] + reach) ** 2)
        return w[balls], k[balls]

    def _gaps(self, w: Ints, k: Ints, moves: int, centers: Floats, turns: Floats) -> Floats:
        """Return by how much the face normals of either box separate pairs at configurations [m].

        That is a lower bound of their signed distance also where it is negative: moved apart by as much, they are separate.
        Of the first `moves` of the pairs both move, of the others the second stands.
        """
        a, b = self.pairs[k].T
        first, second, stands = w * self._moving_count + a, w[:moves] * self._moving_count + b[:moves], b[moves:]
        middles, turns = centers.reshape(3, -1), turns.reshape(3, 3, -1)
        half_a, half_b = self._half.take(a, axis=1), self._half.take(b, axis=1)
        turn_a = turns.take(first, axis=2).swapaxes(0, 1)
        turn_b = np.concatenate([turns.take(second, axis=2), self._turn.take(stands, axis=2)], axis=2)
        between = np.concatenate([middles.take(second, axis=1), self._local.take(stands, axis=1)], axis=1)
        between -= middles.take(first, axis=1)
        mixed = np.abs(_products(turn_a, turn_b))
        gap_a = np.abs(_turned(turn_a, between)) - half_a - _turned(mixed, half_b)
        gap_b = np.abs(_turned(turn_b.swapaxes(0, 1), between)) - half_b - _turned(mixed.swapaxes(0, 1), half_a)
        return np.asarray(np.maximum(gap_a, gap_b).max(axis=0))

    @cached_property
    def _moving_count(self) -> int:
        """How many geometries, the first, are on joints; the others stand in the world."""
        return int(np.count_nonzero(self.joint))

    @cached_property
    def _radius(self) -> Floats:
        """Of the ball around each geometry's box, shape (G,) [m]."""
        return np.linalg.norm(self.half, axis=1)

    @cached_property
    def _half(self) -> Floats:
        """The half extents of each geometry's box, shape (3, G) [m]."""
        return np.ascontiguousarray(self.half.T)

    @cached_property
    def _turn(self) -> Floats:
        """The rotation of each geometry in its joint's frame, shape (3, 3, G)."""
        return np.ascontiguousarray(self.rotation.transpose(1, 2, 0))

    @cached_property
    def _local(self) -> Floats:
        """The centre of each geometry's box in its joint's frame, shape (3, G) [m]."""
        return np.ascontiguousarray((np.einsum("gij,gj->gi", self.rotation, self.center) + self.translation).T)

    @cached_property
    def _own(self) -> tuple[Ints, Ints, Ints, Floats]:
        """The pairs of which both move, the first and second of each, and the sum of their radii [m]."""
        own = np.flatnonzero(self.joint[self.pairs[:, 1]] != 0)
        a, b = np.ascontiguousarray(self.pairs[own].T)
        return own, a, b, self._radius[a] + self._radius[b]

    @cached_property
    def _groups(self) -> tuple[Ints, Ints, Ints]:
        """What can hit something that stands, by the joint that carries it; where each group begins, and its size."""
        first = np.unique(self.pairs[self.joint[self.pairs[:, 1]] == 0, 0])
        members = first[np.argsort(self.joint[first], kind="stable")]
        _, starts, sizes = np.unique(self.joint[members], return_index=True, return_counts=True)
        return members, starts, sizes

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
        centers, extents = self._local[:, standing], _turned(np.abs(self._turn[..., standing]), self._half[:, standing])
        return centers - extents, centers + extents


def _products(one: Floats, other: Floats) -> Floats:
    """Return the products of matrices, shape (3, 3, ...)."""
    return np.asarray(one[:, 0, None] * other[0] + one[:, 1, None] * other[1] + one[:, 2, None] * other[2])


def _turned(matrices: Floats, vectors: Floats) -> Floats:
    """Return the products of matrices, shape (3, 3, ...), with vectors, shape (3, ...)."""
    return np.asarray((matrices * vectors).sum(axis=1))
