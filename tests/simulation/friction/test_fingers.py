"""Tests that fingers are the joints of a described gripper or the pads of a hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from helpers.grippers import write_cheeks_scene, write_gripper

import vkc_pin as vkc
from vkc_pin.simulation.friction import find_fingers, limit_finger_servos
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.servos import make_servos
from vkc_pin.world.trajectory.world_model import World


def test_pads_slide_without_a_described_gripper() -> None:
    world = World(vkc.load_scene("drawer"))
    fingers = find_fingers(world, Physics(closing_force=100.0))
    assert fingers.sides is not None
    assert fingers.sides.travel == pytest.approx(
        0.043, abs=5e-4
    )  # half the opening in the robot's README
    names = [{world.collision_labels[k] for k in side} for side in fingers.sides.shapes]
    assert names == [{"gripper_right_finger"}, {"gripper_left_finger"}]
    assert [len(side) for side in fingers.sides.shapes] == [
        1,
        1,
    ]  # the pads, not the linkages behind them
    assert [servo.limit for servo in fingers.servos] == [100.0, 100.0]


def test_described_gripper_uses_its_own_joints(tmp_path: Path) -> None:
    world = World(write_cheeks_scene(write_gripper(tmp_path), opening=0.03))
    fingers = find_fingers(world, Physics())
    assert (fingers.sides, fingers.names) == (None, ("finger_a_joint", "finger_b_joint"))
    np.testing.assert_allclose(fingers.closed, 0.0)
    np.testing.assert_allclose(fingers.open, 0.04)
    servos = make_servos(world, world.start[None], Physics())
    limits = {
        servo.coordinate: servo.limit
        for servo in limit_finger_servos(servos, fingers, world, Physics(closing_force=7.0))
    }
    assert [limits[name] for name in fingers.names] == [7.0, 7.0]
    assert all(
        limits[servo.coordinate] == servo.limit
        for servo in servos
        if servo.coordinate not in fingers.names
    )


def test_hand_without_fingers_is_rejected() -> None:
    scene = vkc.load_scene("drawer")
    touch_links = frozenset({"gripper_link", "gripper_left_finger"})
    robot = dataclasses.replace(scene.robot, touch_links=touch_links)
    with pytest.raises(vkc.InputError, match="no fingers that close") as caught:
        find_fingers(World(dataclasses.replace(scene, robot=robot)), Physics())
    assert caught.value.field == "grasp"
    assert "gripper" in str(caught.value.expected)
