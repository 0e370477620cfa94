"""Fingers that close: those of a gripper, or the pads of a hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.grippers import between_cheeks, write_gripper

import vkc_pin as vkc
from vkc_pin.simulation.friction.fingers import fingers_of, limited
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.servos import servos
from vkc_pin.world.trajectory.world_model import World


def test_pads_slide_where_nothing_is_said_of_a_gripper() -> None:
    world = World(vkc.load_scene("drawer"))
    fingers = fingers_of(world, Physics(closing_force=100.0))
    assert fingers.sides is not None
    assert fingers.sides.travel == pytest.approx(
        0.043, abs=5e-4
    )  # half of what the README of the robot says
    names = [{world.collision_labels[k] for k in side} for side in fingers.sides.shapes]
    assert names == [{"gripper_right_finger"}, {"gripper_left_finger"}]
    assert [len(side) for side in fingers.sides.shapes] == [
        1,
        1,
    ]  # the pads, not the linkages behind them
    assert [servo.limit for servo in fingers.servos] == [100.0, 100.0]


def test_a_gripper_has_its_own_joints(tmp_path: Path) -> None:
    world = World(between_cheeks(write_gripper(tmp_path), opening=0.03))
    fingers = fingers_of(world, Physics())
    assert (fingers.sides, fingers.names) == (None, ("finger_a_joint", "finger_b_joint"))
    np.testing.assert_allclose(fingers.closed, 0.0)
    np.testing.assert_allclose(fingers.open, 0.04)
    own = servos(world, world.start[None], Physics())
    weak = {
        servo.coordinate: servo.limit
        for servo in limited(own, fingers, world, Physics(closing_force=7.0))
    }
    assert [weak[name] for name in fingers.names] == [7.0, 7.0]
    assert all(
        weak[servo.coordinate] == servo.limit
        for servo in own
        if servo.coordinate not in fingers.names
    )


def test_a_hand_without_fingers_is_refused() -> None:
    scene = vkc.load_scene("drawer")
    object.__setattr__(
        scene.robot, "touch_links", frozenset({"gripper_link", "gripper_left_finger"})
    )
    with pytest.raises(vkc.InputError, match="no fingers that close") as caught:
        fingers_of(World(scene), Physics())
    assert caught.value.field == "grasp"
    assert "gripper" in str(caught.value.expected)
