"""Defines rectangles on the floor of a room, and checks whether a robot can move between places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vkc_pin.utils.arrays import Floats

# [m] of the grid for path searches
_CELL = 0.1
# Directions of the sides east, north, west and south.
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
        c = math.cos(self.yaw)
        s = math.sin(self.yaw)
        return np.array([[c, s], [-s, c]])

    @property
    def corners(self) -> Floats:
        """Its corners in the world frame, shape (4, 2) [m]."""
        signs = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        local = signs * (self.length / 2.0, self.width / 2.0)
        return np.array([self.x, self.y]) + local @ self.axes

    def compute_gap(self, other: Rectangle) -> float:
        """Return the largest separation of two rectangles along an axis [m]; negative: overlap."""
        gaps: list[float] = []
        for axis in np.vstack([self.axes, other.axes]):
            own = self.corners @ axis
            others = other.corners @ axis
            gaps.append(max(own.min() - others.max(), others.min() - own.max()))
        return float(max(gaps))

    def compute_distances(self, points: ArrayLike) -> Floats:
        """Return the distances of points, shape (n, 2), to the rectangle, shape (n,) [m].

        They are 0 inside.
        """
        local = np.abs((np.asarray(points, float) - (self.x, self.y)) @ self.axes.T)
        outside = np.maximum(local - (self.length / 2.0, self.width / 2.0), 0.0)
        return np.linalg.norm(outside, axis=-1)


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
        c = math.cos(self.yaw)
        s = math.sin(self.yaw)
        world_x = self.x + c * x - s * y
        world_y = self.y + s * x + c * y
        return round(world_x, 3), round(world_y, 3)

    def make_rectangle(self, x: tuple[float, float], y: tuple[float, float]) -> Rectangle:
        """Return the rectangle between two values of x and two values of y in this frame [m]."""
        x_min, x_max = x
        y_min, y_max = y
        centre = self.transform_point((x_min + x_max) / 2.0, (y_min + y_max) / 2.0)
        return Rectangle(*centre, x_max - x_min, y_max - y_min, self.yaw)


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
        half = np.array([self.width, self.depth]) / 2.0
        return bool((np.abs(rectangle.corners) <= half + 1e-6).all())

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
        half = np.array([self.width, self.depth]) / 2.0
        to_walls = (half - np.abs(points)).min(axis=1)
        is_free = np.asarray(to_walls >= radius)
        for rectangle in standing:
            is_free &= rectangle.compute_distances(points) >= radius
        return is_free

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

        xs = np.arange(-self.width / 2.0, self.width / 2.0 + _CELL, _CELL)
        ys = np.arange(-self.depth / 2.0, self.depth / 2.0 + _CELL, _CELL)
        points = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
        is_free = self.find_free(standing, radius, points).reshape(len(xs), len(ys))
        regions, _ = label(is_free)  # 0 where the disc collides
        occupied = set[int]()
        for x, y in places:
            i = int(np.argmin(np.abs(xs - x)))
            j = int(np.argmin(np.abs(ys - y)))
            occupied.add(int(regions[i, j]))
        return 0 not in occupied and len(occupied) <= 1
