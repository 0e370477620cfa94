"""What the search for a way knows: where it begins and may end, and what has turned out not to be free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vkc_pin.base_ways import Ground, wrapped

__all__ = ["AHEAD", "BACK", "BEGIN", "DIRECT", "END", "LEFT", "RIGHT", "Step", "Task"]

# How a step is taken; the first four lead from node to node.
AHEAD, BACK, LEFT, RIGHT, BEGIN, END, DIRECT = range(7)

Step = tuple[int, int, int]  # how, goal, number of the way

_ALIKE = 0.1  # [rad] between ways of which one is blocked, and the other then may well be


class Task:
    """Where the way begins and may end, and what has been learned.

    Attributes:
        starts, ends: Ways from the start, and to each goal.
        closed: Steps from the start, or to a goal, that are not free.
        shut: Moves that are not free, as cell, heading, kind.
    """

    def __init__(self, ground: Ground, extra: NDArray[np.float64]) -> None:
        self.ground, self.extra = ground, extra
        self.starts = ground.starts()
        self.ends = {g: ground.ends(g) for g, goal in enumerate(ground.goals) if ground.clear(goal)}
        self.closed: set[Step] = set()
        self.shut: set[tuple[int, int, int]] = set()
        self._turned: set[int] = set()  # goals at which it is known how far the base can turn

    def free(self, step: Step, yaw: float) -> bool:
        """Return whether a step from the start or to a goal is free; `yaw` is that in the cell [rad]."""
        ground, (kind, goal, way) = self.ground, step
        if kind == BEGIN:
            return ground.swept(float(ground.start[2]), *ground.begin(self.starts, way), ground.leaving)
        if kind == END:
            return ground.swept(yaw, *ground.end(self.ends[goal], way, goal, yaw))
        direct = ground.direct(goal, way)
        return direct is not None and ground.swept(float(ground.start[2]), *direct, ground.leaving)

    def close(self, step: Step) -> None:
        """Note that a step from the start or to a goal is not free, and look at those that are like it."""
        self.closed.add(step)
        kind, goal, way = step
        if kind == DIRECT:
            return
        ground, ways = self.ground, self.starts if kind == BEGIN else self.ends[goal]
        if kind == END and goal not in self._turned:
            self._turned.add(goal)
            turnable = ground.turnable(ground.goals[goal], ways)
            self.closed |= {(END, goal, k) for k in np.flatnonzero(~turnable).tolist()}
        alike = np.flatnonzero(np.abs(wrapped(ways.yaw - ways.yaw[way])) < _ALIKE).tolist()
        for other in [(kind, goal, k) for k in alike]:
            if other not in self.closed and not self.free(other, float(ground.grid.yaws[ways.heading[other[2]]])):
                self.closed.add(other)
