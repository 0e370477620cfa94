from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pinocchio as pin
from helpers.furniture import BAR, write_flap

import vkc_pin as vkc
from vkc_pin.importing.proposals.candidates import Candidate, Piece
from vkc_pin.importing.proposals.fitting import (
    Opening,
    find_named_handles,
    find_openings,
    score_grasp,
)

FRONT = np.column_stack(
    [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
)  # approaches along x, closes along y


def find_opening(name_or_path: str | Path) -> Opening:
    item = vkc.load_object(name_or_path)
    pieces: dict[int, list[Piece]] = {}
    for shape in item.collision.geometryObjects:
        pieces.setdefault(shape.parentJoint, []).append(Piece.from_shape(shape))
    return find_openings(item, pieces)[1]


def test_score_depends_on_leverage_side_and_name(tmp_path: Path) -> None:
    write_flap(tmp_path, BAR.format(""))
    hinge = find_opening(tmp_path / "flap.yaml")
    bar = Candidate(
        Piece("flap", "flap_1", np.zeros((0, 3)), np.zeros((0, 3), int)),
        "bar",
        pin.SE3.Identity(),
        0.02,
        (0, 0),
        0,
    )

    def score_at(
        *place: float, rotation: np.ndarray = FRONT, named: bool = False, grasp: Candidate = bar
    ) -> float:
        return score_grasp(grasp, pin.SE3(rotation, np.array(place)), hinge, named=named)

    best = score_at(-0.08, 0.55, 0.5)
    assert best > score_at(-0.08, 0.3, 0.5) > score_at(-0.08, 0.05, 0.5) > 0.0  # leverage
    assert best > score_at(-0.08, 0.55, 0.85)  # in the middle of the flap's height
    behind = FRONT @ np.diag([-1.0, 1.0, -1.0])
    assert best > score_at(
        -0.08, 0.55, 0.5, rotation=behind
    )  # the hand approaches from the opening side
    along = np.column_stack([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert best > 2.0 * score_at(-0.08, 0.55, 0.5, rotation=along)  # a bar along the pull slips
    assert score_at(-0.08, 0.55, 0.5, named=True) > best
    assert best > score_at(-0.08, 0.55, 0.5, grasp=dataclasses.replace(bar, kind="edge"))


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
