"""Tests the search for the joints that move an attachment."""

from __future__ import annotations

import pinocchio as pin
from helpers.small_problems import make_full_scene

from vkc_pin.world.task.lookup import (
    find_path_joints,
)


def test_path_joints_move_the_attachment() -> None:
    """Compares with the displacement of the frame by each joint in Pinocchio."""
    for placed in make_full_scene().objects.values():
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
    cabinet = make_full_scene().objects["cabinet"]
    assert find_path_joints(cabinet, cabinet.object.attachments["grip"]) == ["swing", "slide"], (
        "base first"
    )
