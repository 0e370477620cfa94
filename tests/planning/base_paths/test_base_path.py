"""Tests paths of bases that turn in place, checked with coal."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pytest
from helpers.base_scenes import (
    BLINK,
    HALL,
    MARGIN,
    compute_distance,
    interpolate_poses,
    make_arm_shapes,
    make_chassis,
    make_clutter,
    make_furniture,
    make_pose,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.base_path import BasePath, sample_poses, shortest_path
from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.planning.base_paths.motion_primitives import BACKWARDS, SIDEWAYS

TURNING = 0.3  # [m/rad] where a grid is not told

NEAR = 1.0


def make_wall_with_gap(width: float, *, height: float = 1.0) -> list[Shape]:
    """A wall along x = 0 from one side of the hall to the other, with a gap around y = 0."""
    side = 5.5 - width / 2
    return [
        (coal.Box(0.2, side, height), make_pose(0.0, sign * (width + side) / 2, height / 2))
        for sign in (-1, 1)
    ]


def check(
    path: BasePath,
    start: NDArray[np.float64],
    goals: NDArray[np.float64],
    base: list[Shape],
    carried: list[Shape],
    standing: list[Shape],
) -> None:
    """Check a path against coal, all shapes with all obstacles at poses a centimetre apart."""
    poses, goal = path.poses, goals[path.goal]
    np.testing.assert_array_equal(poses[0], start)
    np.testing.assert_array_equal(poses[-1][:2], goal[:2])
    assert (poses[-1, 2] - goal[2]) / (2 * np.pi) == pytest.approx(
        round((poses[-1, 2] - goal[2]) / (2 * np.pi)), abs=1e-12
    )
    cost = 0.0
    for a, b in itertools.pairwise(poses):
        way = b[:2] - a[:2]
        length = np.hypot(*way)
        if length > 1e-9:
            assert abs(a[2] - b[2]) < 1e-9
            ahead = way @ (np.cos(a[2]), np.sin(a[2]))
            if abs(ahead) == pytest.approx(length, abs=1e-9):
                cost += length * (1.0 if ahead > 0.0 else BACKWARDS)
            else:  # it slides beside start or goal
                assert length <= 0.6
                assert any(
                    np.array_equal(p[:2], place[:2]) for p in (a, b) for place in (start, goal)
                )
                cost += SIDEWAYS * length
        else:
            cost += TURNING * abs(b[2] - a[2])
        for pose in interpolate_poses(a, b):
            assert compute_distance(base, standing, pose) >= MARGIN - BLINK
            if min(np.hypot(*(pose[:2] - place[:2])) for place in [start, *goals]) > NEAR + 1e-9:
                assert compute_distance(carried, standing, pose) >= MARGIN - BLINK
    assert path.cost == pytest.approx(cost, abs=1e-9)


def find(
    standing: list[Shape],
    start: list[float],
    goals: list[list[float]],
    *,
    base: list[Shape] | None = None,
    **options: object,
) -> BasePath | None:
    """Return the path of a bare base."""
    grid = BaseGrid(base or make_chassis(), [], standing, HALL, MARGIN)
    return shortest_path(grid, start, np.array(goals), **options)  # type: ignore[arg-type]


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 2**32 - 1))
@example(280)  # a drive whose ends differ in heading by a rounding error
@example(955485)  # a move from near the start to near a goal, which in between is near neither
@pytest.mark.long
def test_paths_are_collision_free(seed: int) -> None:
    rng = np.random.default_rng(seed)
    standing = [*make_furniture(), *make_clutter(int(rng.integers(10_000)), 12)]
    grid = BaseGrid(make_chassis(), make_arm_shapes(), standing, HALL, MARGIN, near=NEAR)
    poses = rng.uniform([-4.5, -4.5, -7.0], [4.5, 4.5, 7.0], size=(100, 3))
    start = next(pose for pose in poses if grid.is_pose_free(*pose))
    goals = poses[-4:]
    path, plain = (shortest_path(grid, start, goals, smooth=smooth) for smooth in (True, False))
    assert (path is None) == (plain is None)
    if path is not None and plain is not None:
        assert path.cost <= plain.cost + 1e-9
        check(path, start, goals, make_chassis(), make_arm_shapes(), standing)
        check(plain, start, goals, make_chassis(), make_arm_shapes(), standing)


AHEAD = np.arctan2(3.7, 6.1)


@pytest.mark.parametrize(
    ("poses", "cost"),
    [
        (  # straight ahead
            [[-3.0, -2.0, 0.3], [-3.0, -2.0, AHEAD], [3.1, 1.7, AHEAD], [3.1, 1.7, -0.4]],
            np.hypot(6.1, 3.7) + TURNING * (2 * AHEAD + 0.1),
        ),
        ([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], BACKWARDS),
        ([[0.0, 0.0, 3.0], [0.0, 0.0, 2 * np.pi - 3.0]], TURNING * (2 * np.pi - 6.0)),
        ([[0.0, 0.0, 3.0], [0.0, 0.0, 3.0]], 0.0),
    ],
)
def test_shortest_paths_without_obstacles(poses: list[list[float]], cost: float) -> None:
    path = find([], poses[0], [poses[-1]])
    assert path is not None
    np.testing.assert_allclose(path.poses, poses, atol=1e-9)
    assert path.cost == pytest.approx(cost)
    assert sample_poses(path, 3, turning=TURNING)[-1] == pytest.approx(poses[-1])


def test_base_drives_sideways_along_a_wall() -> None:
    """In the open it turns instead."""
    walls: list[Shape] = [(coal.Box(3.0, 0.1, 1.0), make_pose(x, 0.0, 0.5)) for x in (-2.0, 2.0)]
    y = 0.05 + 0.335 + 0.03
    start, goals = np.array([-2.0, y, 0.0]), np.array([[2.0, y, 0.0]])
    path = find(walls, start, goals)  # type: ignore[arg-type]
    assert path is not None
    check(path, start, goals, make_chassis(), [], walls)
    free = find([], [0.0, 0.0, 0.0], [[0.0, 2.0, 0.0]])
    assert free is not None
    assert free.cost == pytest.approx(2.0 + TURNING * np.pi)


def test_narrow_gap_is_passed_lengthwise() -> None:
    standing, start, goals = (
        make_wall_with_gap(0.85),
        [-2.5, 1.0, np.pi / 2],
        [[2.5, -1.0, np.pi / 2]],
    )
    path = find(standing, start, goals)
    assert path is not None
    check(path, np.array(start), np.array(goals), make_chassis(), [], standing)
    assert find(standing, start, goals, base=make_chassis(1.0, 0.85)) is None
    assert find(make_wall_with_gap(1.2), start, goals, base=make_chassis(1.0, 0.85)) is not None


def test_load_does_not_fit_through_a_gap() -> None:
    standing, start, goals = (
        make_wall_with_gap(1.0),
        np.array([-2.5, 0.0, 0.0]),
        np.array([[2.5, 0.0, 0.0]]),
    )
    across: list[Shape] = [(coal.Box(0.05, 1.4, 0.05), make_pose(0.4, 0.0, 0.8))]
    along_it: list[Shape] = [(coal.Box(1.4, 0.05, 0.05), make_pose(0.4, 0.0, 0.8))]
    for carried, fits in (([], True), (along_it, True), (across, False)):
        path = shortest_path(
            BaseGrid(make_chassis(), carried, standing, HALL, MARGIN), start, goals
        )
        assert (path is not None) == fits
    low = shortest_path(
        BaseGrid(make_chassis(), across, make_wall_with_gap(1.0, height=0.6), HALL, MARGIN),
        start,
        goals,
    )
    assert low is not None  # it passes over


def test_only_the_base_counts_near_start_and_goals() -> None:
    """The arm reaches over tables at either end, but does not pass under a third."""
    rod: list[Shape] = [(coal.Box(0.4, 0.05, 0.4), make_pose(0.6, 0.0, 0.8))]
    tables = [(coal.Box(1.0, 2.0, 0.1), make_pose(x, 0.0, 0.85)) for x in (-3.5, 3.5)]
    start, goals = np.array([-2.5, 0.0, np.pi]), np.array([[2.5, 0.0, 0.0]])
    grid = BaseGrid(make_chassis(), rod, tables, HALL, MARGIN, near=NEAR)
    assert not grid.is_pose_free(*start)
    assert not grid.is_pose_free(*goals[0])
    path = shortest_path(grid, start, goals)
    assert path is not None
    check(path, start, goals, make_chassis(), rod, tables)
    between_them = [*tables, (coal.Box(0.4, 20.0, 0.1), make_pose(0.0, 0.0, 0.85))]
    for standing, near, is_free in (
        (between_them, NEAR, False),
        (between_them, 3.0, True),
        (tables, 0.0, False),
    ):
        grid = BaseGrid(make_chassis(), rod, standing, HALL, MARGIN, near=near)
        assert (shortest_path(grid, start, goals) is not None) == is_free


@pytest.mark.parametrize(
    ("block", "start", "goal", "clearance"),
    [
        ((4.0, 0.1), (0.0, -0.395), (0.0, 1.5), 0.01),  # within the margin of a wall
        ((1.0, 1.0), (-0.8, 0.0), (3.0, 0.0), -0.2),  # within a block
    ],
)
def test_blocked_start_is_left_the_short_way(
    block: tuple[float, float],
    start: tuple[float, float],
    goal: tuple[float, float],
    clearance: float,
) -> None:
    """The base does not cross the obstacle."""
    standing: list[Shape] = [(coal.Box(*block, 1.0), make_pose(0.0, 0.0, 0.5))]
    path = find(standing, [*start, 0.0], [[*goal, 0.0]])
    assert path is not None
    poses = np.concatenate([interpolate_poses(a, b) for a, b in itertools.pairwise(path.poses)])
    distances = np.array([compute_distance(make_chassis(), standing, pose) for pose in poses])
    assert distances[0] == pytest.approx(clearance, abs=0.01)
    assert clearance < 0.0 or distances.min() >= distances[0] - BLINK
    blocked = np.flatnonzero(distances < MARGIN - BLINK)
    assert (np.diff(blocked) == 1).all()
    axis = 1 if clearance > 0.0 else 0
    assert poses[blocked, axis].max() <= start[axis] + 1e-9
    assert len(blocked) < 200  # centimetres, or fiftieths of a radian
    assert path.cost > 4.0


def test_blocked_goals_are_skipped() -> None:
    block: list[Shape] = [(coal.Box(1.0, 1.0, 1.0), make_pose(2.0, 0.0, 0.5))]
    path = find(block, [0.0, 0.0, 0.0], [[2.0, 0.2, 0.0], [-4.0, 0.0, 1.0]])
    assert path is not None
    assert path.goal == 1


def test_additional_goal_costs_count() -> None:
    start, goals = [0.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]
    found = [
        find([], start, goals, costs=costs) for costs in (None, [0.0, 0.5], [1.5, 0.0], [1.5, 1.0])
    ]
    assert [path.goal for path in found if path is not None] == [0, 0, 1, 0]
    assert [path.cost for path in found if path is not None] == pytest.approx([1.0, 1.0, 2.0, 2.5])


def test_tasks_without_a_path() -> None:
    """Goals or start are blocked, or one of them is in a closed room."""
    block: list[Shape] = [(coal.Box(6.0, 6.0, 1.0), make_pose(0.0, 0.0, 0.5))]
    room: list[Shape] = [(coal.Box(3.0, 0.1, 1.0), make_pose(0.0, y, 0.5)) for y in (-1.5, 1.5)]
    room += [(coal.Box(0.1, 3.0, 1.0), make_pose(x, 0.0, 0.5)) for x in (-1.5, 1.5)]
    inside, outside = [0.0, 0.0, 0.0], [4.0, 4.0, 0.0]
    for standing in (block, room):
        assert find(standing, inside, [outside]) is None
        assert find(standing, outside, [inside]) is None
    assert find(room, [0.3, 0.0, 0.0], [[-0.3, 0.0, 2.0]]) is not None
    assert find([], [20.0, 0.0, 0.0], [outside]) is not None  # from outside the arena
    assert (
        shortest_path(BaseGrid(make_chassis(), [], [], HALL, MARGIN), inside, np.empty((0, 3)))
        is None
    )


@pytest.fixture(scope="module")
def around_the_block() -> BasePath:
    path = find(make_furniture(), [2.0, -4.3, 1.0], [[2.5, 2.8, 0.0], [1.3, 1.0, 0.0]])
    assert path is not None
    return path


def test_smoothing_removes_turns(around_the_block: BasePath) -> None:
    assert len(around_the_block.poses) <= 16
    assert 5.5 < around_the_block.cost < 8.5


@pytest.mark.parametrize("steps", [1, 7, 40])
def test_poses_are_sampled_along_a_path(around_the_block: BasePath, steps: int) -> None:
    path = around_the_block
    waypoints = sample_poses(path, steps, turning=TURNING)
    assert waypoints.shape == (steps, 3)
    np.testing.assert_array_equal(waypoints[-1], path.poses[-1])
    change = np.diff(path.poses, axis=0)
    passed = np.concatenate(
        [[0.0], np.cumsum(np.hypot(change[:, 0], change[:, 1]) + TURNING * np.abs(change[:, 2]))]
    )
    dense = np.linspace(0.0, passed[-1], 20_001)
    poses = np.column_stack([np.interp(dense, passed, column) for column in path.poses.T])
    nearest = [np.abs(poses - waypoint).max(axis=1).argmin() for waypoint in waypoints]
    assert np.abs(poses[nearest] - waypoints).max() < 1e-3
    assert np.all(np.diff(nearest) > 0)
    if steps == 40:  # it starts and ends slowly
        progress = np.diff(dense[[0, *nearest]])
        assert max(progress[0], progress[-1]) < 0.2 * progress.max()
