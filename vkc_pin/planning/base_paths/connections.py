"""Connects start and goals of a base path with the cells around them and with each other."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.base_paths.motion_primitives import UNIT, Connections, Drive, SearchSpace
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["EndConnections"]


class EndConnections:
    """Connections of start and goals, with their costs.

    Attributes:
        starts: Connections of the start with the cells around it.
        ends: Connections of all free goals, one goal after the other; costs include the goals' own.
        goal: Goal of each of the `ends`.
        direct: Straight drives from the start to goals as cost [UNIT], goal and kind (see
            `SearchSpace.get_direct_drive`), the cheapest last.
    """

    def __init__(self, space: SearchSpace, extra: Floats) -> None:
        self.space = space
        self.starts = space.get_starts()
        goals = [g for g, goal in enumerate(space.goals) if space.is_pose_free(goal)]
        more = {goal: round(float(extra[goal]) / UNIT) for goal in goals}
        ends = {goal: space.get_ends(goal) for goal in goals}
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
