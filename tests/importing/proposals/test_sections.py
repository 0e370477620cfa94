from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.importing.proposals.sections import Piece, Section


def piece(geometry: coal.CollisionGeometry, placement: pin.SE3 | None = None) -> Piece:
    return Piece.from_shape(
        pin.GeometryObject("link_0", 0, 0, placement or pin.SE3.Identity(), geometry)
    )


angles = st.floats(-3.0, 3.0)


@settings(max_examples=40, deadline=None)
@given(roll=angles, pitch=angles, yaw=angles)
def test_the_axes_of_a_box_are_its_own_however_it_is_turned(
    roll: float, pitch: float, yaw: float
) -> None:
    rotation = pin.rpy.rpyToMatrix(roll, pitch, yaw)
    box = piece(coal.Box(0.5, 0.2, 0.05), pin.SE3(rotation, np.array([1.0, 2.0, 3.0])))
    assert np.allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-9)
    assert np.allclose(
        np.ptp(box.extents, axis=1), [0.5, 0.2, 0.05], rtol=0.031
    )  # as thin as along any, within 3 %


def test_a_round_bar_has_the_axes_of_its_frame() -> None:
    bar = piece(coal.Cylinder(0.01, 0.3))
    assert np.allclose(np.abs(bar.axes) @ np.ones(3), 1.0)
    assert np.allclose(np.abs(bar.axes[0]), [0.0, 0.0, 1.0])


def test_the_section_of_a_tilted_box_is_where_and_as_large_as_it_should_be() -> None:
    turn = pin.rpy.rpyToMatrix(0.0, 0.0, 0.7)
    box = piece(coal.Box(0.5, 0.2, 0.05), pin.SE3(turn, np.array([1.0, 0.0, 0.0])))
    section = box.cut(0, float(box.extents[0].mean()))
    assert section is not None
    assert np.allclose(section.centre, [1.0, 0.0, 0.0], atol=1e-9)
    widths = sorted(np.ptp(section.polygon, axis=0))
    assert widths == pytest.approx([0.05, 0.2])
    assert box.cut(0, float(box.extents[0, 1]) + 0.01) is None


SQUARE = Section(
    np.zeros(3),
    np.eye(3)[:2],
    np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.01,
)


def test_fingers_slip_off_corners_and_hold_on_faces() -> None:
    assert SQUARE.is_graspable(np.array([1.0, 0.0]))
    assert SQUARE.is_graspable(np.array([np.cos(0.3), np.sin(0.3)]))
    assert not SQUARE.is_graspable(np.array([1.0, 1.0]) / np.sqrt(2.0))


def test_what_is_before_a_limit_has_the_area_that_is_left() -> None:
    left = SQUARE.clip(np.array([1.0, 0.0]), -0.005)
    assert left is not None
    assert left.extent(np.array([1.0, 0.0])) == pytest.approx((-0.01, -0.005))
    assert left.extent(np.array([0.0, 1.0])) == pytest.approx((-0.01, 0.01))
    assert SQUARE.clip(np.array([1.0, 0.0]), -0.02) is None
    assert np.allclose(left.to_joint_frame(np.array([0.001, 0.002])), [0.001, 0.002, 0.0])
