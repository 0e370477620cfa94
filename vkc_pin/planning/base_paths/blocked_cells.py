"""Cells and headings at which the mobile base surely hits something, found for all of them at once, without coal.

At one heading, a convex shape of the base hits a convex obstacle at the places of a convex region
of the plan view. Its support function is the sum of theirs, taken of the parts at the same height;
here it is filled row by row. What the few directions `FAN` leave uncertain is taken off, so that
nothing free is called stuck; most of what is blocked is found, so that a search knows in advance
where it need not look.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import coal
import numpy as np
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.base_clearance import FAN, Shape, hull_points
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.budget import spend

__all__ = ["Lattice", "PlanViews", "Solid", "slice_of", "solids_of", "stuck"]

_FLAT = 1e-6  # [m]: shapes, and what two have in common in height, that are no higher are left out
_ROUNDING = 1e-5  # [m] of numbers of single precision
_AT_ONCE = 16  # outlines
_KEPT = 4096  # of slices whose support functions are remembered
_SLANT = float(
    np.cos(np.pi / len(FAN) * 1.2)
)  # of the angle between a direction and the nearest of `FAN`, at least


class Lattice(NamedTuple):
    """Cells and headings: centre of cell (0, 0) and size of a cell, shape (2,) [m]; cells along a side; shape (H,) [rad]."""

    origin: Floats
    step: Floats
    cells: int
    yaws: Floats


class Solid(NamedTuple):
    """Points whose hull a shape contains, shape (n, 3), its lowest and highest z [m], if it is a prism, and a name for it."""

    points: Floats
    bottom: float
    top: float
    prism: bool
    key: bytes


_Part = tuple[Solid, float, float]
"""Of a solid, what is between two heights [m]."""
_Reach = tuple[Floats, Floats]
"""Support functions, and how far beyond their hulls the polygons reach that they bound."""


def stuck(
    base: Sequence[Shape],
    carried: Sequence[Shape],
    standing: Sequence[Shape],
    lattice: Lattice,
    margin: float,
    *,
    views: PlanViews | None = None,
) -> tuple[Bools, Bools]:
    """Return where the base, and where what is carried, surely comes closer than `margin` [m] to an obstacle.

    Args:
        base: Shapes of the base, in its frame.
        carried: Shapes that are carried, in its frame.
        standing: Obstacles in the world.
        lattice: Cells and headings.
        margin: [m].
        views: Remembers what shapes look like from above.

    Returns:
        For base and carried, shape (cells, cells, H). What rides within the outline of the base is
        looked at only for obstacles that the base passes under.
    """
    obstacles, below, above = solids_of(standing), solids_of(base), solids_of(carried)
    pairs, over = _meeting(below, obstacles), _meeting(above, obstacles)
    points = np.concatenate([solid.points for solid in below] or [np.zeros((1, 3))])
    low, high = points.min(axis=0), points.max(axis=0)
    inside = [
        np.all((solid.points >= low) & (solid.points <= high), axis=0)[:2].all() for solid in above
    ]
    hidden = np.array(inside, bool)[over[:, 0]] & np.isin(over[:, 1], pairs[:, 1])
    views = PlanViews() if views is None else views
    carrying = _fill(above, obstacles, over[~hidden], lattice, margin, views=views)
    return _fill(below, obstacles, pairs, lattice, margin, views=views), carrying


def solids_of(shapes: Sequence[Shape]) -> list[Solid]:
    """Return what hulls placed shapes contain, without those that are flat."""
    solids = []
    for shape, placement in shapes:
        points, _ = hull_points(shape, placement, outer=False)
        if len(points) and np.ptp(points[:, 2]) > _FLAT:
            prism = isinstance(shape, coal.Box | coal.Cylinder) and bool(
                abs(placement.rotation[2, 2]) > 1.0 - 1e-9
            )
            key = points.tobytes() + bytes([prism])
            solids.append(
                Solid(points, float(points[:, 2].min()), float(points[:, 2].max()), prism, key)
            )
    return solids


def _meeting(first: Sequence[Solid], second: Sequence[Solid]) -> Ints:
    """Return which solids share heights with which, in the order of the first, shape (P, 2)."""
    one, other = (
        np.array([(solid.bottom, solid.top) for solid in solids]).reshape(-1, 2)
        for solids in (first, second)
    )
    common = np.minimum(one[:, None, 1], other[:, 1]) - np.maximum(one[:, None, 0], other[:, 0])
    return np.argwhere(common > _FLAT)


def slice_of(solid: Solid, low: float, high: float) -> Floats:
    """Return those points in the plan view of a solid between two heights that `FAN` touches, shape (n, 2) [m], n at most 32."""
    points = solid.points
    if solid.prism or (low <= solid.bottom and high >= solid.top):
        return _touched(points[:, :2])
    parts = [points[(points[:, 2] >= low) & (points[:, 2] <= high)][:, :2]]
    for height in {low, high}:
        above, below = points[points[:, 2] > height], points[points[:, 2] < height]
        share = ((above[:, None, 2] - height) / (above[:, None, 2] - below[:, 2]))[..., None]
        parts.append(
            (above[:, None, :2] + share * (below[:, :2] - above[:, None, :2])).reshape(-1, 2)
        )
    return _touched(np.concatenate(parts))


def _touched(points: Floats) -> Floats:
    return points[np.flatnonzero(np.bincount((FAN @ points.T).argmax(axis=1)))]


class PlanViews:
    """Support functions of slices, remembered: rooms and robots stay what they are from phase to phase and task to task."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[bytes, float, float, bytes], _Reach] = OrderedDict()

    @property
    def nbytes(self) -> int:
        """Its size in memory [bytes]."""
        return sum(support.nbytes + overshoot.nbytes for support, overshoot in self._known.values())

    def of(self, parts: Sequence[_Part], directions: Floats) -> _Reach:
        """Return support functions of the plan views of parts of solids, and how far beyond their hulls these let polygons reach.

        Args:
            parts: M solids, each with two heights.
            directions: Unit vectors in turn, shape (D, K, 2).

        Returns:
            Shapes (M, D, K) and (M, D) [m].
        """
        turned = directions.tobytes() if len(directions) > 1 else b""
        keys = [(solid.key, low, high, turned) for solid, low, high in parts]
        new = {
            key: slice_of(*part)
            for key, part in zip(keys, parts, strict=True)
            if key not in self._known
        }
        order = sorted(new, key=lambda key: len(new[key]))
        for first in range(0, len(order), _AT_ONCE):  # few at once stay in the processor's cache
            some = order[first : first + _AT_ONCE]
            self._known.update(
                zip(
                    some,
                    zip(*_support_of([new[key] for key in some], directions), strict=True),
                    strict=True,
                )
            )
        support, overshoot = (
            np.array(values) for values in zip(*(self._known[key] for key in keys), strict=True)
        )
        for key in keys:
            self._known.move_to_end(key)
        while len(self._known) > _KEPT:
            self._known.popitem(last=False)
        return support, overshoot


def _support_of(outlines: list[Floats], directions: Floats) -> tuple[Floats, Floats]:
    size = max(len(points) for points in outlines)
    padded = np.array(
        [
            np.concatenate([points, np.repeat(points[:1], size - len(points), axis=0)])
            for points in outlines
        ]
    )
    # No matrix product: its last digits hang on what else is in the batch, and so on what was
    # remembered.
    along = (
        directions[..., 0] * padded[:, :, 0, None, None]
        + directions[..., 1] * padded[:, :, 1, None, None]
    )
    support, which = along[:, 0].copy(), np.zeros((len(padded), *directions.shape[:2]), int)
    for point in range(
        1, size
    ):  # faster than argmax, since there are many more directions than points
        further = along[:, point] > support
        which[further] = point
        np.maximum(support, along[:, point], out=support)
    touched = padded[np.arange(len(padded))[:, None, None], which]  # (M, D, K, 2)
    after, following, beyond = (
        np.roll(a, -1, axis=axis) for a, axis in ((directions, 1), (support, 2), (touched, 2))
    )
    # The corner between two neighbouring directions, and how far it is from the segment between the
    # points touched.
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


def _fill(
    first: Sequence[Solid],
    second: Sequence[Solid],
    pairs: Ints,
    lattice: Lattice,
    margin: float,
    *,
    views: PlanViews,
) -> Bools:
    """Return where any of pairs of solids, shape (P, 2), surely come too close, shape (cells, cells, H)."""
    count, cells = len(lattice.yaws), lattice.cells
    if not len(pairs):
        return np.zeros((cells, cells, count), bool)
    parts: tuple[dict[tuple[int, float, float], tuple[int, _Part]], ...] = ({}, {})
    indices: tuple[list[int], ...] = ([], [])
    for i, j in zip(*pairs.T.tolist(), strict=True):
        solid, other = first[i], second[j]
        low, high = max(solid.bottom, other.bottom), min(solid.top, other.top)
        if not other.prism:
            low = high = (low + high) / 2
        for known, index, number, which in zip(parts, indices, (i, j), (solid, other), strict=True):
            key = (number, 0.0, 0.0) if which.prism else (number, low, high)
            index.append(known.setdefault(key, (len(known), (which, *key[1:])))[0])
    spend()
    moving, standing = np.array(indices)
    cosine, sine = np.cos(lattice.yaws)[:, None], np.sin(lattice.yaws)[:, None]
    turned = -np.stack(
        [cosine * FAN[:, 0] + sine * FAN[:, 1], cosine * FAN[:, 1] - sine * FAN[:, 0]], axis=-1
    )
    support, overshoot = views.of([part for _, part in parts[0].values()], turned)
    other_support, other_overshoot = views.of([part for _, part in parts[1].values()], FAN[None])
    spend()
    allowed = (
        _SLANT * margin - overshoot[moving] - other_overshoot[standing] - _ROUNDING
    )  # (pairs, H)
    reach = (
        (support[moving] + other_support[standing] + allowed[..., None])
        .reshape(-1, len(FAN))
        .astype(np.float32)
    )
    return _rows(reach, np.tile(np.arange(count), len(moving)), lattice)


def _rows(reach: NDArray[np.float32], heading: Ints, lattice: Lattice) -> Bools:
    """Return the cells inside any of many polygons, by heading, shape (cells, cells, H).

    Args:
        reach: How far each polygon reaches along `FAN`, shape (Q, 32) [m].
        heading: Of each, shape (Q,).
        lattice: Cells and headings.
    """
    cells, quarter = lattice.cells, len(FAN) // 4
    (x0, y0), (dx, dy) = lattice.origin, lattice.step
    begin = np.clip(np.floor((-reach[:, 2 * quarter] - x0) / dx) + 1, 0, cells).astype(int)
    end = np.clip(np.ceil((reach[:, 0] - x0) / dx), 0, cells).astype(int)
    rows = np.maximum(end - begin, 0)
    polygon = np.repeat(np.arange(len(reach)), rows)
    i = np.arange(len(polygon)) - np.repeat(np.cumsum(rows) - rows - begin, rows)
    x = (x0 + dx * i).astype(np.float32)
    bounds = []
    for side in (0, 1):  # up to where it reaches towards y, and towards -y
        nearest = np.full(len(polygon), np.inf, np.float32)
        for k in range(1 + 2 * quarter * side, 2 * quarter * (side + 1)):
            ux, uy = FAN[k].astype(np.float32)
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
