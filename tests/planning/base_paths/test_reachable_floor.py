"""Tests inscribed discs, cells that they block, and flood fills."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

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


def test_disc_is_inscribed_in_the_union_of_shapes() -> None:
    discs = InscribedDiscs(BASE)
    assert discs.get_radius(0.2) == pytest.approx(0.335)
    assert discs.get_radius(0.299) == pytest.approx(0.335)
    assert discs.get_radius(0.05) <= 0.0  # between the wheels
    assert discs.get_radius(0.35) <= 0.0


def test_separate_shapes_do_not_extend_the_disc() -> None:
    apart = [make_box((0.4, 0.4, 0.2), (0.0, 0.0, 0.1)), make_box((0.4, 0.4, 0.2), (0.0, 0.5, 0.1))]
    assert InscribedDiscs(apart).get_radius(0.1) == pytest.approx(0.195)


def test_obstacles_above_or_below_the_base_are_no_walls() -> None:
    discs = InscribedDiscs(BASE)
    assert (
        discs.make_walls(
            [
                make_box((1.0, 1.0, 0.1), (0.0, 0.0, 0.5)),
                make_box((1.0, 1.0, 0.04), (0.0, 0.0, 0.0)),
            ]
        )
        == []
    )
    (plate,) = discs.make_walls(
        [make_box((1.0, 1.0, 0.01), (0.0, 0.0, 0.225))]
    )  # thinner than the spacing of levels
    assert plate.radius == pytest.approx(0.335)


def test_no_walls_without_base_or_obstacles() -> None:
    assert InscribedDiscs([]).make_walls([make_box((1.0, 1.0, 1.0), (0.0, 0.0, 0.5))]) == []
    assert InscribedDiscs(BASE).make_walls([]) == []


@pytest.mark.parametrize("seed", range(4))
def test_base_collides_in_blocked_cells_at_every_heading(seed: int) -> None:
    rng = np.random.default_rng(seed)
    placement = pin.SE3(
        pin.rpy.rpyToMatrix(*rng.uniform(-0.6, 0.6, 3)),
        np.array([0.1, -0.2, rng.uniform(0.1, 0.3)]),
    )
    shape = [
        coal.Box(*rng.uniform(0.1, 0.8, 3)),
        coal.Cylinder(0.3, 0.3),
        coal.Sphere(0.2),
        coal.Capsule(0.1, 0.4),
    ][seed]
    cells, count = CellGrid.over(np.full(2, -1.5), np.full(2, 1.5), 0.05), 0
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    for wall in InscribedDiscs(BASE).make_walls([(shape, placement)]):
        (rows, columns), is_blocked = find_blocked_cells(cells, wall, -0.05 * np.sqrt(0.5))
        x, y = cells.centers()
        for i, j in rng.permutation(np.argwhere(is_blocked))[:40].tolist():
            at = np.array([x[rows][i, 0], y[:, columns][0, j]]) + rng.uniform(-0.025, 0.025, 2)
            pose = pin.SE3(pin.utils.rotate("z", rng.uniform(-np.pi, np.pi)), np.array([*at, 0.0]))
            hit = False
            for part, local in BASE:
                result.clear()
                placed = pose * local
                transforms = [
                    coal.Transform3s(each.rotation, each.translation)
                    for each in (placed, placement)
                ]
                hit |= coal.collide(part, transforms[0], shape, transforms[1], request, result) > 0
            assert hit
            count += 1
    assert count > 40


def test_flood_fill_passes_corners_only_if_allowed() -> None:
    free = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 0]], bool)
    begin = np.zeros((3, 3), bool)
    begin[0, 0] = True
    assert flood_fill(free, begin, corners=True).sum() == 2
    assert flood_fill(free, begin, corners=False).sum() == 1


def test_flood_fill_may_begin_in_blocked_cells() -> None:
    free, begin = np.ones((1, 5), bool), np.zeros((1, 5), bool)
    free[0, 2], begin[0, 2] = False, True
    assert flood_fill(free, begin, corners=True).all()
