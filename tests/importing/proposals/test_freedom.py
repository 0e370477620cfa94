from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.furniture import BAR, flap

import vkc_pin as vkc
from vkc_pin.importing.proposals.candidates import Thickness, find_candidates
from vkc_pin.importing.proposals.fitting import HandClearance
from vkc_pin.importing.proposals.freedom import GraspMotion
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.importing.proposals.ranking import Opening, find_openings
from vkc_pin.importing.proposals.sections import Piece


def grip(folder: Path, **what: str) -> tuple[GraspMotion, Opening, HandClearance]:
    """Return the hand at the middle of the bar, from the front."""
    fitting = HandClearance(
        flap(folder, BAR.format(""), **what), make_hand(vkc.load_robot("husky_ur5e")), 0.02, 0.005
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


def test_a_free_bar_can_be_slid_along_and_turned_about(tmp_path: Path) -> None:
    hand, opening, fitting = grip(tmp_path)
    assert hand.follow(opening) == pytest.approx(1.5)
    assert np.allclose(fitting.state, 0.0)  # put back
    kind, freedoms = hand.freedoms()
    assert kind == "cylindrical"
    slide, turn = freedoms
    assert slide.upper == -slide.lower == pytest.approx(hand.slack)
    assert 0.12 <= slide.upper <= 0.15 - fitting.hand.width / 2
    assert turn.lower < -0.3
    assert turn.upper > 0.3


def test_what_stands_beside_it_ends_the_slide_and_the_way(tmp_path: Path) -> None:
    above = '<collision><origin xyz="-0.15 0.5 0.68"/><geometry><box size="0.3 0.6 0.02"/></geometry></collision>'
    hand, opening, _ = grip(tmp_path, before=above)
    hand.follow(opening)
    slide = hand.freedoms()[1][0]
    assert slide.upper - slide.lower < 0.25
    assert hand.slack < 0.13
    wall = '<collision><origin xyz="-0.5 -0.3 0.5"/><geometry><box size="0.4 0.02 1.0"/></geometry></collision>'
    hand, opening, _ = grip(tmp_path, before=wall)
    assert 0.5 < hand.follow(opening) <= 1.5
    shelf = '<collision><origin xyz="-0.7 0.3 0.5"/><geometry><box size="0.4 0.8 1.0"/></geometry></collision>'
    hand, opening, _ = grip(tmp_path, before=shelf)
    assert hand.follow(opening) < 1.0


def test_what_stands_beside_it_ends_the_turn_also_where_it_is_free_behind(tmp_path: Path) -> None:
    post = '<collision><origin xyz="-0.2 0.66 0.5"/><geometry><box size="0.04 0.04 1.0"/></geometry></collision>'
    (_, free), (_, turn) = (
        grip(tmp_path, **what)[0].freedoms()[1] for what in ({}, {"before": post})
    )
    ends = sorted([-turn.lower, turn.upper])
    assert (
        ends[0] < 0.9 < ends[1] <= max(-free.lower, free.upper)
    )  # the post is at 0.9 rad to one side
    assert -free.lower > 0.9 < free.upper
