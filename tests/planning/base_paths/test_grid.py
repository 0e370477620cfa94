"""Compares free cells, moves and distances of a grid with coal and SciPy."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from helpers.base_scenes import (
    HALL,
    MARGIN,
    MARGIN_TOLERANCE,
    compute_distance,
    interpolate_poses,
    make_arm_shapes,
    make_chassis,
    make_clutter,
    make_furniture,
    make_pose,
)
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.grid import HEADINGS, BaseGrid

OBSTACLES = [*make_furniture(), *make_clutter(2, 20)]


@pytest.fixture(scope="module")
def grid() -> BaseGrid:
    return BaseGrid(make_chassis(), make_arm_shapes(), OBSTACLES, HALL, MARGIN)


def sample_states(count: int, seed: int) -> list[list[int]]:
    return np.random.default_rng(seed).integers([100, 100, HEADINGS], size=(count, 3)).tolist()


def test_moves_connect_cell_centers_along_their_headings(grid: BaseGrid) -> None:
    assert grid.center(0, 0) == pytest.approx((-4.95, -4.95))
    assert grid.center(99, 50) == pytest.approx((4.95, 0.05))
    assert np.all(np.diff(grid.yaws) > 0.0)
    for heading, yaw in enumerate(grid.yaws):
        ahead = np.subtract(grid.center(*(50 + grid.moves[heading])), grid.center(50, 50))
        assert ahead == pytest.approx(grid.lengths[heading] * np.array([np.cos(yaw), np.sin(yaw)]))


def test_free_cells_and_poses_agree_with_coal(grid: BaseGrid) -> None:
    answers = []
    for i, j, heading in sample_states(200, 0):
        pose = [*grid.center(i, j), grid.yaws[heading]]
        base, load = (
            compute_distance(shapes, OBSTACLES, pose) >= MARGIN
            for shapes in (make_chassis(), make_arm_shapes())
        )
        assert grid.is_cell_free(i, j, heading, reaching=True) == base
        assert grid.is_cell_free(i, j, heading) == (base and load)
        assert grid.is_pose_free(*pose) == (base and load)
        answers.append([base, load])
    assert np.all(np.mean(answers, axis=0) > 0.2)
    assert np.all(np.mean(answers, axis=0) < 0.9)
    assert [True, False] in answers


def test_arena_need_not_be_square() -> None:
    obstacles: list[Shape] = [(coal.Box(0.5, 0.5, 1.0), make_pose(4.0, 1.0, 0.5))]
    grid = BaseGrid(make_chassis(), [], obstacles, (0.0, 8.0, -1.0, 3.0), MARGIN, cells=40)
    assert grid.step == pytest.approx([0.2, 0.1])
    for i, j, heading in (np.array(sample_states(300, 0)) % 40).tolist():
        pose = [*grid.center(i, j), grid.yaws[heading % HEADINGS]]
        free = compute_distance(make_chassis(), obstacles, pose) >= MARGIN
        assert grid.is_cell_free(i, j, heading % HEADINGS) == free
        assert not (free and grid.blocked[i, j, heading % HEADINGS])


@pytest.mark.parametrize("reaching", [True, False])
def test_moves_between_cells_agree_with_coal(grid: BaseGrid, reaching: bool) -> None:
    shapes = make_chassis() if reaching else [*make_chassis(), *make_arm_shapes()]
    answers = []
    for i, j, heading in sample_states(15, 2):
        if not all(2 <= k < 98 for k in (i, j)):
            continue
        here, yaw = grid.center(i, j), grid.yaws[heading]
        there = grid.center(*(np.array([i, j]) + grid.moves[heading]))
        turned = grid.yaws[heading + 1] if heading < HEADINGS - 1 else 2 * np.pi
        for free, end in (
            (grid.is_move_free(i, j, heading, reaching=reaching), [*there, yaw]),
            (grid.is_left_turn_free(i, j, heading, reaching=reaching), [*here, turned]),
        ):
            poses = interpolate_poses([*here, yaw], end, angle=0.01)
            nearest = min(compute_distance(shapes, OBSTACLES, pose) for pose in poses)
            assert nearest >= MARGIN - MARGIN_TOLERANCE if free else nearest < MARGIN + 0.01
            answers.append(free)
    assert 0.2 < np.mean(answers) < 0.9


def test_distances_exclude_only_moves_known_to_be_blocked(grid: BaseGrid) -> None:
    """Distances equal those in a graph that is built move by move."""
    start = grid.center(30, 20)
    found = grid.compute_distances(np.array([start[:2]]))[0]
    edges = []
    for i, j, heading in np.ndindex(100, 100, HEADINGS):
        k, m = i + grid.moves[heading][0], j + grid.moves[heading][1]
        if 0 <= k < 100 and 0 <= m < 100:
            headings = [heading, (heading + HEADINGS // 2) % HEADINGS]
            if not (grid.blocked[i, j, headings] | grid.blocked[k, m, headings]).all():
                edges.append((100 * i + j, 100 * k + m, grid.lengths[heading]))
    rows, columns, lengths = zip(*edges, strict=True)
    graph = csr_array((lengths, (rows, columns)), shape=(10_000, 10_000))
    expected = dijkstra(graph, indices=3020).reshape(100, 100)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert found[30, 20] == 0.0
    assert np.isinf(found).sum() > 100
    assert grid.blocked[np.isinf(found)].any(axis=1).all()


def test_distances_from_several_positions_are_those_from_each(grid: BaseGrid) -> None:
    many = np.random.default_rng(0).uniform(-3.0, 3.0, (7, 2))
    alone = np.concatenate([grid.compute_distances(one[None]) for one in many])
    for threads in (1, 2, 9):
        np.testing.assert_array_equal(grid.compute_distances(many, threads=threads), alone)


def test_distances_from_a_blocked_position_are_finite_if_cells_are_free() -> None:
    for size, is_finite in ((2.0, True), (20.0, False)):
        block: list[Shape] = [(coal.Box(size, size, 1.0), make_pose(0.0, 0.0, 0.5))]
        grid = BaseGrid(make_chassis(), [], block, HALL, MARGIN)
        distances = grid.compute_distances(np.array([(0.7, 0.0)]))
        assert np.isfinite(distances).any() == is_finite
