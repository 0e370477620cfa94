"""How the mobile base moves between two places: it turns, drives straight, turns; what that costs, and where it is free.

It drives ahead or backwards. Only next to the start and the goals, where furniture may leave no
room to turn, it may slide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.utils.arrays import Bools, Floats, Ints

__all__ = ["BACKWARDS", "SIDEWAYS", "UNIT", "Connections", "Drive", "Ground", "wrapped"]

BACKWARDS = 1.2
"""What a metre driven backwards costs [m]."""
SIDEWAYS = 5.0
"""What a metre costs on which the base slides instead of turning, near the start or a goal where it has no room to turn [m]."""
UNIT = 1e-6
"""Costs on the grid are whole numbers of this [m], so that equal paths cost exactly the same."""

# [m] from the start, and from the goals, to the cells where the path over the grid begins and ends
_ENTRY = 0.6
_CELL = 0.1  # [m]: where cells are smaller, so is the distance to them
_LEAVE = 1.0  # [m]: so far a blocked start may be left in one go, if it overlaps something
_AWAY = 10.0  # what a metre costs on which the base leaves what it overlaps
_TRY = np.pi / 16  # [rad] of turning, tried step by step
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Drive:
    """A straight drive from a to b in the world, shape (2,) [m], at one yaw [rad]."""

    a: Floats
    b: Floats
    yaw: float

    @property
    def length(self) -> float:
        """How long it is [m]."""
        return float(np.hypot(self.b[0] - self.a[0], self.b[1] - self.a[1]))

    @property
    def cost(self) -> float:
        """What it costs without turns [m]."""
        ahead, length = float((self.b - self.a) @ (np.cos(self.yaw), np.sin(self.yaw))), self.length
        if abs(ahead) < (1.0 - _SAME) * length:
            return SIDEWAYS * length
        return length if ahead >= 0.0 else BACKWARDS * length


@dataclass(frozen=True, eq=False)
class Connections:
    """Of a pose with cells around it: turn, drive or slide straight, turn; arrays over the connections.

    Attributes:
        cell: As i·cells + j.
        heading: In the cell.
        yaw: While driving [rad].
        cost: [UNIT].
    """

    cell: Ints
    heading: Ints
    yaw: Floats
    cost: Ints

    def select(self, which: Bools) -> Connections:
        """Return some of them."""
        return Connections(self.cell[which], self.heading[which], self.yaw[which], self.cost[which])


class Ground:
    """Where the base may move in one search: near its start and its goals, only the base counts, elsewhere what it carries, too.

    Attributes:
        near: For each cell, a place (0: start, then the goals) that it is near, shape (cells,
            cells); -1: none.
        stuck: Where the base, or what counts of what it carries, is known to be blocked, shape
            (cells, cells, HEADINGS).
        leaving: Margins kept when leaving the start, if that is blocked; see `BaseGrid.leaving`.
        haste: What a metre costs when leaving the start.
    """

    def __init__(self, grid: BaseGrid, start: Floats, goals: Floats) -> None:
        self.grid, self.start, self.goals = grid, start, goals
        places = np.concatenate([start[None, :2], goals[:, :2]])
        self._places = places if grid.near > 0.0 else places[:0]
        self.near = np.full((grid.cells, grid.cells), -1)
        for place, (x, y) in enumerate(self._places.tolist()):
            self.near[tuple(grid.around(x, y, grid.near).T)] = place
        self.stuck = grid.stuck | (grid.stuck_carrying & (self.near < 0)[..., None])
        self.leaving = grid.leaving(*start)
        self.haste = 1.0 if self.leaving is None or np.all(np.isfinite(self.leaving)) else _AWAY

    def clear(self, pose: Floats) -> bool:
        """Return whether the base is free at a pose."""
        return self.grid.clear(*pose, reaching=self._reaching(pose[:2]))

    def turned(self, at: Floats, start: float, end: float, margins: Floats | None = None) -> bool:
        """Return whether the base can turn at a place from one yaw to another."""
        return self.grid.turned(at, start, end, reaching=self._reaching(at), margins=margins)

    def driven(self, drive: Drive, margins: Floats | None = None) -> bool:
        """Return whether the base can drive there."""
        return self.grid.base.driven(drive.a, drive.b, drive.yaw, margins) and all(
            self.grid.carried.driven(a, b, drive.yaw) for a, b in self._outside(drive)
        )

    def swept(
        self, before: float, drive: Drive, after: float, margins: Floats | None = None
    ) -> bool:
        """Return whether the base can turn to a drive from one yaw, drive, and turn to another; `margins` up to there."""
        return (
            self.turned(drive.a, before, drive.yaw, margins)
            and self.turned(drive.b, drive.yaw, after)
            and self.driven(drive, margins)
        )

    def likely(self, drive: Drive) -> bool:
        """Return whether none of the cells that a drive crosses is known to be blocked at about its heading."""
        grid = self.grid
        count = int(np.hypot(*((drive.b - drive.a) / grid.step))) + 2
        cells = (
            np.rint((np.linspace(drive.a, drive.b, count)[1:-1] - grid.origin) / grid.step)
            .astype(int)
            .clip(0, grid.cells - 1)
        )
        heading = int(np.abs(wrapped(grid.yaws - drive.yaw)).argmin())
        return not self.stuck[cells[:, 0], cells[:, 1], heading].any()

    def _reaching(self, at: Floats) -> bool:
        return bool(np.any(np.hypot(*(self._places - at).T) <= self.grid.near))

    def _outside(self, drive: Drive) -> Iterator[tuple[Floats, Floats]]:
        """Yield the parts of a drive that are not near the start or a goal."""
        along, from_place = drive.b - drive.a, drive.a - self._places
        # |a + t·along − place|² = near², a quadratic in t.
        square, mixed = float(along @ along), from_place @ along
        rest = (from_place**2).sum(axis=1) - self.grid.near**2
        if square < _SAME**2:
            if np.all(rest > 0.0):
                yield drive.a, drive.b
            return
        meets = mixed**2 > square * rest
        root = np.sqrt(mixed[meets] ** 2 - square * rest[meets])
        inside = sorted(
            zip(
                ((-mixed[meets] - root) / square).tolist(),
                ((-mixed[meets] + root) / square).tolist(),
                strict=True,
            )
        )
        done = 0.0
        for begin, end in [*inside, (1.0, np.inf)]:
            if done < min(begin, 1.0):
                yield drive.a + done * along, drive.a + min(begin, 1.0) * along
            done = max(done, end)

    def starts(self) -> Connections:
        """Return the connections from the start to the cells around it."""
        found = self._connections(
            self.start, 1.0, _LEAVE if self.haste > 1.0 else _ENTRY, self.haste
        )
        # A search from the goals would find out last, after it has looked everywhere else.
        return found.select(self.turnable(self.start, found, self.leaving))

    def ends(self, goal: int) -> Connections:
        """Return the connections to a goal from the cells around it."""
        return self._connections(self.goals[goal], -1.0, _ENTRY, 1.0)

    def _connections(self, pose: Floats, sign: float, radius: float, haste: float) -> Connections:
        """Return those from a pose (`sign` 1), or to it (-1), within a radius [m], where a metre costs `haste`."""
        grid = self.grid
        step = float(grid.step.max())
        cells = grid.around(
            float(pose[0]), float(pose[1]), max(radius * min(1.0, step / _CELL), 1.5 * step)
        )
        offset = sign * (grid.origin + cells * grid.step - pose[:2])
        length = np.hypot(*offset.T)
        ahead = np.where(length > _SAME, np.arctan2(offset[:, 1], offset[:, 0]), pose[2])
        yaw = np.concatenate([ahead, ahead + np.pi, np.full(len(cells), pose[2])])
        heading = np.abs(wrapped(yaw[:, None] - grid.yaws)).argmin(axis=1)
        turned = np.abs(wrapped(yaw - pose[2])) + np.abs(wrapped(yaw - grid.yaws[heading]))
        cost = (
            haste * np.concatenate([length, BACKWARDS * length, SIDEWAYS * length])
            + grid.turning * turned
        )
        found = Connections(
            np.tile(cells @ [grid.cells, 1], 3), heading, yaw, np.rint(cost / UNIT).astype(int)
        )
        return found.select(~self.stuck.reshape(-1, len(grid.yaws))[found.cell, heading])

    def turnable(
        self, pose: Floats, connections: Connections, margins: Floats | None = None
    ) -> Bools:
        """Return for which connections the base can turn at the pose between its yaw and theirs, up to a few degrees more."""
        key = (
            pose.tobytes(),
            self._reaching(pose[:2]),
            None if margins is None else margins.tobytes(),
        )
        if key not in self.grid.turns:  # one start, or goal, has paths to many
            self.grid.turns[key] = (
                self._turns(pose, 1.0, margins) + _TRY,
                self._turns(pose, -1.0, margins) + _TRY,
            )
        left, right = self.grid.turns[key]
        turn = wrapped(connections.yaw - pose[2])
        return (turn < left) & (turn > -right)

    def _turns(self, pose: Floats, side: float, margins: Floats | None) -> float:
        """Return how far the base can turn at a pose to the left (`side` 1) or right (-1), up to half a turn [rad]."""
        turned = 0.0
        while turned < np.pi and self.turned(
            pose[:2], pose[2] + side * turned, pose[2] + side * (turned + _TRY), margins
        ):
            turned += _TRY
        return turned

    def begin(self, connections: Connections, number: int) -> tuple[Drive, float]:
        """Return the drive of a connection from the start, and the yaw in its cell."""
        yaw = float(self.start[2] + wrapped(connections.yaw[number] - self.start[2]))
        drive = Drive(self.start[:2], self.center(connections.cell[number]), yaw)
        return drive, float(
            drive.yaw + wrapped(self.grid.yaws[connections.heading[number]] - drive.yaw)
        )

    def end(
        self, connections: Connections, number: int, goal: int, yaw: float
    ) -> tuple[Drive, float]:
        """Return the drive of a connection to a goal from its cell, where the base has a yaw, and the yaw at the goal."""
        pose = self.goals[goal]
        drive = Drive(
            self.center(connections.cell[number]),
            pose[:2],
            float(yaw + wrapped(connections.yaw[number] - yaw)),
        )
        return drive, float(drive.yaw + wrapped(pose[2] - drive.yaw))

    def direct(self, goal: int, how: int) -> tuple[Drive, float] | None:
        """Return the straight drive from the start to a goal, ahead (0), backwards (1) or sideways (2), and the yaw there.

        None if it is too long for this: sideways, or from a blocked start.
        """
        a, b, yaw = self.start[:2], self.goals[goal, :2], float(self.start[2])
        if how < 2 and np.hypot(*(b - a)) > _SAME:
            yaw += float(wrapped(np.arctan2(b[1] - a[1], b[0] - a[0]) + np.pi * how - yaw))
        drive = Drive(a, b, yaw)
        if drive.length > (_ENTRY if how == 2 else np.inf if self.leaving is None else _LEAVE):
            return None
        return drive, float(yaw + wrapped(self.goals[goal, 2] - yaw))

    def center(self, cell: int) -> Floats:
        """Return the centre of a cell, given as i·cells + j, shape (2,) [m]."""
        return np.array(self.grid.center(*divmod(int(cell), self.grid.cells)))


def wrapped(angle: Any) -> Any:
    """Return an angle, or an array of them, between -π and π."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
