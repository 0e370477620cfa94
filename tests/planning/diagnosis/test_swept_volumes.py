"""Tests of collisions that an object's own joint causes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import door_scene

from vkc_pin.options import Options
from vkc_pin.planning.diagnosis.swept_volumes import find_swept_collisions
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.models.shapes import compute_world_box, get_link_name
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate

POST = (3.2, 0.14, 0.25)  # in the hall, where the leaf is at 1.14 rad


BAR = """<robot name="bar"><link name="base"/>
<link name="bar"><collision><geometry><box size="0.08 0.1 0.5"/></geometry>
</collision></link><joint name="up" type="prismatic">
<parent link="base"/><child link="bar"/><origin xyz="0 0 0.25"/>
<axis xyz="0 0 1"/>
<limit lower="0" upper="2" effort="1" velocity="1"/></joint></robot>"""


def problem(
    hinge: float,
    at: Sequence[float],
    *,
    object_type: str | dict[str, Any] | None = None,
    state: float = 0.0,
    size: Sequence[float] = (0.08, 0.1, 0.5),
    allow: Sequence[Any] = (),
) -> TrajectoryProblem:
    scene = door_scene().with_state("door", {"hinge": state})
    document = scene.document
    if object_type is None:
        box = {"name": "post", "type": "box", "size": list(size), "position": list(at)}
        document = {**document, "obstacles": [*document["obstacles"], box]}
    else:
        document = {
            **document,
            "objects": [
                *document["objects"],
                {"name": "post", "type": object_type, "position": list(at)},
            ],
        }
    scene = Scene.from_document({**document, "allow": list(allow)}, scene.folder)
    options = Options(reach_waypoints=4, turn_waypoints=3, move_waypoints=6)
    return TrajectoryProblem(
        scene, compile_task(scene, [Actuate("door", {"hinge": hinge})], options), options
    )


def test_obstacle_in_the_swept_volume_is_named() -> None:
    (line,) = find_swept_collisions(problem(1.3, POST))
    assert "no path for door.hinge, proven: between 0 and 1.3, at " in line
    assert "door.panel – post overlap by " in line
    at = float(line.partition(", at ")[2].partition(",")[0])
    assert 1.0 < at < 1.3


@pytest.mark.parametrize(
    ("hinge", "at", "state"),
    [
        (0.7, POST, 0.0),  # it ends before
        (1.3, (3.2, 0.14, 2.6), 0.0),  # above the leaf
        (1.5, POST, 1.45),  # it begins beyond
    ],
)
def test_obstacle_elsewhere_proves_nothing(hinge: float, at: Sequence[float], state: float) -> None:
    assert find_swept_collisions(problem(hinge, at, state=state)) == []


def test_movable_object_proves_nothing() -> None:
    assert find_swept_collisions(problem(1.3, (3.2, 0.14, 0.4), object_type="ball")) == []
    assert (
        find_swept_collisions(problem(1.3, (3.2, 0.14, 0.0), object_type="cabinet")) != []
    )  # its case stays
    assert (
        find_swept_collisions(
            problem(1.3, (3.2, 0.14, 0.0), object_type={"urdf": BAR, "attachments": []})
        )
        == []
    )  # it slides out of the way


def around_the_hinge(angle: float, at: np.ndarray) -> np.ndarray:
    """Return the position of a point of the door's leaf at an angle [rad]."""
    placed = door_scene().objects["door"]
    model = placed.object.model
    hinge = placed.placement * model.jointPlacements[model.getJointId("hinge")]
    turn = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, angle), np.zeros(3))
    return (hinge * turn * hinge.inverse()).act(at)


def test_goal_is_clipped_to_the_limit() -> None:
    assert np.allclose(around_the_hinge(0.8, np.array(POST))[2], POST[2])
    further = around_the_hinge(0.86, np.array(POST))  # where the leaf would be at 2 rad
    assert find_swept_collisions(problem(9.0, further)) == []
    assert find_swept_collisions(problem(9.0, around_the_hinge(0.2, np.array(POST)))) != []


def test_link_of_two_joints_proves_nothing() -> None:
    """Only links that depend on a single joint prove a collision."""
    placed = door_scene().objects["door"]
    bar = placed.link_placement("lever") * placed.object.attachments["handle"].placement
    there = around_the_hinge(0.1, bar.translation)  # the leaf turns away from it
    assert find_swept_collisions(problem(1.3, there, size=(0.02, 0.02, 0.02))) == []
    inside = around_the_hinge(
        0.6,
        (placed.link_placement("panel") * placed.object.attachments["push"].placement).translation,
    )
    assert find_swept_collisions(problem(1.3, inside, size=(0.02, 0.02, 0.02))) != []


@pytest.mark.parametrize(("deep", "proven"), [(0.0005, False), (0.004, True)])
def test_small_overlap_proves_nothing(deep: float, proven: bool) -> None:
    """A slab grazes the leaf's lower edge on the whole motion."""
    placed = door_scene().objects["door"].with_state({"hinge": 0.6})
    boxes = [
        compute_world_box(shape.geometry, shape.placement)
        for shape in make_world_shapes(placed)
        if get_link_name(shape.name) == "panel"
    ]
    low = min(lower[2] for lower, _ in boxes)
    middle = around_the_hinge(
        0.6, (placed.placement * pin.SE3.Identity()).act(np.array([0.0, -0.5, 0.0]))
    )
    slab = [*middle[:2], low + deep - 0.05]
    assert bool(find_swept_collisions(problem(1.3, slab, size=(0.1, 0.1, 0.1)))) == proven


@pytest.mark.parametrize(("margin", "proven"), [(-0.01, True), (-0.5, False), (None, False)])
def test_allowed_contact_proves_nothing(margin: float | None, proven: bool) -> None:
    pair = ["door.panel", "post"]
    allow: Any = pair if margin is None else {"pair": pair, "margin": margin}
    assert bool(find_swept_collisions(problem(1.3, POST, allow=[allow]))) == proven
