"""Tests the detection of collisions in the volume that an object's joint sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.diagnosis.proofs import find_swept_collisions

POST = (3.2, 0.14, 0.25)  # in the leaf at 1.14 rad
SIZE = (0.08, 0.1, 0.5)  # [m]
OPTIONS = vkc.Options(reach_waypoints=4, turn_waypoints=3, move_waypoints=6)
SLIDING_BAR = """<robot name="bar"><link name="base"/>
<link name="bar"><collision><geometry><box size="0.08 0.1 0.5"/></geometry></collision></link>
<joint name="up" type="prismatic"><parent link="base"/><child link="bar"/><origin xyz="0 0 0.25"/>
<axis xyz="0 0 1"/><limit lower="0" upper="2" effort="1" velocity="1"/></joint></robot>"""


def explain(
    hinge: float,
    at: Sequence[float] = POST,
    *,
    object_type: str | dict[str, Any] | None = None,
    state: float = 0.0,
    size: Sequence[float] = SIZE,
    allow: Sequence[Any] = (),
) -> list[str]:
    """Explain why the door cannot be opened with a box or an object of some type in the room."""
    scene = load_door_scene().with_state("door", {"hinge": state})
    post: dict[str, Any] = {"name": "post", "position": list(at)}
    kind = "obstacles" if object_type is None else "objects"
    post |= {"type": "box", "size": list(size)} if object_type is None else {"type": object_type}
    document = {**scene.document, kind: [*scene.document[kind], post], "allow": list(allow)}
    scene = vkc.Scene.from_document(document, scene.folder)
    steps = [vkc.Actuate("door", {"hinge": hinge})]
    return find_swept_collisions(make_program(scene, steps, options=OPTIONS))


def test_obstacle_in_the_swept_volume_is_named() -> None:
    (line,) = explain(1.3)
    assert "no path for door.hinge, proven: between 0 and 1.3, at " in line
    assert "door.panel – post overlap by " in line
    worst, first = float(line.split(", at ")[1].split(",")[0]), float(line.split("first at ")[1])
    assert 1.0 < first < worst < 1.3
    assert explain(first - 0.01) == []


@pytest.mark.parametrize(
    ("hinge", "at", "state"),
    [(0.7, POST, 0.0), (1.3, (3.2, 0.14, 2.6), 0.0), (1.5, POST, 1.45)],
    ids=["ends before", "above the leaf", "begins beyond"],
)
def test_obstacle_elsewhere_proves_nothing(hinge: float, at: Sequence[float], state: float) -> None:
    assert explain(hinge, at, state=state) == []


@pytest.mark.parametrize(
    ("object_type", "height", "proven"),
    [
        ("ball", 0.4, False),
        ("cabinet", 0.0, True),
        ({"urdf": SLIDING_BAR, "attachments": []}, 0.0, False),
    ],
    ids=["ball", "fixed case", "sliding bar"],
)
def test_movable_link_proves_nothing(object_type: Any, height: float, proven: bool) -> None:
    assert bool(explain(1.3, (3.2, 0.14, height), object_type=object_type)) == proven


@cache
def transform_leaf(angle: float) -> pin.SE3:
    """Return the motion of the leaf from closed to an angle [rad]."""
    placed = load_door_scene().objects["door"]
    model = placed.object.model
    hinge = placed.placement * model.jointPlacements[model.getJointId("hinge")]
    turn = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, angle), np.zeros(3))
    return hinge * turn * hinge.inverse()


def test_goal_is_clipped_to_the_limit() -> None:
    assert explain(9.0, transform_leaf(0.86).act(np.array(POST))) == []
    assert explain(9.0, transform_leaf(0.2).act(np.array(POST))) != []


@pytest.mark.parametrize(
    ("link", "attachment", "angle"), [("lever", "handle", 0.1), ("panel", "push", 0.6)]
)
def test_link_of_two_joints_proves_nothing(link: str, attachment: str, angle: float) -> None:
    """The lever may turn away from an obstacle, unlike the leaf."""
    placed = load_door_scene().objects["door"]
    frame = placed.link_placement(link) * placed.object.attachments[attachment].placement
    at = transform_leaf(angle).act(frame.translation)
    assert bool(explain(1.3, at, size=(0.02, 0.02, 0.02))) == (link == "panel")


@pytest.mark.parametrize(("depth", "proven"), [(0.0005, False), (0.004, True)])
def test_small_overlap_proves_nothing(depth: float, proven: bool) -> None:
    """A slab of 0.1 m grazes the leaf's lower edge, which is 10 mm above the floor."""
    door = load_door_scene().objects["door"].placement
    x, y, _ = transform_leaf(0.6).act(door.act(np.array([0.0, -0.5, 0.0])))
    assert bool(explain(1.3, (x, y, depth - 0.04), size=(0.1, 0.1, 0.1))) == proven


@pytest.mark.parametrize(("margin", "proven"), [(-0.01, True), (-0.5, False), (None, False)])
def test_allowed_contact_proves_nothing(margin: float | None, proven: bool) -> None:
    pair = ["door.panel", "post"]
    allow: Any = pair if margin is None else {"pair": pair, "margin": margin}
    assert bool(explain(1.3, allow=[allow])) == proven
