"""Compares blocked cells with coal."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from helpers.base_scenes import (
    HALL,
    MARGIN,
    compute_distance,
    make_arm_shapes,
    make_chassis,
    make_clutter,
    make_furniture,
    make_pose,
    make_wedge,
)

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.blocked_cells import Lattice, find_colliding_cells
from vkc_pin.planning.base_paths.grid import BaseGrid

CARRIED = [
    *make_arm_shapes(),
    (make_wedge(), make_pose(0.4, 0.4, 0.6, 0.4)),
    (coal.Box(0.05, 1.4, 0.05), make_pose(0.3, 0.0, 0.8)),
]
SCENES = {
    "furniture": make_furniture(),
    "clutter": [
        *make_furniture(),
        *make_clutter(3, 30),
        (make_wedge(), make_pose(-3.0, -3.0, 0.4, 1.0)),
        (coal.Ellipsoid(0.3, 0.2, 0.5), make_pose(0.0, 0.0, 0.5)),
    ],
}


@pytest.mark.parametrize("name", SCENES)
def test_blocked_cells_collide_and_few_are_missed(name: str) -> None:
    obstacles, rng = SCENES[name], np.random.default_rng(0)
    grid = BaseGrid(make_chassis(), CARRIED, obstacles, HALL, MARGIN)
    colliding, found = np.zeros(2), np.zeros(2)
    for i, j, heading in rng.integers([100, 100, 16], size=(400, 3)).tolist():
        pose = [*grid.center(i, j), grid.yaws[heading]]
        for body, (shapes, mask) in enumerate(
            ((make_chassis(), grid.blocked), (CARRIED, grid.carried_blocked))
        ):
            hit = compute_distance(shapes, obstacles, pose) < MARGIN
            assert hit or not mask[i, j, heading]
            colliding[body] += hit
            found[body] += mask[i, j, heading]
    assert colliding.min() > 25
    assert found[0] > 0.9 * colliding[0]
    assert found[1] > 0.4 * colliding[1]  # the base collides in most cells that are missed


BASE: list[Shape] = [(coal.Box(0.5, 0.5, 0.4), make_pose(0.0, 0.0, 0.2))]
LATTICE = Lattice(np.zeros(2), np.full(2, 0.1), 10, np.array([0.0, np.pi]))


def test_blocked_cells_of_a_box_near_a_wall() -> None:
    """A cell is blocked if the wall is closer than half the box plus the margin."""
    lattice = Lattice(np.array([0.05, 0.05]), np.array([0.1, 0.1]), 20, np.array([0.0, np.pi / 2]))
    wall: list[Shape] = [(coal.Box(0.2, 10.0, 1.0), make_pose(1.0, 1.0, 0.5))]
    box: list[Shape] = [(coal.Box(0.6, 0.3, 0.4), make_pose(0.0, 0.0, 0.2))]
    base, carried = find_colliding_cells(box, [], wall, lattice, MARGIN)
    x = 0.05 + 0.1 * np.arange(20)
    for heading, half in ((0, 0.3), (1, 0.15)):
        expected = np.abs(x - 1.0) < half + 0.1 + MARGIN - 1e-9
        np.testing.assert_array_equal(base[:, :, heading], np.tile(expected[:, None], (1, 20)))
    assert not carried.any()


@pytest.mark.parametrize(
    ("height", "z", "expected"),
    [
        (0.05, 0.775, (False, True)),
        (2.0, 1.0, (True, False)),  # above the outline of the colliding base
    ],
)
def test_shapes_collide_only_at_common_heights(
    height: float, z: float, expected: tuple[bool, bool]
) -> None:
    table: list[Shape] = [(coal.Box(5.0, 5.0, height), make_pose(0.5, 0.5, z))]
    high: list[Shape] = [(coal.Box(0.1, 0.1, 0.4), make_pose(0.0, 0.0, 0.7))]
    for cells, collide in zip(
        find_colliding_cells(BASE, high, table, LATTICE, MARGIN), expected, strict=True
    ):
        assert (cells == collide).all()


def test_flat_and_unsupported_shapes_are_ignored() -> None:
    ignored: list[Shape] = [
        (coal.Ellipsoid(1.0, 1.0, 1.0), make_pose(0.5, 0.5, 0.5)),
        (coal.Box(3.0, 3.0, 0.0), make_pose(0.5, 0.5, 0.1)),
    ]
    for base in (BASE, []):
        assert not find_colliding_cells(base, [], ignored, LATTICE, MARGIN)[0].any()
