"""Tests inscribed discs, cells that they block, and flood fills."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.base_scenes import compute_distance

from vkc_pin.planning.base_paths.base_clearance import Shape
from vkc_pin.planning.base_paths.reachable_floor import (
    CellGrid,
    InscribedDiscs,
    find_blocked_cells,
    flood_fill,
)


def make_box(
    size: tuple[float, float, float], at: tuple[float, float, float], yaw: float = 0.0
) -> Shape:
    return coal.Box(*size), pin.SE3(pin.utils.rotate("z", yaw), np.array(at))


BASE = [
    make_box((1.0, 0.5, 0.2), (0.0, 0.0, 0.2)),
    make_box((0.8, 0.1, 0.3), (0.0, 0.29, 0.15)),
    make_box((0.8, 0.1, 0.3), (0.0, -0.29, 0.15)),
]


APART = [make_box((0.4, 0.4, 0.2), (0.0, 0.0, 0.1)), make_box((0.4, 0.4, 0.2), (0.0, 0.5, 0.1))]


@pytest.mark.parametrize(
    ("shapes", "height", "radius"),
    [
        (BASE, 0.2, 0.335),
        (BASE, 0.299, 0.335),
        (BASE, 0.05, 0.0),  # between the wheels
        (BASE, 0.35, 0.0),
        (APART, 0.1, 0.195),
    ],
)
def test_disc_is_inscribed_in_the_union_of_shapes(
    shapes: list[Shape], height: float, radius: float
) -> None:
    assert max(InscribedDiscs(shapes).get_radius(height), 0.0) == pytest.approx(radius)


def test_only_obstacles_at_the_height_of_the_base_are_walls() -> None:
    discs, above, below, thin = InscribedDiscs(BASE), (0.1, 0.5), (0.04, 0.0), (0.01, 0.225)
    others = [make_box((1.0, 1.0, size), (0.0, 0.0, z)) for size, z in (above, below)]
    assert discs.make_walls(others) == []
    # Thinner than the spacing of levels.
    (plate,) = discs.make_walls([make_box((1.0, 1.0, thin[0]), (0.0, 0.0, thin[1]))])
    assert plate.radius == pytest.approx(0.335)
    assert InscribedDiscs([]).make_walls(BASE) == []


@pytest.mark.parametrize("seed", range(4))
def test_base_collides_in_blocked_cells_at_every_heading(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tilt, height = pin.rpy.rpyToMatrix(*rng.uniform(-0.6, 0.6, 3)), rng.uniform(0.1, 0.3)
    placement = pin.SE3(tilt, np.array([0.1, -0.2, height]))
    shape = [
        coal.Box(*rng.uniform(0.1, 0.8, 3)),
        coal.Cylinder(0.3, 0.3),
        coal.Sphere(0.2),
        coal.Capsule(0.1, 0.4),
    ][seed]
    cells, count = CellGrid.over(np.full(2, -1.5), np.full(2, 1.5), 0.05), 0
    for wall in InscribedDiscs(BASE).make_walls([(shape, placement)]):
        (rows, columns), is_blocked = find_blocked_cells(cells, wall, -0.05 * np.sqrt(0.5))
        x, y = cells.centers()
        for i, j in rng.permutation(np.argwhere(is_blocked))[:40].tolist():
            at = np.array([x[rows][i, 0], y[:, columns][0, j]]) + rng.uniform(-0.025, 0.025, 2)
            pose = [*at, rng.uniform(-np.pi, np.pi)]
            assert compute_distance(BASE, [(shape, placement)], pose) <= 0.0
            count += 1
    assert count > 40


def test_flood_fill_passes_corners_only_if_allowed() -> None:
    free, begin = np.diag([True, True, False]), np.zeros((3, 3), bool)
    begin[0, 0] = True
    assert flood_fill(free, begin, corners=True).sum() == 2
    assert flood_fill(free, begin, corners=False).sum() == 1


def test_flood_fill_may_begin_in_blocked_cells() -> None:
    begin = np.array([[False, False, True, False, False]])
    assert flood_fill(~begin, begin, corners=True).all()
