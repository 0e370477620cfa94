"""What a path of the base may begin and end with: drives between the start, or a goal, and the cells around it, or past them."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.base_paths.motion_primitives import UNIT, Connections, Drive, Ground
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["Query"]


class Query:
    """Where a path may begin and end, and at what cost.

    Attributes:
        starts: Connections of the start with the cells around it.
        ends: Connections of all goals that are not blocked, one goal after the other; their costs
            include the goals' own.
        goal: Which goal each of the `ends` leads to.
        direct: Straight drives from the start to goals as cost [UNIT], goal and kind (see
            `Ground.direct`), the cheapest last.
    """

    def __init__(self, ground: Ground, extra: Floats) -> None:
        self.ground = ground
        self.starts = ground.starts()
        goals = [g for g, goal in enumerate(ground.goals) if ground.clear(goal)]
        more = {goal: round(float(extra[goal]) / UNIT) for goal in goals}
        ends = {goal: ground.ends(goal) for goal in goals}
        self.goal = np.concatenate(
            [np.zeros(0, int), *(np.full(len(part.cell), goal) for goal, part in ends.items())]
        )
        self.ends = Connections(
            np.concatenate([np.zeros(0, int), *(part.cell for part in ends.values())]),
            np.concatenate([np.zeros(0, int), *(part.heading for part in ends.values())]),
            np.concatenate([np.zeros(0), *(part.yaw for part in ends.values())]),
            np.concatenate(
                [np.zeros(0, int), *(part.cost + more[goal] for goal, part in ends.items())]
            ),
        )
        drives = [(goal, how, ground.direct(goal, how)) for goal in goals for how in range(3)]
        found = [
            (self._cost(*drive) + more[goal], goal, how)
            for goal, how, drive in drives
            if drive is not None
        ]
        self.direct = sorted(found, reverse=True)
        self._turned: set[int] = set()  # goals at which it is known how far the base can turn

    def _cost(self, drive: Drive, last: float) -> int:
        turned = abs(drive.yaw - self.ground.start[2]) + abs(last - drive.yaw)
        return round((drive.cost * self.ground.haste + self.ground.grid.turning * turned) / UNIT)

    def begins(self, number: int) -> bool:
        """Return whether a connection from the start is free."""
        ground = self.ground
        return ground.swept(
            float(ground.start[2]), *ground.begin(self.starts, number), ground.leaving
        )

    def leads(self, goal: int, how: int) -> bool:
        """Return whether a straight drive from the start to a goal is free."""
        direct = self.ground.direct(goal, how)
        return direct is not None and self.ground.swept(
            float(self.ground.start[2]), *direct, self.ground.leaving
        )

    def barred(self, number: int) -> Ints:
        """Return which connections are not free if one to a goal is not; none if that is free."""
        ground, goal = self.ground, int(self.goal[number])
        yaw = float(ground.grid.yaws[self.ends.heading[number]])
        if ground.swept(yaw, *ground.end(self.ends, number, goal, yaw)):
            return np.empty(0, int)
        others = np.empty(0, int)
        if goal not in self._turned:
            self._turned.add(goal)
            others = np.flatnonzero(
                (self.goal == goal) & ~ground.turnable(ground.goals[goal], self.ends)
            )
        return np.append(others, number)
