"""Which pairs may be close: bounding volumes of all geometries of a phase, for many configurations at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["PhaseGeometry"]


@dataclass(frozen=True, eq=False)
class PhaseGeometry:
    """Geometry and pairs of one phase.

    Attributes:
        geometry: Robot, held links, then what stands in the world (parent joint 0).
        labels: Per geometry, its link or obstacle, e.g. "wrist_3_link", "door.panel", "sofa".
        pairs: Shape (P, 2).
        margins: Clearance each pair must keep, shape (P,) [m].
        joint: Parent joint per geometry, shape (G,).
        center, half: Bounding box per geometry, in the geometry's own frame: centre and half extents, shape (G, 3) [m].
        rotation, translation: Placement of each geometry in its joint's frame, shapes (G, 3, 3) and (G, 3).
        eased: Pair → (first waypoint, last waypoint, margin) [m]: between these it may come closer than `margins` says.
        left: Object → its geometries, for what the motion leaves behind at a place that it chooses.
    """

    geometry: pin.GeometryModel
    data: pin.GeometryData
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

    def margin(self, pair: int, waypoint: int) -> float:
        """Return the clearance that a pair must keep at a waypoint [m]."""
        eased = (margin for first, last, margin in self.eased.get(pair, ()) if first <= waypoint <= last)
        return float(min(eased, default=self.margins[pair]))

    def maybe_within(
        self, reach: float, rotations: NDArray[np.float64], translations: NDArray[np.float64]
    ) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Return (configuration, pair) of all pairs that bounding volumes cannot prove to be `reach` [m] apart.

        First balls (against boxes where they stand in the world), then what the face normals of both boxes separate.

        Args:
            reach: [m].
            rotations: Of all joints in the world, shape (W, J, 3, 3).
            translations: Of all joints in the world, shape (W, J, 3) [m].
        """
        local = np.einsum("gij,gj->gi", self.rotation, self.center) + self.translation
        centers = np.einsum("wgij,gj->wgi", rotations[:, self.joint], local) + translations[:, self.joint]
        radius = np.linalg.norm(self.half, axis=1)
        first, second = self.pairs.T
        bounds = np.empty((len(rotations), len(self.pairs)))
        still = self.joint[second] == 0
        a, b = first[~still], second[~still]
        bounds[:, ~still] = np.linalg.norm(centers[:, a] - centers[:, b], axis=2) - radius[a] - radius[b]
        for j in np.unique(second[still]):
            of = np.flatnonzero(still & (second == j))
            inside = (centers[:, first[of]] - centers[:1, j]) @ self.rotation[j]
            outside = np.maximum(np.abs(inside) - self.half[j], 0.0)
            bounds[:, of] = np.sqrt(np.einsum("wki,wki->wk", outside, outside)) - radius[first[of]]
        w, k = np.nonzero(bounds < reach)
        a, b = first[k], second[k]
        turn_a = rotations[w, self.joint[a]] @ self.rotation[a]
        turn_b = rotations[w, self.joint[b]] @ self.rotation[b]
        between = (centers[w, b] - centers[w, a])[:, None, :]
        mixed = np.abs(turn_a.swapaxes(1, 2) @ turn_b)
        gap_a = np.abs(between @ turn_a)[:, 0] - self.half[a] - (mixed @ self.half[b][..., None])[..., 0]
        gap_b = np.abs(between @ turn_b)[:, 0] - self.half[b] - (self.half[a][:, None] @ mixed)[:, 0]
        near = np.maximum(gap_a.max(axis=1), gap_b.max(axis=1)) < reach
        return w[near], k[near]
