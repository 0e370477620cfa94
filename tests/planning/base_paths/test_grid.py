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
from vkc_pin.utils.optional_imports import import_compiled

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
            compute_distance(make_chassis(), OBSTACLES, pose),
            compute_distance(make_arm_shapes(), OBSTACLES, pose),
        )
        assert grid.is_cell_free(i, j, heading, reaching=True) == (base >= MARGIN)
        assert grid.is_cell_free(i, j, heading) == (min(base, load) >= MARGIN)
        assert grid.is_pose_free(*pose) == (min(base, load) >= MARGIN)
        answers.append([base >= MARGIN, load >= MARGIN])
    assert np.all(np.mean(answers, axis=0) > 0.2)
    assert np.all(np.mean(answers, axis=0) < 0.9)
    assert any(base and not load for base, load in answers)


@pytest.mark.parametrize("reaching", [True, False])
def test_moves_between_cells_agree_with_coal(grid: BaseGrid, reaching: bool) -> None:
    shapes = make_chassis() if reaching else [*make_chassis(), *make_arm_shapes()]
    answers = []
    for i, j, heading in sample_states(15, 2):
        if not all(2 <= k < 98 for k in (i, j)):
            continue
        here, yaw = grid.center(i, j), grid.yaws[heading]
        there = grid.center(i + grid.moves[heading][0], j + grid.moves[heading][1])
        turned = grid.yaws[heading + 1] if heading < HEADINGS - 1 else 2 * np.pi
        for free, end in (
            (grid.is_move_free(i, j, heading, reaching=reaching), [*there, yaw]),
            (grid.is_left_turn_free(i, j, heading, reaching=reaching), [*here, turned]),
        ):
            nearest = min(
                compute_distance(shapes, OBSTACLES, pose)
                for pose in interpolate_poses([*here, yaw], end, angle=0.01)
            )
            assert nearest >= MARGIN - MARGIN_TOLERANCE if free else nearest < MARGIN + 0.01
            answers.append(free)
    assert 0.2 < np.mean(answers) < 0.9


def test_distances_exclude_only_moves_known_to_be_blocked(grid: BaseGrid) -> None:
    """Distances equal those in a graph that is built move by move."""
    start = grid.center(30, 20)
    found = grid.compute_distances(np.array([start[:2]]))[0]
    rows, columns, lengths = [], [], []
    for i, j in np.ndindex(100, 100):
        for heading in range(HEADINGS):
            k, m = i + grid.moves[heading][0], j + grid.moves[heading][1]
            if not (0 <= k < 100 and 0 <= m < 100):
                continue
            back = (heading + HEADINGS // 2) % HEADINGS
            if any(
                not grid.blocked[i, j, h] and not grid.blocked[k, m, h] for h in (heading, back)
            ):
                rows.append(100 * i + j)
                columns.append(100 * k + m)
                lengths.append(grid.lengths[heading])
    graph = csr_array((lengths, (rows, columns)), shape=(10_000, 10_000))
    expected = dijkstra(graph, indices=3020).reshape(100, 100)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert found[30, 20] == 0.0
    assert np.isinf(found).sum() > 100
    assert grid.blocked[np.isinf(found)].any(axis=1).all()


def test_distances_lead_around_a_wall() -> None:
    wall: list[Shape] = [(coal.Box(0.1, 8.0, 1.0), make_pose(0.0, -1.0, 0.5))]
    grid = BaseGrid(make_chassis(), [], wall, HALL, MARGIN)
    found = grid.compute_distances(np.array([(-2.0, -3.0)]))[0]
    corner = np.array([0.0, 3.0 + 0.335])
    around = np.hypot(*(corner - (-2.0, -3.0))) + np.hypot(*(corner - grid.center(69, 20)))
    assert around < found[69, 20] < 1.1 * around
    assert found[20, 20] < 1.2
    several = grid.compute_distances(np.array([(-2.0, -3.0), (3.0, 3.0)]))
    np.testing.assert_array_equal(several[0], found)
    assert several[1, 80, 80] < 0.1
    many = np.random.default_rng(0).uniform(-3.0, 3.0, (7, 2))
    for threads in (2, 9):
        np.testing.assert_array_equal(
            grid.compute_distances(many, threads=threads), grid.compute_distances(many)
        )


def test_distances_from_a_blocked_position_are_finite_if_cells_are_free() -> None:
    for size, is_finite in ((2.0, True), (20.0, False)):
        block: list[Shape] = [(coal.Box(size, size, 1.0), make_pose(0.0, 0.0, 0.5))]
        grid = BaseGrid(make_chassis(), [], block, HALL, MARGIN)
        distances = grid.compute_distances(np.array([(0.7, 0.0)]))
        assert np.isfinite(distances).any() == is_finite


def test_moves_without_positive_lengths_are_rejected(grid: BaseGrid) -> None:
    floor = import_compiled("vkc_pin.planning.base_paths._driving").Floor
    for lengths in (np.zeros(HEADINGS), -grid.lengths, np.full(HEADINGS, np.nan)):
        with pytest.raises(ValueError, match="lead"):
            floor(grid.blocked.view(np.uint8), grid.moves, lengths)


def test_arena_need_not_be_square() -> None:
    obstacles: list[Shape] = [(coal.Box(0.5, 0.5, 1.0), make_pose(4.0, 1.0, 0.5))]
    grid = BaseGrid(make_chassis(), [], obstacles, (0.0, 8.0, -1.0, 3.0), MARGIN, cells=40)
    assert grid.step == pytest.approx([0.2, 0.1])
    for i, j, heading in sample_states(300, 0):
        i, j = i % 40, j % 40
        pose = [*grid.center(i, j), grid.yaws[heading]]
        free = compute_distance(make_chassis(), obstacles, pose) >= MARGIN
        assert grid.is_cell_free(i, j, heading) == free
        assert not (free and grid.blocked[i, j, heading])
