"""Searches the cheapest base path over cells and headings with lazy collision checks.

The cheapest path among all moves not known to be blocked is checked, from the goal on, and its
blocked moves are removed, until a path is free (LazySP, Dellin and Srinivasa 2016). Compiled code
(`_driving.cpp`) repairs the path after each change (LPA*). SciPy's `dijkstra` takes about 20 times
as long, which would multiply the planning time of homes. Results of earlier searches in the same
grid are reused and make no difference.
"""

from __future__ import annotations

from dataclasses import replace
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
# flags of nodes
_BLOCKED = 1
_NO_AHEAD = 2
_NO_LEFT = 4
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
        goal_of_part = []
        parts = [Connections(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0, int))]
        direct = list[tuple[int, int, int]]()
        for goal, pose in enumerate(space.goals):
            if not space.is_pose_free(pose):
                continue
            extra_cost = round(float(extra[goal]) / UNIT)
            ends = space.get_ends(goal)
            goal_of_part += [goal] * len(ends.cell)
            parts.append(replace(ends, cost=ends.cost + extra_cost))
            for how in range(3):
                found = space.get_direct_drive(goal, how)
                if found is not None:
                    drive, last_yaw = found
                    direct.append((self._compute_cost(drive, last_yaw) + extra_cost, goal, how))
        self.goal = np.array(goal_of_part, int)
        self.ends = Connections(
            np.concatenate([part.cell for part in parts]),
            np.concatenate([part.heading for part in parts]),
            np.concatenate([part.yaw for part in parts]),
            np.concatenate([part.cost for part in parts]),
        )
        self.direct = sorted(direct, reverse=True)
        self._checked_goals: set[int] = set()  # goals whose turning range was checked

    def _compute_cost(self, drive: Drive, last_yaw: float) -> int:
        """Return the cost of a drive from the start with its turns [UNIT]."""
        turned = abs(drive.yaw - self.space.start[2]) + abs(last_yaw - drive.yaw)
        return round((drive.cost * self.space.exit_cost + self.space.grid.turning * turned) / UNIT)

    def is_start_free(self, number: int) -> bool:
        """Return whether a connection from the start is free."""
        space = self.space
        drive, yaw = space.get_start_drive(self.starts, number)
        return space.is_sweep_free(float(space.start[2]), drive, yaw, space.exit_margins)

    def is_direct_free(self, goal: int, how: int) -> bool:
        """Return whether a straight drive from the start to a goal is free."""
        space = self.space
        direct = space.get_direct_drive(goal, how)
        if direct is None:
            return False
        drive, yaw = direct
        return space.is_sweep_free(float(space.start[2]), drive, yaw, space.exit_margins)

    def find_blocked(self, number: int) -> Ints:
        """Return the connections that are blocked along with one to a goal; none if it is free."""
        space = self.space
        goal = int(self.goal[number])
        yaw = float(space.grid.yaws[self.ends.heading[number]])
        drive, last_yaw = space.get_goal_drive(self.ends, number, goal, yaw)
        if space.is_sweep_free(yaw, drive, last_yaw):
            return np.empty(0, int)
        others = np.empty(0, int)
        if goal not in self._checked_goals:
            self._checked_goals.add(goal)
            can_turn = space.find_turnable(space.goals[goal], self.ends)
            others = np.flatnonzero((self.goal == goal) & ~can_turn)
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
                drive, yaw = direct
                return cost * UNIT, goal, [drive], yaw


class _Search:
    """Moves of one search, without blocked ones; nodes are (i·cells + j)·HEADINGS + heading."""

    def __init__(self, connections: _EndConnections) -> None:
        self.connections = connections
        self.space = connections.space
        self.grid = connections.space.grid
        self.near = self.space.near.reshape(-1)
        grid = self.grid
        ahead = np.rint(grid.lengths / UNIT)
        back = np.rint(BACKWARDS * grid.lengths / UNIT)
        left = np.rint(grid.turning * wrap_angle(np.roll(grid.yaws, -1) - grid.yaws) / UNIT)
        right = np.roll(left, 1)
        costs = np.column_stack([ahead, back, left, right])
        self.paths = import_compiled("vkc_pin.planning.base_paths._driving").Paths(
            self._make_flags(),
            grid.moves.astype(np.int64),
            np.maximum(costs, 1.0).astype(np.int64),
            _list_nodes_and_costs(connections.starts),
            _list_nodes_and_costs(connections.ends),
        )

    def _make_flags(self) -> NDArray[np.uint8]:
        """Return the flags of known blocked nodes and moves, shape (cells, cells, HEADINGS)."""
        near = self.space.near
        flags = self.space.blocked.astype(np.uint8) * np.uint8(_BLOCKED)
        cells, ahead, left = self.grid.get_blocked_moves(near >= 0)
        # Moves between cells near different places are checked separately, see `_is_move_free`.
        i, j, heading = ahead.T
        k, m = (ahead[:, :2] + self.grid.moves[heading]).T
        ahead = ahead[near[i, j] == near[k, m]]
        for rows, flag in ((cells, _BLOCKED), (ahead, _NO_AHEAD), (left, _NO_LEFT)):
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
        grid = self.grid
        kind = self._classify_move(node, after)
        # Backward moves and right turns are looked up from their other end.
        first, second = (node, after) if kind in (_AHEAD, _LEFT) else (after, node)
        cell, heading = divmod(first, HEADINGS)
        other_cell = second // HEADINGS
        i, j = divmod(cell, grid.cells)
        near = self.near[cell]
        if kind in (_LEFT, _RIGHT):
            return grid.is_left_turn_free(i, j, heading, reaching=near >= 0)
        if near == self.near[other_cell]:
            return grid.is_move_free(i, j, heading, reaching=near >= 0)
        a = self.space.center(cell)
        b = self.space.center(other_cell)
        return self.space.is_drive_free(Drive(a, b, float(grid.yaws[heading])))

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
        space = self.space
        yaws = self.grid.yaws
        goal = int(self.connections.goal[end])
        drive, yaw = space.get_start_drive(self.connections.starts, begin)
        drives = [drive]
        kind_before = -1
        for node, after in pairwise(path):
            kind = self._classify_move(node, after)
            if kind in (_LEFT, _RIGHT):
                yaw += float(wrap_angle(yaws[after % HEADINGS] - yaws[node % HEADINGS]))
            else:
                a = space.center(node // HEADINGS)
                b = space.center(after // HEADINGS)
                if kind == kind_before:  # the same drive goes on
                    a = drives.pop().a
                drives.append(Drive(a, b, yaw))
            kind_before = kind
        drive, yaw = space.get_goal_drive(self.connections.ends, end, goal, yaw)
        return goal, [*drives, drive], yaw


def _list_nodes_and_costs(connections: Connections) -> NDArray[np.int64]:
    """Return node and cost [UNIT] of each connection, shape (C, 2)."""
    nodes = connections.cell * HEADINGS + connections.heading
    return np.column_stack([nodes, connections.cost]).astype(np.int64)
