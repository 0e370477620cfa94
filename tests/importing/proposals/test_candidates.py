from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.importing.proposals.candidates import (
    Candidate,
    Piece,
    Section,
    Thickness,
    find_candidates,
)
from vkc_pin.importing.proposals.hand import Hand

HAND = Hand("none", (), (), opening=0.086, tip=0.019, width=0.022)
UP = np.array([0.0, 0.0, 1.0])


def make_piece(geometry: coal.CollisionGeometry, placement: pin.SE3 | None = None) -> Piece:
    shape = pin.GeometryObject("link_0", 0, 0, placement or pin.SE3.Identity(), geometry)
    return Piece.from_shape(shape)


def find_grasps(piece: Piece) -> tuple[list[Candidate], Thickness]:
    thickness = Thickness()
    return list(find_candidates(piece, HAND, 0.005, UP, thickness)), thickness


def test_bar_is_grasped_around_its_middle() -> None:
    middle = np.array([0.1, 0.2, 0.3])
    grasps, _ = find_grasps(make_piece(coal.Cylinder(0.01, 0.3), pin.SE3(np.eye(3), middle)))
    bars = [
        grasp
        for grasp in grasps
        if grasp.kind == "bar" and np.allclose(grasp.placement.translation, middle)
    ]
    assert len(bars) == 8  # from all sides
    for grasp in bars:
        assert grasp.thickness == pytest.approx(0.02, rel=0.02)
        # The bar is the tool's y axis.
        assert abs(grasp.placement.rotation[2, 1]) == pytest.approx(1.0)
        assert grasp.span == pytest.approx((-0.15, 0.15))
        assert grasp.round == pytest.approx(1.6)


def test_panel_is_grasped_at_its_edges() -> None:
    grasps, thickness = find_grasps(make_piece(coal.Box(0.02, 0.6, 0.8)))
    assert {grasp.kind for grasp in grasps} == {"edge"}
    assert thickness.too_thick > 0
    for grasp in grasps:
        tool = grasp.placement.rotation
        assert abs(tool[0, 0]) == pytest.approx(1.0)  # the fingers close across the panel
        depth = abs(grasp.placement.translation @ tool[:, 2])
        assert np.isclose(depth, [0.28, 0.38]).any()  # 20 mm behind the edge
        assert grasp.round == 0.0


@settings(max_examples=30, deadline=None)
@given(size=st.tuples(*[st.floats(0.005, 0.3)] * 3), yaw=st.floats(-3.0, 3.0))
def test_every_grasp_fits_and_closes_upwards(size: tuple[float, float, float], yaw: float) -> None:
    rotation = pin.rpy.rpyToMatrix(0.0, 0.0, yaw)
    for grasp in find_grasps(make_piece(coal.Box(*size), pin.SE3(rotation, np.zeros(3))))[0]:
        assert grasp.thickness <= HAND.opening - 2 * 0.005 + 1e-12
        tool = grasp.placement.rotation
        assert np.allclose(tool.T @ tool, np.eye(3), atol=1e-9)
        assert np.linalg.det(tool) > 0.0
        assert tool[2, 0] >= -0.3 - 1e-9  # of two equivalent hands, the one that points up
        assert grasp.span[0] <= 0.0 <= grasp.span[1]
        # The fingers close on faces, not on corners.
        assert np.abs(rotation.T @ tool[:, 0]).max() > np.cos(np.radians(20.1))


angles = st.floats(-3.0, 3.0)


@settings(max_examples=40, deadline=None)
@given(roll=angles, pitch=angles, yaw=angles)
def test_axes_and_sections_of_a_rotated_box_are_found(
    roll: float, pitch: float, yaw: float
) -> None:
    """The widths are minimal within 3 %."""
    centre = np.array([1.0, 2.0, 3.0])
    placement = pin.SE3(pin.rpy.rpyToMatrix(roll, pitch, yaw), centre)
    box = make_piece(coal.Box(0.5, 0.2, 0.05), placement)
    assert np.allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-9)
    assert np.allclose(np.ptp(box.extents, axis=1), [0.5, 0.2, 0.05], rtol=0.031)
    section = box.compute_section(0, float(box.extents[0].mean()))
    assert section is not None
    assert np.allclose(section.centre, centre, atol=1e-3)
    assert np.ptp(section.polygon, axis=0) == pytest.approx([0.2, 0.05], rel=0.031)
    assert box.compute_section(0, float(box.extents[0, 1]) + 0.01) is None


def test_clipping_cuts_off_a_part_of_the_section() -> None:
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.01
    square = Section(np.zeros(3), np.eye(3)[:2], corners)
    clipped = square.clip(np.array([1.0, 0.0]), -0.005)
    assert clipped is not None
    assert clipped.extent(np.array([1.0, 0.0])) == pytest.approx((-0.01, -0.005))
    assert clipped.extent(np.array([0.0, 1.0])) == pytest.approx((-0.01, 0.01))
    assert square.clip(np.array([1.0, 0.0]), -0.02) is None
