from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.importing.proposals.candidates import Candidate, Thickness, find_candidates
from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.importing.proposals.sections import Piece

HAND = Hand("none", (), (), opening=0.086, tip=0.019, width=0.022)
UP = np.array([0.0, 0.0, 1.0])


def found(
    geometry: coal.CollisionGeometry, placement: pin.SE3 | None = None
) -> tuple[list[Candidate], Thickness]:
    seen = Thickness()
    piece = Piece.from_shape(
        pin.GeometryObject("link_0", 0, 0, placement or pin.SE3.Identity(), geometry)
    )
    return list(find_candidates(piece, HAND, 0.005, UP, seen)), seen


def test_a_bar_is_taken_around_in_its_middle() -> None:
    grasps, _ = found(coal.Cylinder(0.01, 0.3), pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.3])))
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


def test_a_leaf_is_taken_at_its_edges() -> None:
    grasps, seen = found(coal.Box(0.02, 0.6, 0.8))
    assert {grasp.kind for grasp in grasps} == {"edge"}
    assert seen.too_thick > 0
    for grasp in grasps:
        tool = grasp.placement.rotation
        assert abs(tool[0, 0]) == pytest.approx(1.0)  # closes on the thickness
        depth = abs(grasp.placement.translation @ tool[:, 2])
        assert np.isclose(depth, [0.28, 0.38]).any()  # 20 mm behind the edge
        assert grasp.round == 0.0


def test_a_block_is_too_thick() -> None:
    grasps, seen = found(coal.Box(0.1, 0.1, 0.1))
    assert grasps == []
    assert seen.tried == seen.too_thick > 0
    assert seen.thinnest == pytest.approx(0.1)


@settings(max_examples=30, deadline=None)
@given(size=st.tuples(*[st.floats(0.005, 0.3)] * 3), yaw=st.floats(-3.0, 3.0))
def test_every_grasp_fits_and_closes_upwards(size: tuple[float, float, float], yaw: float) -> None:
    for grasp in found(coal.Box(*size), pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), np.zeros(3)))[
        0
    ]:
        assert grasp.thickness <= HAND.opening - 2 * 0.005 + 1e-12
        tool = grasp.placement.rotation
        assert np.allclose(tool.T @ tool, np.eye(3), atol=1e-9)
        assert np.linalg.det(tool) > 0.0
        assert tool[2, 0] >= -0.3 - 1e-9  # of two hands half a turn apart, the one that points up
        assert grasp.span[0] <= 0.0 <= grasp.span[1]
