from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.furniture import BAR, flap

import vkc_pin as vkc
from vkc_pin.importing.proposals.fitting import HandClearance, Obstruction
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.world.models.shapes import compute_clearance

FRONT = np.column_stack(
    [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
)  # approaches along x, closes along y


@pytest.fixture
def fitting(tmp_path: Path) -> HandClearance:
    return HandClearance(
        flap(tmp_path, BAR.format("")), make_hand(vkc.load_robot("husky_ur5e")), 0.02, 0.005
    )


def test_a_hand_around_a_bar_has_room(fitting: HandClearance) -> None:
    assert fitting.find_obstruction(pin.SE3(FRONT, np.array([-0.08, 0.5, 0.5])), "flap") is None


def test_what_is_in_the_way_is_named(fitting: HandClearance) -> None:
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


def test_the_object_is_where_its_joints_are(fitting: HandClearance) -> None:
    tool = pin.SE3(FRONT, np.array([-0.08, 0.5, 0.5]))
    fitting.place(np.array([1.2]))
    assert (
        fitting.find_obstruction(pin.SE3(FRONT, np.array([-0.14, 0.5, 0.5])), "case") is None
    )  # the flap has gone
    hinge = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    turned = hinge * pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 1.2), np.zeros(3)) * hinge.inverse()
    assert fitting.find_obstruction(turned * tool, "flap") is None


def test_clearance_is_that_of_coal(fitting: HandClearance) -> None:
    """A hand at places on a line: blocked if and only if coal finds it closer than the options allow."""
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

    def free(x: float) -> bool:
        tool = pin.SE3(FRONT, np.array([x, 0.5, 0.5]))
        touch, others = (
            [(shape, tool * where) for shape, where in group] for group in (hand.touch, hand.others)
        )
        found = (
            compute_clearance(touch, groups["flap"]) >= 0.005
            and compute_clearance([*touch, *others], groups["case"]) >= 0.02
            and compute_clearance(others, groups["flap"]) >= 0.02
        )
        assert (fitting.find_obstruction(tool, "flap") is None) == found
        return found

    places = np.linspace(-0.4, 0.1, 26).tolist()
    changes = [(a, b) for a, b in itertools.pairwise(places) if free(a) != free(b)]
    assert changes
    for one, other in changes:  # and where that changes, to 0.1 mm
        before = free(one)
        while abs(other - one) > 1e-4:
            middle = (one + other) / 2.0
            one, other = (middle, other) if free(middle) == before else (one, middle)
