"""Tests that doors and drawers are pushed shut and that a bowl is grasped at its rim."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from oracle.changes import write_changed
from oracle.judge import judge

import vkc_pin as vkc

CASES = [  # scene, object, joint, initial value, attachment
    ("door", "door", "hinge", -1.2, "push"),
    ("drawer", "drawer", "slide", 0.3, "push"),
    ("household", "dishwasher", "door", 0.6, "door_push"),
]


@cache
def push_shut(scene: str, owner: str, joint: str, begin: float, face: str) -> vkc.Plan:
    return vkc.plan(
        vkc.load_scene(scene).with_state(owner, {joint: begin}),
        [vkc.Actuate(owner, {joint: 0.0}, face)],
    )


def measure_gaps(plan: vkc.Plan, owner: str, face: str) -> np.ndarray:
    """Return distances of the hand's foremost point from the face while it pushes [m]."""
    scene, motion = plan.scene, plan.trajectory
    (phase,), robot, placed, found = (
        [one for one in motion.phases if one.holds],
        scene.robot,
        scene.objects[owner],
        [],
    )
    attachment, model, data = placed.object.attachments[face], robot.model, robot.model.createData()
    frame, shapes = model.getFrameId(robot.tool_frame), robot.collision.createData()
    hand = [
        i
        for i in range(len(robot.collision.geometryObjects))
        if robot.link_of(i) in robot.touch_links
    ]
    for row in motion.positions[phase.first : phase.last + 1]:
        pin.updateGeometryPlacements(
            model, data, robot.collision, shapes, robot.coordinates.q(row[: motion.robot_size])
        )
        tool = pin.updateFramePlacement(model, data, frame)
        corners = [
            shapes.oMg[i].act(point)
            for i in hand
            for point in robot.collision.geometryObjects[i].geometry.points()
        ]
        foremost = tool.act(
            np.array([0.0, 0.0, max(float(tool.actInv(corner)[2]) for corner in corners)])
        )
        named = dict(zip(motion.names, row.tolist(), strict=True))
        state = {
            name: named[f"{owner}.{name}"]
            for name in placed.object.coordinates.names
            if f"{owner}.{name}" in named
        }
        found.append(
            -(
                placed.with_state(state).link_placement(attachment.link) * attachment.placement
            ).actInv(foremost)[2]
        )
    return np.array(found)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=f"{case[1]}.{case[-1]}", marks=[pytest.mark.long] if k else [])
        for k, case in enumerate(CASES)
    ],
)
def test_open_objects_are_pushed_shut(case: tuple[str, str, str, float, str]) -> None:
    """The hand stays on the face, up to its tilt, and the joint never moves back."""
    plan, (_, owner, joint, begin, face) = push_shut(*case), case
    assert plan.success, plan.summary()
    column = plan.trajectory.positions[:, plan.trajectory.names.index(f"{owner}.{joint}")]
    assert (column[0], abs(column[-1]) < 1e-3) == (begin, True)
    assert (np.diff(column) * np.sign(begin)).max() < 1e-6
    distance = measure_gaps(plan, owner, face)
    standoff = plan.scene.objects[owner].object.attachments[face].standoff
    assert standoff > 0.0
    assert distance.min() > standoff * np.cos(0.4) - 1.1e-3
    assert distance.max() < standoff + 1.1e-3


def test_backward_push_is_a_violation(tmp_path: Path) -> None:
    plan = push_shut(*CASES[0])
    motion, (phase,) = plan.trajectory, [one for one in plan.trajectory.phases if one.holds]
    middle = (phase.first + phase.last) // 2

    def reverse(rows: np.ndarray) -> None:
        rows[middle + 1] = rows[middle - 1]  # robot and door move back together

    rows = motion.positions.copy()
    reverse(rows)
    violations = vkc.validate(
        plan.scene, plan.steps, dataclasses.replace(motion, positions=rows, curve=None)
    ).violations
    (push,) = [one for one in violations if one.constraint == "push"]
    assert (push.subject, push.unit) == ("door.push", "m")
    hinge = motion.positions[:, motion.names.index("door.hinge")]
    lever = push.amount / (hinge[middle] - hinge[middle - 1])
    assert 0.3 < lever < 0.8  # [m] from the hinge, within the contact region
    other = write_changed(
        plan.save(tmp_path / "plan.npz"),
        tmp_path / "back.npz",
        lambda content: reverse(content["positions"]),
    )
    assert {one.subject for one in judge(other).found if one.rule == "push"} == {"door.push"}


@pytest.mark.parametrize("yaw", [2.0])
def test_bowl_is_grasped_at_its_rim(yaw: float) -> None:
    scene = vkc.load_scene("tray").document
    scene["objects"] = [{"name": "bowl", "type": "bowl", "position": [0.9, 0.5, 0.701], "yaw": yaw}]
    plan = vkc.plan(vkc.Scene.from_document(scene), [vkc.Place("bowl", (-0.3, -1.95, 0.701))])
    assert plan.success, plan.summary()
    motion, (phase,) = plan.trajectory, [one for one in plan.trajectory.phases if one.holds]
    row = motion.positions[phase.first]
    robot = plan.scene.robot
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(row[: motion.robot_size]))
    tool = plan.scene.objects["bowl"].placement.actInv(
        data.oMf[robot.model.getFrameId(robot.tool_frame)]
    )
    assert np.hypot(*tool.translation[:2]) == pytest.approx(0.107, abs=2e-3)
    assert tool.translation[2] == pytest.approx(0.055, abs=2e-3)
    outwards = tool.translation[:2] / np.hypot(*tool.translation[:2])
    assert (
        abs(tool.rotation[:2, 0] @ outwards) > np.cos(0.4) - 1e-2
    )  # the fingers close across the wall
    assert tool.rotation[2, 2] < -np.cos(0.4) + 1e-2
