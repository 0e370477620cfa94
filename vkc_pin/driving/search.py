"""A* for the mobile base over cells and headings.

A move is asked for only when the search is about to take it. The heuristic is what the path from the start costs, with headings
and turns, if nothing blocked it but what is known to; SciPy finds it for all cells and headings at once. It is
admissible and consistent, since what turns out to be blocked only makes paths longer. After surprises it is found again, with
what has been learned.
"""

from __future__ import annotations

import heapq

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.driving.grid import HEADINGS
from vkc_pin.driving.ground import BACKWARDS, UNIT, Drive, Ground, wrapped
from vkc_pin.driving.query import AHEAD, BACK, BEGIN, DIRECT, END, LEFT, RIGHT, Move, Query
from vkc_pin.interrupt import NEVER, Interrupt

__all__ = ["cheapest"]

_OPPOSITE = [BACK, AHEAD, RIGHT, LEFT]
_KINDS = (AHEAD, BACK, LEFT, RIGHT)

_Entry = tuple[float, float, int, int, int, Move]  # cost in all, cost up to the node, tie-break, node, the next one, move

# By how much [m] paths may be longer than what is known to be needed, and how many cells are looked at, one try after the other.
_WIDER = ((1.0, 1000), (1.0, 2000), (3.0, 4000), (np.inf, 0))
_CURVES = 0.13  # by what share paths are longer, mostly, because of turns
_PATIENCE = 8e-3  # share of all nodes that are looked at, after a surprise, before the heuristic is found again


def cheapest(ground: Ground, extra: Floats, interrupt: Interrupt = NEVER) -> tuple[float, int, list[Drive], float] | None:
    """Return the cheapest path to a goal that is not blocked, or None if there is none.

    Args:
        ground: Where the base may move, from where to where.
        extra: What reaching each goal costs beside the path, shape (G,) [m].
        interrupt: Ends the search, as if there were no path.

    Returns:
        The cost [m], the goal, the drives up to it, with continuous yaws, and the yaw at the goal.
    """
    query = Query(ground, extra)
    if not query.ends:
        return None
    # What the path costs at least up to every cell, and from it on.
    count = ground.grid.cells**2
    first, last = np.full(count, np.inf), np.full(count, np.inf)
    np.minimum.at(first, query.starts.cell, query.starts.cost * UNIT)
    for goal, ends in query.ends.items():
        np.minimum.at(last, ends.cell, ends.cost * UNIT + extra[goal])
    entries = [(np.flatnonzero(np.isfinite(cost)), cost[np.isfinite(cost)]) for cost in (first, last)]
    before, after = ground.grid.spread(entries, ground.stuck)
    least = np.sort(before + after, axis=None)
    cost, found = float(least[0]) * (1.0 + _CURVES) if np.isfinite(least[0]) else 0.0, None
    for longer, cells in _WIDER:
        if found is None and cost < np.inf:
            bound = max(cost + longer, float(least[min(cells, count - 1)]))
            cost, found = _Round(query, before, after, bound).run(interrupt)
    return None if found is None else (cost, *found)


class _Round:
    """A* over some of the cells, from the goals back to the start: dead ends are mostly around goals, and small."""

    def __init__(self, query: Query, before: Floats, after: Floats, bound: float) -> None:
        """Look at the cells over which a path may cost less than `bound` [m], given what it costs at least up to and from it."""
        self.query, self.ground, self.bound = query, query.ground, bound / UNIT
        grid = self.ground.grid
        cells = np.isfinite(before + after) & (before + after <= bound)
        i, j = np.nonzero(cells)
        self.cell = (i * grid.cells + j).tolist()
        self.near = self.ground.near[cells].tolist()
        self.after = np.repeat(after[cells], HEADINGS) / UNIT
        # Nodes are numbered cell by cell; `nowhere` stands for all that are not looked at or known to be blocked.
        self.start = len(self.cell) * HEADINGS
        self.nowhere = self.start + 1
        number = np.full((grid.cells + 4, grid.cells + 4, HEADINGS), self.nowhere, np.int32)
        inner = number[2:-2, 2:-2]
        inner[cells] = np.arange(self.start, dtype=np.int32).reshape(-1, HEADINGS)
        inner[self.ground.stuck] = self.nowhere
        self.node = inner.reshape(-1, HEADINGS)
        # Where each node leads: ahead, back, turning left, turning right.
        heading, (di, dj) = np.arange(HEADINGS), grid.moves.T
        i, j = i[:, None] + 2, j[:, None] + 2
        leads = [
            number[i + di, j + dj, heading],
            number[i - di, j - dj, heading],
            number[i, j, (heading + 1) % HEADINGS],
            number[i, j, (heading - 1) % HEADINGS],
        ]
        self.targets = np.full((self.start + 2, 4), self.nowhere, np.int32)
        self.targets[: self.start] = np.stack(leads, axis=-1).reshape(-1, 4)
        for cell, h, kind in query.shut:
            self._shut(int(self.node[cell, h]), kind)
        left = wrapped(np.roll(grid.yaws, -1) - grid.yaws)
        turning = grid.turning
        costs = [grid.lengths, BACKWARDS * grid.lengths, turning * left, turning * np.roll(left, 1)]
        self.costs = np.rint(np.column_stack(costs) / UNIT)
        self.begin: dict[int, list[tuple[int, int]]] = {}
        self.passed = np.empty(0)
        self._look()

    def _look(self) -> None:
        """Find the cost from the start to every node if nothing blocks the base but what is known to."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        starts, closed = self.query.starts, self.query.closed
        self.begin.clear()
        for k, (node, cost) in enumerate(zip(self.node[starts.cell, starts.heading].tolist(), starts.cost.tolist(), strict=True)):
            if node != self.nowhere and (BEGIN, 0, k) not in closed:
                self.begin.setdefault(node, []).append((cost, k))
        edges, first = 4 * self.start, np.array(list(self.begin), np.int32)
        weights = np.broadcast_to(self.costs, (len(self.cell), HEADINGS, 4)).reshape(-1)
        graph = csr_array(
            (
                np.concatenate([weights, [min(moves)[0] for moves in self.begin.values()]]),
                np.concatenate([self.targets[: self.start].reshape(-1), first]),
                np.concatenate([np.arange(0, edges + 1, 4), [edges + len(first)] * 2]).astype(np.int32),
            ),
            shape=(self.start + 2, self.start + 2),
        )
        self.passed = dijkstra(graph, indices=self.start)
        self.passed[self.nowhere] = np.inf
        # No path through these is good enough; the next time they are left out.
        self.targets[: self.start][self.passed[: self.start] + self.after > self.bound + 0.5] = self.nowhere

    def run(self, interrupt: Interrupt) -> tuple[float, tuple[int, list[Drive], float] | None]:
        """Return the goal of the cheapest path, its drives and the yaw at the goal, after its cost [m].

        If no path costs less than the bound, None, after what all paths cost at least; infinite: there is none.
        """
        queue, leads, surprised, count = self._endings(), dict[int, _Entry](), -1, 0
        # By the heading at their end: turning right from it costs what turning left to it does.
        moves = self.costs[:, [AHEAD, BACK, RIGHT, LEFT]].tolist()
        while queue:
            if interrupt.pressed:
                return np.inf, None
            entry = heapq.heappop(queue)
            total, passed, _, node, _, move = entry
            if total > self.bound:
                return total * UNIT, None
            if node in leads or move in self.query.closed:
                continue
            if not self._free(entry):
                self._learn(entry)
                surprised = len(leads) if surprised < 0 else surprised
                continue
            leads[node] = entry
            if node == self.start:
                return total * UNIT, self._trace(leads)
            if 0 <= surprised < len(leads) - self.start * _PATIENCE:
                self._look()
                queue, leads, surprised = self._endings(), {}, -1
                continue
            # A node is reached ahead from where it leads back to, and so on.
            sources, spent = self.targets[node][_OPPOSITE], total - passed
            for kind, source, cost, before in zip(
                _KINDS, sources.tolist(), moves[node % HEADINGS], self.passed[sources].tolist(), strict=True
            ):
                if before < np.inf and source not in leads:
                    count += 1
                    heapq.heappush(queue, (spent + cost + before, before, -count, source, node, (kind, 0, 0)))
            for cost, number in self.begin.get(node, ()):
                count += 1
                heapq.heappush(queue, (spent + cost, 0.0, -count, self.start, node, (BEGIN, 0, number)))
        return self.bound * UNIT, None

    def _endings(self) -> list[_Entry]:
        """Return the moves to the goals from cells around them, and straight from the start, as a heap."""
        query, queue, number = self.query, list[_Entry](), 0
        for goal, ends in query.ends.items():
            nodes, extra = self.node[ends.cell, ends.heading], round(query.extra[goal] / UNIT)
            passed = self.passed[nodes]
            total = ends.cost + extra + passed
            some, beyond = np.flatnonzero(total <= self.bound), np.flatnonzero((total > self.bound) & (total < np.inf))
            some = np.append(some, beyond[np.argsort(total[beyond], kind="stable")[:1]])  # only the least is ever looked at
            columns = (values.tolist() for values in (some, nodes[some], total[some], passed[some]))
            queue += [
                (cost, before, number + k, node, -1, (END, goal, k)) for k, node, cost, before in zip(*columns, strict=True)
            ]
            number += len(nodes) + 3
            for how in range(3):
                direct = self.ground.direct(goal, how)
                if direct is not None:
                    drive, last = direct
                    turned = abs(drive.yaw - self.ground.start[2]) + abs(last - drive.yaw)
                    cost = float(np.rint((drive.cost * self.ground.haste + self.ground.grid.turning * turned) / UNIT)) + extra
                    queue.append((cost, 0.0, number - 3 + how, self.start, -1, (DIRECT, goal, how)))
        heapq.heapify(queue)
        return queue

    def _free(self, entry: _Entry) -> bool:
        _, _, _, node, after, move = entry
        grid, kind = self.ground.grid, move[0]
        if kind not in _KINDS:
            return self.query.free(move, float(grid.yaws[node % HEADINGS]))
        # Backwards, and to the right, the same move is taken from its other end.
        first, second = (node, after) if kind in (AHEAD, LEFT) else (after, node)
        index, heading = divmod(first, HEADINGS)
        i, j = divmod(self.cell[index], grid.cells)
        near, other = self.near[index], second // HEADINGS
        if kind in (LEFT, RIGHT):
            return grid.left(i, j, heading, reaching=near >= 0)
        if near == self.near[other]:
            return grid.forward(i, j, heading, reaching=near >= 0)
        ends = self.ground.center(self.cell[index]), self.ground.center(self.cell[other])
        return self.ground.driven(Drive(*ends, float(grid.yaws[heading])))

    def _learn(self, entry: _Entry) -> None:
        """Take out a move that is not free, and what is blocked around it."""
        _, _, _, node, _, move = entry
        kind, closed = move[0], self.query.closed
        if kind not in _KINDS:
            self.query.close(move)
            if kind == BEGIN:
                self.begin = {n: [m for m in moves if (BEGIN, 0, m[1]) not in closed] for n, moves in self.begin.items()}
            return
        index, heading = divmod(node, HEADINGS)
        self.query.shut.add((self.cell[index], heading, kind))
        self._shut(node, kind)
        cells = self.ground.grid.cells  # and, with the same heading, in the four cells around this one
        i, j = divmod(self.cell[index], cells)
        around = [(k, m) for k, m in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)) if 0 <= k < cells and 0 <= m < cells]
        neighbours = [*self.targets[node].tolist(), *(int(self.node[k * cells + m, heading]) for k, m in around)]
        if self._blocked(node):  # then its neighbours may well be, too
            for neighbour in neighbours:
                self._blocked(neighbour)

    def _blocked(self, node: int) -> bool:
        """Return whether the base is blocked at a node, and take it out if so."""
        if node == self.nowhere:
            return False
        index, heading = divmod(node, HEADINGS)
        i, j = divmod(self.cell[index], self.ground.grid.cells)
        if self.ground.grid.free(i, j, heading, reaching=self.near[index] >= 0):
            return False
        self.ground.stuck[i, j, heading] = True
        for kind in _KINDS:
            self._shut(node, kind)
        self.node[self.cell[index], heading] = self.nowhere
        self.begin.pop(node, None)
        return True

    def _shut(self, node: int, kind: int) -> None:
        """Take out a move and the same move from its other end."""
        other = self.targets[node, kind]
        self.targets[node, kind] = self.targets[other, _OPPOSITE[kind]] = self.nowhere

    def _trace(self, leads: dict[int, _Entry]) -> tuple[int, list[Drive], float]:
        """Return the goal, the drives up to it, and the yaw there."""
        query, ground, yaws = self.query, self.ground, self.ground.grid.yaws
        drives: list[Drive] = []
        yaw, node, before = float(ground.start[2]), self.start, -1
        while True:
            _, _, _, _, after, (kind, goal, number) = leads[node]
            if kind in (LEFT, RIGHT):
                yaw += float(wrapped(yaws[after % HEADINGS] - yaws[node % HEADINGS]))
            elif kind in (AHEAD, BACK):
                ends = [ground.center(self.cell[n // HEADINGS]) for n in (node, after)]
                drives.append(Drive(drives.pop().a if kind == before else ends[0], ends[1], yaw))
            else:
                if kind == BEGIN:
                    drive, yaw = ground.begin(query.starts, number)
                else:
                    direct = ground.direct(goal, number) if kind == DIRECT else None
                    drive, yaw = direct or ground.end(query.ends[goal], number, goal, yaw)
                drives.append(drive)
            if after < 0:
                return goal, drives, yaw
            node, before = after, kind
