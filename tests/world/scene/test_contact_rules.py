"""Tests the rules for contact and clearance between hand and object."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pinocchio as pin
import pytest
from helpers.grippers import write_cheeks_scene, write_gripper
from helpers.judging import replace_object
from helpers.small_problems import load_door_scene

from vkc_pin import Attachment, Hold, Options, Scene
from vkc_pin.world.scene.contact_rules import (
    compute_grasp_opening,
    compute_hand_clearance,
    compute_hand_frame,
    compute_start_opening,
    is_rigid_grasp,
)

HANDLE = Hold("door", "handle")
THROUGH = Hold("door", "handle", Hold("stick", "grip"), "tip")
LEVER, PANEL = "door.lever", "door.panel"


def load_door(attachment: str = "handle", **fields: object) -> Scene:
    """Return the door scene with changed fields of one attachment."""
    scene = load_door_scene()
    attachments = scene.objects["door"].object.attachments
    changed: Attachment = dataclasses.replace(attachments[attachment], **fields)  # type: ignore[arg-type]
    return replace_object(scene, attachments={**attachments, attachment: changed})


@pytest.mark.parametrize(
    ("clearance", "expected"),
    [(None, 0.005), (0.012, 0.012), (0.0, 0.0), (0.5, 0.02)],  # at most the general clearance
)
def test_hand_clearance_is_that_of_the_attachment(clearance: float | None, expected: float) -> None:
    scene = load_door(clearance=clearance)
    for link in (LEVER, PANEL):
        assert compute_hand_clearance(scene, HANDLE, link, Options()) == expected
    assert compute_hand_clearance(scene, HANDLE, LEVER, Options(dist_safe=0.001)) == min(
        expected, 0.001
    )


def test_pushing_or_indirect_hold_needs_no_clearance_from_its_link() -> None:
    pushed, door = load_door(contact="push"), load_door()
    for scene, hold, link, expected in (
        (pushed, HANDLE, LEVER, 0.0),
        (pushed, HANDLE, PANEL, 0.005),
        (door, THROUGH, LEVER, 0.0),
        (door, THROUGH, PANEL, 0.005),
        (door, HANDLE, LEVER, 0.005),
    ):
        assert compute_hand_clearance(scene, hold, link, Options()) == expected


@pytest.mark.parametrize(
    ("attachment", "contact", "firm", "is_rigid"),
    [
        ("handle", "grasp", False, True),  # without freedoms
        ("handle", "grasp", True, True),
        ("handle_free", "grasp", False, False),
        ("handle_free", "grasp", True, True),  # clamped
        ("handle", "push", False, False),
        ("handle_free", "push", True, False),
    ],
)
def test_rigid_grasps(attachment: str, contact: str, firm: bool, is_rigid: bool) -> None:
    scene = load_door(attachment, contact=contact, firm=firm)
    assert bool(scene.objects["door"].object.attachments[attachment].freedoms) == (
        attachment == "handle_free"
    )
    assert is_rigid_grasp(scene, Hold("door", attachment)) == is_rigid


def test_gripper_openings(tmp_path: Path) -> None:
    """Covers grasps, pushes, the start, and robots without a gripper."""
    scene = write_cheeks_scene(write_gripper(tmp_path / "mine"), opening=0.04, start=0.03)
    hold = Hold("drawer", "grip")
    assert compute_grasp_opening(scene, hold) == pytest.approx(0.04)
    assert compute_start_opening(scene) == pytest.approx(0.03)
    assert compute_start_opening(scene.with_held({"drawer": "grip"})) == pytest.approx(0.04)
    assert compute_grasp_opening(load_door_scene(), HANDLE) is None
    assert compute_start_opening(load_door_scene()) is None
    grip = scene.objects["drawer"].object.attachments["grip"]
    pushed = dataclasses.replace(grip, contact="push")
    foremost = scene.robot.opened(0.04).front
    assert foremost.translation[2] > 0.0
    assert compute_hand_frame(scene.robot, grip) == pin.SE3.Identity()
    assert compute_hand_frame(scene.robot, pushed) == foremost
