"""Compares lattice searches with SciPy's search of a graph of all states."""

from __future__ import annotations

from collections.abc import Callable

import coal
import numpy as np
import pytest
from helpers.base_scenes import MARGIN, make_chassis, make_clutter, make_pose
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.grid import HEADINGS, BaseGrid
from vkc_pin.planning.base_paths.lattice_search import find_cheapest_path
from vkc_pin.planning.base_paths.motion_primitives import (
    BACKWARDS,
    SIDEWAYS,
    SearchSpace,
    wrap_angle,
)

TURNING = 0.3  # [m/rad], default of a grid

CELLS, ROOM = 13, (-2.0, 2.0, -2.0, 2.0)
ENTRY = 0.6  # [m], maximum distance of start or goal to connected cells


def get_state_index(grid: BaseGrid, i: int, j: int, heading: int) -> int:
    return (i * grid.cells + j) * HEADINGS + heading % HEADINGS


def add_moves(grid: BaseGrid, add_edge: Callable[[int, int, float], None]) -> None:
    """Add the free moves between cells and the free turns."""
    turns = TURNING * np.abs(wrap_angle(np.roll(grid.yaws, -1) - grid.yaws))
    for i, j, heading in np.ndindex(grid.cells, grid.cells, HEADINGS):
        k, m = np.add((i, j), grid.moves[heading])
        here, left = (get_state_index(grid, i, j, heading + turn) for turn in (0, 1))
        if 0 <= k < grid.cells and 0 <= m < grid.cells and grid.is_move_free(i, j, heading):
            there, length = get_state_index(grid, k, m, heading), grid.lengths[heading]
            add_edge(here, there, length)
            add_edge(there, here, BACKWARDS * length)
        if grid.is_left_turn_free(i, j, heading):
            add_edge(here, left, turns[heading])
            add_edge(left, here, turns[heading])


def compute_drive(
    grid: BaseGrid, start: NDArray[np.float64], end: NDArray[np.float64], kind: int, default: float
) -> tuple[float, int]:
    """Return the cost of a drive between poses and the turns at its ends, infinite if blocked.

    A drive ahead (0) or backwards (1) has the heading of its line, or, if it is short or sideways
    (2), a default one. A missing heading at one of the ends, NaN, is the nearest of the grid, which
    is returned, too.
    """
    (a, before), (b, after) = ((pose[:2], pose[2]) for pose in (start, end))
    length = np.hypot(*(b - a))
    yaw = np.arctan2(*(b - a)[::-1]) if length > 1e-9 else default
    yaw = yaw + np.pi * kind if kind < 2 else default
    heading = int(np.abs(wrap_angle(grid.yaws - yaw)).argmin())
    before, after = (grid.yaws[heading] if np.isnan(one) else one for one in (before, after))
    yaw = before + wrap_angle(yaw - before)
    after = yaw + wrap_angle(after - yaw)
    free = (
        grid.is_turn_free(a, before, yaw)
        and grid.is_drive_free(a, b, yaw)
        and grid.is_turn_free(b, yaw, after)
    )
    turned = abs(yaw - before) + abs(after - yaw)
    cost = length * (1.0, BACKWARDS, SIDEWAYS)[kind] + TURNING * turned
    return float(cost) if free else np.inf, heading


def search_full_graph(
    grid: BaseGrid,
    start: NDArray[np.float64],
    goals: NDArray[np.float64],
    extra: NDArray[np.float64],
) -> float:
    """Return the cost of the cheapest path over a graph of all states, or infinity."""
    count, edges = grid.cells**2 * HEADINGS, dict[tuple[int, int], float]()
    first, last = count, count + 1
    radius = max(ENTRY, 1.5 * grid.step.max())

    def add_edge(a: int, b: int, cost: float) -> None:
        if cost < edges.get((a, b), np.inf):
            edges[a, b] = max(cost, 1e-12)

    add_moves(grid, add_edge)
    for i, j, kind in np.ndindex(grid.cells, grid.cells, 3):
        center = np.array([*grid.center(i, j), np.nan])
        if np.hypot(*(center - start)[:2]) <= radius:
            cost, heading = compute_drive(grid, start, center, kind, start[2])
            add_edge(first, get_state_index(grid, i, j, heading), cost)
        for goal, goal_cost in zip(goals, extra, strict=True):
            if np.hypot(*(center - goal)[:2]) <= radius and grid.is_pose_free(*goal):
                cost, heading = compute_drive(grid, center, goal, kind, goal[2])
                add_edge(get_state_index(grid, i, j, heading), last, cost + goal_cost)
    for goal, goal_cost in zip(goals, extra, strict=True):
        for kind in range(3):
            if kind < 2 or np.hypot(*(goal - start)[:2]) <= ENTRY:
                cost, _ = compute_drive(grid, start, goal, kind, start[2])
                add_edge(first, last, cost + goal_cost)
    a, b = np.array(list(edges)).T
    graph = csr_array((list(edges.values()), (a, b)), shape=(count + 2, count + 2))
    return float(dijkstra(graph, indices=first)[last])


def make_task(
    seed: int,
) -> tuple[BaseGrid, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return a small room with obstacles, a free start, three goals and their costs."""
    rng = np.random.default_rng(seed)
    rod: list[Shape] = [(coal.Box(0.1, 0.8, 0.05), make_pose(0.2, 0.0, 0.7))]
    obstacles = make_clutter(int(rng.integers(10_000)), 4, reach=1.8)
    # Ellipsoids block no cells in advance: only exact checks of a path find them.
    obstacles += [
        (coal.Ellipsoid(0.1, 0.15, 0.3), make_pose(*rng.uniform(-1.8, 1.8, 2), 0.2))
        for _ in range(8)
    ]
    grid = BaseGrid(
        make_chassis(0.7, 0.4),
        rod if seed % 2 else [],
        obstacles,
        ROOM,
        MARGIN,
        cells=CELLS,
        near=0.0,
    )
    poses = rng.uniform([-1.8, -1.8, -3.0], [1.8, 1.8, 3.0], size=(200, 3))
    start = next(pose for pose in poses if grid.is_pose_free(*pose))
    return grid, start, poses[100:103], rng.choice([0.0, 1.0], 3)


@pytest.mark.parametrize("seed", range(10))
def test_cheapest_path_is_found(seed: int) -> None:
    grid, start, goals, extra = make_task(seed)
    expected = search_full_graph(grid, start, goals, extra)
    fresh, *_ = make_task(seed)  # with empty caches
    found = find_cheapest_path(SearchSpace(fresh, start, goals), extra)
    assert (np.inf if found is None else found[0]) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_earlier_searches_do_not_change_the_result(seed: int) -> None:
    grid, start, goals, extra = make_task(seed)
    fresh, *_ = make_task(seed)
    rng = np.random.default_rng(seed)
    for each in (grid, fresh):
        each.near = 0.5
    for other in rng.uniform([-1.8, -1.8, -3.0], [1.8, 1.8, 3.0], size=(4, 3)):
        find_cheapest_path(SearchSpace(grid, other, goals[:2]), extra[:2])
        find_cheapest_path(SearchSpace(grid, start, other[None]), extra[:1])
    first, *others = (
        find_cheapest_path(SearchSpace(one, start, goals), extra) for one in (fresh, grid, grid)
    )
    for other in others:
        assert (first is None) == (other is None)
        if first is not None and other is not None:
            assert (*first[:2], first[3]) == (*other[:2], other[3])
            for drive, same in zip(first[2], other[2], strict=True):
                assert (*drive.a, *drive.b, drive.yaw) == (*same.a, *same.b, same.yaw)


def test_start_and_goal_may_be_cell_centers() -> None:
    """Connections have zero length and cost at both ends."""
    grid = BaseGrid(
        make_chassis(0.7, 0.4),
        [],
        [(coal.Box(0.2, 2.5, 1.0), make_pose(0.0, -0.75, 0.5))],
        ROOM,
        MARGIN,
        cells=CELLS,
        near=0.0,
    )
    start = np.array([*grid.center(2, 2), grid.yaws[4]])
    goals = np.array([[*grid.center(10, 2), grid.yaws[12]]])
    found = find_cheapest_path(SearchSpace(grid, start, goals), np.zeros(1))
    assert found is not None
    assert found[0] == pytest.approx(search_full_graph(grid, start, goals, np.zeros(1)), abs=1e-4)
    same = find_cheapest_path(SearchSpace(grid, start, start[None]), np.zeros(1))
    assert same is not None
    assert same[0] == 0.0


def test_path_may_be_much_longer_than_the_heuristic() -> None:
    """Only exact collision checks find the obstacle on the short path."""
    gate: list[Shape] = [(coal.Box(0.1, 1.4, 1.0), make_pose(0.0, y, 0.5)) for y in (-1.3, 1.3)]
    # Ellipsoids block no cells in advance.
    lid: list[Shape] = [(coal.Ellipsoid(0.1, 0.6, 0.1), make_pose(0.0, 0.0, 0.3))]
    walls: list[Shape] = [(coal.Box(8.0, 0.1, 1.0), make_pose(0.0, y, 0.5)) for y in (-2.0, 2.0)]
    sides = [(coal.Box(0.1, 1.4, 1.0), make_pose(0.0, 4.3, 0.5))]
    grid = BaseGrid(
        make_chassis(0.7, 0.4),
        [],
        [*gate, *lid, *walls[:1], *sides],
        (-5.0, 5.0, -5.0, 5.0),
        MARGIN,
        cells=50,
    )
    start, goals = np.array([-1.0, 0.0, 0.0]), np.array([[1.0, 0.0, 0.0]])
    found = find_cheapest_path(SearchSpace(grid, start, goals), np.zeros(1))
    assert found is not None
    assert found[0] > 4.0
    assert any(drive.b[1] > 2.0 for drive in found[2])
