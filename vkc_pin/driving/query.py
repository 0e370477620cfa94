"""What a search for a path of the base knows: where that begins and may end, and what has turned out not to be free."""

from __future__ import annotations

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.driving.ground import Ground, wrapped

__all__ = ["AHEAD", "BACK", "BEGIN", "DIRECT", "END", "LEFT", "RIGHT", "Move", "Query"]

# Kinds of moves; the first four lead from node to node.
AHEAD, BACK, LEFT, RIGHT, BEGIN, END, DIRECT = range(7)

Move = tuple[int, int, int]
"""Its kind, the goal, and the number of the connection; the last two are 0 from node to node."""

_ALIKE = 0.1  # [rad] between connections of which one is blocked, and the other then may well be


class Query:
    """Where the path begins and may end, and what has been learned.

    Attributes:
        starts, ends: Connections of the start, and of each goal, with the cells around them.
        closed: Moves from the start, or to a goal, that are not free.
        shut: Moves from node to node that are not free, as cell, heading, kind.
    """

    def __init__(self, ground: Ground, extra: Floats) -> None:
        self.ground, self.extra = ground, extra
        self.starts = ground.starts()
        self.ends = {g: ground.ends(g) for g, goal in enumerate(ground.goals) if ground.clear(goal)}
        self.closed: set[Move] = set()
        self.shut: set[tuple[int, int, int]] = set()
        self._turned: set[int] = set()  # goals at which it is known how far the base can turn

    def free(self, move: Move, yaw: float) -> bool:
        """Return whether a move from the start or to a goal is free; `yaw` is that in the cell [rad]."""
        ground, (kind, goal, number) = self.ground, move
        if kind == BEGIN:
            return ground.swept(float(ground.start[2]), *ground.begin(self.starts, number), ground.leaving)
        if kind == END:
            return ground.swept(yaw, *ground.end(self.ends[goal], number, goal, yaw))
        direct = ground.direct(goal, number)
        return direct is not None and ground.swept(float(ground.start[2]), *direct, ground.leaving)

    def close(self, move: Move) -> None:
        """Note that a move from the start or to a goal is not free, and look at those that are like it."""
        self.closed.add(move)
        kind, goal, number = move
        if kind == DIRECT:
            return
        ground, connections = self.ground, self.starts if kind == BEGIN else self.ends[goal]
        if kind == END and goal not in self._turned:
            self._turned.add(goal)
            turnable = ground.turnable(ground.goals[goal], connections)
            self.closed |= {(END, goal, k) for k in np.flatnonzero(~turnable).tolist()}
        alike = np.flatnonzero(np.abs(wrapped(connections.yaw - connections.yaw[number])) < _ALIKE).tolist()
        for other in [(kind, goal, k) for k in alike]:
            if other not in self.closed and not self.free(other, float(ground.grid.yaws[connections.heading[other[2]]])):
                self.closed.add(other)
