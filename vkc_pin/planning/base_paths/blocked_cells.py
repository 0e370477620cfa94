"""Finds cells and headings at which the base certainly collides, without exact collision checks.

At one heading, a convex shape hits a convex obstacle in a convex region of the plan view, whose
support function is the sum of both, of the parts at the same height. It is rasterized row by row,
reduced by the uncertainty that the few `DIRECTIONS` leave, so that no free cell is marked.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import coal
import numpy as np
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.base_clearance import DIRECTIONS, Shape, compute_hull_points
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.budget import record_evaluations

_MIN_HEIGHT = 1e-6  # [m] below which shapes, and common heights of two shapes, are ignored
_ROUNDING = 1e-5  # [m] rounding error of single precision
_BATCH = 16  # outlines
_CACHE_SIZE = 4096  # slices
# least cosine of the angle between a direction and the nearest of `DIRECTIONS`
_MIN_COSINE = float(np.cos(np.pi / len(DIRECTIONS) * 1.2))


class Lattice(NamedTuple):
    """Cells and headings.

    Attributes:
        origin: Centre of cell (0, 0), shape (2,) [m].
        step: Size of a cell, shape (2,) [m].
        cells: Number of cells along each side.
        yaws: Headings, shape (H,) [rad].
    """

    origin: Floats
    step: Floats
    cells: int
    yaws: Floats


class Solid(NamedTuple):
    """Convex solid inside a shape.

    Attributes:
        points: Points whose hull the shape contains, shape (n, 3) [m].
        bottom: Lowest z [m].
        top: Highest z [m].
        prism: Whether it is an upright prism.
        key: Cache key.
    """

    points: Floats
    bottom: float
    top: float
    prism: bool
    key: bytes


_Slice = tuple[Solid, float, float]
"""A solid and two heights between which it is considered [m]."""
_Supports = tuple[Floats, Floats]
"""Support functions, and how far the polygons that they bound exceed the hulls."""


def find_colliding_cells(
    base: Sequence[Shape],
    carried: Sequence[Shape],
    obstacles: Sequence[Shape],
    lattice: Lattice,
    margin: float,
    *,
    views: SupportCache | None = None,
) -> tuple[Bools, Bools]:
    """Return masks, shape (cells, cells, H), of where base and load certainly violate the margin.

    Shapes of base and load are in the base's frame. Loads within the outline of the base are
    checked only against obstacles that the base passes under. `views` caches support functions.
    """
    solids = make_solids(obstacles)
    of_base = make_solids(base)
    of_load = make_solids(carried)
    base_pairs = _find_height_overlaps(of_base, solids)
    load_pairs = _find_height_overlaps(of_load, solids)
    points = np.concatenate([solid.points for solid in of_base] or [np.zeros((1, 3))])
    low = points[:, :2].min(axis=0)
    high = points[:, :2].max(axis=0)
    is_within_base = np.zeros(len(of_load), bool)
    for number, solid in enumerate(of_load):
        plan_view = solid.points[:, :2]
        is_within_base[number] = np.all((plan_view >= low) & (plan_view <= high))
    is_hidden = is_within_base[load_pairs[:, 0]] & np.isin(load_pairs[:, 1], base_pairs[:, 1])
    load_pairs = load_pairs[~is_hidden]
    views = SupportCache() if views is None else views
    load_collides = _fill_cells(of_load, solids, load_pairs, lattice, margin, views=views)
    base_collides = _fill_cells(of_base, solids, base_pairs, lattice, margin, views=views)
    return base_collides, load_collides


def make_solids(shapes: Sequence[Shape]) -> list[Solid]:
    """Return convex solids inside placed shapes, without flat ones."""
    solids = []
    for shape, placement in shapes:
        points, _ = compute_hull_points(shape, placement, outer=False)
        if not len(points) or np.ptp(points[:, 2]) <= _MIN_HEIGHT:
            continue
        is_upright = bool(abs(placement.rotation[2, 2]) > 1.0 - 1e-9)
        is_prism = is_upright and isinstance(shape, coal.Box | coal.Cylinder)
        bottom = float(points[:, 2].min())
        top = float(points[:, 2].max())
        key = points.tobytes() + bytes([is_prism])
        solids.append(Solid(points, bottom, top, is_prism, key))
    return solids


def _find_height_overlaps(first: Sequence[Solid], second: Sequence[Solid]) -> Ints:
    """Return pairs of solids that share heights, ordered by the first, shape (P, 2)."""
    first_bottom = np.array([solid.bottom for solid in first])[:, None]
    first_top = np.array([solid.top for solid in first])[:, None]
    second_bottom = np.array([solid.bottom for solid in second])
    second_top = np.array([solid.top for solid in second])
    common = np.minimum(first_top, second_top) - np.maximum(first_bottom, second_bottom)
    return np.argwhere(common > _MIN_HEIGHT)


def slice_solid(solid: Solid, low: float, high: float) -> Floats:
    """Return the extreme points along `DIRECTIONS` of a slice between two heights, (n, 2) [m].

    The slice is the hull of the solid's points in it, and of the points at which the lines between
    points above and below one of its heights pass that height.
    """
    points = solid.points
    if solid.prism or (low <= solid.bottom and high >= solid.top):
        return _select_support_points(points[:, :2])
    z = points[:, 2]
    parts = [points[(z >= low) & (z <= high)][:, :2]]
    for height in {low, high}:
        above = points[z > height][:, None]  # (A, 1, 3), with `below` all pairs
        below = points[z < height]
        s = ((above[..., 2] - height) / (above[..., 2] - below[:, 2]))[..., None]
        crossing = above[..., :2] + s * (below[:, :2] - above[..., :2])
        parts.append(crossing.reshape(-1, 2))
    return _select_support_points(np.concatenate(parts))


def _select_support_points(points: Floats) -> Floats:
    """Return the points, of shape (n, 2), that are furthest along any of `DIRECTIONS`."""
    furthest = (DIRECTIONS @ points.T).argmax(axis=1)
    return points[np.flatnonzero(np.bincount(furthest))]


class SupportCache:
    """Cache of the support functions of slices, which recur between phases and tasks."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[bytes, float, float, bytes], _Supports] = OrderedDict()

    @property
    def nbytes(self) -> int:
        """Size in memory [bytes]."""
        return sum(support.nbytes + overshoot.nbytes for support, overshoot in self._known.values())

    def get(self, parts: Sequence[_Slice], directions: Floats) -> _Supports:
        """Return support functions of M slices in the plan view, shape (M, D, K) [m].

        `directions` are unit vectors in counter-clockwise order, shape (D, K, 2). The second result
        is by how much the polygons that they bound exceed the hulls, shape (M, D) [m].
        """
        directions_key = directions.tobytes() if len(directions) > 1 else b""
        keys = []
        new_outlines = {}
        for solid, low, high in parts:
            key = (solid.key, low, high, directions_key)
            keys.append(key)
            if key not in self._known:
                new_outlines[key] = slice_solid(solid, low, high)
        # Outlines of similar size, since those of a batch are padded to the same one.
        order = sorted(new_outlines, key=lambda key: len(new_outlines[key]))
        for first in range(0, len(order), _BATCH):  # small batches fit into the processor's cache
            batch = order[first : first + _BATCH]
            outlines = [new_outlines[key] for key in batch]
            supports, overshoots = _compute_supports(outlines, directions)
            for key, one_support, one_overshoot in zip(batch, supports, overshoots, strict=True):
                self._known[key] = (one_support, one_overshoot)
        support = np.array([self._known[key][0] for key in keys])
        overshoot = np.array([self._known[key][1] for key in keys])
        for key in keys:
            self._known.move_to_end(key)
        while len(self._known) > _CACHE_SIZE:
            self._known.popitem(last=False)
        return support, overshoot


def _compute_supports(outlines: list[Floats], directions: Floats) -> tuple[Floats, Floats]:
    """Return support functions and overshoots of outlines; see `SupportCache.get`."""
    size = max(len(points) for points in outlines)
    padded = np.empty((len(outlines), size, 2))
    for row, points in zip(padded, outlines, strict=True):
        row[: len(points)] = points
        row[len(points) :] = points[0]
    # No matrix product: its last digits depend on the rest of the batch, and so on what is cached.
    along = (
        directions[..., 0] * padded[:, :, 0, None, None]
        + directions[..., 1] * padded[:, :, 1, None, None]
    )
    support = along[:, 0].copy()
    which = np.zeros((len(padded), *directions.shape[:2]), int)
    # Faster than argmax, since there are many more directions than points.
    for point in range(1, size):
        is_further = along[:, point] > support
        which[is_further] = point
        np.maximum(support, along[:, point], out=support)
    touched = padded[np.arange(len(padded))[:, None, None], which]  # (M, D, K, 2)
    next_directions = np.roll(directions, -1, axis=1)
    next_support = np.roll(support, -1, axis=2)
    next_touched = np.roll(touched, -1, axis=2)
    # The polygon's corner x between two neighbouring directions u and v has u·x = h(u) and v·x =
    # h(v). The overshoot is its distance from the segment between their support points.
    ux = directions[..., 0]
    uy = directions[..., 1]
    vx = next_directions[..., 0]
    vy = next_directions[..., 1]
    determinant = ux * vy - uy * vx
    x = (support * vy - next_support * uy) / determinant
    y = (next_support * ux - support * vx) / determinant
    corner = np.stack([x, y], axis=-1)
    edge = next_touched - touched
    offset = corner - touched
    squared_length = np.maximum(np.sum(edge * edge, axis=-1), 1e-12)
    s = np.clip(np.sum(offset * edge, axis=-1) / squared_length, 0.0, 1.0)
    distance = np.linalg.norm(offset - s[..., None] * edge, axis=-1)
    return support, distance.max(axis=2)


def _fill_cells(
    first: Sequence[Solid],
    second: Sequence[Solid],
    pairs: Ints,
    lattice: Lattice,
    margin: float,
    *,
    views: SupportCache,
) -> Bools:
    """Return where any of pairs of solids, shape (P, 2), certainly collide, (cells, cells, H).

    A solid of the base at the position p, turned by a heading, meets an obstacle where u·p is at
    most h_o(u) + h_b(−u) for all directions u, with the support functions h_o of the obstacle in
    the world and h_b of the solid, turned. `margin` extends this, overshoots reduce it.
    """
    count = len(lattice.yaws)
    cells = lattice.cells
    if not len(pairs):
        return np.zeros((cells, cells, count), bool)
    slices = _SliceList()
    other_slices = _SliceList()
    rows = []
    other_rows = []
    for i, j in pairs.tolist():
        solid = first[i]
        other = second[j]
        low = max(solid.bottom, other.bottom)
        high = min(solid.top, other.top)
        if not other.prism:
            low = high = (low + high) / 2
        rows.append(slices.find_or_add(i, solid, low, high))
        other_rows.append(other_slices.find_or_add(j, other, low, high))
    record_evaluations()
    cosine = np.cos(lattice.yaws)[:, None]
    sine = np.sin(lattice.yaws)[:, None]
    # −u for each direction u, in the base's frame
    turned_x = cosine * DIRECTIONS[:, 0] + sine * DIRECTIONS[:, 1]
    turned_y = cosine * DIRECTIONS[:, 1] - sine * DIRECTIONS[:, 0]
    turned = -np.stack([turned_x, turned_y], axis=-1)
    support, overshoot = views.get(slices.parts, turned)
    other_support, other_overshoot = views.get(other_slices.parts, DIRECTIONS[None])
    record_evaluations()
    # Shape (pairs, H).
    allowed = _MIN_COSINE * margin - overshoot[rows] - other_overshoot[other_rows] - _ROUNDING
    reach = support[rows] + other_support[other_rows] + allowed[..., None]
    reach_of_polygons = reach.reshape(-1, len(DIRECTIONS)).astype(np.float32)
    return _rasterize(reach_of_polygons, np.tile(np.arange(count), len(rows)), lattice)


class _SliceList:
    """Slices of solids, each of them once.

    Attributes:
        parts: The slices; those of prisms do not depend on the heights.
    """

    def __init__(self) -> None:
        self.parts: list[_Slice] = []
        self._rows: dict[tuple[int, float, float], int] = {}

    def find_or_add(self, number: int, solid: Solid, low: float, high: float) -> int:
        """Return the row of a slice of solid `number` between two heights, added if it is new."""
        if solid.prism:
            low = 0.0
            high = 0.0
        key = (number, low, high)
        if key not in self._rows:
            self._rows[key] = len(self.parts)
            self.parts.append((solid, low, high))
        return self._rows[key]


def _rasterize(reach: NDArray[np.float32], heading: Ints, lattice: Lattice) -> Bools:
    """Return the cells inside any of Q polygons, by heading (Q,), shape (cells, cells, H).

    `reach`, shape (Q, 32) [m], are their support functions along `DIRECTIONS`.
    """
    cells = lattice.cells
    quarter = len(DIRECTIONS) // 4
    x0, y0 = lattice.origin
    dx, dy = lattice.step
    # Rows i, of equal x, that each polygon covers.
    begin = np.clip(np.floor((-reach[:, 2 * quarter] - x0) / dx) + 1, 0, cells).astype(int)
    end = np.clip(np.ceil((reach[:, 0] - x0) / dx), 0, cells).astype(int)
    rows = np.maximum(end - begin, 0)
    polygon = np.repeat(np.arange(len(reach)), rows)
    i = np.arange(len(polygon)) - np.repeat(np.cumsum(rows) - rows - begin, rows)
    x = (x0 + dx * i).astype(np.float32)
    # In each row, u·p ≤ reach bounds y for directions u upwards, and −y for those downwards.
    bounds = []
    for side in (0, 1):
        bound = np.full(len(polygon), np.inf, np.float32)
        for k in range(1 + 2 * quarter * side, 2 * quarter * (side + 1)):
            ux, uy = DIRECTIONS[k].astype(np.float32)
            along_row = (reach[:, k] / abs(uy))[polygon] - x * (ux / abs(uy))
            np.minimum(bound, along_row, out=bound)
        bounds.append(bound)
    max_y, max_minus_y = bounds
    first = np.clip(np.floor((-max_minus_y - y0) / dy) + 1, 0, cells).astype(int)
    last = np.clip(np.ceil((max_y - y0) / dy), 0, cells).astype(int)
    # Count where intervals of covered cells begin and end: cells inside any have a positive sum.
    is_covered = first < last
    line = ((heading[polygon] * cells + i) * (cells + 1))[is_covered]
    size = len(lattice.yaws) * cells * (cells + 1)
    begins = np.bincount(line + first[is_covered], minlength=size)
    ends = np.bincount(line + last[is_covered], minlength=size)
    change = begins - ends
    inside = np.cumsum(change.reshape(-1, cells, cells + 1), axis=2)[:, :, :cells] > 0
    return np.ascontiguousarray(np.moveaxis(inside, 0, 2))
