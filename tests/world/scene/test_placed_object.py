"""Tests placed objects and their joint values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
from helpers.expected_errors import expect_error
from helpers.rooms import TINY, load_scene_text

from vkc_pin.world.scene.placed_object import make_world_shapes


def test_world_shapes_follow_the_joints(tmp_path: Path) -> None:
    placed = load_scene_text(tmp_path, TINY).objects["front"]
    np.testing.assert_array_equal(placed.state, [0.3, 0.0])
    shapes = {s.name: s for s in make_world_shapes(placed)}
    middle = np.array([3.0, 0.0, 0.0]) + pin.utils.rotate("z", 0.3) @ [0.0, -0.45, 1.01]
    np.testing.assert_allclose(shapes["panel_0"].placement.translation, middle, atol=1e-12)
    assert {s.parentJoint for s in shapes.values()} == {0}
    assert len(make_world_shapes(placed, visual=True)) == len(placed.object.visual.geometryObjects)
    np.testing.assert_allclose(
        placed.link_placement("panel").rotation, pin.utils.rotate("z", 0.3), atol=1e-12
    )


def test_joints_are_set_by_name_within_their_limits(tmp_path: Path) -> None:
    placed = load_scene_text(tmp_path, TINY).objects["front"]
    moved = placed.with_state({"knob": 0.5})
    assert moved.state.tolist() == [0.3, 0.5]
    assert placed.state.tolist() == [0.3, 0.0]
    assert repr(moved) == "<PlacedObject front: door, hinge=0.3, knob=0.5>"
    with expect_error(nearest="knob", field="front.knop"):
        placed.with_state({"knop": 0.5})
    with expect_error(field="front.hinge"):
        placed.with_state({"hinge": 2.0})
