"""Tests paths of bases that turn in place, checked with coal."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

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
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.base_path import BasePath, sample_poses, shortest_path
from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.planning.base_paths.motion_primitives import BACKWARDS, SIDEWAYS

TURNING = 0.3  # [m/rad], default of a grid

NEAR = 1.0


def make_wall_with_gap(width: float, *, height: float = 1.0) -> list[Shape]:
    """Return a wall along x = 0 across the hall, with a gap around y = 0."""
    side = 5.5 - width / 2
    return [
        (coal.Box(0.2, side, height), make_pose(0.0, sign * (width + side) / 2, height / 2))
        for sign in (-1, 1)
    ]


def check(
    path: BasePath | None,
    start: Sequence[float],
    goals: NDArray[np.float64],
    carried: list[Shape],
    obstacles: list[Shape],
) -> None:
    """Check ends, moves and cost of a path, and with coal its clearance every centimetre."""
    assert path is not None
    poses, goal = path.poses, goals[path.goal]
    np.testing.assert_array_equal(poses[0], start)
    np.testing.assert_array_equal(poses[-1][:2], goal[:2])
    turns = (poses[-1, 2] - goal[2]) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-12)
    ends, cost = [np.array(start), *goals], 0.0
    for a, b in itertools.pairwise(poses):
        displacement = b[:2] - a[:2]
        length = np.hypot(*displacement)
        if length > 1e-9:
            assert abs(a[2] - b[2]) < 1e-9
            forward = displacement @ (np.cos(a[2]), np.sin(a[2]))
            if abs(forward) == pytest.approx(length, abs=1e-9):
                cost += length * (1.0 if forward > 0.0 else BACKWARDS)
            else:  # a sideways drive next to start or goal
                assert length <= 0.6
                assert any(np.array_equal(p[:2], e[:2]) for p in (a, b) for e in (start, goal))
                cost += SIDEWAYS * length
        else:
            cost += TURNING * abs(b[2] - a[2])
        for pose in interpolate_poses(a, b):
            assert compute_distance(make_chassis(), obstacles, pose) >= MARGIN - MARGIN_TOLERANCE
            if min(np.hypot(*(pose[:2] - end[:2])) for end in ends) > NEAR + 1e-9:
                assert compute_distance(carried, obstacles, pose) >= MARGIN - MARGIN_TOLERANCE
    assert path.cost == pytest.approx(cost, abs=1e-9)


def find_path(
    obstacles: list[Shape],
    start: Sequence[float],
    *goals: Sequence[float],
    base: list[Shape] | None = None,
    carried: Sequence[Shape] = (),
    near: float = NEAR,
    costs: list[float] | None = None,
) -> BasePath | None:
    """Return the shortest path of a base."""
    grid = BaseGrid(base or make_chassis(), [*carried], obstacles, HALL, MARGIN, near=near)
    return shortest_path(grid, start, np.array(goals).reshape(-1, 3), costs=costs)


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 2**32 - 1))
@example(280)  # a drive whose ends differ in heading by a rounding error
@example(955485)  # a move from near the start to near a goal, with poses in between near neither
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
        for one in (path, plain):
            check(one, start, goals, make_arm_shapes(), standing)


HEADING = np.arctan2(3.7, 6.1)


@pytest.mark.parametrize(
    ("poses", "cost"),
    [
        (  # straight ahead
            [[-3.0, -2.0, 0.3], [-3.0, -2.0, HEADING], [3.1, 1.7, HEADING], [3.1, 1.7, -0.4]],
            np.hypot(6.1, 3.7) + TURNING * (2 * HEADING + 0.1),
        ),
        ([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], BACKWARDS),
        ([[0.0, 0.0, 3.0], [0.0, 0.0, 2 * np.pi - 3.0]], TURNING * (2 * np.pi - 6.0)),
        ([[0.0, 0.0, 3.0], [0.0, 0.0, 3.0]], 0.0),
    ],
)
def test_shortest_paths_without_obstacles(poses: list[list[float]], cost: float) -> None:
    path = find_path([], poses[0], poses[-1])
    assert path is not None
    np.testing.assert_allclose(path.poses, poses, atol=1e-9)
    assert path.cost == pytest.approx(cost)
    assert sample_poses(path, 3, turning=TURNING)[-1] == pytest.approx(poses[-1])


def test_base_drives_sideways_along_a_wall() -> None:
    """Without walls it turns instead."""
    walls: list[Shape] = [(coal.Box(3.0, 0.1, 1.0), make_pose(x, 0.0, 0.5)) for x in (-2.0, 2.0)]
    y = 0.05 + 0.335 + 0.03
    start, goal = [-2.0, y, 0.0], [2.0, y, 0.0]
    check(find_path(walls, start, goal), start, np.array([goal]), [], walls)
    free = find_path([], [0.0, 0.0, 0.0], [0.0, 2.0, 0.0])
    assert free is not None
    assert free.cost == pytest.approx(2.0 + TURNING * np.pi)


def test_narrow_gap_is_passed_lengthwise() -> None:
    walls, wide = make_wall_with_gap(0.85), make_chassis(1.0, 0.85)
    start, goal = [-2.5, 1.0, np.pi / 2], [2.5, -1.0, np.pi / 2]
    check(find_path(walls, start, goal), start, np.array([goal]), [], walls)
    assert find_path(walls, start, goal, base=wide) is None
    assert find_path(make_wall_with_gap(1.2), start, goal, base=wide) is not None


@pytest.mark.parametrize(
    ("size", "height", "fits"),
    [((1.4, 0.05), 1.0, True), ((0.05, 1.4), 1.0, False), ((0.05, 1.4), 0.6, True)],
    ids=["lengthwise", "across", "above the walls"],
)
def test_long_load_fits_through_a_gap_lengthwise_or_above_the_walls(
    size: tuple[float, float], height: float, fits: bool
) -> None:
    load: list[Shape] = [(coal.Box(*size, 0.05), make_pose(0.4, 0.0, 0.8))]
    walls, start = make_wall_with_gap(1.0, height=height), [-2.5, 0.0, 0.0]
    assert (find_path(walls, start, [2.5, 0.0, 0.0], carried=load) is not None) == fits


def test_only_the_base_counts_near_start_and_goals() -> None:
    """The load may overlap the tables at either end, but not a third one in between."""
    rod: list[Shape] = [(coal.Box(0.4, 0.05, 0.4), make_pose(0.6, 0.0, 0.8))]
    tables: list[Shape] = [(coal.Box(1.0, 2.0, 0.1), make_pose(x, 0.0, 0.85)) for x in (-3.5, 3.5)]
    ends = [[-2.5, 0.0, np.pi], [2.5, 0.0, 0.0]]
    assert all(compute_distance(rod, tables, end) < 0.0 for end in ends)
    path = find_path(tables, *ends, carried=rod)
    check(path, ends[0], np.array(ends[1:]), rod, tables)
    three_tables = [*tables, (coal.Box(0.4, 20.0, 0.1), make_pose(0.0, 0.0, 0.85))]
    for obstacles, near, is_free in (
        (three_tables, NEAR, False),
        (three_tables, 3.0, True),
        (tables, 0.0, False),
    ):
        path = find_path(obstacles, *ends, carried=rod, near=near)
        assert (path is not None) == is_free


@pytest.mark.parametrize(
    ("block", "start", "goal", "clearance"),
    [
        ((4.0, 0.1), (0.0, -0.395), (0.0, 1.5), 0.01),  # within the margin of a wall
        ((1.0, 1.0), (-0.8, 0.0), (3.0, 0.0), -0.2),  # within a block
    ],
)
def test_base_leaves_a_blocked_start_without_crossing_the_obstacle(
    block: tuple[float, float],
    start: tuple[float, float],
    goal: tuple[float, float],
    clearance: float,
) -> None:
    obstacles: list[Shape] = [(coal.Box(*block, 1.0), make_pose(0.0, 0.0, 0.5))]
    path = find_path(obstacles, [*start, 0.0], [*goal, 0.0])
    assert path is not None
    poses = np.concatenate([interpolate_poses(a, b) for a, b in itertools.pairwise(path.poses)])
    distances = np.array([compute_distance(make_chassis(), obstacles, pose) for pose in poses])
    assert distances[0] == pytest.approx(clearance, abs=0.01)
    assert clearance < 0.0 or distances.min() >= distances[0] - MARGIN_TOLERANCE
    blocked = np.flatnonzero(distances < MARGIN - MARGIN_TOLERANCE)
    assert (np.diff(blocked) == 1).all()
    axis = 1 if clearance > 0.0 else 0
    assert poses[blocked, axis].max() <= start[axis] + 1e-9
    assert len(blocked) < 200  # poses at most 1 cm or 0.02 rad apart
    assert path.cost > 4.0


@pytest.mark.parametrize(
    ("costs", "goal", "cost"),
    [
        (None, 1, 1.0),
        ([0.0, 0.0, 0.5], 1, 1.0),
        ([0.0, 1.5, 0.0], 2, 2.0),
        ([0.0, 1.5, 1.0], 1, 2.5),
    ],
)
def test_goal_costs_are_added_and_blocked_goals_are_skipped(
    costs: list[float] | None, goal: int, cost: float
) -> None:
    block: list[Shape] = [(coal.Box(1.0, 1.0, 1.0), make_pose(0.0, 2.0, 0.5))]
    goals = [[0.0, 2.2, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]
    path = find_path(block, [0.0, 0.0, 0.0], *goals, costs=costs)
    assert path is not None
    assert path.goal == goal
    assert path.cost == pytest.approx(cost)


def test_unreachable_goals_have_no_path() -> None:
    """Start or goal is blocked or in a closed room."""
    block: list[Shape] = [(coal.Box(6.0, 6.0, 1.0), make_pose(0.0, 0.0, 0.5))]
    room: list[Shape] = [(coal.Box(3.0, 0.1, 1.0), make_pose(0.0, y, 0.5)) for y in (-1.5, 1.5)]
    room += [(coal.Box(0.1, 3.0, 1.0), make_pose(x, 0.0, 0.5)) for x in (-1.5, 1.5)]
    inside, outside = [0.0, 0.0, 0.0], [4.0, 4.0, 0.0]
    for obstacles in (block, room):
        assert find_path(obstacles, inside, outside) is None
        assert find_path(obstacles, outside, inside) is None
    assert find_path(room, [0.3, 0.0, 0.0], [-0.3, 0.0, 2.0]) is not None
    assert find_path([], [20.0, 0.0, 0.0], outside) is not None  # start outside the arena
    assert find_path([], inside) is None


@pytest.fixture(scope="module")
def path_around_furniture() -> BasePath:
    path = find_path(make_furniture(), [2.0, -4.3, 1.0], [2.5, 2.8, 0.0], [1.3, 1.0, 0.0])
    assert path is not None
    return path


def test_smoothing_removes_turns(path_around_furniture: BasePath) -> None:
    assert len(path_around_furniture.poses) <= 16
    assert 5.5 < path_around_furniture.cost < 8.5


@pytest.mark.parametrize("steps", [1, 7, 40])
def test_poses_are_sampled_along_a_path(path_around_furniture: BasePath, steps: int) -> None:
    path = path_around_furniture
    waypoints = sample_poses(path, steps, turning=TURNING)
    assert waypoints.shape == (steps, 3)
    np.testing.assert_array_equal(waypoints[-1], path.poses[-1])
    change = np.abs(np.diff(path.poses, axis=0))
    travel = np.append(0.0, np.cumsum(np.hypot(*change.T[:2]) + TURNING * change[:, 2]))
    dense = np.linspace(0.0, travel[-1], 20_001)
    poses = np.column_stack([np.interp(dense, travel, column) for column in path.poses.T])
    nearest = [np.abs(poses - waypoint).max(axis=1).argmin() for waypoint in waypoints]
    assert np.abs(poses[nearest] - waypoints).max() < 1e-3
    assert np.all(np.diff(nearest) > 0)
    if steps == 40:  # the first and last steps are short
        progress = np.diff(dense[[0, *nearest]])
        assert max(progress[0], progress[-1]) < 0.2 * progress.max()
