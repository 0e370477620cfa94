"""Tests which neighbours the links of estimated joints may come near to."""

from __future__ import annotations

import coal
import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.execution.uncertain_joints import allow_near_neighbours
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.placed_object import make_world_shapes

SAFE = 0.02
STEPS = (vkc.Actuate("door", {"hinge": 1.2}),)


def make_scene(gap: float) -> vkc.Scene:
    """Return the door ajar, and a ball that its leaf comes near to at 1.2 rad, to a gap [m]."""
    scene = vkc.load_scene("door").with_state("door", {"hinge": 0.2})
    opened = scene.objects["door"].with_state({"hinge": 1.2, "knob": 0.0})
    centre = opened.link_placement("panel").translation
    tip = max(
        (shape for shape in make_world_shapes(opened) if shape.name.startswith("panel")),
        key=lambda shape: float(np.linalg.norm(shape.placement.translation - centre)),
    )
    away = opened.placement.translation[:2] - tip.placement.translation[:2]
    side = np.array([away[1], -away[0], 0.0]) / np.linalg.norm(away)
    place = tip.placement.translation + 0.3 * side
    point = coal.Transform3s(np.eye(3), place)
    at_tip = coal.Transform3s(tip.placement.rotation, tip.placement.translation)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    distance = coal.distance(tip.geometry, at_tip, coal.Sphere(1e-6), point, request, result)
    ball = {
        "name": "ball",
        "type": "sphere",
        "radius": distance - gap,
        "position": place.tolist(),
    }
    document = {**scene.document, "obstacles": [*scene.document["obstacles"], ball]}
    return vkc.Scene.from_document(document, scene.folder)


def find_margin(scene: vkc.Scene) -> float | None:
    """Return the margin that the scene states for the leaf and the ball [m]; None: the usual."""
    for exemption in find_clearance_exemptions(scene, SAFE):
        if {exemption.first, exemption.second} == {"door.panel", "ball"}:
            return exemption.margin
    return None


@pytest.mark.parametrize(
    ("gap", "margin"),
    [(0.05, None), (0.015, 0.0), (0.003, 0.0), (-0.003, -0.004), (-0.02, None)],
)
def test_leaf_may_come_near_on_its_way(gap: float, margin: float | None) -> None:
    """But it may not overlap a neighbour by more than an error of the model."""
    scene = make_scene(gap)
    assert find_margin(scene) is None
    allowed = allow_near_neighbours(scene, "door", "hinge", STEPS, SAFE)
    found = find_margin(allowed)
    assert found == (None if margin is None else pytest.approx(margin, abs=5e-4))


def test_what_lies_beyond_the_goal_does_not_count() -> None:
    scene = make_scene(0.003)
    short = (vkc.Actuate("door", {"hinge": 0.6}),)
    other = (vkc.Actuate("door", {"knob": 0.6}),)
    for steps in (short, other):
        allowed = allow_near_neighbours(scene, "door", "hinge", steps, SAFE)
        assert find_margin(allowed) is None
