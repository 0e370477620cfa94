"""Defines rectangles on the floor of a room, and checks whether a robot can move between places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vkc_pin.utils.arrays import Floats

_CELL = 0.1  # [m] of the grid for path searches
_QUARTERS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


@dataclass(frozen=True)
class Rectangle:
    """A rectangle on the floor.

    Attributes:
        x, y: Its centre in the world frame [m].
        length, width: Its edges along its own axes [m].
        yaw: Heading of its first edge [rad].
    """

    x: float
    y: float
    length: float
    width: float
    yaw: float = 0.0

    @property
    def axes(self) -> Floats:
        """Directions of its edges as rows, shape (2, 2)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[c, s], [-s, c]])

    @property
    def corners(self) -> Floats:
        """Its corners in the world frame, shape (4, 2) [m]."""
        signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        return (
            np.array([self.x, self.y]) + signs * (self.length / 2.0, self.width / 2.0) @ self.axes
        )

    def compute_gap(self, other: Rectangle) -> float:
        """Return the largest separation of two rectangles along an axis [m]; negative: overlap."""
        gaps = []
        for axis in np.vstack([self.axes, other.axes]):
            one, two = self.corners @ axis, other.corners @ axis
            gaps.append(max(one.min() - two.max(), two.min() - one.max()))
        return float(max(gaps))

    def compute_distances(self, points: ArrayLike) -> Floats:
        """Return the distances of points, shape (n, 2), to the rectangle, shape (n,) [m].

        They are 0 inside.
        """
        local = np.abs((np.asarray(points, float) - (self.x, self.y)) @ self.axes.T)
        return np.linalg.norm(
            np.maximum(local - (self.length / 2.0, self.width / 2.0), 0.0), axis=-1
        )


@dataclass(frozen=True)
class Frame:
    """A frame on the floor: x and y in the world frame [m], and yaw [rad].

    x points from the user into the part at the frame.
    """

    x: float
    y: float
    yaw: float

    def transform_point(self, x: float, y: float) -> tuple[float, float]:
        """Return a point of this frame in the world frame, rounded to the millimetre [m]."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return round(self.x + c * x - s * y, 3), round(self.y + s * x + c * y, 3)

    def make_rectangle(self, x: tuple[float, float], y: tuple[float, float]) -> Rectangle:
        """Return the rectangle between two values of x and two values of y in this frame [m]."""
        centre = self.transform_point((x[0] + x[1]) / 2.0, (y[0] + y[1]) / 2.0)
        return Rectangle(*centre, x[1] - x[0], y[1] - y[0], self.yaw)


@dataclass(frozen=True)
class Floor:
    """The floor of a room between its walls, centred at the world's origin.

    Attributes:
        width: Length along x [m].
        depth: Length along y [m].
    """

    width: float
    depth: float

    def compute_half_length(self, side: int) -> float:
        """Return half the length of the wall at a side [m]: 0 east, 1 north, 2 west, 3 south."""
        return (self.width if side % 2 else self.depth) / 2.0

    def make_wall_frame(self, side: int, along: float) -> Frame:
        """Return a frame on a wall's inner face, with x out of the room and y along the wall."""
        c, s = _QUARTERS[side]
        out = self.compute_half_length(side + 1)
        return Frame(round(c * out - s * along, 3), round(s * out + c * along, 3), math.atan2(s, c))

    def contains(self, rectangle: Rectangle) -> bool:
        """Return whether a rectangle lies between the walls."""
        return bool(
            (np.abs(rectangle.corners) <= np.array([self.width, self.depth]) / 2.0 + 1e-6).all()
        )

    def find_free(
        self, standing: Sequence[Rectangle], radius: float, points: ArrayLike
    ) -> NDArray[np.bool_]:
        """Return at which points a disc is free of collisions, shape (n,).

        Args:
            standing: Occupied rectangles.
            radius: Radius of the disc [m].
            points: Positions of its centre, shape (n, 2) [m].
        """
        points = np.asarray(points, float)
        free = np.asarray(
            (np.array([self.width, self.depth]) / 2.0 - np.abs(points)).min(axis=1) >= radius
        )
        for rectangle in standing:
            free &= rectangle.compute_distances(points) >= radius
        return free

    def is_connected(
        self, standing: Sequence[Rectangle], radius: float, places: Sequence[tuple[float, float]]
    ) -> bool:
        """Return whether a disc can move between any two of some places without collision.

        Args:
            standing: Occupied rectangles.
            radius: Radius of the disc [m].
            places: Positions of its centre in the world frame [m].
        """
        from scipy.ndimage import label

        ticks = [
            np.arange(-size / 2.0, size / 2.0 + _CELL, _CELL) for size in (self.width, self.depth)
        ]
        cells = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
        free = self.find_free(standing, radius, cells.reshape(-1, 2)).reshape(cells.shape[:2])
        regions, _ = label(free)
        found_regions = set()
        for place in places:
            i, j = (
                int(np.argmin(np.abs(axis - value)))
                for axis, value in zip(ticks, place, strict=True)
            )
            found_regions.add(int(regions[i, j]))
        return 0 not in found_regions and len(found_regions) <= 1
