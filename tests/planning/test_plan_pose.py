"""Tests where frames are along a plan."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error

import vkc_pin as vkc


def test_pose_of_the_hand_is_that_of_its_grasp(door_plan: vkc.Plan) -> None:
    """At the end the tool is at the lever's attachment, which the opened panel carries along."""
    end = float(door_plan.trajectory.times[-1])
    grasp = door_plan.scene.objects["door"].object.attachment("handle")
    hand = door_plan.pose(f"door.{grasp.link}", end) * grasp.tool()
    assert door_plan.pose(None, end).isApprox(hand, 2e-3)
    tool = door_plan.scene.robot.tool_frame
    assert door_plan.pose(tool, end).isApprox(door_plan.pose(None, end), 1e-12)


def test_pose_at_the_start_is_that_of_the_scene(door_plan: vkc.Plan) -> None:
    scene = door_plan.scene
    assert door_plan.pose(None, 0.0).isApprox(scene.tool_placement(), 1e-9)
    assert door_plan.pose("door", 0.0).isApprox(scene.objects["door"].placement, 1e-9)
    panel = scene.objects["door"].link_placement("panel")
    assert door_plan.pose("door.panel", 0.0).isApprox(panel, 1e-9)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.77, 1.0])
def test_pose_of_a_moved_link_follows_its_joint(door_plan: vkc.Plan, share: float) -> None:
    """The base frame moves as the base does, the panel turns about its hinge."""
    time = share * float(door_plan.trajectory.times[-1])
    (row,) = door_plan.trajectory.at(np.array([time]))
    names = list(door_plan.trajectory.names)
    angle = 0.0
    if "door.hinge" in names:
        angle = row[names.index("door.hinge")]
    placed = door_plan.scene.objects["door"].with_state({"hinge": angle})
    expected = placed.link_placement("panel")
    assert door_plan.pose("door.panel", time).isApprox(expected, 1e-9)
    x, y, _ = row[:3]
    root = door_plan.pose("base_link", time)
    np.testing.assert_allclose(root.translation[:2], [x, y], atol=1e-9)


def test_pose_of_a_carried_object_follows_the_hand() -> None:
    scene = vkc.load_scene("household").with_held({"cup": "top"})
    plan = vkc.plan(scene, [vkc.GoTo(*(scene.start[:2] + 0.1))])
    assert plan.success, plan.summary()
    end = float(plan.trajectory.times[-1])
    before, after = (plan.pose(None, t).actInv(plan.pose("cup", t)) for t in (0.0, end))
    assert isinstance(after, pin.SE3)
    assert before.isApprox(after, 1e-9)
    assert not plan.pose("cup", 0.0).isApprox(plan.pose("cup.cup", end), 1e-3)


@pytest.mark.parametrize(
    ("frame", "time", "message"),
    [
        ("door.pannel", 0.0, "did you mean 'door.panel'"),
        ("drawer", 0.0, "no frame 'drawer'"),
        (None, -0.1, "time: .*a time from 0 to"),
        (None, 1e3, "time: .*a time from 0 to"),
        (None, float("nan"), "time"),
        (None, "soon", "time"),
    ],
)
def test_wrong_frames_and_times_are_refused(
    door_plan: vkc.Plan, frame: str | None, time: float, message: str
) -> None:
    with expect_error(message):
        door_plan.pose(frame, time)
