"""Tests rectangles on the floor against coal's boxes, and paths between places."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.procedural.rooms.footprints import Floor, Frame, Rectangle
from vkc_pin.world.models.shapes import compute_shape_distance

LENGTHS = st.floats(0.1, 2.0)
RECTANGLES = st.builds(
    Rectangle, st.floats(-2, 2), st.floats(-2, 2), LENGTHS, LENGTHS, st.floats(-4, 4)
)


def make_box(one: Rectangle) -> tuple[coal.Box, pin.SE3]:
    return coal.Box(one.length, one.width, 1.0), pin.SE3(
        pin.rpy.rpyToMatrix(0.0, 0.0, one.yaw), np.array([one.x, one.y, 0.0])
    )


@given(RECTANGLES, RECTANGLES)
def test_gap_bounds_the_distance_from_below(one: Rectangle, other: Rectangle) -> None:
    distance = compute_shape_distance(*make_box(one), *make_box(other))
    gap = one.compute_gap(other)
    assert gap == pytest.approx(other.compute_gap(one))
    if distance > 1e-6:
        assert -1e-6 < gap < distance + 1e-6
    elif distance < -1e-6:
        assert gap < 1e-6


@given(RECTANGLES, st.floats(-3, 3), st.floats(-3, 3))
def test_distance_to_a_point_agrees_with_coal(one: Rectangle, x: float, y: float) -> None:
    point = coal.Sphere(1e-3), pin.SE3(np.eye(3), np.array([x, y, 0.0]))
    expected = max(compute_shape_distance(*make_box(one), *point) + 1e-3, 0.0)
    (found,) = one.compute_distances([[x, y]])
    assert found == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(
    ("side", "expected"), [(0, (3.0, 1.0)), (1, (-1.0, 2.0)), (2, (-3.0, -1.0)), (3, (1.0, -2.0))]
)
def test_wall_frames_point_out_of_the_room(side: int, expected: tuple[float, float]) -> None:
    frame = Floor(6.0, 4.0).make_wall_frame(side, 1.0)
    assert (frame.x, frame.y) == pytest.approx(expected)
    outward = np.subtract(frame.transform_point(0.5, 0.0), (frame.x, frame.y))
    middle = [(3.0, 0.0), (0.0, 2.0), (-3.0, 0.0), (0.0, -2.0)][side]
    assert outward == pytest.approx(0.5 * np.array(middle) / np.linalg.norm(middle))


def test_floor_contains_rectangles_between_the_walls() -> None:
    floor = Floor(4.0, 6.0)
    assert floor.contains(Rectangle(1.5, 2.5, 1.0, 1.0))
    assert not floor.contains(Rectangle(1.5, 2.5, 1.0, 1.0, 0.5))
    assert floor.find_free([], 0.5, [[1.4, 0.0], [1.6, 0.0], [0.0, 2.6]]).tolist() == [
        True,
        False,
        False,
    ]
    assert floor.find_free(
        [Rectangle(0.0, 0.0, 1.0, 1.0)], 0.5, [[0.9, 0.0], [1.1, 0.0]]
    ).tolist() == [
        False,
        True,
    ]


@pytest.mark.parametrize(("width", "expected"), [(2.4, True), (2.8, False)])
def test_passage_must_be_wide_enough_for_the_disc(width: float, expected: bool) -> None:
    """A wall across a room 4 m wide leaves a passage at one end."""
    barrier = Frame(2.0, 0.0, 0.0).make_rectangle((-width, 0.0), (-0.1, 0.1))
    assert Floor(4.0, 6.0).is_connected([barrier], 0.65, [(0.0, -2.0), (0.0, 2.0)]) is expected
    assert Floor(4.0, 6.0).is_connected([barrier], 0.65, [(0.0, -2.0), (0.5, -2.0)])
