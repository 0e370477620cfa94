"""Searches the cheapest base path over cells and headings with lazy collision checks.

The cheapest path among all moves not known to be blocked is checked, from the goal on, and its
blocked moves are removed, until a path is free (LazySP, Dellin and Srinivasa 2016). Compiled code
(`_driving.cpp`) repairs the path after each change (LPA*). SciPy's `dijkstra` takes about 20 times
as long, which would multiply the planning time of homes. Results of earlier searches in the same
grid are reused and make no difference.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.grid import HEADINGS
from vkc_pin.planning.base_paths.motion_primitives import (
    BACKWARDS,
    UNIT,
    Connections,
    Drive,
    SearchSpace,
)
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.optional_imports import import_compiled
from vkc_pin.world.models.coordinates import wrap_angle

_AHEAD, _BACK, _LEFT, _RIGHT = range(4)  # kinds of moves, as in `_driving.cpp`
_BLOCKED, _NO_AHEAD, _NO_LEFT = 1, 2, 4  # flags of nodes
_NONE = 2**60  # [UNIT] more than any path costs


class _EndConnections:
    """Connections of start and free goals with the cells around them and with each other.

    Attributes:
        starts, ends: Connections of the start and of all goals, whose costs include the goals' own.
        goal: Goal of each of the `ends`.
        direct: Straight drives to goals as cost [UNIT], goal and kind, the cheapest last.
    """

    def __init__(self, space: SearchSpace, extra: Floats) -> None:
        self.space = space
        self.starts = space.get_starts()
        goals = [g for g, goal in enumerate(space.goals) if space.is_pose_free(goal)]
        more = {goal: round(float(extra[goal]) / UNIT) for goal in goals}
        ends = {goal: space.get_ends(goal) for goal in goals}
        self.goal = np.repeat(np.array([*ends], int), [len(part.cell) for part in ends.values()])
        parts = [(p.cell, p.heading, p.yaw, p.cost + more[goal]) for goal, p in ends.items()]
        none = np.zeros(0, int)
        columns = zip((none, none, np.zeros(0), none), *parts, strict=True)
        self.ends = Connections(*map(np.concatenate, columns))
        drives = [
            (goal, how, space.get_direct_drive(goal, how)) for goal in goals for how in range(3)
        ]
        found = [
            (self._compute_cost(*drive) + more[goal], goal, how)
            for goal, how, drive in drives
            if drive is not None
        ]
        self.direct = sorted(found, reverse=True)
        self._checked_goals: set[int] = set()  # goals whose turning range was checked

    def _compute_cost(self, drive: Drive, last: float) -> int:
        turned = abs(drive.yaw - self.space.start[2]) + abs(last - drive.yaw)
        return round((drive.cost * self.space.exit_cost + self.space.grid.turning * turned) / UNIT)

    def is_start_free(self, number: int) -> bool:
        """Return whether a connection from the start is free."""
        space = self.space
        return space.is_sweep_free(
            float(space.start[2]), *space.get_start_drive(self.starts, number), space.exit_margins
        )

    def is_direct_free(self, goal: int, how: int) -> bool:
        """Return whether a straight drive from the start to a goal is free."""
        direct = self.space.get_direct_drive(goal, how)
        return direct is not None and self.space.is_sweep_free(
            float(self.space.start[2]), *direct, self.space.exit_margins
        )

    def find_blocked(self, number: int) -> Ints:
        """Return the connections that are blocked along with one to a goal; none if it is free."""
        space, goal = self.space, int(self.goal[number])
        yaw = float(space.grid.yaws[self.ends.heading[number]])
        if space.is_sweep_free(yaw, *space.get_goal_drive(self.ends, number, goal, yaw)):
            return np.empty(0, int)
        others = np.empty(0, int)
        if goal not in self._checked_goals:
            self._checked_goals.add(goal)
            others = np.flatnonzero(
                (self.goal == goal) & ~space.find_turnable(space.goals[goal], self.ends)
            )
        return np.append(others, number)


def find_cheapest_path(
    space: SearchSpace, extra: Floats
) -> tuple[float, int, list[Drive], float] | None:
    """Return cost [m], goal, drives and last yaw [rad] of the cheapest path, or None.

    `extra`, shape (G,) [m], are additional costs of the goals.
    """
    ends = _EndConnections(space, extra)
    if not len(ends.goal):
        return None
    search = _Search(ends)
    while True:
        record_evaluations(1)
        limit = ends.direct[-1][0] if ends.direct else _NONE
        cost, end, begin, nodes = search.paths.cheapest(limit)
        if len(nodes):
            path = nodes[::-1].tolist()
            if search.is_path_free(path, begin, end):
                return cost * UNIT, *search.make_drives(path, begin, end)
        elif not ends.direct:
            return None
        else:
            cost, goal, how = ends.direct.pop()
            direct = space.get_direct_drive(goal, how)
            if direct is not None and ends.is_direct_free(goal, how):
                return cost * UNIT, goal, [direct[0]], direct[1]


class _Search:
    """Moves of one search, without blocked ones; nodes are (i·cells + j)·HEADINGS + heading."""

    def __init__(self, connections: _EndConnections) -> None:
        self.connections = connections
        self.space, self.grid = connections.space, connections.space.grid
        grid, starts, ends = self.grid, connections.starts, connections.ends
        self.near = self.space.near.reshape(-1)
        lengths = np.rint(grid.lengths / UNIT)
        left = np.rint(grid.turning * wrap_angle(np.roll(grid.yaws, -1) - grid.yaws) / UNIT)
        costs = np.column_stack(
            [lengths, np.rint(BACKWARDS * grid.lengths / UNIT), left, np.roll(left, 1)]
        )
        self.paths = import_compiled("vkc_pin.planning.base_paths._driving").Paths(
            self._make_flags(),
            grid.moves.astype(np.int64),
            np.maximum(costs, 1.0).astype(np.int64),
            *(
                np.column_stack([part.cell * HEADINGS + part.heading, part.cost]).astype(np.int64)
                for part in (starts, ends)
            ),
        )

    def _make_flags(self) -> NDArray[np.uint8]:
        """Return the flags of known blocked nodes and moves, shape (cells, cells, HEADINGS)."""
        near, flags = self.space.near, self.space.blocked.astype(np.uint8) * np.uint8(_BLOCKED)
        stays, ahead, left = self.grid.get_blocked_moves(near >= 0)
        # Moves between cells near different places are checked separately, see `_is_move_free`.
        there = ahead[:, :2] + self.grid.moves[ahead[:, 2]]
        ahead = ahead[near[ahead[:, 0], ahead[:, 1]] == near[there[:, 0], there[:, 1]]]
        for rows, flag in ((stays, _BLOCKED), (ahead, _NO_AHEAD), (left, _NO_LEFT)):
            flags[tuple(rows.T)] |= flag
        return flags

    def is_path_free(self, path: list[int], begin: int, end: int) -> bool:
        """Return whether a path is free; otherwise remove its blocked moves."""
        blocked = self.connections.find_blocked(end)
        if len(blocked):
            self.paths.close(blocked, True)
            return False
        for node, after in reversed(list(pairwise(path))):
            if not self._is_move_free(node, after):
                self._exclude_move(node, after)
                return False
        if not self.connections.is_start_free(begin):
            self.paths.close(np.array([begin]), False)
            return False
        return True

    def _classify_move(self, node: int, after: int) -> int:
        """Return the kind of the move between two nodes."""
        if node // HEADINGS == after // HEADINGS:
            return _LEFT if (after - node) % HEADINGS == 1 else _RIGHT
        di, dj = self.grid.moves[node % HEADINGS].tolist()
        return _AHEAD if after - node == (di * self.grid.cells + dj) * HEADINGS else _BACK

    def _is_move_free(self, node: int, after: int) -> bool:
        """Return whether the move between two nodes is free."""
        grid, kind = self.grid, self._classify_move(node, after)
        # Backward moves and right turns are looked up from their other end.
        first, second = (node, after) if kind in (_AHEAD, _LEFT) else (after, node)
        cell, heading = divmod(first, HEADINGS)
        i, j = divmod(cell, grid.cells)
        near, other = self.near[cell], second // HEADINGS
        if kind in (_LEFT, _RIGHT):
            return grid.is_left_turn_free(i, j, heading, reaching=near >= 0)
        if near == self.near[other]:
            return grid.is_move_free(i, j, heading, reaching=near >= 0)
        return self.space.is_drive_free(
            Drive(self.space.center(cell), self.space.center(other), float(grid.yaws[heading]))
        )

    def _exclude_move(self, node: int, after: int) -> None:
        """Remove a blocked move, and blocked cells around it."""
        self.paths.shut(node, self._classify_move(node, after))
        cell, heading = divmod(node, HEADINGS)
        i, j = divmod(cell, self.grid.cells)
        if self._exclude_if_blocked(i, j, heading):  # then its neighbours are likely blocked, too
            di, dj = self.grid.moves[heading].tolist()
            for k, m in (
                (i + di, j + dj),
                (i - di, j - dj),
                (i + 1, j),
                (i - 1, j),
                (i, j + 1),
                (i, j - 1),
            ):
                self._exclude_if_blocked(k, m, heading)
            for turned in (heading + 1, heading - 1):
                self._exclude_if_blocked(i, j, turned % HEADINGS)

    def _exclude_if_blocked(self, i: int, j: int, heading: int) -> bool:
        """Remove a cell at a heading if it is blocked; return whether it is."""
        cells = self.grid.cells
        if not (0 <= i < cells and 0 <= j < cells):
            return False
        cell = i * cells + j
        if self.grid.is_cell_free(i, j, heading, reaching=self.near[cell] >= 0):
            return False
        self.paths.block(cell * HEADINGS + heading)
        return True

    def make_drives(self, path: list[int], begin: int, end: int) -> tuple[int, list[Drive], float]:
        """Return goal, drives and yaw at the goal of a path; arguments as of `is_path_free`."""
        space, yaws = self.space, self.grid.yaws
        goal = int(self.connections.goal[end])
        drive, yaw = space.get_start_drive(self.connections.starts, begin)
        drives, before = [drive], -1
        for node, after in pairwise(path):
            kind = self._classify_move(node, after)
            if kind in (_LEFT, _RIGHT):
                yaw += float(wrap_angle(yaws[after % HEADINGS] - yaws[node % HEADINGS]))
            else:
                ends = [space.center(n // HEADINGS) for n in (node, after)]
                drives.append(Drive(drives.pop().a if kind == before else ends[0], ends[1], yaw))
            before = kind
        drive, yaw = space.get_goal_drive(self.connections.ends, end, goal, yaw)
        return goal, [*drives, drive], yaw
