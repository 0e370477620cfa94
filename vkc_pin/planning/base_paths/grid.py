"""Where the mobile base fits: the arena's floor as cells and headings, with the real shapes of the base and what it carries."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.planning.base_paths.base_clearance import FAN, Body, Shape, Standing
from vkc_pin.planning.base_paths.blocked_cells import Lattice, PlanViews, stuck
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.budget import spend
from vkc_pin.utils.cache import Cache
from vkc_pin.utils.optional_imports import compiled_module

__all__ = ["HEADINGS", "BaseGrid", "fine_cells"]

HEADINGS = 16
"""Directions of travel: to the eight neighbours of a cell and, between these, a knight's move away."""

_MOVES = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1)])
_MOVES = np.concatenate([_MOVES, -_MOVES])  # by heading, in cells
_FREE, _FORWARD, _LEFT = range(3)  # in a cell, to the next one, to the next heading
_CELLS, _FINEST = 100, 250  # along a side; at most
_ROOM = 0.5  # [m] beyond which more room makes no difference


def fine_cells(arena: Sequence[float], margin: float) -> int:
    """Return along how many cells a grid has one in the middle of any passage with room for the margins [m], within reason."""
    size = max(arena[1] - arena[0], arena[3] - arena[2])
    return int(np.clip(np.ceil(size / (2.0 * margin)), _CELLS, _FINEST))


class BaseGrid:
    """The floor of an arena in cells and headings, and where on it the base fits with what it carries.

    Attributes:
        cells: Number of cells along each side.
        origin: Centre of cell (0, 0) in the world, shape (2,) [m].
        step: Size of a cell, shape (2,) [m].
        moves: Cells from one to the next when driving forwards at each heading, shape (HEADINGS,
            2).
        yaws: The headings, ascending from 0, shape (HEADINGS,) [rad].
        lengths: Of the moves, shape (HEADINGS,) [m].
        near: Radius around the start and goals of a search in which only the base counts [m].
        turning: What turning costs beside driving [m/rad].
        base, carried: The shapes of either, which can be asked about a drive or a turn on their
            own.
        stuck: Where the base surely hits something, shape (cells, cells, HEADINGS).
        stuck_carrying: Where what is carried surely does, shape (cells, cells, HEADINGS).
        turns: What is known of how far the base can turn where a path begins or ends, by pose; see
            `Ground.turnable`.
    """

    def __init__(
        self,
        base: Sequence[Shape],
        carried: Sequence[Shape],
        standing: Sequence[Shape],
        arena: Sequence[float],
        margin: float,
        *,
        cells: int = _CELLS,
        near: float = 1.0,
        turning: float = 0.3,
        cache: Cache | None = None,
    ) -> None:
        """Look at every cell once, without asking coal.

        Args:
            base: Convex shapes of the chassis, placed in the base's frame.
            carried: Convex shapes of the arm, and of what it holds, as they are carried; placed in
                the base's frame.
            standing: Convex obstacles without the floor, placed in the world.
            arena: x_min, x_max, y_min, y_max [m]; the base's origin stays inside.
            margin: Clearance to keep [m].
            cells: Number of cells along each side.
            near: Radius around the start and goals of a search in which only `base` counts: there
                the arm reaches in and out [m].
            turning: What turning costs beside driving [m/rad].
            cache: Where what shapes look like from above is remembered; None: nowhere.

        Raises:
            InputError: The arena is empty, or a number is out of range.
        """
        low, high = np.array(arena[::2], float), np.array(arena[1::2], float)
        if not (len(arena) == 4 and np.all(np.isfinite(arena)) and np.all(high > low)):
            raise InputError(
                "the arena is empty",
                field="arena",
                expected="x_min < x_max and y_min < y_max",
                got=list(arena),
            )
        for field, value, least in (
            ("margin", margin, 0.0),
            ("near", near, 0.0),
            ("cells", cells, 2),
        ):
            if not (np.isfinite(value) and value >= least):
                raise InputError(
                    "out of range", field=field, expected=f"at least {least:g}", got=value
                )
        self.cells, self.near, self.turning = int(cells), float(near), float(turning)
        self.step = (high - low) / cells
        self.origin = low + self.step / 2
        self.moves = _MOVES
        self.yaws = np.arctan2(_MOVES[:, 1] * self.step[1], _MOVES[:, 0] * self.step[0]) % (
            2 * np.pi
        )
        self.lengths = np.hypot(*(_MOVES * self.step).T)
        world = Standing(standing)
        self.base, self.carried = Body(base, world, margin), Body(carried, world, margin)
        views = (cache or Cache()).get("plan views", PlanViews)
        lattice = Lattice(self.origin, self.step, self.cells, self.yaws)
        self.stuck, self.stuck_carrying = stuck(
            base, carried, standing, lattice, margin, views=views
        )
        self.turns: dict[tuple[bytes, bool, bytes | None], tuple[float, float]] = {}
        # Whether these are free, with everything and for the base alone; -1: nobody has asked yet.
        self._known = np.full((3, 2, self.cells, self.cells, HEADINGS), -1, np.int8)
        self._refused: list[tuple[list[tuple[int, ...]], ...]] = [([], []) for _ in range(3)]

    def center(self, i: int, j: int) -> tuple[float, float]:
        """Return the world position of a cell's centre [m]."""
        return float(self.origin[0] + i * self.step[0]), float(self.origin[1] + j * self.step[1])

    def around(self, x: float, y: float, radius: float) -> Ints:
        """Return the cells whose centres are within `radius` [m] of a place, shape (C, 2)."""
        low = np.maximum(np.ceil((np.array([x, y]) - radius - self.origin) / self.step), 0).astype(
            int
        )
        high = (
            np.minimum(
                np.floor((np.array([x, y]) + radius - self.origin) / self.step), self.cells - 1
            ).astype(int)
            + 1
        )
        i, j = (
            grid.ravel()
            for grid in np.meshgrid(
                np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij"
            )
        )
        inside = (
            np.hypot(self.origin[0] + i * self.step[0] - x, self.origin[1] + j * self.step[1] - y)
            <= radius
        )
        return np.column_stack([i[inside], j[inside]])

    def free(self, i: int, j: int, heading: int, *, reaching: bool = False) -> bool:
        """Return whether everything keeps its margin in a cell at a heading, 0 to HEADINGS - 1; remembered.

        `reaching` as in `clear`.
        """
        key = (_FREE, int(reaching), i, j, heading)
        if self._known[key] < 0:
            roomy = self._roomy(i, j, reaching)
            self._note(
                key,
                roomy
                or self.clear(*self.center(i, j), float(self.yaws[heading]), reaching=reaching),
            )
        return bool(self._known[key])

    def clear(self, x: float, y: float, yaw: float, *, reaching: bool = False) -> bool:
        """Return whether everything keeps its margin at a pose in the world.

        Args:
            x: [m].
            y: [m].
            yaw: [rad].
            reaching: The arm is about to reach out or back: only the base counts.
        """
        return self.driven((x, y), (x, y), yaw, reaching=reaching)

    def driven(self, a: ArrayLike, b: ArrayLike, yaw: float, *, reaching: bool = False) -> bool:
        """Return whether everything keeps its margin all along a straight line.

        Args:
            a: Its beginning in the world, shape (2,) [m].
            b: Its end.
            yaw: [rad], the same everywhere.
            reaching: As in `clear`.
        """
        begin, end = np.asarray(a, float), np.asarray(b, float)
        return self.base.driven(begin, end, yaw) and (
            reaching or self.carried.driven(begin, end, yaw)
        )

    def turned(
        self,
        at: ArrayLike,
        start: float,
        end: float,
        *,
        reaching: bool = False,
        margins: Floats | None = None,
    ) -> bool:
        """Return whether everything keeps its margin while the base turns from one yaw to the other at a place [m], [rad]."""
        place = np.asarray(at, float)
        return self.base.turned(place, start, end, margins) and (
            reaching or self.carried.turned(place, start, end)
        )

    def leaving(self, x: float, y: float, yaw: float) -> Floats | None:
        """Return the margins the base can keep when it leaves a blocked pose, None if the pose is not blocked.

        It comes no closer to what it is too close to; what it overlaps does not count.

        Returns:
            Margin from each of `standing`, shape (S,) [m]; -inf: none.
        """
        return (
            None
            if self.clear(x, y, yaw, reaching=True)
            else self.base.leaving(np.array([x, y]), yaw)
        )

    def forward(self, i: int, j: int, heading: int, *, reaching: bool = False) -> bool:
        """Return whether the move at `heading` from a cell is free all along; remembered."""
        key = (_FORWARD, int(reaching), i, j, heading)
        if self._known[key] < 0:
            k, m = i + int(self.moves[heading, 0]), j + int(self.moves[heading, 1])
            enough = self.lengths[heading]
            room = [rows[i][j] + rows[k][m] for rows in self._room]
            roomy = room[0] >= enough and (reaching or room[1] >= enough)
            ends = self.center(i, j), self.center(k, m)
            self._note(
                key, roomy or self.driven(*ends, float(self.yaws[heading]), reaching=reaching)
            )
        return bool(self._known[key])

    def left(self, i: int, j: int, heading: int, *, reaching: bool = False) -> bool:
        """Return whether turning in a cell from `heading` to the next is free all along; remembered."""
        key = (_LEFT, int(reaching), i, j, heading)
        if self._known[key] < 0:
            end = float(self.yaws[heading + 1]) if heading + 1 < HEADINGS else 2 * np.pi
            roomy = self._roomy(i, j, reaching)
            self._note(
                key,
                roomy
                or self.turned(
                    self.center(i, j), float(self.yaws[heading]), end, reaching=reaching
                ),
            )
        return bool(self._known[key])

    def refused(self, reaching: Bools) -> tuple[Ints, Ints, Ints]:
        """Return what was asked and is not free: to be in a cell, to move ahead from it, and to turn left in it.

        Args:
            reaching: Where only the base counts, shape (cells, cells).

        Returns:
            Cells and headings as in `free`, `forward` and `left`, shape (K, 3) each.
        """
        found = []
        for parts in self._refused:
            rows = [np.array(part, int).reshape(-1, 3) for part in parts]
            found.append(
                np.concatenate(
                    [
                        part[reaching[part[:, 0], part[:, 1]] == alone]
                        for alone, part in enumerate(rows)
                    ]
                )
            )
        return found[_FREE], found[_FORWARD], found[_LEFT]

    def _note(self, key: tuple[int, int, int, int, int], free: bool) -> None:
        """Remember an answer; `key` is what was asked, whether of the base alone, and where."""
        self._known[key] = free
        if not free:
            self._refused[key[0]][key[1]].append(key[2:])

    def _roomy(self, i: int, j: int, reaching: bool) -> bool:
        """Return whether nothing can be hit from a cell at any heading."""
        return self._room[0][i][j] >= 0.0 and (reaching or self._room[1][i][j] >= 0.0)

    @cached_property
    def _room(self) -> list[list[list[float]]]:
        """How far every cell is at least from where base, or carried, can hit something at some heading [m]."""
        x, y = (self.origin[axis] + self.step[axis] * np.arange(self.cells) for axis in (0, 1))
        along_x, along_y = np.outer(x, FAN[:, 0]), np.outer(y, FAN[:, 1])
        bodies = (self.base, self.carried)
        rooms = (np.full((self.cells, self.cells), _ROOM), np.full((self.cells, self.cells), _ROOM))
        for s, support in enumerate(self.base.world.support):
            spend()
            reach = max(float(body.span[s]) for body in bodies) + _ROOM
            if reach < 0.0:  # nothing can hit it
                continue
            rows = slice(*np.searchsorted(x, [-support[16] - reach, support[0] + reach]))
            columns = slice(*np.searchsorted(y, [-support[24] - reach, support[8] + reach]))
            distance = (along_x[rows, None] + (along_y[columns] - support)).max(axis=2)
            for body, room in zip(bodies, rooms, strict=True):
                np.minimum(room[rows, columns], distance - body.span[s], out=room[rows, columns])
        return [room.tolist() for room in rooms]

    def distances_from(self, starts: Floats, *, threads: int = 1) -> Floats:
        """Return how far the base drives at least from places, shape (W, 2) [m], to every cell, shape (W, cells, cells) [m].

        Infinite: there is no path. Turns are free, and only what surely blocks the base counts.
        Each start takes about a millisecond on 100 x 100 cells; for many of them, a grid of fewer
        cells will do. It makes no difference how many threads look for them.
        """
        blocked = np.asarray(self.stuck.all(axis=2))
        entries: list[tuple[Ints, Floats]] = []
        for x, y in np.asarray(starts, float):
            for radius in (2.5 * float(self.step.max()), 2.0 * _ROOM, np.inf):
                cells = self.around(x, y, radius)
                cells = cells[~blocked[cells[:, 0], cells[:, 1]]]
                if len(cells):
                    break
            entries.append(
                (
                    self.cells * cells[:, 0] + cells[:, 1],
                    np.hypot(*(self.origin + cells * self.step - (x, y)).T),
                )
            )
        firsts = np.cumsum([0, *(len(cells) for cells, _ in entries)])
        begins, costs = (np.concatenate(part) for part in zip(*entries, strict=True))
        return np.asarray(self._floor.distances(firsts, begins, costs, threads))

    @cached_property
    def _floor(self) -> Any:
        """Finds distances over the cells, turns being free."""
        module = compiled_module("vkc_pin.planning.base_paths._driving")
        return module.Floor(self.stuck.view(np.uint8), self.moves, self.lengths)
