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
    standing: Sequence[Shape],
    lattice: Lattice,
    margin: float,
    *,
    views: SupportCache | None = None,
) -> tuple[Bools, Bools]:
    """Return masks, shape (cells, cells, H), of where base and load certainly violate the margin.

    Shapes of base and load are in the base's frame. Loads within the outline of the base are
    checked only against obstacles that the base passes under. `views` caches support functions.
    """
    obstacles, below, above = make_solids(standing), make_solids(base), make_solids(carried)
    pairs, over = _find_height_overlaps(below, obstacles), _find_height_overlaps(above, obstacles)
    points = np.concatenate([solid.points for solid in below] or [np.zeros((1, 3))])
    low, high = points.min(axis=0), points.max(axis=0)
    inside = [
        np.all((solid.points >= low) & (solid.points <= high), axis=0)[:2].all() for solid in above
    ]
    hidden = np.array(inside, bool)[over[:, 0]] & np.isin(over[:, 1], pairs[:, 1])
    views = SupportCache() if views is None else views
    carrying = _fill_cells(above, obstacles, over[~hidden], lattice, margin, views=views)
    return _fill_cells(below, obstacles, pairs, lattice, margin, views=views), carrying


def make_solids(shapes: Sequence[Shape]) -> list[Solid]:
    """Return convex solids inside placed shapes, without flat ones."""
    solids = []
    for shape, placement in shapes:
        points, _ = compute_hull_points(shape, placement, outer=False)
        if len(points) and np.ptp(points[:, 2]) > _MIN_HEIGHT:
            prism = isinstance(shape, coal.Box | coal.Cylinder) and bool(
                abs(placement.rotation[2, 2]) > 1.0 - 1e-9
            )
            key = points.tobytes() + bytes([prism])
            solids.append(
                Solid(points, float(points[:, 2].min()), float(points[:, 2].max()), prism, key)
            )
    return solids


def _find_height_overlaps(first: Sequence[Solid], second: Sequence[Solid]) -> Ints:
    """Return pairs of solids that share heights, ordered by the first, shape (P, 2)."""
    one, other = (
        np.array([(solid.bottom, solid.top) for solid in solids]).reshape(-1, 2)
        for solids in (first, second)
    )
    common = np.minimum(one[:, None, 1], other[:, 1]) - np.maximum(one[:, None, 0], other[:, 0])
    return np.argwhere(common > _MIN_HEIGHT)


def slice_solid(solid: Solid, low: float, high: float) -> Floats:
    """Return the extreme points along `DIRECTIONS` of a slice between two heights, (n, 2) [m]."""
    points = solid.points
    if solid.prism or (low <= solid.bottom and high >= solid.top):
        return _select_support_points(points[:, :2])
    parts = [points[(points[:, 2] >= low) & (points[:, 2] <= high)][:, :2]]
    for height in {low, high}:
        above, below = points[points[:, 2] > height], points[points[:, 2] < height]
        share = ((above[:, None, 2] - height) / (above[:, None, 2] - below[:, 2]))[..., None]
        parts.append(
            (above[:, None, :2] + share * (below[:, :2] - above[:, None, :2])).reshape(-1, 2)
        )
    return _select_support_points(np.concatenate(parts))


def _select_support_points(points: Floats) -> Floats:
    return points[np.flatnonzero(np.bincount((DIRECTIONS @ points.T).argmax(axis=1)))]


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
        turned = directions.tobytes() if len(directions) > 1 else b""
        keys = [(solid.key, low, high, turned) for solid, low, high in parts]
        new = {
            key: slice_solid(*part)
            for key, part in zip(keys, parts, strict=True)
            if key not in self._known
        }
        order = sorted(new, key=lambda key: len(new[key]))
        for first in range(0, len(order), _BATCH):  # small batches fit into the processor's cache
            some = order[first : first + _BATCH]
            self._known.update(
                zip(
                    some,
                    zip(*_compute_supports([new[key] for key in some], directions), strict=True),
                    strict=True,
                )
            )
        support, overshoot = (
            np.array(values) for values in zip(*(self._known[key] for key in keys), strict=True)
        )
        for key in keys:
            self._known.move_to_end(key)
        while len(self._known) > _CACHE_SIZE:
            self._known.popitem(last=False)
        return support, overshoot


def _compute_supports(outlines: list[Floats], directions: Floats) -> tuple[Floats, Floats]:
    """Return support functions and overshoots of outlines; see `SupportCache.get`."""
    size = max(len(points) for points in outlines)
    padded = np.array(
        [
            np.concatenate([points, np.repeat(points[:1], size - len(points), axis=0)])
            for points in outlines
        ]
    )
    # No matrix product: its last digits depend on the rest of the batch, and so on what is cached.
    along = (
        directions[..., 0] * padded[:, :, 0, None, None]
        + directions[..., 1] * padded[:, :, 1, None, None]
    )
    support, which = along[:, 0].copy(), np.zeros((len(padded), *directions.shape[:2]), int)
    # Faster than argmax, since there are many more directions than points.
    for point in range(1, size):
        further = along[:, point] > support
        which[further] = point
        np.maximum(support, along[:, point], out=support)
    touched = padded[np.arange(len(padded))[:, None, None], which]  # (M, D, K, 2)
    after, following, beyond = (
        np.roll(a, -1, axis=axis) for a, axis in ((directions, 1), (support, 2), (touched, 2))
    )
    # Corner between two neighbouring directions, and its distance from the segment between their
    # support points.
    area = directions[..., 0] * after[..., 1] - directions[..., 1] * after[..., 0]
    corner = np.stack(
        [
            (support * after[..., 1] - following * directions[..., 1]) / area,
            (following * directions[..., 0] - support * after[..., 0]) / area,
        ],
        axis=-1,
    )
    edge, offset = beyond - touched, corner - touched
    share = np.clip(
        np.sum(offset * edge, axis=-1) / np.maximum(np.sum(edge * edge, axis=-1), 1e-12), 0.0, 1.0
    )
    return support, np.linalg.norm(offset - share[..., None] * edge, axis=-1).max(axis=2)


def _fill_cells(
    first: Sequence[Solid],
    second: Sequence[Solid],
    pairs: Ints,
    lattice: Lattice,
    margin: float,
    *,
    views: SupportCache,
) -> Bools:
    """Return where any of pairs of solids, shape (P, 2), certainly collide, (cells, cells, H)."""
    count, cells = len(lattice.yaws), lattice.cells
    if not len(pairs):
        return np.zeros((cells, cells, count), bool)
    parts: tuple[dict[tuple[int, float, float], tuple[int, _Slice]], ...] = ({}, {})
    indices: tuple[list[int], ...] = ([], [])
    for i, j in zip(*pairs.T.tolist(), strict=True):
        solid, other = first[i], second[j]
        low, high = max(solid.bottom, other.bottom), min(solid.top, other.top)
        if not other.prism:
            low = high = (low + high) / 2
        for known, index, number, which in zip(parts, indices, (i, j), (solid, other), strict=True):
            key = (number, 0.0, 0.0) if which.prism else (number, low, high)
            index.append(known.setdefault(key, (len(known), (which, *key[1:])))[0])
    record_evaluations()
    moving, standing = np.array(indices)
    cosine, sine = np.cos(lattice.yaws)[:, None], np.sin(lattice.yaws)[:, None]
    turned = -np.stack(
        [
            cosine * DIRECTIONS[:, 0] + sine * DIRECTIONS[:, 1],
            cosine * DIRECTIONS[:, 1] - sine * DIRECTIONS[:, 0],
        ],
        axis=-1,
    )
    support, overshoot = views.get([part for _, part in parts[0].values()], turned)
    other_support, other_overshoot = views.get(
        [part for _, part in parts[1].values()], DIRECTIONS[None]
    )
    record_evaluations()
    # Shape (pairs, H).
    allowed = _MIN_COSINE * margin - overshoot[moving] - other_overshoot[standing] - _ROUNDING
    reach = (
        (support[moving] + other_support[standing] + allowed[..., None])
        .reshape(-1, len(DIRECTIONS))
        .astype(np.float32)
    )
    return _rasterize(reach, np.tile(np.arange(count), len(moving)), lattice)


def _rasterize(reach: NDArray[np.float32], heading: Ints, lattice: Lattice) -> Bools:
    """Return the cells inside any of Q polygons, by heading (Q,), shape (cells, cells, H).

    `reach`, shape (Q, 32) [m], are their support functions along `DIRECTIONS`.
    """
    cells, quarter = lattice.cells, len(DIRECTIONS) // 4
    (x0, y0), (dx, dy) = lattice.origin, lattice.step
    begin = np.clip(np.floor((-reach[:, 2 * quarter] - x0) / dx) + 1, 0, cells).astype(int)
    end = np.clip(np.ceil((reach[:, 0] - x0) / dx), 0, cells).astype(int)
    rows = np.maximum(end - begin, 0)
    polygon = np.repeat(np.arange(len(reach)), rows)
    i = np.arange(len(polygon)) - np.repeat(np.cumsum(rows) - rows - begin, rows)
    x = (x0 + dx * i).astype(np.float32)
    bounds = []
    for side in (0, 1):  # upper bounds of y, then of -y
        nearest = np.full(len(polygon), np.inf, np.float32)
        for k in range(1 + 2 * quarter * side, 2 * quarter * (side + 1)):
            ux, uy = DIRECTIONS[k].astype(np.float32)
            np.minimum(nearest, (reach[:, k] / abs(uy))[polygon] - x * (ux / abs(uy)), out=nearest)
        bounds.append(nearest)
    first = np.clip(np.floor((-bounds[1] - y0) / dy) + 1, 0, cells).astype(int)
    last = np.clip(np.ceil((bounds[0] - y0) / dy), 0, cells).astype(int)
    some = first < last
    line = ((heading[polygon] * cells + i) * (cells + 1))[some]
    size = len(lattice.yaws) * cells * (cells + 1)
    change = np.bincount(line + first[some], minlength=size) - np.bincount(
        line + last[some], minlength=size
    )
    inside = np.cumsum(change.reshape(-1, cells, cells + 1), axis=2)[:, :, :cells] > 0
    return np.ascontiguousarray(np.moveaxis(inside, 0, 2))
