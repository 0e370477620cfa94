from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.furniture import BAR, write_flap

import vkc_pin as vkc
from vkc_pin.importing.proposals.candidates import Piece, Thickness, find_candidates
from vkc_pin.importing.proposals.fitting import (
    GraspMotion,
    HandClearance,
    Obstruction,
    Opening,
    find_openings,
)
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.world.models.shapes import compute_clearance

FRONT = np.column_stack(
    [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
)  # approaches along x, closes along y


@pytest.fixture
def fitting(tmp_path: Path) -> HandClearance:
    return HandClearance(
        write_flap(tmp_path, BAR.format("")), make_hand(vkc.load_robot("husky_ur5e")), 0.02, 0.005
    )


def test_obstruction_is_named(fitting: HandClearance) -> None:
    middle = pin.SE3(FRONT, np.array([-0.08, 0.5, 0.5]))
    assert fitting.find_obstruction(middle, "flap") is None
    beside = pin.SE3(FRONT, np.array([-0.08, 0.535, 0.5]))
    assert fitting.find_obstruction(beside, "flap") == Obstruction("fingers", "flap")
    assert fitting.find_obstruction(
        pin.SE3(FRONT, np.array([0.0, 0.3, 0.5])), "case"
    ) == Obstruction("others", "flap")
    below = pin.SE3(
        np.column_stack([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        np.array([-0.3, 0.5, 0.15]),
    )
    assert fitting.find_obstruction(below, "flap") == Obstruction("floor")


def test_clearance_agrees_with_coal(fitting: HandClearance) -> None:
    """The hand moves on a line."""
    shapes, hand = fitting.item.collision.geometryObjects, fitting.hand
    data = fitting.item.model.createData()
    pin.forwardKinematics(fitting.item.model, data, fitting.item.coordinates.q(np.zeros(1)))
    groups = {
        name: [
            (s.geometry, data.oMi[s.parentJoint] * s.placement)
            for s in shapes
            if s.name.startswith(name)
        ]
        for name in ("case", "flap")
    }

    def is_free(x: float) -> bool:
        tool = pin.SE3(FRONT, np.array([x, 0.5, 0.5]))
        touch, others = (
            [(shape, tool * placement) for shape, placement in group]
            for group in (hand.touch, hand.others)
        )
        expected = (
            compute_clearance(touch, groups["flap"]) >= 0.005
            and compute_clearance([*touch, *others], groups["case"]) >= 0.02
            and compute_clearance(others, groups["flap"]) >= 0.02
        )
        assert (fitting.find_obstruction(tool, "flap") is None) == expected
        return expected

    places = np.linspace(-0.4, 0.1, 26).tolist()
    changes = [(a, b) for a, b in itertools.pairwise(places) if is_free(a) != is_free(b)]
    assert changes
    for one, other in changes:  # bisect to 0.1 mm
        before = is_free(one)
        while abs(other - one) > 1e-4:
            middle = (one + other) / 2.0
            one, other = (middle, other) if is_free(middle) == before else (one, middle)


def make_grasp_motion(folder: Path, **shapes: str) -> tuple[GraspMotion, Opening, HandClearance]:
    """Return a frontal grasp at the bar's middle, the flap's opening and the hand's clearance."""
    fitting = HandClearance(
        write_flap(folder, BAR.format(""), **shapes),
        make_hand(vkc.load_robot("husky_ur5e")),
        0.02,
        0.005,
    )
    pieces = {
        1: [
            Piece.from_shape(shape)
            for shape in fitting.item.collision.geometryObjects
            if shape.parentJoint == 1
        ]
    }
    bar = next(
        piece
        for piece in pieces[1]
        if np.ptp(piece.vertices[:, 0]) < 0.03 and np.ptp(piece.vertices[:, 1]) < 0.03
    )
    grasps = find_candidates(bar, fitting.hand, 0.005, np.array([0.0, 0.0, 1.0]), Thickness())
    front = next(
        g
        for g in grasps
        if g.placement.rotation[0, 2] > 0.99 and abs(g.placement.translation[2]) < 1e-6
    )
    return GraspMotion(fitting, front, 0.0), find_openings(fitting.item, pieces)[1], fitting


def make_box(position: str, size: str) -> str:
    shape = f'<geometry><box size="{size}"/></geometry>'
    return f'<collision><origin xyz="{position}"/>{shape}</collision>'


def test_free_bar_permits_sliding_and_turning(tmp_path: Path) -> None:
    hand, opening, fitting = make_grasp_motion(tmp_path)
    assert hand.follow(opening) == pytest.approx(1.5)
    assert np.allclose(fitting.state, 0.0)  # reset
    kind, freedoms = hand.freedoms()
    assert kind == "cylindrical"
    slide, turn = freedoms
    assert slide.upper == -slide.lower == pytest.approx(hand.slack)
    assert 0.12 <= slide.upper <= 0.15 - fitting.hand.width / 2
    assert turn.lower < -0.3
    assert turn.upper > 0.3


def test_obstacles_limit_slide_and_opening(tmp_path: Path) -> None:
    above = make_box("-0.15 0.5 0.68", "0.3 0.6 0.02")
    hand, opening, _ = make_grasp_motion(tmp_path, before=above)
    hand.follow(opening)
    slide = hand.freedoms()[1][0]
    assert slide.upper - slide.lower < 0.25
    assert hand.slack < 0.13
    wall = make_box("-0.5 -0.3 0.5", "0.4 0.02 1.0")
    hand, opening, _ = make_grasp_motion(tmp_path, before=wall)
    assert 0.5 < hand.follow(opening) <= 1.5
    shelf = make_box("-0.7 0.3 0.5", "0.4 0.8 1.0")
    hand, opening, _ = make_grasp_motion(tmp_path, before=shelf)
    assert hand.follow(opening) < 1.0
