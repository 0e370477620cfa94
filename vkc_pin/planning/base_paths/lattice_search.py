"""The cheapest path of the mobile base over cells and headings, where it takes long to find out whether a move is free.

The cheapest path is found as if everything were free that is not known to be blocked. Then its
moves are looked at, from the goal on, since dead ends are mostly around goals. What is not free is
taken out, and so on, until a path is free throughout (LazySP, Dellin and Srinivasa 2016). From one
path to the next, compiled code (`_driving.cpp`) finds only anew what is different (LPA*, A* that is
repaired; its heuristic is what is left if turns are free).

What searches in the same grid have found out is used, and makes no difference: of equal paths, what
moves cost decides.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.connections import Query
from vkc_pin.planning.base_paths.grid import HEADINGS
from vkc_pin.planning.base_paths.motion_primitives import BACKWARDS, UNIT, Drive, Ground, wrapped
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import spend
from vkc_pin.utils.optional_imports import compiled_module

__all__ = ["cheapest"]

_AHEAD, _BACK, _LEFT, _RIGHT = range(4)  # kinds of moves, as in `_driving.cpp`
_BLOCKED, _NO_AHEAD, _NO_LEFT = 1, 2, 4  # flags of nodes
_NONE = 2**60  # [UNIT] more than any path costs


def cheapest(ground: Ground, extra: Floats) -> tuple[float, int, list[Drive], float] | None:
    """Return the cheapest path to a goal that is not blocked, or None if there is none.

    Args:
        ground: Where the base may move, from where to where.
        extra: What reaching each goal costs beside the path, shape (G,) [m].

    Returns:
        The cost [m], the goal, the drives up to it, with continuous yaws, and the yaw at the goal.
    """
    query = Query(ground, extra)
    if not len(query.goal):
        return None
    search = _Search(query)
    while True:
        spend(1)
        limit = query.direct[-1][0] if query.direct else _NONE
        cost, end, begin, nodes = search.paths.cheapest(limit)
        if len(nodes):
            path = nodes[::-1].tolist()
            if search.free(path, begin, end):
                return cost * UNIT, *search.drives(path, begin, end)
        elif not query.direct:
            return None
        else:
            cost, goal, how = query.direct.pop()
            direct = ground.direct(goal, how)
            if direct is not None and query.leads(goal, how):
                return cost * UNIT, goal, [direct[0]], direct[1]


class _Search:
    """The moves of one search, of which more and more are known not to be free. Nodes are (i·cells + j)·HEADINGS + heading.

    Attributes:
        paths: The cheapest paths as far as is known.
    """

    def __init__(self, query: Query) -> None:
        self.query, self.ground, self.grid = query, query.ground, query.ground.grid
        grid, starts, ends = self.grid, query.starts, query.ends
        self.near = self.ground.near.reshape(-1)
        lengths = np.rint(grid.lengths / UNIT)
        left = np.rint(grid.turning * wrapped(np.roll(grid.yaws, -1) - grid.yaws) / UNIT)
        costs = np.column_stack(
            [lengths, np.rint(BACKWARDS * grid.lengths / UNIT), left, np.roll(left, 1)]
        )
        self.paths = compiled_module("vkc_pin.planning.base_paths._driving").Paths(
            self._flags(),
            grid.moves.astype(np.int64),
            np.maximum(costs, 1.0).astype(np.int64),
            *(
                np.column_stack([part.cell * HEADINGS + part.heading, part.cost]).astype(np.int64)
                for part in (starts, ends)
            ),
        )

    def _flags(self) -> NDArray[np.uint8]:
        """Return what is known not to be free: flags of all nodes, shape (cells, cells, HEADINGS)."""
        near, flags = self.ground.near, self.ground.stuck.astype(np.uint8) * np.uint8(_BLOCKED)
        stays, ahead, left = self.grid.refused(near >= 0)
        # What is near different places is looked at in another way, see `_move`.
        there = ahead[:, :2] + self.grid.moves[ahead[:, 2]]
        ahead = ahead[near[ahead[:, 0], ahead[:, 1]] == near[there[:, 0], there[:, 1]]]
        for rows, flag in ((stays, _BLOCKED), (ahead, _NO_AHEAD), (left, _NO_LEFT)):
            flags[tuple(rows.T)] |= flag
        return flags

    def free(self, path: list[int], begin: int, end: int) -> bool:
        """Return whether a path through nodes is free, by a connection from the start and one to a goal; if not, learn that."""
        barred = self.query.barred(end)
        if len(barred):
            self.paths.close(barred, True)
            return False
        for node, after in reversed(list(pairwise(path))):
            if not self._move(node, after):
                self._learn(node, after)
                return False
        if not self.query.begins(begin):
            self.paths.close(np.array([begin]), False)
            return False
        return True

    def _kind(self, node: int, after: int) -> int:
        if node // HEADINGS == after // HEADINGS:
            return _LEFT if (after - node) % HEADINGS == 1 else _RIGHT
        di, dj = self.grid.moves[node % HEADINGS].tolist()
        return _AHEAD if after - node == (di * self.grid.cells + dj) * HEADINGS else _BACK

    def _move(self, node: int, after: int) -> bool:
        """Return whether the move from a node to the next is free."""
        grid, kind = self.grid, self._kind(node, after)
        # Backwards, and to the right, the same move is taken from its other end.
        first, second = (node, after) if kind in (_AHEAD, _LEFT) else (after, node)
        cell, heading = divmod(first, HEADINGS)
        i, j = divmod(cell, grid.cells)
        near, other = self.near[cell], second // HEADINGS
        if kind in (_LEFT, _RIGHT):
            return grid.left(i, j, heading, reaching=near >= 0)
        if near == self.near[other]:
            return grid.forward(i, j, heading, reaching=near >= 0)
        return self.ground.driven(
            Drive(self.ground.center(cell), self.ground.center(other), float(grid.yaws[heading]))
        )

    def _learn(self, node: int, after: int) -> None:
        """Take out a move that is not free, and what is blocked around it."""
        self.paths.shut(node, self._kind(node, after))
        cell, heading = divmod(node, HEADINGS)
        i, j = divmod(cell, self.grid.cells)
        if self._blocked(i, j, heading):  # then its neighbours may well be, too
            di, dj = self.grid.moves[heading].tolist()
            for k, m in (
                (i + di, j + dj),
                (i - di, j - dj),
                (i + 1, j),
                (i - 1, j),
                (i, j + 1),
                (i, j - 1),
            ):
                self._blocked(k, m, heading)
            for turned in (heading + 1, heading - 1):
                self._blocked(i, j, turned % HEADINGS)

    def _blocked(self, i: int, j: int, heading: int) -> bool:
        """Return whether the base is blocked in a cell at a heading, and take that out if so."""
        cells = self.grid.cells
        if not (0 <= i < cells and 0 <= j < cells):
            return False
        cell = i * cells + j
        if self.grid.free(i, j, heading, reaching=self.near[cell] >= 0):
            return False
        self.paths.block(cell * HEADINGS + heading)
        return True

    def drives(self, path: list[int], begin: int, end: int) -> tuple[int, list[Drive], float]:
        """Return the goal of a path, the drives up to it, and the yaw there; arguments as of `free`."""
        query, ground, yaws, goal = (
            self.query,
            self.ground,
            self.grid.yaws,
            int(self.query.goal[end]),
        )
        drive, yaw = ground.begin(query.starts, begin)
        drives, before = [drive], -1
        for node, after in pairwise(path):
            kind = self._kind(node, after)
            if kind in (_LEFT, _RIGHT):
                yaw += float(wrapped(yaws[after % HEADINGS] - yaws[node % HEADINGS]))
            else:
                ends = [ground.center(n // HEADINGS) for n in (node, after)]
                drives.append(Drive(drives.pop().a if kind == before else ends[0], ends[1], yaw))
            before = kind
        drive, yaw = ground.end(query.ends, end, goal, yaw)
        return goal, [*drives, drive], yaw
