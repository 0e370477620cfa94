from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.world.models.gripper import WIDTH_TOLERANCE, check_bar_fits, find_widest_bar


def make_walls(left: float, right: float) -> list[tuple[coal.CollisionGeometry, pin.SE3]]:
    """Return two walls with faces at given distances from the origin along x [m]."""
    return [
        (coal.Box(0.1, 1.0, 1.0), pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])))
        for x in (-left - 0.05, right + 0.05)
    ]


@pytest.mark.parametrize(("left", "right"), [(0.04, 0.04), (0.01, 0.04), (0.1, 0.02)])
def test_the_nearer_wall_limits_the_width(left: float, right: float) -> None:
    width = 2.0 * min(left, right)
    assert find_widest_bar(make_walls(left, right)) == pytest.approx(width, abs=WIDTH_TOLERANCE)
    assert check_bar_fits(width - 1e-5, make_walls(left, right))
    assert not check_bar_fits(width + 1e-5, make_walls(left, right))


def test_no_bar_fits_between_touching_walls() -> None:
    assert find_widest_bar(make_walls(-0.01, 0.04)) == 0.0


def test_shapes_beside_the_bar_are_ignored() -> None:
    shapes = [
        (shape, place * pin.SE3(np.eye(3), np.array([0.0, 0.6, 0.0])))
        for shape, place in make_walls(0.04, 0.04)
    ]
    assert find_widest_bar(shapes) > 0.4
