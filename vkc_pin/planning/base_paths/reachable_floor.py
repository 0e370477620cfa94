"""Where the base cannot get to at any heading: a disc inside it does not pass, so that nothing around the disc passes either.

Whatever the heading, the base covers a disc around a point of it. Obstacles grown by its radius are
where the point cannot be. A cell counts as taken only if all of it is: what a flood over the other
cells, corners included, does not touch, no motion gets to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.blocked_cells import Solid, slice_of, solids_of
from vkc_pin.utils.arrays import Bools, Floats

__all__ = ["Cells", "Discs", "Wall", "flooded", "taken"]

_LEVELS = 9  # heights of the base at which discs are looked for
_SLACK = 5e-3  # [m] taken off the disc: more than validation lets anything overlap
_THIN = 1e-9
_KEPT = 4096  # slices


class Wall(NamedTuple):
    """Part of an obstacle at some height, and how near the base's origin it keeps away.

    Attributes:
        outline: Corners of a convex polygon that is inside the obstacle, counter-clockwise, shape
            (n, 2) [m].
        radius: Of a disc that is inside the base at the same height [m].
        number: Of the obstacle.
    """

    outline: Floats
    radius: float
    number: int


class Cells(NamedTuple):
    """A part of the floor as cells: centre of cell (0, 0), shape (2,) [m]; size of a cell [m]; how many along x and y."""

    origin: Floats
    step: float
    shape: tuple[int, int]

    @classmethod
    def over(cls, low: Floats, high: Floats, step: float) -> Cells:
        """Return cells that cover a rectangle, corners of shape (2,) [m]."""
        size = np.maximum(np.ceil((high - low) / step), 1).astype(int)
        return cls(low + step / 2, step, (int(size[0]), int(size[1])))

    def centers(self) -> tuple[Floats, Floats]:
        """Return the x of rows, shape (X, 1), and the y of columns, shape (1, Y) [m]."""
        x, y = (self.origin[axis] + self.step * np.arange(self.shape[axis]) for axis in (0, 1))
        return x[:, None], y[None]

    def at(self, place: Floats) -> tuple[int, int]:
        """Return the cell that a place is in, shape (2,) [m], or the nearest one."""
        i, j = np.clip(
            np.rint((place - self.origin) / self.step), 0, np.array(self.shape) - 1
        ).astype(int)
        return int(i), int(j)


class Discs:
    """Discs inside a base, by height, and slices of obstacles, remembered: rooms and robots stay what they are.

    Args:
        base: Convex shapes fixed in the base's frame, without what moves on it.
    """

    def __init__(self, base: Sequence[Shape]) -> None:
        self._solids = solids_of(base)
        self._bottom = min((solid.bottom for solid in self._solids), default=0.0)
        self._top = max((solid.top for solid in self._solids), default=0.0)
        self._radii: dict[float, float] = {}
        self._outlines: dict[tuple[bytes, float], Floats] = {}

    @property
    def nbytes(self) -> int:
        """Its size in memory [bytes]."""
        return sum(outline.nbytes for outline in self._outlines.values())

    def radius(self, height: float) -> float:
        """Return the radius of a disc around the base's origin that is inside the base at a height [m]; not positive: none."""
        if height not in self._radii:
            part = [
                _outline(solid, height)
                for solid in self._solids
                if solid.bottom < height < solid.top
            ]
            self._radii[height] = _disc(part) - _SLACK
        return self._radii[height]

    def walls(self, standing: Sequence[Shape]) -> list[Wall]:
        """Return what keeps the base's origin away, whatever its heading.

        Args:
            standing: Convex obstacles in the world.
        """
        levels = np.linspace(self._bottom, self._top, _LEVELS + 2)[1:-1].tolist()
        found = []
        for number, shape in enumerate(standing):
            for solid in solids_of([shape]):
                low, high = max(solid.bottom, self._bottom), min(solid.top, self._top)
                heights = [z for z in levels if low < z < high] or [(low + high) / 2.0] * (
                    low < high
                )
                if solid.prism and heights:
                    heights = [max(heights, key=self.radius)]
                found += [
                    Wall(self._slice(solid, z), self.radius(z), number)
                    for z in heights
                    if self.radius(z) > 0.0
                ]
        return [wall for wall in found if len(wall.outline)]

    def _slice(self, solid: Solid, height: float) -> Floats:
        key = (solid.key, 0.0 if solid.prism else height)
        if key not in self._outlines:
            if len(self._outlines) >= _KEPT:
                self._outlines.clear()
            self._outlines[key] = _outline(solid, height)
        return self._outlines[key]


def _outline(solid: Solid, height: float) -> Floats:
    """Return a convex polygon inside a slice of a solid, counter-clockwise, shape (n, 2) [m]."""
    points = slice_of(solid, height, height)
    offset = points - points.mean(axis=0)
    return points[np.argsort(np.arctan2(offset[:, 1], offset[:, 0]), kind="stable")]


def _disc(outlines: Sequence[Floats]) -> float:
    """Return the radius of a disc around the origin that convex polygons cover together [m]; 0: none."""
    if not any(_inside(outline, np.zeros((1, 2)))[0] for outline in outlines):
        return 0.0
    least = np.inf
    for number, outline in enumerate(outlines):
        others = [other for k, other in enumerate(outlines) if k != number]
        for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            for begin, end in _uncovered(a, b, others):
                p, q = a + begin * (b - a), a + end * (b - a)
                along = q - p
                share = np.clip(-(p @ along) / max(float(along @ along), _THIN), 0.0, 1.0)
                least = min(least, float(np.hypot(*(p + share * along))))
    return least if np.isfinite(least) else 0.0


def _uncovered(a: Floats, b: Floats, others: Sequence[Floats]) -> Iterator[tuple[float, float]]:
    """Yield the parts of the segment from a to b, as shares from 0 to 1, that are inside no convex polygon."""
    covered = []
    for outline in others:
        begin, end = 0.0, 1.0
        for p, q in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            normal = np.array([p[1] - q[1], q[0] - p[0]])  # inwards
            first, last = float(normal @ (a - p)), float(normal @ (b - p))
            if max(first, last) <= _THIN:
                begin, end = 1.0, 0.0
            elif min(first, last) < 0.0:
                at = first / (first - last)
                begin, end = (max(begin, at), end) if first < 0.0 else (begin, min(end, at))
        if begin < end:
            covered.append((begin, end))
    done = 0.0
    for begin, end in sorted(covered):
        if begin > done:
            yield done, begin
        done = max(done, end)
    if done < 1.0:
        yield done, 1.0


def _inside(outline: Floats, places: Floats) -> Bools:
    """Return which places, shape (B, 2), are inside a convex polygon."""
    edge = np.roll(outline, -1, axis=0) - outline
    offset = places[:, None] - outline
    return np.asarray((edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0] > 0.0).all(axis=1))


def taken(cells: Cells, wall: Wall, grown: float) -> tuple[tuple[slice, slice], Bools]:
    """Return a window of cells, and which of them a wall takes: no others are.

    Args:
        cells: The floor.
        wall: What keeps the base's origin away.
        grown: A cell is taken if its centre is nearer to the wall than the wall's radius and so
            much [m]. With half a cell's diagonal, negative, all of it is out of bounds; positive,
            no part of what is not taken is.
    """
    outline, reach = wall.outline, wall.radius + grown
    low = np.ceil((outline.min(axis=0) - max(reach, 0.0) - cells.origin) / cells.step)
    high = np.floor((outline.max(axis=0) + max(reach, 0.0) - cells.origin) / cells.step) + 1
    rows, columns = (
        slice(*np.clip([low[k], high[k]], 0, cells.shape[k]).astype(int).tolist()) for k in (0, 1)
    )
    x, y = cells.centers()
    return (rows, columns), _signed(outline, x[rows], y[:, columns]) < reach


def _signed(outline: Floats, x: Floats, y: Floats) -> Floats:
    """Return how far places are from a convex polygon, negative inside, shape (X, Y) [m]; x of shape (X, 1), y (1, Y)."""
    square, inside = (
        np.full((len(x), y.shape[1]), np.inf),
        np.full((len(x), y.shape[1]), len(outline) > 2),
    )
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        ex, ey, ox, oy = bx - ax, by - ay, x - ax, y - ay
        share = np.clip((ox * ex + oy * ey) / max(ex * ex + ey * ey, _THIN), 0.0, 1.0)
        np.minimum(square, (ox - share * ex) ** 2 + (oy - share * ey) ** 2, out=square)
        inside &= ex * oy - ey * ox > 0.0
    distance = np.sqrt(square)
    return np.where(inside, -distance, distance)


def flooded(free: Bools, begin: Bools, *, corners: bool) -> Bools:
    """Return the cells that can be reached over free ones from where a motion begins, those it begins in included.

    Args:
        free: Which cells are free, shape (X, Y).
        begin: Where a motion may begin; that may be in a cell that is taken by then.
        corners: Whether it may pass between cells that share a corner alone.
    """
    from scipy import ndimage

    around = np.ones((3, 3), bool) if corners else ndimage.generate_binary_structure(2, 1)
    labels, _ = ndimage.label(free, structure=around)
    near = ndimage.binary_dilation(begin, structure=around) if corners else begin
    known = np.unique(labels[near & free])
    return np.asarray(begin | (np.isin(labels, known[known > 0])))
