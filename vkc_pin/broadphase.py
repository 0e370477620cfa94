"""Which pairs may be close: bounding volumes of all geometries of a phase, for many configurations at once.

What moves are a few tens of shapes, what stands may be thousands. So first the boxes, along the world's axes, around what each
joint carries are compared with those of all that stands. Only what is left is looked at pair by pair.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["PhaseGeometry"]

_AT_ONCE = 4_000_000  # comparisons of boxes


@dataclass(frozen=True, eq=False)
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
    pairs: NDArray[np.int_]
    margins: NDArray[np.float64]
    joint: NDArray[np.int_]
    center: NDArray[np.float64]
    half: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    eased: Mapping[int, Sequence[tuple[int, int, float]]] = field(default_factory=dict)
    left: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def margins_at(self, pairs: NDArray[np.int_], waypoints: NDArray[np.int_]) -> NDArray[np.float64]:
        """Return the clearances that pairs must keep at waypoints, both of shape (n,), shape (n,) [m]."""
        margins = self.margins[pairs]
        for pair, moments in self.eased.items():
            (which,) = np.nonzero(pairs == pair)
            for first, last, margin in moments:
                inside = which[(first <= waypoints[which]) & (waypoints[which] <= last)]
                margins[inside] = np.minimum(margins[inside], margin)
        return margins

    def place(self, geometry: int, placement: pin.SE3) -> None:
        """Let a geometry that stands stand elsewhere in the world."""
        self.shapes[geometry].placement = placement
        self.rotation[geometry], self.translation[geometry] = placement.rotation, placement.translation
        self.__dict__.pop("_boxes", None)

    def within(self, reach: float, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> NDArray[np.int_]:
        """Return what stands and may be within `reach` [m] of a box along the world's axes, corners of shape (3,) [m]."""
        lows, highs = self._boxes
        return np.flatnonzero(((lows < upper + reach) & (highs > lower - reach)).all(axis=1)) + self._moving_count

    def pairs_of(self, first: int, seconds: NDArray[np.int_]) -> NDArray[np.int_]:
        """Return the pairs of a geometry that moves with some that stand, those that there are."""
        numbers = self._number[first, seconds - self._moving_count]
        return numbers[numbers >= 0]

    def maybe_within(
        self, reach: float, rotations: NDArray[np.float64], translations: NDArray[np.float64]
    ) -> tuple[NDArray[np.int_], NDArray[np.int_], NDArray[np.float64]]:
        """Return (configuration, pair) of all pairs that bounding volumes cannot prove to be `reach` [m] apart, in this order.

        First balls (against boxes where they stand in the world), then what the face normals of both boxes separate. The third
        array has lower bounds of the signed distances [m].

        Args:
            reach: [m].
            rotations: Of all joints in the world, shape (W, J, 3, 3).
            translations: Of all joints in the world, shape (W, J, 3) [m].
        """
        moving = slice(self._moving_count)
        local = np.einsum("gij,gj->gi", self.rotation, self.center) + self.translation
        joint = self.joint[moving]
        centers = np.einsum("wgij,gj->wgi", rotations[:, joint], local[moving]) + translations[:, joint]
        found = [self._moving_within(reach, centers)]
        if self._groups:
            turns = rotations[:, joint] @ self.rotation[moving]
            extents = np.abs(turns) @ self.half[moving, :, None]
            step = max(1, _AT_ONCE // (len(self._groups) * len(self._boxes[0])))
            for first in range(0, len(centers), step):
                rows = slice(first, first + step)
                w, k = self._standing_within(reach, centers[rows], extents[rows, ..., 0], local)
                found.append((w + first, k))
        w, k = (np.concatenate(parts) for parts in zip(*found, strict=True))
        gaps = self._gaps(w, k, rotations, centers, local)
        near = np.flatnonzero(gaps < reach)
        near = near[np.lexsort((k[near], w[near]))]
        return w[near], k[near], gaps[near]

    def _moving_within(self, reach: float, centers: NDArray[np.float64]) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Return (configuration, pair) of what moves and whose balls are within `reach` of each other."""
        own = np.flatnonzero(self.joint[self.pairs[:, 1]] != 0)
        radius = np.linalg.norm(self.half[: self._moving_count], axis=1)
        a, b = self.pairs[own].T
        w, k = np.nonzero(np.linalg.norm(centers[:, a] - centers[:, b], axis=2) - radius[a] - radius[b] < reach)
        return w, own[k]

    def _standing_within(
        self, reach: float, centers: NDArray[np.float64], extents: NDArray[np.float64], local: NDArray[np.float64]
    ) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Return (configuration, pair) of balls that are within `reach` of boxes that stand.

        Args:
            reach: [m].
            centers: Of what moves in the world, shape (W, M, 3) [m].
            extents: Half extents of its boxes along the world's axes, shape (W, M, 3) [m].
            local: Centres of all boxes in their joints' frames, shape (G, 3) [m].
        """
        lower = np.stack([(centers - extents)[:, group].min(axis=1) for group in self._groups], axis=1) - reach
        upper = np.stack([(centers + extents)[:, group].max(axis=1) for group in self._groups], axis=1) + reach
        lows, highs = self._boxes
        some = ((lower.min(axis=(0, 1)) < highs) & (upper.max(axis=(0, 1)) > lows)).all(axis=1).nonzero()[0]
        near = np.ones((*lower.shape[:2], len(some)), bool)
        for axis in range(3):
            near &= lower[..., axis, None] < highs[some, axis]
            near &= upper[..., axis, None] > lows[some, axis]
        w, group, standing = np.nonzero(near)
        standing = some[standing]
        sizes = np.array([len(members) for members in self._groups])
        entry = np.repeat(np.arange(len(w)), sizes[group])
        place = np.arange(len(entry)) - np.repeat(np.cumsum(sizes[group]) - sizes[group], sizes[group])
        a = np.concatenate(self._groups)[(np.cumsum(sizes) - sizes)[group][entry] + place]
        w, standing = w[entry], standing[entry]
        k = self._number[a, standing]
        some = k >= 0
        w, a, k, b = w[some], a[some], k[some], standing[some] + self._moving_count
        inside = ((centers[w, a] - local[b])[:, None] @ self.rotation[b])[:, 0]
        outside = np.maximum(np.abs(inside) - self.half[b], 0.0)
        near_ball = np.sqrt(np.einsum("ni,ni->n", outside, outside)) - np.linalg.norm(self.half[a], axis=1) < reach
        return w[near_ball], k[near_ball]

    def _gaps(
        self,
        w: NDArray[np.int_],
        k: NDArray[np.int_],
        rotations: NDArray[np.float64],
        centers: NDArray[np.float64],
        local: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return by how much the face normals of either box separate pairs at configurations [m].

        That is a lower bound of their signed distance also where it is negative: moved apart by as much, they are separate.
        """
        a, b = self.pairs[k].T
        stands = self.joint[b] == 0
        second = np.where(stands[:, None], local[b], centers[w, np.where(stands, 0, b)])
        turn_a = rotations[w, self.joint[a]] @ self.rotation[a]
        turn_b = rotations[w, self.joint[b]] @ self.rotation[b]
        between = (second - centers[w, a])[:, None, :]
        mixed = np.abs(turn_a.swapaxes(1, 2) @ turn_b)
        gap_a = np.abs(between @ turn_a)[:, 0] - self.half[a] - (mixed @ self.half[b][..., None])[..., 0]
        gap_b = np.abs(between @ turn_b)[:, 0] - self.half[b] - (self.half[a][:, None] @ mixed)[:, 0]
        return np.asarray(np.maximum(gap_a.max(axis=1), gap_b.max(axis=1)))

    # -- what does not change -------------------------------------------------------------------------------------------------

    @cached_property
    def _moving_count(self) -> int:
        """How many geometries, the first, are on joints; the others stand in the world."""
        return int(np.count_nonzero(self.joint))

    @cached_property
    def _groups(self) -> list[NDArray[np.int_]]:
        """What can hit something that stands, by the joint that carries it."""
        first = np.unique(self.pairs[self.joint[self.pairs[:, 1]] == 0, 0])
        return [first[self.joint[first] == joint] for joint in np.unique(self.joint[first])]

    @cached_property
    def _number(self) -> NDArray[np.int_]:
        """Which pair a geometry that moves is with one that stands, shape (M, S); -1: none."""
        moving = self._moving_count
        number = np.full((moving, len(self.joint) - moving), -1)
        (standing,) = np.nonzero(self.joint[self.pairs[:, 1]] == 0)
        number[self.pairs[standing, 0], self.pairs[standing, 1] - moving] = standing
        return number

    @cached_property
    def _boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lower and upper corners of boxes along the world's axes around what stands, shape (S, 3) each [m]."""
        standing = slice(self._moving_count, None)
        rotation = self.rotation[standing]
        centers = np.einsum("gij,gj->gi", rotation, self.center[standing]) + self.translation[standing]
        extents = np.einsum("gij,gj->gi", np.abs(rotation), self.half[standing])
        return centers - extents, centers + extents
