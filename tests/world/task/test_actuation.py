"""Tests the joints that a hand can push, and their directions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from helpers.small_problems import (
    load_door_scene,
    make_full_scene,
    replace_attachment,
    replace_objects,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.task.actuation import compute_advance
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task

STEP = 1e-6  # [rad] or [m]


def differentiate_contact(
    placed: vkc.PlacedObject, attachment: vkc.Attachment, joint: str, values: list[float]
) -> float:
    """Return the advance of the contact into its face per unit of a joint, numerically."""
    contact = attachment.placement
    for freedom, value in zip(attachment.freedoms, values, strict=True):
        contact = contact * freedom.motion(value)
    now = float(placed.state[placed.object.coordinates.index(joint)])
    ahead, behind = (
        placed.with_state({joint: at}).link_placement(attachment.link).act(contact.translation)
        for at in (now + STEP, now - STEP)
    )
    normal = (placed.link_placement(attachment.link) * attachment.placement).rotation[:, 2]
    return float(normal @ (ahead - behind)) / (2 * STEP)


@settings(deadline=None, max_examples=15)
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3),
    st.tuples(st.floats(-0.9, 1.9), st.floats(0.01, 0.29)),
)
def test_advance_matches_finite_differences(
    rpy: list[float], position: list[float], fractions: list[float], state: tuple[float, float]
) -> None:
    """The extremes bound the advance of all points of the face, and corners attain them.

    The face is on a tray that slides on a rotating arm.
    """
    cabinet = (
        make_full_scene().objects["cabinet"].with_state({"swing": state[0], "slide": state[1]})
    )
    slides = [
        vkc.Freedom(f"_{k}", "prismatic", axis, -0.1, 0.2) for k, axis in enumerate(np.eye(3)[:2])
    ]
    tilt = vkc.Freedom("_tilt", "revolute", np.array([1.0, 0.0, 0.0]), -0.5, 0.5)
    placement = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(position))
    face = vkc.Attachment(
        name="face",
        link="tray",
        placement=placement,
        freedoms=(*slides, tilt),
        standoff=0.01,
        contact="push",
    )
    for joint in ("swing", "slide"):
        least, most = compute_advance(cabinet, face, joint)
        corners = [
            differentiate_contact(cabinet, face, joint, [x, y, 0.3])
            for x in (-0.1, 0.2)
            for y in (-0.1, 0.2)
        ]
        np.testing.assert_allclose([least, most], [min(corners), max(corners)], rtol=0.0, atol=1e-8)
        inside = [
            freedom.lower + fraction * (freedom.upper - freedom.lower)
            for freedom, fraction in zip(face.freedoms, fractions, strict=True)
        ]
        assert least - 1e-8 <= differentiate_contact(cabinet, face, joint, inside) <= most + 1e-8


def push(scene: vkc.Scene, joints: dict[str, float], face: str, name: str = "door") -> Task:
    return compile_task(scene, [vkc.Actuate(name, joints, face)], vkc.Options())


def open_door(hinge: float) -> vkc.Scene:
    return load_door_scene().with_state("door", {"hinge": hinge})


@pytest.mark.parametrize(
    ("begin", "end", "face", "direction"),
    [(-1.2, 0.0, "push", 1), (1.57, 2.0, "push_back", -1), (0.3, 0.9, "push", 1)],
)
def test_door_is_pushed_shut_or_further_open(
    begin: float, end: float, face: str, direction: int
) -> None:
    reach, move = push(open_door(begin), {"hinge": end}, face).phases
    assert (reach.pushed, move.pushed, move.name) == (
        {},
        {"door.hinge": direction},
        "move door.hinge",
    )


@pytest.mark.parametrize(
    ("begin", "end", "face", "direction"),
    [(-0.5, -1.0, "push", "up"), (0.5, 1.0, "push_back", "down")],
)
def test_push_cannot_pull(begin: float, end: float, face: str, direction: str) -> None:
    message = (
        f"pushing 'door' at '{face}' moves 'hinge' {direction} only: a hand that pushes cannot pull"
    )
    other = "or an attachment that can be grasped: handle, handle_free"
    limit = f"{'≥' if direction == 'up' else '≤'} {begin:g}"
    with expect_error(message, field="steps[0].joints", expected=f"{limit}, {other}"):
        push(open_door(begin), {"hinge": end}, face)


def test_push_along_the_joint_axis_is_rejected() -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.0, np.pi / 2, 0.0), np.array([0.0, 6e-4, 0.0]))
    face = vkc.Attachment(name="face", link="arm", placement=placement, contact="push")
    cabinet = replace_attachment(make_full_scene().objects["cabinet"], face)
    scene = replace_objects(load_door_scene(), {"cabinet": cabinet})
    with expect_error("does not move 'swing' in a single direction"):
        push(scene, {"swing": 0.2}, "face", "cabinet")


def test_face_on_both_sides_of_the_hinge_is_rejected() -> None:
    placed = open_door(-1.0).objects["door"]
    face = placed.object.attachments["push"]
    wide = (dataclasses.replace(face.freedoms[0], lower=-0.7), *face.freedoms[1:])
    both = replace_attachment(placed, dataclasses.replace(face, name="both", freedoms=wide))
    with expect_error("does not move 'hinge' in a single direction"):
        push(replace_objects(open_door(-1.0), {"door": both}), {"hinge": 0.0}, "both")
