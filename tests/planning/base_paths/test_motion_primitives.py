"""Tests drives, turns and connections of start and goals with the grid."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from helpers.base_scenes import HALL, MARGIN, make_chassis, make_pose

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.planning.base_paths.motion_primitives import (
    BACKWARDS,
    SIDEWAYS,
    UNIT,
    Drive,
    SearchSpace,
    wrap_angle,
)

TURNING = 0.3  # [m/rad], default of a grid

START = np.array([0.0, 0.0, 0.0])


def make_space(
    obstacles: list[Shape],
    goals: list[list[float]],
    *,
    carried: list[Shape] | None = None,
    near: float = 1.0,
) -> SearchSpace:
    grid = BaseGrid(make_chassis(), carried or [], obstacles, HALL, MARGIN, near=near)
    return SearchSpace(grid, START, np.array(goals))


@pytest.mark.parametrize(
    ("angle", "factor"), [(0.0, 1.0), (np.pi, BACKWARDS), (0.1, SIDEWAYS), (np.pi / 2, SIDEWAYS)]
)
def test_drive_cost_depends_on_the_direction(angle: float, factor: float) -> None:
    drive = Drive(np.zeros(2), np.array([4.0, 3.0]), np.arctan2(3.0, 4.0) + angle)
    assert drive.length == 5.0
    assert drive.cost == pytest.approx(5.0 * factor)


def test_cells_near_start_and_goals_are_marked() -> None:
    space = make_space([], [[3.0, 3.0, 0.0]])
    for i, j in np.ndindex(100, 100):
        center = space.grid.center(i, j)
        near = [np.hypot(*np.subtract(center, place)) <= 1.0 for place in ((0.0, 0.0), (3.0, 3.0))]
        assert space.near[i, j] == (0 if near[0] else 1 if near[1] else -1)
    assert np.all(make_space([], [[3.0, 3.0, 0.0]], near=0.0).near == -1)


def test_start_and_goals_are_connected_to_the_cells_around_them() -> None:
    space = make_space([], [[3.0, 3.0, 1.0]])
    starts, ends = space.get_starts(), space.get_ends(0)
    assert len(np.unique(starts.cell)) == np.sum(
        [np.hypot(*np.subtract(space.center(c), (0, 0))) <= 0.6 for c in range(10_000)]
    )
    for connections, leaving in ((starts, True), (ends, False)):
        kinds = set()
        for k in range(len(connections.cell)):
            heading = float(space.grid.yaws[connections.heading[k]])
            drive, after = (
                space.get_start_drive(connections, k)
                if leaving
                else space.get_goal_drive(connections, k, 0, heading)
            )
            before = 0.0 if leaving else heading
            expected = drive.cost + TURNING * (abs(drive.yaw - before) + abs(after - drive.yaw))
            assert connections.cost[k] * UNIT == pytest.approx(expected, abs=2 * UNIT)
            assert abs(wrap_angle(after - (heading if leaving else 1.0))) < 1e-9
            np.testing.assert_array_equal(
                drive.a if leaving else drive.b, [0.0, 0.0] if leaving else [3.0, 3.0]
            )
            np.testing.assert_array_equal(
                drive.b if leaving else drive.a, space.center(connections.cell[k])
            )
            kinds.add(round(drive.cost / drive.length, 6))
        assert kinds == {1.0, BACKWARDS, SIDEWAYS}


def test_connections_without_space_to_turn_are_omitted() -> None:
    walls: list[Shape] = [(coal.Box(4.0, 0.1, 1.0), make_pose(0.0, y, 0.5)) for y in (-0.55, 0.55)]
    space = make_space(walls, [[3.0, 0.0, 0.0]])
    turns = np.abs(wrap_angle(2 * space.get_starts().yaw)) / 2  # relative to ahead or back
    assert len(turns) > 0
    assert turns.max() < 0.5
    assert make_space([], [[3.0, 0.0, 0.0]]).get_starts().yaw.max() > 1.5


def test_blocked_start_has_exit_margins() -> None:
    close, overlapping = [(coal.Box(1.0, 1.0, 1.0), make_pose(x, 0.0, 0.5)) for x in (1.01, 0.9)]
    free, near, inside = (
        make_space([], [[3.0, 0.0, 0.0]]),
        make_space([close], [[3.0, 0.0, 0.0]]),
        make_space([overlapping], [[-0.9, 0.0, 0.0]]),
    )
    assert free.exit_margins is None
    assert near.exit_margins is not None
    assert near.exit_margins == pytest.approx([0.01], abs=1e-5)
    assert near.exit_cost == 1.0
    assert inside.exit_margins is not None
    assert inside.exit_margins[0] == -np.inf
    assert inside.exit_cost > 1.0
    long_drive = near.get_direct_drive(0, 1)
    assert long_drive is None  # too far for a blocked start
    short_drive = inside.get_direct_drive(0, 1)
    assert short_drive is not None
    assert inside.is_sweep_free(0.0, *short_drive, inside.exit_margins)
    assert not inside.is_sweep_free(0.0, *short_drive)


def test_load_is_checked_away_from_start_and_goals() -> None:
    rod: list[Shape] = [(coal.Box(0.05, 2.0, 0.05), make_pose(0.0, 0.0, 0.8))]
    post: list[Shape] = [(coal.Box(0.1, 0.1, 1.0), make_pose(x, 0.9, 0.5)) for x in (0.0, 2.0)]
    space = make_space(post, [[4.0, 0.0, 0.0]], carried=rod)
    assert space.is_pose_free(START)
    assert not space.is_pose_free(np.array([2.0, 0.0, 0.0]))
    assert space.is_drive_free(Drive(np.array([-0.5, 0.0]), np.array([0.5, 0.0]), 0.0))
    assert not space.is_drive_free(Drive(np.array([0.5, 0.0]), np.array([3.5, 0.0]), 0.0))
    assert space.is_turn_free(START[:2], 0.0, 3.0)
    assert not space.is_turn_free(np.array([2.0, 0.0]), 0.3, 3.3)
    assert not space.looks_free(Drive(np.array([0.5, 0.0]), np.array([3.5, 0.0]), 0.0))
    assert space.looks_free(Drive(np.array([-0.5, 0.0]), np.array([0.5, 0.0]), 0.0))
