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


def find_grasps(
    geometry: coal.CollisionGeometry, placement: pin.SE3 | None = None
) -> tuple[list[Candidate], Thickness]:
    thickness = Thickness()
    piece = Piece.from_shape(
        pin.GeometryObject("link_0", 0, 0, placement or pin.SE3.Identity(), geometry)
    )
    return list(find_candidates(piece, HAND, 0.005, UP, thickness)), thickness


def test_bar_is_grasped_around_its_middle() -> None:
    grasps, _ = find_grasps(coal.Cylinder(0.01, 0.3), pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.3])))
    bars = [
        grasp
        for grasp in grasps
        if grasp.kind == "bar"
        and np.linalg.norm(grasp.placement.translation - [0.1, 0.2, 0.3]) < 1e-6
    ]
    assert len(bars) == 8  # from all sides
    for grasp in bars:
        assert grasp.thickness == pytest.approx(0.02, rel=0.02)
        assert abs(grasp.placement.rotation[2, 1]) == pytest.approx(
            1.0
        )  # the bar is the tool's y axis
        assert grasp.span == pytest.approx((-0.15, 0.15))
        assert grasp.round == pytest.approx(1.6)


def test_panel_is_grasped_at_its_edges() -> None:
    grasps, thickness = find_grasps(coal.Box(0.02, 0.6, 0.8))
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
    for grasp in find_grasps(
        coal.Box(*size), pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), np.zeros(3))
    )[0]:
        assert grasp.thickness <= HAND.opening - 2 * 0.005 + 1e-12
        tool = grasp.placement.rotation
        assert np.allclose(tool.T @ tool, np.eye(3), atol=1e-9)
        assert np.linalg.det(tool) > 0.0
        assert tool[2, 0] >= -0.3 - 1e-9  # of two equivalent hands, the one that points up
        assert grasp.span[0] <= 0.0 <= grasp.span[1]


def make_piece(geometry: coal.CollisionGeometry, placement: pin.SE3 | None = None) -> Piece:
    return Piece.from_shape(
        pin.GeometryObject("link_0", 0, 0, placement or pin.SE3.Identity(), geometry)
    )


angles = st.floats(-3.0, 3.0)


@settings(max_examples=40, deadline=None)
@given(roll=angles, pitch=angles, yaw=angles)
def test_axes_of_a_rotated_box_are_found(roll: float, pitch: float, yaw: float) -> None:
    rotation = pin.rpy.rpyToMatrix(roll, pitch, yaw)
    box = make_piece(coal.Box(0.5, 0.2, 0.05), pin.SE3(rotation, np.array([1.0, 2.0, 3.0])))
    assert np.allclose(box.axes @ box.axes.T, np.eye(3), atol=1e-9)
    assert np.allclose(
        np.ptp(box.extents, axis=1), [0.5, 0.2, 0.05], rtol=0.031
    )  # minimum width, within 3 %


def test_section_of_a_rotated_box_is_computed() -> None:
    rotation = pin.rpy.rpyToMatrix(0.0, 0.0, 0.7)
    box = make_piece(coal.Box(0.5, 0.2, 0.05), pin.SE3(rotation, np.array([1.0, 0.0, 0.0])))
    section = box.compute_section(0, float(box.extents[0].mean()))
    assert section is not None
    assert np.allclose(section.centre, [1.0, 0.0, 0.0], atol=1e-9)
    widths = sorted(np.ptp(section.polygon, axis=0))
    assert widths == pytest.approx([0.05, 0.2])
    assert box.compute_section(0, float(box.extents[0, 1]) + 0.01) is None


SQUARE = Section(
    np.zeros(3),
    np.eye(3)[:2],
    np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.01,
)


def test_faces_are_graspable_and_corners_are_not() -> None:
    assert SQUARE.is_graspable(np.array([1.0, 0.0]))
    assert SQUARE.is_graspable(np.array([np.cos(0.3), np.sin(0.3)]))
    assert not SQUARE.is_graspable(np.array([1.0, 1.0]) / np.sqrt(2.0))


def test_clipping_cuts_off_a_part_of_the_section() -> None:
    clipped = SQUARE.clip(np.array([1.0, 0.0]), -0.005)
    assert clipped is not None
    assert clipped.extent(np.array([1.0, 0.0])) == pytest.approx((-0.01, -0.005))
    assert clipped.extent(np.array([0.0, 1.0])) == pytest.approx((-0.01, 0.01))
    assert SQUARE.clip(np.array([1.0, 0.0]), -0.02) is None
    assert np.allclose(clipped.to_joint_frame(np.array([0.001, 0.002])), [0.001, 0.002, 0.0])
