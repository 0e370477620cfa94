"""Tests names and keys of phases, and the truncation of tasks."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_stand, make_room
from helpers.small_problems import SHORT, make_full_scene

from vkc_pin import Actuate, GoTo, Grasp, Hold, Place, Reach, Release, Scene, Touch
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import FrameGoal
from vkc_pin.world.task.steps import Step

POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array([0.4, 0.2, 0.9]))
FURNITURE: list[Step] = [
    GoTo(0.5, 0.0),
    Actuate("drawer", {"slide": 0.2}),
    Reach(POSE),
    Actuate("door", {"hinge": 1.0}),
]
CARRYING: list[Step] = [
    Grasp("stick", "grip"),
    Touch("stick.tip", (0.8, 0.9, 0.7)),
    Grasp("ball", "pull", by="stick.tip"),
    Place("ball", POSE),
    Release("stick"),
    GoTo(0.0, 0.0),
]


def make_scene(steps: list[Step]) -> Scene:
    return (
        make_full_scene()
        if steps is FURNITURE
        else make_room(describe_stand(), objects=("stick", "ball"))
    )


@pytest.mark.parametrize("steps", [FURNITURE, CARRYING], ids=["furniture", "carrying"])
def test_truncated_task_equals_the_task_of_the_first_steps(steps: list[Step]) -> None:
    scene = make_scene(steps)
    whole = compile_task(scene, steps, SHORT)
    for count in range(1, len(steps) + 1):
        part, expected = whole.truncate(count), compile_task(scene, steps[:count], SHORT)
        assert part == expected
        assert part.boundaries == expected.boundaries
    assert whole.segments == sum(phase.segments for phase in whole.phases)
    assert whole.truncate(len(steps)) == whole


def test_goals_are_named() -> None:
    assert str(FrameGoal("panel", POSE, hold=Hold("door", "handle"))) == "door.panel"
    assert str(FrameGoal("tool", POSE)) == "tool"
