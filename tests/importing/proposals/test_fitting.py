from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.furniture import BAR, write_flap
from helpers.texts import format_box

import vkc_pin as vkc
from vkc_pin.importing.proposals.candidates import Candidate, Piece, Thickness, find_candidates
from vkc_pin.importing.proposals.fitting import (
    GraspMotion,
    HandClearance,
    Obstruction,
    Opening,
    find_named_handles,
    find_openings,
    score_grasp,
)
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.world.models.shapes import compute_clearance

# Approaches along x, closes along y
FRONT = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def make_fitting(folder: Path, **shapes: str) -> HandClearance:
    """Return the clearance of a hand at a flap with a bar."""
    flap = write_flap(folder, BAR.format(""), **shapes)  # type: ignore[arg-type]
    return HandClearance(flap, make_hand(vkc.load_robot("husky_ur5e")), 0.02, 0.005)


@pytest.fixture
def fitting(tmp_path: Path) -> HandClearance:
    return make_fitting(tmp_path)


def test_obstruction_is_named(fitting: HandClearance) -> None:
    from_below = np.column_stack([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for rotation, place, link, expected in (
        (FRONT, (-0.08, 0.5, 0.5), "flap", None),
        (FRONT, (-0.08, 0.535, 0.5), "flap", Obstruction("fingers", "flap")),
        (FRONT, (0.0, 0.3, 0.5), "case", Obstruction("others", "flap")),
        (from_below, (-0.3, 0.5, 0.15), "flap", Obstruction("floor")),
    ):
        assert fitting.find_obstruction(pin.SE3(rotation, np.array(place)), link) == expected


def test_clearance_agrees_with_coal(fitting: HandClearance) -> None:
    """The hand moves on a line."""
    shapes, hand = fitting.item.collision.geometryObjects, fitting.hand
    data = fitting.item.model.createData()
    pin.forwardKinematics(fitting.item.model, data, fitting.item.coordinates.q(np.zeros(1)))
    groups: dict[str, list[Any]] = {"case": [], "flap": []}
    for shape in shapes:
        placed = shape.geometry, data.oMi[shape.parentJoint] * shape.placement
        groups[shape.name.partition("_")[0]].append(placed)

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
    fitting = make_fitting(folder, **shapes)
    moving = [each for each in fitting.item.collision.geometryObjects if each.parentJoint == 1]
    pieces = {1: list(map(Piece.from_shape, moving))}
    bar = pieces[1][1]
    grasps = find_candidates(bar, fitting.hand, 0.005, np.array([0.0, 0.0, 1.0]), Thickness())
    front = next(
        g
        for g in grasps
        if g.placement.rotation[0, 2] > 0.99 and abs(g.placement.translation[2]) < 1e-6
    )
    return GraspMotion(fitting, front, 0.0), find_openings(fitting.item, pieces)[1], fitting


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
    above = format_box("0.3 0.6 0.02", "-0.15 0.5 0.68")
    hand, opening, _ = make_grasp_motion(tmp_path, before=above)
    hand.follow(opening)
    slide = hand.freedoms()[1][0]
    assert slide.upper - slide.lower < 0.25
    assert hand.slack < 0.13
    wall = format_box("0.4 0.02 1.0", "-0.5 -0.3 0.5")
    hand, opening, _ = make_grasp_motion(tmp_path, before=wall)
    assert 0.5 < hand.follow(opening) <= 1.5
    shelf = format_box("0.4 0.8 1.0", "-0.7 0.3 0.5")
    hand, opening, _ = make_grasp_motion(tmp_path, before=shelf)
    assert hand.follow(opening) < 1.0


def test_score_depends_on_leverage_side_and_name(tmp_path: Path) -> None:
    _, hinge, fitting = make_grasp_motion(tmp_path)
    bar = Piece.from_shape(fitting.item.collision.geometryObjects[-1])

    def score_at(
        y: float = 0.55,
        z: float = 0.5,
        rotation: np.ndarray = FRONT,
        *,
        kind: str = "bar",
        named: bool = False,
    ) -> float:
        grasp = Candidate(bar, kind, pin.SE3.Identity(), 0.02, (0, 0), 0)
        tool = pin.SE3(rotation, np.array([-0.08, y, z]))
        return score_grasp(grasp, tool, hinge, named=named)

    best = score_at()
    assert best > score_at(y=0.3) > score_at(y=0.05) > 0.0  # leverage
    assert best > score_at(z=0.85)  # in the middle of the flap's height
    # The hand approaches from the opening side.
    assert best > score_at(rotation=FRONT @ np.diag([-1.0, 1.0, -1.0]))
    along = np.column_stack([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert best > 2.0 * score_at(rotation=along)  # a bar along the pull slips
    assert score_at(named=True) > best
    assert best > score_at(kind="edge")


def test_handles_are_named_by_elements_and_meshes() -> None:
    text = """<robot><link name="door"><collision/><collision name="Handle-3"/>
    <collision><geometry><mesh filename="meshes/knob_7.obj"/></geometry></collision></link>
    <link name="lever"><collision/></link></robot>"""
    assert find_named_handles(ElementTree.fromstring(text)) == {
        "door_0": False,
        "door_1": True,
        "door_2": True,
        "lever_0": True,
    }
