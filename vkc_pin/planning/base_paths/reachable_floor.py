"""Finds floor that the base certainly cannot reach at any heading.

Whatever its heading, the base covers a disc around its origin, which no obstacle may enter. A cell
is blocked only if all of it is; a flood fill over the others finds what can be reached.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.blocked_cells import Solid, make_solids, slice_solid
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.models.shapes import list_placed_shapes
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene

CELL = 0.1
"""Size of the cells of `find_free_floor` [m]."""
_BASE = 1  # joint number of a robot's base

_HEIGHT_SAMPLES = 9  # heights of the base at which discs are inscribed
_SLACK = 5e-3  # [m] by which discs are reduced: more than the overlap that validation accepts
_TINY = 1e-9
_CACHE_SIZE = 4096  # slices


class Wall(NamedTuple):
    """Convex polygon inside an obstacle at some height, and its distance from the base's origin.

    Attributes:
        outline: Corners, counter-clockwise, shape (n, 2) [m].
        radius: Radius of a disc inside the base at the same height [m].
        number: Number of the obstacle.
    """

    outline: Floats
    radius: float
    number: int


class CellGrid(NamedTuple):
    """Cells of a rectangle of the floor.

    Attributes:
        origin: Centre of cell (0, 0), shape (2,) [m].
        step: Size of a cell [m].
        shape: Numbers of cells along x and y.
    """

    origin: Floats
    step: float
    shape: tuple[int, int]

    @classmethod
    def over(cls, low: Floats, high: Floats, step: float) -> CellGrid:
        """Return cells that cover a rectangle with corners `low` and `high`, shape (2,) [m]."""
        size = np.maximum(np.ceil((high - low) / step), 1).astype(int)
        return cls(low + step / 2, step, (int(size[0]), int(size[1])))

    def centers(self) -> tuple[Floats, Floats]:
        """Return x of the rows, shape (X, 1), and y of the columns, shape (1, Y) [m]."""
        x = self.origin[0] + self.step * np.arange(self.shape[0])
        y = self.origin[1] + self.step * np.arange(self.shape[1])
        return x[:, None], y[None]

    def at(self, place: Floats) -> tuple[int, int]:
        """Return the cell nearest to a place, shape (2,) [m]."""
        nearest = np.rint((place - self.origin) / self.step)
        i, j = np.clip(nearest, 0, np.array(self.shape) - 1).astype(int)
        return int(i), int(j)


class InscribedDiscs:
    """Discs inscribed in a base, by height, with a cache of obstacle slices.

    Args:
        base: Convex shapes fixed to the base, in its frame.
    """

    def __init__(self, base: Sequence[Shape]) -> None:
        self._solids = make_solids(base)
        self._bottom = min((solid.bottom for solid in self._solids), default=0.0)
        self._top = max((solid.top for solid in self._solids), default=0.0)
        self._radii: dict[float, float] = {}
        self._outlines: dict[tuple[bytes, float], Floats] = {}

    @property
    def nbytes(self) -> int:
        """Size in memory [bytes]."""
        return sum(outline.nbytes for outline in self._outlines.values())

    def get_radius(self, height: float) -> float:
        """Return the radius of the disc around the base's origin at a height [m]; ≤ 0: none."""
        if height not in self._radii:
            outlines = []
            for solid in self._solids:
                if solid.bottom < height < solid.top:
                    outlines.append(_compute_outline(solid, height))
            self._radii[height] = _find_largest_disc(outlines) - _SLACK
        return self._radii[height]

    def make_walls(self, obstacles: Sequence[Shape]) -> list[Wall]:
        """Return the walls that keep the base's origin away, whatever its heading.

        Args:
            obstacles: Convex obstacles in the world.
        """
        walls = []
        for number, shape in enumerate(obstacles):
            for solid in make_solids([shape]):
                for height in self._list_heights(solid):
                    radius = self.get_radius(height)
                    if radius <= 0.0:
                        continue
                    outline = self._slice(solid, height)
                    if len(outline):
                        walls.append(Wall(outline, radius, number))
        return walls

    def _list_heights(self, solid: Solid) -> list[float]:
        """Return heights that an obstacle shares with the base: at least one if there are any.

        A prism has the same outline at all of them: the one with the largest disc will do.
        """
        low = max(solid.bottom, self._bottom)
        high = min(solid.top, self._top)
        if low >= high:
            return []
        levels = np.linspace(self._bottom, self._top, _HEIGHT_SAMPLES + 2)[1:-1].tolist()
        heights = [z for z in levels if low < z < high]
        if not heights:
            heights = [(low + high) / 2.0]
        if solid.prism:
            heights = [max(heights, key=self.get_radius)]
        return heights

    def _slice(self, solid: Solid, height: float) -> Floats:
        """Return the outline of a solid at a height; cached."""
        key = (solid.key, 0.0 if solid.prism else height)
        if key not in self._outlines:
            if len(self._outlines) >= _CACHE_SIZE:
                self._outlines.clear()
            self._outlines[key] = _compute_outline(solid, height)
        return self._outlines[key]


def _compute_outline(solid: Solid, height: float) -> Floats:
    """Return a convex polygon inside a slice of a solid, counter-clockwise, shape (n, 2) [m]."""
    points = slice_solid(solid, height, height)
    offset = points - points.mean(axis=0)
    return points[np.argsort(np.arctan2(offset[:, 1], offset[:, 0]), kind="stable")]


def _find_largest_disc(outlines: Sequence[Floats]) -> float:
    """Return the radius of the disc around the origin that convex polygons cover [m]; 0: none.

    If any covers the origin, the disc ends at the nearest point of an edge that no other covers.
    """
    origin = np.zeros((1, 2))
    if not any(_is_inside(outline, origin)[0] for outline in outlines):
        return 0.0
    least = np.inf
    for number, outline in enumerate(outlines):
        others = [other for k, other in enumerate(outlines) if k != number]
        for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            for begin, end in _clip_uncovered(a, b, others):
                p = a + begin * (b - a)
                q = a + end * (b - a)
                along = q - p
                s = np.clip(-(p @ along) / max(float(along @ along), _TINY), 0.0, 1.0)
                nearest = p + s * along
                least = min(least, float(np.hypot(*nearest)))
    return least if np.isfinite(least) else 0.0


def _clip_uncovered(
    a: Floats, b: Floats, others: Sequence[Floats]
) -> Iterator[tuple[float, float]]:
    """Yield the parts of segment ab outside all convex polygons, as fractions from 0 to 1."""
    covered = []
    for outline in others:
        begin, end = _clip_to_polygon(a, b, outline)
        if begin < end:
            covered.append((begin, end))
    done = 0.0
    for begin, end in sorted(covered):
        if begin > done:
            yield done, begin
        done = max(done, end)
    if done < 1.0:
        yield done, 1.0


def _clip_to_polygon(a: Floats, b: Floats, outline: Floats) -> tuple[float, float]:
    """Return the part of segment ab inside a convex polygon; it is empty if the end is first.

    Each edge pq cuts off the fractions s at which n·(a + s (b − a) − p) < 0, with its normal n
    inwards.
    """
    begin = 0.0
    end = 1.0
    for p, q in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        normal = np.array([p[1] - q[1], q[0] - p[0]])
        at_a = float(normal @ (a - p))
        at_b = float(normal @ (b - p))
        if max(at_a, at_b) <= _TINY:
            begin = 1.0
            end = 0.0
        elif min(at_a, at_b) < 0.0:
            passes = at_a / (at_a - at_b)
            if at_a < 0.0:
                begin = max(begin, passes)
            else:
                end = min(end, passes)
    return begin, end


def _is_inside(outline: Floats, places: Floats) -> Bools:
    """Return which places, shape (B, 2), are inside a convex polygon, shape (B,)."""
    edge = np.roll(outline, -1, axis=0) - outline
    offset = places[:, None] - outline
    cross = edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0]  # positive left of an edge
    return np.asarray((cross > 0.0).all(axis=1))


def find_blocked_cells(
    cells: CellGrid, wall: Wall, grown: float
) -> tuple[tuple[slice, slice], Bools]:
    """Return a window of cells, and a mask of the cells in it that a wall blocks.

    The centre of a blocked cell is within the wall's radius plus `grown` [m]. Minus half a cell's
    diagonal: blocked cells are blocked entirely. Plus: other cells are free entirely.
    """
    outline = wall.outline
    reach = wall.radius + grown
    low = np.ceil((outline.min(axis=0) - max(reach, 0.0) - cells.origin) / cells.step)
    high = np.floor((outline.max(axis=0) + max(reach, 0.0) - cells.origin) / cells.step) + 1
    first_row, first_column = np.clip(low, 0, cells.shape).astype(int).tolist()
    end_row, end_column = np.clip(high, 0, cells.shape).astype(int).tolist()
    rows = slice(first_row, end_row)
    columns = slice(first_column, end_column)
    x, y = cells.centers()
    distance = _compute_signed_distance(outline, x[rows], y[:, columns])
    return (rows, columns), distance < reach


def find_free_floor(scene: Scene) -> tuple[CellGrid, Bools]:
    """Return the cells of the arena, and which of them the base's origin may be in.

    The base is reduced to discs inside it, and all objects stay as they are in the scene.
    """
    arena = scene.arena
    base = [shape for shape in scene.robot.collision.geometryObjects if shape.parentJoint == _BASE]
    obstacles = []
    for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True):
        if label != FLOOR:
            obstacles.append(shape)
    for placed in scene.objects.values():
        obstacles += make_world_shapes(placed)
    cells = CellGrid.over(np.array([arena[0], arena[2]]), np.array([arena[1], arena[3]]), CELL)
    free = np.ones(cells.shape, bool)
    discs = InscribedDiscs(list_placed_shapes(base))
    for wall in discs.make_walls(list_placed_shapes(obstacles)):
        window, is_blocked = find_blocked_cells(cells, wall, 0.0)
        free[window] &= ~is_blocked
    return cells, free


def _compute_signed_distance(outline: Floats, x: Floats, y: Floats) -> Floats:
    """Return signed distances of places from a convex polygon, negative inside, shape (X, Y).

    An edge e from a has the point a + s e nearest to a place a + o, with s = o·e / e·e from 0 to 1.
    """
    squared = np.full((len(x), y.shape[1]), np.inf)
    is_inside = np.full((len(x), y.shape[1]), len(outline) > 2)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        ex = bx - ax
        ey = by - ay
        ox = x - ax
        oy = y - ay
        s = np.clip((ox * ex + oy * ey) / max(ex * ex + ey * ey, _TINY), 0.0, 1.0)
        np.minimum(squared, (ox - s * ex) ** 2 + (oy - s * ey) ** 2, out=squared)
        is_inside &= ex * oy - ey * ox > 0.0
    distance = np.sqrt(squared)
    return np.where(is_inside, -distance, distance)


def flood_fill(free: Bools, begin: Bools, *, corners: bool) -> Bools:
    """Return the cells that free ones connect with the starting ones, which may be blocked.

    `corners`: cells that share only a corner are connected.
    """
    from scipy import ndimage

    if corners:
        neighbours = np.ones((3, 3), bool)
        near_begin = ndimage.binary_dilation(begin, structure=neighbours)
    else:
        neighbours = ndimage.generate_binary_structure(2, 1)
        near_begin = begin
    labels, _ = ndimage.label(free, structure=neighbours)
    reached = np.unique(labels[near_begin & free])
    return np.asarray(begin | np.isin(labels, reached[reached > 0]))
