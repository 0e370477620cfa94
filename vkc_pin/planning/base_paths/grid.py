"""Discretizes an arena into cells and headings, and checks where the base fits with its load."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.planning.base_paths.base_clearance import DIRECTIONS, MovingShapes, Obstacles, Shape
from vkc_pin.planning.base_paths.blocked_cells import Lattice, SupportCache, find_colliding_cells
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.cache import Cache
from vkc_pin.utils.optional_imports import import_compiled

HEADINGS = 16
"""Number of headings: to a cell's eight neighbours and, between these, a knight's move away."""

_CELL_MOVES = np.array([(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1)])
_CELL_MOVES = np.concatenate([_CELL_MOVES, -_CELL_MOVES])  # by heading, in cells
_FREE, _FORWARD, _LEFT = range(3)  # queries: a cell, the move ahead, the left turn
_DEFAULT_CELLS = 100  # along a side
_MAX_CELLS = 250  # along a side
_MAX_CLEARANCE = 0.5  # [m] above which more clearance makes no difference


def compute_fine_cell_count(arena: Sequence[float], margin: float) -> int:
    """Return the cells per side that put one in the middle of any passage, within limits.

    Args:
        arena: x_min, x_max, y_min, y_max [m].
        margin: Clearance that passages leave on either side [m].
    """
    size = max(arena[1] - arena[0], arena[3] - arena[2])
    return int(np.clip(np.ceil(size / (2.0 * margin)), _DEFAULT_CELLS, _MAX_CELLS))


class BaseGrid:
    """Grid of the base poses in an arena, by cell and heading, with cached collision checks.

    Attributes:
        cells: Number of cells along each side.
        origin, step: Centre of cell (0, 0), and size of a cell, shape (2,) [m].
        moves: Cells that a forward move advances at each heading, shape (HEADINGS, 2).
        yaws: Headings, ascending from 0, shape (HEADINGS,) [rad].
        lengths: Lengths of the moves, shape (HEADINGS,) [m].
        near: Radius around start and goals in which only the base counts, since the arm approaches
            or retreats there [m].
        turning: Cost of turning, relative to driving [m/rad].
        base, carried: Shapes of the base, and of arm and load.
        blocked, carried_blocked: Where base, or arm and load, certainly collide, shape (cells,
            cells, HEADINGS).
        turn_limits: Cache of `SearchSpace.find_turnable`.
    """

    def __init__(
        self,
        base: Sequence[Shape],
        carried: Sequence[Shape],
        obstacles: Sequence[Shape],
        arena: Sequence[float],
        margin: float,
        *,
        cells: int = _DEFAULT_CELLS,
        near: float = 1.0,
        turning: float = 0.3,
        cache: Cache | None = None,
    ) -> None:
        """Find certainly blocked cells, without exact collision checks.

        Args:
            base: Convex shapes of the base, in its frame.
            carried: Convex shapes of arm and load in their carrying posture, in the base's frame.
            obstacles: Convex obstacles without the floor, in the world.
            arena: x_min, x_max, y_min, y_max [m]; the base's origin stays inside.
            margin: Clearance to keep [m].
            cells: Number of cells along each side.
            near: See `near`.
            turning: See `turning`.
            cache: Cache of support functions. Default: none.
        """
        low = np.array(arena[::2], float)
        high = np.array(arena[1::2], float)
        self.cells = int(cells)
        self.near = float(near)
        self.turning = float(turning)
        self.step = (high - low) / cells
        self.origin = low + self.step / 2
        self.moves = _CELL_MOVES
        dx = _CELL_MOVES[:, 0] * self.step[0]
        dy = _CELL_MOVES[:, 1] * self.step[1]
        self.yaws = np.arctan2(dy, dx) % (2 * np.pi)
        self.lengths = np.hypot(dx, dy)
        world = Obstacles(obstacles)
        self.base = MovingShapes(base, world, margin)
        self.carried = MovingShapes(carried, world, margin)
        views = (cache or Cache()).get("plan views", SupportCache)
        lattice = Lattice(self.origin, self.step, self.cells, self.yaws)
        self.blocked, self.carried_blocked = find_colliding_cells(
            base, carried, obstacles, lattice, margin, views=views
        )
        self.turn_limits: dict[tuple[bytes, bool, bytes | None], tuple[float, float]] = {}
        # Cached answers for everything and for the base alone; -1: not checked yet.
        self._known = np.full((3, 2, self.cells, self.cells, HEADINGS), -1, np.int8)
        self._blocked_moves: list[tuple[list[tuple[int, ...]], ...]] = [([], []) for _ in range(3)]

    def center(self, i: int, j: int) -> tuple[float, float]:
        """Return the world position of a cell's centre [m]."""
        x = float(self.origin[0] + i * self.step[0])
        y = float(self.origin[1] + j * self.step[1])
        return x, y

    def find_cells_within(self, x: float, y: float, radius: float) -> Ints:
        """Return the cells whose centres are within `radius` [m] of a place, shape (C, 2)."""
        place = np.array([x, y])
        low = np.maximum(np.ceil((place - radius - self.origin) / self.step), 0)
        high = np.minimum(np.floor((place + radius - self.origin) / self.step), self.cells - 1) + 1
        first_i, first_j = low.astype(int)
        end_i, end_j = high.astype(int)
        i, j = np.meshgrid(np.arange(first_i, end_i), np.arange(first_j, end_j), indexing="ij")
        dx = self.origin[0] + i * self.step[0] - x
        dy = self.origin[1] + j * self.step[1] - y
        is_within = np.hypot(dx, dy) <= radius
        return np.column_stack([i[is_within], j[is_within]])

    def is_cell_free(self, i: int, j: int, heading: int, *, reaching: bool = False) -> bool:
        """Return whether a cell is free at a heading, 0 to HEADINGS - 1; cached.

        `reaching` as in `is_pose_free`.
        """

        def check() -> bool:
            if self._is_free_at_any_heading(i, j, reaching):
                return True
            x, y = self.center(i, j)
            return self.is_pose_free(x, y, float(self.yaws[heading]), reaching=reaching)

        return self._query((_FREE, int(reaching), i, j, heading), check)

    def is_pose_free(self, x: float, y: float, yaw: float, *, reaching: bool = False) -> bool:
        """Return whether the margins are kept at a pose x, y [m], yaw [rad] in the world.

        `reaching`: the arm approaches or retreats, so that only the base counts.
        """
        return self.is_drive_free((x, y), (x, y), yaw, reaching=reaching)

    def is_drive_free(
        self, a: ArrayLike, b: ArrayLike, yaw: float, *, reaching: bool = False
    ) -> bool:
        """Return whether the margins are kept from a to b, shape (2,) [m], at a heading [rad]."""
        begin = np.asarray(a, float)
        end = np.asarray(b, float)
        if not self.base.is_drive_free(begin, end, yaw):
            return False
        return reaching or self.carried.is_drive_free(begin, end, yaw)

    def is_turn_free(
        self,
        at: ArrayLike,
        start: float,
        end: float,
        *,
        reaching: bool = False,
        margins: Floats | None = None,
    ) -> bool:
        """Return whether the margins are kept while turning at a place [m] between yaws [rad].

        `margins`: those of the base from each obstacle, shape (S,) [m]. Default: the grid's.
        """
        place = np.asarray(at, float)
        if not self.base.is_turn_free(place, start, end, margins):
            return False
        return reaching or self.carried.is_turn_free(place, start, end)

    def compute_exit_margins(self, x: float, y: float, yaw: float) -> Floats | None:
        """Return the margins that the base can keep when it leaves a blocked pose.

        It comes no closer to obstacles within the margin; those it overlaps are ignored.

        Returns:
            Margin from each obstacle, shape (S,) [m], -inf for ignored ones; None if the pose
            is free.
        """
        if self.is_pose_free(x, y, yaw, reaching=True):
            return None
        return self.base.compute_exit_margins(np.array([x, y]), yaw)

    def is_move_free(self, i: int, j: int, heading: int, *, reaching: bool = False) -> bool:
        """Return whether the move ahead from a cell at a heading is free; cached."""

        def check() -> bool:
            k = i + int(self.moves[heading, 0])
            m = j + int(self.moves[heading, 1])
            # If the clearances at both ends add up to the length, each place between is within one
            # of them.
            length = self.lengths[heading]
            of_base, of_load = self._clearance_maps
            is_base_free = of_base[i][j] + of_base[k][m] >= length
            if is_base_free and (reaching or of_load[i][j] + of_load[k][m] >= length):
                return True
            return self.is_drive_free(
                self.center(i, j), self.center(k, m), float(self.yaws[heading]), reaching=reaching
            )

        return self._query((_FORWARD, int(reaching), i, j, heading), check)

    def is_left_turn_free(self, i: int, j: int, heading: int, *, reaching: bool = False) -> bool:
        """Return whether turning in a cell from a heading to the next is free; cached."""

        def check() -> bool:
            if self._is_free_at_any_heading(i, j, reaching):
                return True
            begin = float(self.yaws[heading])
            end = float(self.yaws[heading + 1]) if heading + 1 < HEADINGS else 2 * np.pi
            return self.is_turn_free(self.center(i, j), begin, end, reaching=reaching)

        return self._query((_LEFT, int(reaching), i, j, heading), check)

    def get_blocked_moves(self, reaching: Bools) -> tuple[Ints, Ints, Ints]:
        """Return the known blocked cells, moves ahead, and left turns, shape (K, 3) each.

        Args:
            reaching: Where only the base counts, shape (cells, cells).
        """
        blocked = []
        for with_load, base_alone in self._blocked_moves:
            everything = np.array(with_load, int).reshape(-1, 3)
            everything = everything[~reaching[everything[:, 0], everything[:, 1]]]
            base = np.array(base_alone, int).reshape(-1, 3)
            base = base[reaching[base[:, 0], base[:, 1]]]
            blocked.append(np.concatenate([everything, base]))
        return blocked[_FREE], blocked[_FORWARD], blocked[_LEFT]

    def _query(self, key: tuple[int, int, int, int, int], check: Callable[[], bool]) -> bool:
        """Return a cached answer; `key`: query, whether only the base counts, cell and heading."""
        if self._known[key] < 0:
            self._known[key] = check()
            if not self._known[key]:
                query, base_alone, *cell_and_heading = key
                self._blocked_moves[query][base_alone].append(tuple(cell_and_heading))
        return bool(self._known[key])

    def _is_free_at_any_heading(self, i: int, j: int, reaching: bool) -> bool:
        """Return whether a cell is certainly free at all headings."""
        of_base, of_load = self._clearance_maps
        return of_base[i][j] >= 0.0 and (reaching or of_load[i][j] >= 0.0)

    @cached_property
    def _clearance_maps(self) -> list[list[list[float]]]:
        """Lower bounds of the clearance of every cell at any heading, of base and load [m].

        The distance of a place p from an obstacle with the support function h along the unit
        vectors u is at least u·p − h(u). The base and its load stay within the exclusion radius.
        """
        x = self.origin[0] + self.step[0] * np.arange(self.cells)
        y = self.origin[1] + self.step[1] * np.arange(self.cells)
        along_x = np.outer(x, DIRECTIONS[:, 0])
        along_y = np.outer(y, DIRECTIONS[:, 1])
        bodies = (self.base, self.carried)
        shape = (self.cells, self.cells)
        clearances = (np.full(shape, _MAX_CLEARANCE), np.full(shape, _MAX_CLEARANCE))
        for s, support in enumerate(self.base.world.support):
            record_evaluations()
            reach = max(float(body.exclusion_radius[s]) for body in bodies) + _MAX_CLEARANCE
            if reach < 0.0:  # no shape can hit it
                continue
            # Supports along the world's axes x, y, −x and −y are eight directions apart.
            rows = slice(*np.searchsorted(x, [-support[16] - reach, support[0] + reach]))
            columns = slice(*np.searchsorted(y, [-support[24] - reach, support[8] + reach]))
            distance = (along_x[rows, None] + (along_y[columns] - support)).max(axis=2)
            for body, clearance in zip(bodies, clearances, strict=True):
                part = clearance[rows, columns]
                np.minimum(part, distance - body.exclusion_radius[s], out=part)
        return [clearance.tolist() for clearance in clearances]

    def compute_distances(self, starts: Floats, *, threads: int = 1) -> Floats:
        """Return lower bounds of the driving distance from places, (W, 2), to every cell.

        Turning is free, and only certain collisions of the base count. `threads` do not change the
        result.
        """
        blocked = np.asarray(self.blocked.all(axis=2))
        entries: list[tuple[Ints, Floats]] = []
        for x, y in np.asarray(starts, float):
            for radius in (2.5 * float(self.step.max()), 2.0 * _MAX_CLEARANCE, np.inf):
                cells = self.find_cells_within(x, y, radius)
                cells = cells[~blocked[cells[:, 0], cells[:, 1]]]
                if len(cells):
                    break
            dx, dy = (self.origin + cells * self.step - (x, y)).T
            entries.append((self.cells * cells[:, 0] + cells[:, 1], np.hypot(dx, dy)))
        counts = [len(cells) for cells, _ in entries]
        firsts = np.cumsum([0, *counts])
        begins = np.concatenate([cells for cells, _ in entries])
        lengths = np.concatenate([lengths for _, lengths in entries])
        return np.asarray(self._floor.distances(firsts, begins, lengths, threads))

    @cached_property
    def _floor(self) -> Any:
        """Compiled search of distances over the cells, turning being free."""
        module = import_compiled("vkc_pin.planning.base_paths._driving")
        return module.Floor(self.blocked.view(np.uint8), self.moves, self.lengths)
