"""Represents measured points of one radius as fixed shapes."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats

# [m] Edge of the cubes into which a cloud is divided. Each has one pair of witness points with a
# link, and one convex outline in the plan view; docs/decisions/0038 compares sizes.
_BLOCK_SIZE = 0.5


class PointCloud(coal.Box):
    """Points of one radius, as the box that bounds them, in whose centre their frame is.

    Whatever computes distances with `solids.convert_solid` takes the points. Anything else takes
    the box, which contains them.

    Attributes:
        points: Points in the frame of the box, shape (n, 3) [m], read-only.
        radius: Radius of each [m].

    Args:
        points: Points, shape (n, 3) [m], whose bounding box has its centre at the origin.
        radius: Radius of each [m].
    """

    def __init__(self, points: Floats, radius: float) -> None:
        half = np.abs(points).max(axis=0) + radius
        super().__init__(*(2.0 * half).tolist())
        self.points = np.array(points, float)
        self.points.flags.writeable = False
        self.radius = radius

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PointCloud):
            return False
        return self.radius == other.radius and np.array_equal(self.points, other.points)

    def __hash__(self) -> int:
        return hash((len(self.points), self.radius))

    def place(self, placement: pin.SE3) -> Floats:
        """Return the points in the world, shape (n, 3) [m], with the box's frame at `placement`."""
        return np.asarray(self.points @ placement.rotation.T + placement.translation)

    def __reduce__(self) -> tuple[Any, ...]:
        return PointCloud, (self.points, self.radius)


def divide_points(points: Floats, radius: float) -> list[tuple[PointCloud, Floats]]:
    """Divide points, shape (n, 3) [m], into shapes with the positions of their frames.

    Args:
        points: Points.
        radius: Radius of each [m].

    Returns:
        Shapes, and the position of each one's frame in the frame of the points, shape (3,) [m].
    """
    blocks = np.floor(points / _BLOCK_SIZE).astype(np.int64)
    order = np.lexsort(blocks.T)
    is_first = np.any(np.diff(blocks[order], axis=0), axis=1)
    edges = np.flatnonzero(is_first) + 1
    divided = []
    for members in np.split(order, edges):
        own = points[members]
        center = (own.min(axis=0) + own.max(axis=0)) / 2
        divided.append((PointCloud(own - center, radius), center))
    return divided


def select_for_drawing(points: Floats, count: int) -> Floats:
    """Return every k-th of points, shape (n, 3), so that at most `count` are left."""
    step = -(-len(points) // count)
    return points[:: max(step, 1)]
