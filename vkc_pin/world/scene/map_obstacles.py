"""Turns an occupancy map into obstacles: boxes of a stated height on its occupied cells."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.files.occupancy_maps import read_occupancy_map

if TYPE_CHECKING:
    from vkc_pin.world.scene import scene_schema as schema

MAP = "map"
"""Name of the map among a scene's obstacles."""
_MAX_BOXES = 20_000  # scanned flats have up to 14 000 with cells of 50 mm, and load in 1 to 2 s
_MIN_BORDER = 1e-6  # [m] of arena beyond the image, below which it is a rounding error
_COLOUR = (0.90, 0.89, 0.86, 1.0)
_BATCH = 4096  # cells

Arena = tuple[float, float, float, float]


class MapObstacle:
    """The obstacle that a map describes.

    Args:
        item: Its description.
        folder: Folder that the path of the map refers to.

    Attributes:
        bounds: Bounding box of the map in the world: (x_min, x_max, y_min, y_max) [m].
    """

    def __init__(self, item: schema.MapSchema, folder: Path) -> None:
        self._item = item
        self._file = folder / item.file
        self._map = read_occupancy_map(self._file)
        x, y, yaw = self._map.origin
        self._placement = pin.SE3(pin.utils.rotate("z", yaw), np.array([x, y, 0.0]))
        width, length = self._map.size
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, length], [0.0, length]])
        in_world = corners @ self._placement.rotation[:2, :2].T + (x, y)
        low = in_world.min(axis=0)
        high = in_world.max(axis=0)
        self.bounds: Arena = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))

    def make_shapes(self, arena: Arena) -> list[pin.GeometryObject]:
        """Return boxes whose union is the blocked cells, in the world frame.

        With unknown cells that are blocked, the arena beyond the image is blocked, too.

        Args:
            arena: (x_min, x_max, y_min, y_max) [m].

        Raises:
            InputError: There are too many.
        """
        is_blocking = self._item.unknown == "blocked"
        blocked = ~self._map.free if is_blocking else self._map.occupied
        cells = merge_cells(blocked, _MAX_BOXES)
        if cells is None:
            raise InputError(
                "the map has too many separate cells",
                file=self._file,
                field="image",
                expected=f"cells that {_MAX_BOXES} boxes cover: a part of the map, or larger cells",
                got=" × ".join(map(str, blocked.shape)) + f" cells of {self._map.resolution:g} m",
            )
        boxes = self._map.resolution * cells.astype(float)
        if is_blocking:
            boxes = np.concatenate([boxes, self._find_borders(arena)])
        shapes = list[pin.GeometryObject]()
        for number, (x_min, x_max, y_min, y_max) in enumerate(boxes.tolist()):
            solid = coal.Box(x_max - x_min, y_max - y_min, self._item.height)
            center = [(x_min + x_max) / 2.0, (y_min + y_max) / 2.0, self._item.height / 2.0]
            placement = self._placement * pin.SE3(np.eye(3), np.array(center))
            shape = pin.GeometryObject(f"{MAP}_{number}", 0, 0, placement, solid)
            shape.meshColor = np.array(_COLOUR)
            shape.overrideMaterial = True
            shapes.append(shape)
        return shapes

    def _find_borders(self, arena: Arena) -> Floats:
        """Return what of the arena is beyond the image, as rectangles in the map's frame, (n, 4).

        Each is x_min, x_max, y_min, y_max [m].
        """
        x_min, x_max, y_min, y_max = arena
        corners = np.array([[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max]])
        inverse = self._placement.inverse()
        in_map = corners @ inverse.rotation[:2, :2].T + inverse.translation[:2]
        u_min, v_min = in_map.min(axis=0)
        u_max, v_max = in_map.max(axis=0)
        width, length = self._map.size
        borders = list[tuple[float, float, float, float]]()
        if u_min < -_MIN_BORDER:
            borders.append((u_min, 0.0, v_min, v_max))
        if u_max > width + _MIN_BORDER:
            borders.append((width, u_max, v_min, v_max))
        if v_min < -_MIN_BORDER:
            borders.append((u_min, u_max, v_min, 0.0))
        if v_max > length + _MIN_BORDER:
            borders.append((u_min, u_max, length, v_max))
        return np.array(borders, float).reshape(-1, 4)


def merge_cells(cells: Bools, most: int) -> Ints | None:
    """Return few rectangles that cover exactly the given cells; None if there are too many.

    Rectangles may overlap. From the cell with the longest run of cells on, each cell that is not
    covered yet is extended first along its row and then across, or in the opposite order, whichever
    covers more new cells. Rectangles that later ones cover are left out.

    Args:
        cells: Shape (rows, columns).
        most: Largest number of rectangles.

    Returns:
        First column, column behind the last, first row, row behind the last; shape (n, 4).
    """
    row_runs = _find_runs(cells)
    column_runs = _find_runs(cells.T)
    is_open = cells.copy()
    count = np.zeros(cells.shape, np.uint16)  # of rectangles over a cell
    found = list[tuple[int, int, int, int]]()
    lengths = np.maximum(row_runs[1] - row_runs[0], (column_runs[1] - column_runs[0]).T).ravel()
    seeds = np.flatnonzero(cells)
    seeds = seeds[np.argsort(-lengths[seeds], kind="stable")]
    for first in range(0, len(seeds), _BATCH):
        batch = seeds[first : first + _BATCH]
        for seed in batch[is_open.ravel()[batch]].tolist():
            row, column = divmod(seed, cells.shape[1])
            if not is_open[row, column]:
                continue
            if len(found) == most:
                return None
            along_row = _extend(row_runs, row, column)
            across = _extend(column_runs, column, row)
            along_column = (*across[2:], *across[:2])
            best = max(along_row, along_column, key=lambda one: int(is_open[_area(one)].sum()))
            is_open[_area(best)] = False
            count[_area(best)] += 1
            found.append(best)
    kept = list[tuple[int, int, int, int]]()
    for one in reversed(found):
        if count[_area(one)].min() > 1:
            count[_area(one)] -= 1
        else:
            kept.append(one)
    return np.array(kept, int).reshape(-1, 4)


def _area(rectangle: tuple[int, int, int, int]) -> tuple[slice, slice]:
    first_column, last_column, first_row, last_row = rectangle
    return slice(first_row, last_row), slice(first_column, last_column)


def _find_runs(cells: Bools) -> tuple[Ints, Ints]:
    """Return first column of each cell's run in its row, and the column behind its last.

    For cells that are not set, both are the column of the cell itself.
    """
    columns = np.arange(cells.shape[1], dtype=np.int32)
    last_gap = np.maximum.accumulate(np.where(cells, -1, columns), axis=1)
    from_right = np.where(cells, cells.shape[1], columns)[:, ::-1]
    next_gap = np.minimum.accumulate(from_right, axis=1)[:, ::-1]
    return np.where(cells, last_gap + 1, columns), next_gap


def _extend(runs: tuple[Ints, Ints], row: int, column: int) -> tuple[int, int, int, int]:
    """Return the run of a cell in its row, extended over rows in which a run contains it."""
    begins = runs[0][:, column]
    ends = runs[1][:, column]
    begin = int(begins[row])
    end = int(ends[row])
    fits = (begins <= begin) & (ends >= end)
    gaps_above = np.flatnonzero(~fits[row:])
    gaps_below = np.flatnonzero(~fits[:row])
    first_row = int(gaps_below[-1]) + 1 if len(gaps_below) else 0
    last_row = row + int(gaps_above[0]) if len(gaps_above) else len(fits)
    return begin, end, first_row, last_row
