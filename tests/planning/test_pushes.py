"""Tests that doors and drawers are pushed shut and that a bowl is grasped at its rim."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.drawers import compute_tool_pose, replace_scene_fields
from oracle.judge import judge

import vkc_pin as vkc

CASES = [  # scene, object, joint, initial value, attachment
    ("door", "door", "hinge", -1.2, "push"),
    ("drawer", "drawer", "slide", 0.3, "push"),
    ("household", "dishwasher", "door", 0.6, "door_push"),
]


@cache
def push_shut(scene: str, owner: str, joint: str, begin: float, face: str) -> vkc.Plan:
    start = vkc.load_scene(scene).with_state(owner, {joint: begin})
    return vkc.plan(start, [vkc.Actuate(owner, {joint: 0.0}, face)])


def get_hold_phase(plan: vkc.Plan) -> vkc.PhaseSpan:
    (phase,) = (one for one in plan.trajectory.phases if one.holds)
    return phase


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=f"{case[1]}.{case[-1]}", marks=[pytest.mark.long] if k else [])
        for k, case in enumerate(CASES)
    ],
)
def test_open_objects_are_pushed_shut(case: tuple[str, str, str, float, str]) -> None:
    """The joint never moves back; the oracle checks that the hand stays on the face."""
    plan, (_, owner, joint, begin, _) = push_shut(*case), case
    assert plan.success, plan.summary()
    column = plan.trajectory.column(f"{owner}.{joint}")
    assert (column[0], abs(column[-1]) < 1e-3) == (begin, True)
    assert (np.diff(column) * np.sign(begin)).max() < 1e-6


def test_backward_push_is_a_violation(tmp_path: Path) -> None:
    """Robot and door move back together."""
    plan = push_shut(*CASES[0])
    motion, phase = plan.trajectory, get_hold_phase(plan)
    middle = (phase.first + phase.last) // 2
    rows = motion.positions.copy()
    rows[middle + 1] = rows[middle - 1]
    back = dataclasses.replace(motion, positions=rows, curve=None)
    violations = vkc.validate(plan.scene, plan.steps, back).violations
    (push,) = [one for one in violations if one.constraint == "push"]
    assert (push.subject, push.unit) == ("door.push", "m")
    hinge = motion.column("door.hinge")
    lever = push.amount / (hinge[middle] - hinge[middle - 1])
    assert 0.3 < lever < 0.8  # [m] from the hinge, within the contact region
    file = dataclasses.replace(plan, trajectory=back).save(tmp_path / "back.npz")
    assert {one.subject for one in judge(file).found if one.rule == "push"} == {"door.push"}


def test_bowl_is_grasped_at_its_rim() -> None:
    bowl = {"name": "bowl", "type": "bowl", "position": [0.9, 0.5, 0.701], "yaw": 2.0}
    scene = replace_scene_fields(vkc.load_scene("tray"), objects=[bowl])
    plan = vkc.plan(scene, [vkc.Place("bowl", (-0.3, -1.95, 0.701))])
    assert plan.success, plan.summary()
    row = plan.trajectory.positions[get_hold_phase(plan).first]
    tool = plan.scene.objects["bowl"].placement.actInv(compute_tool_pose(scene, row))
    radius = np.hypot(*tool.translation[:2])
    assert radius == pytest.approx(0.107, abs=2e-3)
    assert tool.translation[2] == pytest.approx(0.055, abs=2e-3)
    # The fingers close across the wall.
    outwards = tool.translation[:2] / radius
    assert abs(tool.rotation[:2, 0] @ outwards) > np.cos(0.4) - 1e-2
    assert tool.rotation[2, 2] < -np.cos(0.4) + 1e-2
