"""Defines how the base moves between two places, what that costs, and where it is free.

The base turns, drives straight ahead or backwards, and turns; near start and goals, where furniture
may leave no space to turn, it may drive sideways.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.models.coordinates import wrap_angle

BACKWARDS = 1.2
"""Cost of a metre driven backwards [m]."""
SIDEWAYS = 5.0
"""Cost of a metre driven sideways, near the start or a goal where the base cannot turn [m]."""
UNIT = 1e-6
"""Unit of costs on the grid [m]: they are integers, so that equal paths cost exactly the same."""

# [m] from the start and the goals to the cells at which the path over the grid begins and ends
_ENTRY = 0.6
_FULL_CELL = 0.1  # [m] size below which cells shrink this range, too
_EXIT_RANGE = 1.0  # [m] range of the first drive from a start in collision
_EXIT_COST = 10.0  # cost of a metre of that drive
_TURN_STEP = np.pi / 16  # [rad] increment by which turning ranges are checked
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Drive:
    """A straight drive from a to b in the world, shape (2,) [m], at a constant yaw [rad]."""

    a: Floats
    b: Floats
    yaw: float

    @property
    def length(self) -> float:
        """Length [m]."""
        return float(np.hypot(self.b[0] - self.a[0], self.b[1] - self.a[1]))

    @property
    def cost(self) -> float:
        """Cost without turns [m]."""
        length = self.length
        ahead = float((self.b - self.a) @ (np.cos(self.yaw), np.sin(self.yaw)))
        if abs(ahead) < (1.0 - _SAME) * length:
            return SIDEWAYS * length
        if ahead < 0.0:
            return BACKWARDS * length
        return length


@dataclass(frozen=True, eq=False)
class Connections:
    """Connections between a pose and cells around it: turn, drive straight, turn.

    Attributes:
        cell: Cells as i·cells + j, shape (C,).
        heading: Headings in the cells, shape (C,).
        yaw: Yaws while driving, shape (C,) [rad].
        cost: Costs, shape (C,) [UNIT].
    """

    cell: Ints
    heading: Ints
    yaw: Floats
    cost: Ints

    def select(self, which: Bools) -> Connections:
        """Return the connections selected by a mask, shape (C,)."""
        return Connections(self.cell[which], self.heading[which], self.yaw[which], self.cost[which])


class SearchSpace:
    """Free space of one search. Near start and goals only the base counts.

    Attributes:
        near: Place (0: start, then the goals) that each cell is near, shape (cells, cells); -1:
            none.
        blocked: Where base or load are known to be blocked, shape (cells, cells, HEADINGS).
        exit_margins: Margins kept when leaving a blocked start; see
            `BaseGrid.compute_exit_margins`.
        exit_cost: Cost of a metre when leaving the start.
    """

    def __init__(self, grid: BaseGrid, start: Floats, goals: Floats) -> None:
        self.grid = grid
        self.start = start
        self.goals = goals
        places = np.concatenate([start[None, :2], goals[:, :2]])
        self._places = places if grid.near > 0.0 else places[:0]
        self.near = np.full((grid.cells, grid.cells), -1)
        for place, (x, y) in enumerate(self._places.tolist()):
            i, j = grid.find_cells_within(x, y, grid.near).T
            self.near[i, j] = place
        self.blocked = grid.blocked | (grid.carried_blocked & (self.near < 0)[..., None])
        self.exit_margins = grid.compute_exit_margins(*start)
        is_clear = self.exit_margins is None or np.all(np.isfinite(self.exit_margins))
        self.exit_cost = 1.0 if is_clear else _EXIT_COST

    def is_pose_free(self, pose: Floats) -> bool:
        """Return whether a pose, shape (3,), is free."""
        return self.grid.is_pose_free(*pose, reaching=self._is_near_end(pose[:2]))

    def is_turn_free(
        self, at: Floats, start: float, end: float, margins: Floats | None = None
    ) -> bool:
        """Return whether the base can turn in place from one yaw to another."""
        reaching = self._is_near_end(at)
        return self.grid.is_turn_free(at, start, end, reaching=reaching, margins=margins)

    def is_drive_free(self, drive: Drive, margins: Floats | None = None) -> bool:
        """Return whether a straight drive is free."""
        if not self.grid.base.is_drive_free(drive.a, drive.b, drive.yaw, margins):
            return False
        for a, b in self._split_outside_ends(drive):
            if not self.grid.carried.is_drive_free(a, b, drive.yaw):
                return False
        return True

    def is_sweep_free(
        self, before: float, drive: Drive, after: float, margins: Floats | None = None
    ) -> bool:
        """Return whether a drive and the turns from yaw `before` and to `after` [rad] are free.

        `margins`, shape (S,) [m], are those of first turn and drive. Default: the grid's.
        """
        return (
            self.is_turn_free(drive.a, before, drive.yaw, margins)
            and self.is_turn_free(drive.b, drive.yaw, after)
            and self.is_drive_free(drive, margins)
        )

    def looks_free(self, drive: Drive) -> bool:
        """Return whether no cell along a drive is known to be blocked near its heading."""
        grid = self.grid
        count = int(np.hypot(*((drive.b - drive.a) / grid.step))) + 2
        cells = (np.linspace(drive.a, drive.b, count)[1:-1] - grid.origin) / grid.step
        cells = np.rint(cells).astype(int).clip(0, grid.cells - 1)
        heading = int(np.abs(wrap_angle(grid.yaws - drive.yaw)).argmin())
        return not self.blocked[cells[:, 0], cells[:, 1], heading].any()

    def _is_near_end(self, at: Floats) -> bool:
        """Return whether a place is near the start or a goal."""
        dx, dy = (self._places - at).T
        return bool(np.any(np.hypot(dx, dy) <= self.grid.near))

    def _split_outside_ends(self, drive: Drive) -> Iterator[tuple[Floats, Floats]]:
        """Yield the parts of a drive that are near neither the start nor a goal.

        With d = b − a and c = a − place, the point a + t d is at the distance r = `near` from a
        place where

            |d|² t² + 2 (c·d) t + |c|² − r² = 0
        """
        along = drive.b - drive.a
        from_places = drive.a - self._places
        square = float(along @ along)
        mixed = from_places @ along
        constant = (from_places**2).sum(axis=1) - self.grid.near**2
        if square < _SAME**2:
            if np.all(constant > 0.0):
                yield drive.a, drive.b
            return
        meets = mixed**2 > square * constant
        root = np.sqrt(mixed[meets] ** 2 - square * constant[meets])
        inside = np.column_stack([-mixed[meets] - root, -mixed[meets] + root]) / square
        done = 0.0
        for begin, end in [*sorted(inside.tolist()), (1.0, np.inf)]:
            if done < min(begin, 1.0):
                yield drive.a + done * along, drive.a + min(begin, 1.0) * along
            done = max(done, end)

    def get_starts(self) -> Connections:
        """Return the connections from the start to the cells around it."""
        radius = _EXIT_RANGE if self.exit_cost > 1.0 else _ENTRY
        connections = self._make_connections(self.start, 1.0, radius, self.exit_cost)
        # Checked first: a search from the goals would find out last.
        can_turn = self.find_turnable(self.start, connections, self.exit_margins)
        return connections.select(can_turn)

    def get_ends(self, goal: int) -> Connections:
        """Return the connections to a goal from the cells around it."""
        return self._make_connections(self.goals[goal], -1.0, _ENTRY, 1.0)

    def _make_connections(
        self, pose: Floats, sign: float, radius: float, cost_factor: float
    ) -> Connections:
        """Return connections from a pose (`sign` 1) or to it (-1)."""
        grid = self.grid
        step = float(grid.step.max())
        radius = max(radius * min(1.0, step / _FULL_CELL), 1.5 * step)
        cells = grid.find_cells_within(float(pose[0]), float(pose[1]), radius)
        offset = sign * (grid.origin + cells * grid.step - pose[:2])
        dx, dy = offset.T
        length = np.hypot(dx, dy)
        ahead = np.where(length > _SAME, np.arctan2(dy, dx), pose[2])
        # Each cell three times: driven to ahead, backwards, and sideways.
        yaw = np.concatenate([ahead, ahead + np.pi, np.full(len(cells), pose[2])])
        heading = np.abs(wrap_angle(yaw[:, None] - grid.yaws)).argmin(axis=1)
        turned = np.abs(wrap_angle(yaw - pose[2])) + np.abs(wrap_angle(yaw - grid.yaws[heading]))
        driven = np.concatenate([length, BACKWARDS * length, SIDEWAYS * length])
        cost = np.rint((cost_factor * driven + grid.turning * turned) / UNIT).astype(int)
        cell = np.tile(grid.cells * cells[:, 0] + cells[:, 1], 3)
        is_blocked = self.blocked.reshape(-1, len(grid.yaws))[cell, heading]
        return Connections(cell, heading, yaw, cost).select(~is_blocked)

    def find_turnable(
        self, pose: Floats, connections: Connections, margins: Floats | None = None
    ) -> Bools:
        """Return for which connections the base can turn at the pose to their yaw, shape (C,).

        The turning range is overestimated by at most a few degrees.
        """
        margins_key = None if margins is None else margins.tobytes()
        key = (pose.tobytes(), self._is_near_end(pose[:2]), margins_key)
        if key not in self.grid.turn_limits:  # a start or goal belongs to many searches
            self.grid.turn_limits[key] = (
                self._measure_turn(pose, 1.0, margins) + _TURN_STEP,
                self._measure_turn(pose, -1.0, margins) + _TURN_STEP,
            )
        left, right = self.grid.turn_limits[key]
        turn = wrap_angle(connections.yaw - pose[2])
        return (turn < left) & (turn > -right)

    def _measure_turn(self, pose: Floats, side: float, margins: Floats | None) -> float:
        """Return how far the base can turn left (`side` 1) or right (-1), at most π [rad]."""
        turned = 0.0
        while turned < np.pi:
            begin = pose[2] + side * turned
            end = pose[2] + side * (turned + _TURN_STEP)
            if not self.is_turn_free(pose[:2], begin, end, margins):
                break
            turned += _TURN_STEP
        return turned

    def get_start_drive(self, connections: Connections, number: int) -> tuple[Drive, float]:
        """Return the drive of a connection from the start, and the yaw in its cell [rad]."""
        yaw = float(self.start[2] + wrap_angle(connections.yaw[number] - self.start[2]))
        drive = Drive(self.start[:2], self.center(connections.cell[number]), yaw)
        yaw_in_cell = self.grid.yaws[connections.heading[number]]
        return drive, float(yaw + wrap_angle(yaw_in_cell - yaw))

    def get_goal_drive(
        self, connections: Connections, number: int, goal: int, yaw: float
    ) -> tuple[Drive, float]:
        """Return the drive of a connection to a goal from a yaw in its cell, and the last yaw."""
        yaw = float(yaw + wrap_angle(connections.yaw[number] - yaw))
        drive = Drive(self.center(connections.cell[number]), self.goals[goal, :2], yaw)
        return drive, float(yaw + wrap_angle(self.goals[goal, 2] - yaw))

    def get_direct_drive(self, goal: int, how: int) -> tuple[Drive, float] | None:
        """Return the straight drive from the start to a goal, and the yaw at the goal [rad].

        `how`: 0: ahead, 1: backwards, 2: sideways. None: too long, sideways or from a blocked
        start.
        """
        a = self.start[:2]
        b = self.goals[goal, :2]
        yaw = float(self.start[2])
        if how < 2 and np.hypot(*(b - a)) > _SAME:
            direction = np.arctan2(b[1] - a[1], b[0] - a[0])
            yaw += float(wrap_angle(direction + np.pi * how - yaw))
        drive = Drive(a, b, yaw)
        limit = np.inf
        if how == 2:
            limit = _ENTRY
        elif self.exit_margins is not None:
            limit = _EXIT_RANGE
        if drive.length > limit:
            return None
        return drive, float(yaw + wrap_angle(self.goals[goal, 2] - yaw))

    def center(self, cell: int) -> Floats:
        """Return the centre of a cell, given as i·cells + j, shape (2,) [m]."""
        return np.array(self.grid.center(*divmod(int(cell), self.grid.cells)))
