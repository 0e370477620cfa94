"""Compares repaired cheapest paths with those that SciPy finds in the changed graph."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from vkc_pin.planning.base_paths.grid import HEADINGS, BaseGrid
from vkc_pin.utils.optional_imports import import_compiled

MODULE = "vkc_pin.planning.base_paths._driving"
CELLS, LIMIT = 9, 2**60
NODES = CELLS**2 * HEADINGS
GRID = BaseGrid([], [], [], (-2.0, 2.0, -2.0, 2.0), 0.0, cells=CELLS)


class Graph:
    """Reference graph of `Paths`, from which the same parts are removed."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.costs = self.rng.integers(
            1, 6, (HEADINGS, 4)
        )  # small integers, so that many paths cost the same
        self.flags = np.where(
            self.rng.random((CELLS, CELLS, HEADINGS)) < 0.2,
            self.rng.integers(0, 8, (CELLS, CELLS, HEADINGS)),
            0,
        )
        self.begins, self.ends = (
            np.column_stack([self.rng.integers(0, NODES, n), self.rng.integers(1, 9, n)])
            for n in (12, 20)
        )
        self.moves = GRID.moves.astype(np.int64)

    def make_paths(self) -> Any:
        return import_compiled(MODULE).Paths(
            self.flags.astype(np.uint8), self.moves, self.costs, self.begins, self.ends
        )

    def get_target(self, node: int, kind: int) -> int:
        cell, heading = divmod(node, HEADINGS)
        if kind > 1:
            return cell * HEADINGS + (heading + (1, -1)[kind - 2]) % HEADINGS
        i, j = np.array(divmod(cell, CELLS)) + (1, -1)[kind] * self.moves[heading]
        return (
            int((i * CELLS + j) * HEADINGS + heading) if 0 <= i < CELLS and 0 <= j < CELLS else -1
        )

    def compute_move_cost(self, node: int, after: int) -> float:
        """Return the cost of the cheapest move between two nodes, infinite if there is none."""
        flags, cheapest = self.flags.reshape(-1), np.inf
        for kind in range(4):
            first = node if kind in (0, 2) else after
            is_removed = flags[first] & (2 if kind < 2 else 4)
            if (
                self.get_target(node, kind) == after
                and not is_removed
                and not (flags[node] | flags[after]) & 1
            ):
                cheapest = min(cheapest, self.costs[node % HEADINGS, kind])
        return cheapest

    def compute_cheapest_cost(self) -> float:
        """Return the cost of the cheapest path, infinite if there is none."""
        flags, edges = self.flags.reshape(-1), dict[tuple[int, int], float]()
        for node in range(NODES):
            for kind in range(4):
                after = self.get_target(node, kind)
                if after >= 0 and self.compute_move_cost(node, after) < np.inf:
                    edges[node, after] = self.compute_move_cost(node, after)
        for terminal, connections, is_start in (
            (NODES, self.begins, True),
            (NODES + 1, self.ends, False),
        ):
            for node, cost in connections.tolist():
                if cost < LIMIT and not flags[node] & 1:
                    key = (terminal, node) if is_start else (node, terminal)
                    edges[key] = min(edges.get(key, np.inf), cost)
        rows, columns = np.array(list(edges)).T
        graph = csr_array((list(edges.values()), (rows, columns)), shape=(NODES + 2, NODES + 2))
        return float(dijkstra(graph, indices=NODES)[NODES + 1])

    def check(self, found: tuple[int, int, int, Any]) -> None:
        cost, end, begin, nodes = found
        expected = self.compute_cheapest_cost()
        assert (cost if len(nodes) else np.inf) == expected
        if len(nodes):
            path = nodes[::-1].tolist()
            assert (path[0], path[-1]) == (self.begins[begin, 0], self.ends[end, 0])
            moves = sum(self.compute_move_cost(a, b) for a, b in itertools.pairwise(path))
            assert self.begins[begin, 1] + moves + self.ends[end, 1] == cost

    def remove_random_part(self, paths: Any, found: tuple[int, int, int, Any]) -> None:
        """Remove a random part of the path from both graphs."""
        _, end, begin, nodes = found
        flags, path = self.flags.reshape(-1), nodes[::-1].tolist()
        part = self.rng.integers(4)
        if part == 0 or (part == 1 and len(path) == 1):
            paths.close(np.array([end]), True)
            self.ends[end, 1] = LIMIT
        elif part == 1:
            k = int(self.rng.integers(len(path) - 1))
            kind = next(kind for kind in range(4) if self.get_target(path[k], kind) == path[k + 1])
            paths.shut(path[k], kind)
            flags[path[k] if kind in (0, 2) else path[k + 1]] |= 2 if kind < 2 else 4
        elif part == 2:
            node = int(self.rng.choice(path))
            paths.block(node)
            flags[node] |= 1
        else:
            paths.close(np.array([begin]), False)
            self.begins[begin, 1] = LIMIT


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))]
)
def test_cheapest_path_is_repaired_after_every_change(seed: int) -> None:
    graph = Graph(seed)
    paths, lengths = graph.make_paths(), []
    for _ in range(12):
        found = paths.cheapest(LIMIT)
        graph.check(found)
        fresh = graph.make_paths().cheapest(LIMIT)
        assert found[0] == fresh[0]
        np.testing.assert_array_equal(found[3], fresh[3])
        if not len(found[3]):
            break
        lengths.append(len(found[3]))
        assert paths.cheapest(found[0])[3].size == 0  # none costs less
        graph.remove_random_part(paths, found)
    assert max(lengths) > 2


def test_invalid_arguments_are_rejected() -> None:
    graph = Graph(0)
    paths = graph.make_paths()
    with pytest.raises(IndexError):
        paths.block(NODES)
    with pytest.raises(IndexError):
        paths.shut(0, 4)
    with pytest.raises(IndexError):
        paths.close(np.array([len(graph.ends)]), True)
    graph.costs[3, 2] = 0
    with pytest.raises(ValueError, match="cost"):
        graph.make_paths()
    graph.costs[3, 2], graph.begins[0, 0] = 1, -1
    with pytest.raises(IndexError):
        graph.make_paths()
