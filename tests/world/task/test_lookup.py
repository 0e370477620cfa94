"""Tests the search for names of steps in a scene, and the errors for unknown names."""

from __future__ import annotations

import dataclasses

import pinocchio as pin
import pytest
from helpers.small_problems import full_scene

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.task.lookup import (
    check_link,
    find_attachment,
    find_object,
    find_path_joints,
    find_robot_frame,
)


def test_unknown_names_are_reported() -> None:
    scene = full_scene()
    cabinet = scene.objects["cabinet"]
    for call, nearest in (
        (lambda: find_object(scene, "cabinett", "here"), "cabinet"),
        (lambda: find_attachment(cabinet, "gripp", "here"), "grip"),
        (lambda: check_link(cabinet, "try", "here"), "tray"),
        (lambda: find_robot_frame(scene, "forearm", "here"), "forearm_link"),
    ):
        with pytest.raises(UnknownNameError) as caught:
            call()
        assert (caught.value.field, caught.value.nearest) == ("here", nearest)
    bare = dataclasses.replace(cabinet, object=dataclasses.replace(cabinet.object, attachments={}))
    with pytest.raises(InputError, match="cannot be grasped"):
        find_attachment(bare, None, "here")


def test_path_joints_move_the_attachment() -> None:
    """By trying each of them, with Pinocchio."""
    for placed in full_scene().objects.values():
        model, base = placed.object.model, placed.object.coordinates.q(placed.state)
        for attachment in placed.object.attachments.values():
            frame, moving = model.getFrameId(attachment.link, pin.FrameType.BODY), []
            for index, name in enumerate(placed.object.coordinates.names):
                state = placed.state.copy()
                state[index] += 0.1
                data, other = model.createData(), model.createData()
                pin.framesForwardKinematics(model, data, base)
                pin.framesForwardKinematics(model, other, placed.object.coordinates.q(state))
                if not data.oMf[frame].isApprox(other.oMf[frame], 1e-9):
                    moving.append(name)
            assert sorted(find_path_joints(placed, attachment)) == sorted(moving)
    cabinet = full_scene().objects["cabinet"]
    assert find_path_joints(cabinet, cabinet.object.attachments["grip"]) == ["swing", "slide"], (
        "base first"
    )
