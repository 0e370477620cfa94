"""Tests that steps which drop an object, or carry too much, are refused before planning."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.blocks import ABOVE, TABLE, TOP, describe_block, make_block_scene
from helpers.carrying import describe_box
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin.experiments.chores import CHORES
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.loads import check_footings, check_loads

ON_TABLE = (1.0, 0.2, TOP + ABOVE)
IN_AIR = (1.0, 0.2, TOP + 0.2)


def check(scene: vkc.Scene, *steps: vkc.Step, each: bool = False) -> None:
    """Check steps together, or with `each` one after the other as a window does."""
    options = vkc.Options()
    tasks = compile_each_step(scene, steps, options) if each else []
    check_footings(scene, tasks or [compile_task(scene, steps, options)])


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize(
    ("steps", "number", "problem"),
    [
        ([vkc.Place("block", IN_AIR)], 0, "mid-air, 200 mm above 'table'"),
        ([vkc.Grasp("block"), vkc.Place("block", IN_AIR)], 1, "mid-air, 200 mm above 'table'"),
        ([vkc.Place("block", (1.0, 1.0, 0.3))], 0, "mid-air, 300 mm above 'floor'"),
        (
            [vkc.Place("block", (1.0, 0.32, TOP + ABOVE))],
            0,
            "20 mm beyond its contact with 'table'",
        ),
        ([vkc.Place("block", (1.0, 0.5, TOP + ABOVE, 0, 0, 0))], 0, "mid-air, 501 mm above"),
        (
            [vkc.Place("block", ON_TABLE), vkc.Grasp("other"), vkc.Place("other", IN_AIR)],
            2,
            "'other' would not stay where it is released",
        ),
        ([vkc.GoTo(0.0, 0.0), vkc.Place("block", (1.0, 0.2, 5.0))], 1, "mid-air, 4500 mm"),
    ],
)
def test_object_must_rest_where_it_is_placed(
    steps: list[vkc.Step], number: int, problem: str, each: bool
) -> None:
    other = describe_block("other", at=[1.0, -0.2, TOP + ABOVE])
    scene = make_block_scene(describe_block(), other)
    with expect_error(problem, field=f"steps[{number}]"):
        check(scene, *steps, each=each)
    last = dataclasses.replace(steps[number], unsupported=True)
    check(scene, *steps[:number], last, *steps[number + 1 :], each=each)


@pytest.mark.parametrize(
    "steps",
    [
        [vkc.Place("block", ON_TABLE)],
        [vkc.Place("block", (0.5, 1.0, ABOVE))],
        [vkc.Place("block", (*ON_TABLE, 0.0, 0.0, 1.0))],
        [vkc.Place("block", (1.0, -0.2, TOP + 0.1 + 2 * ABOVE))],
        [vkc.Grasp("block"), vkc.Release("block")],
        [vkc.Grasp("block"), vkc.GoTo(0.0, 0.0), vkc.Release("block")],
    ],
)
@pytest.mark.parametrize("each", [False, True])
def test_object_may_be_placed_on_anything_that_holds_it(steps: list[vkc.Step], each: bool) -> None:
    """Another block lies at y = -0.2; where a motion ends is left to its validation."""
    other = describe_block("other", at=[1.0, -0.2, TOP + ABOVE])
    check(make_block_scene(describe_block(), other), *steps, each=each)


def test_object_that_the_hand_holds_at_the_start_must_rest_to_be_released() -> None:
    scene = make_block_scene().with_held({"block": "top"})
    with expect_error("'block' would not stay where it is released: .* mid-air", field="steps[0]"):
        check(scene, vkc.Release("block"))
    check(scene, vkc.Release("block", unsupported=True))
    check(scene, vkc.GoTo(0.0, 0.0), vkc.Release(), each=True)


def test_object_may_be_put_back_where_the_scene_has_it() -> None:
    floating = make_block_scene(describe_block(at=[1.0, 0.0, TOP + 0.1]))
    check(floating, vkc.Place("block", (1.0, 0.0, TOP + 0.1)))
    check(floating, vkc.Place("block", (1.0, 0.0, TOP + 0.1, 0, 0, 1.0)))
    with expect_error("mid-air"):
        check(floating, vkc.Place("block", (1.0, 0.01, TOP + 0.1)))


def test_long_object_needs_a_heading_at_which_it_rests() -> None:
    """A plank rests along a narrow shelf, but not across its end."""
    plank = describe_block(size=(0.05, 0.4, 0.02), mass=0.2, centre=(0.0, 0.15, 0.0))
    shelf = describe_box("shelf", [0.08, 0.6, 0.02], [1.0, 1.0, TOP - 0.01])
    scene = make_block_scene(plank, obstacles=[TABLE, shelf])
    check(scene, vkc.Place("block", (1.0, 1.0, TOP + ABOVE)))
    check(scene, vkc.Place("block", (1.0, 1.0, TOP + ABOVE, 0, 0, 0)))
    with expect_error("beyond its contact with 'shelf'"):
        check(scene, vkc.Place("block", (1.0, 1.0, TOP + ABOVE, 0, 0, np.pi / 2)))


def test_moved_joints_are_supports_where_they_will_be() -> None:
    scene = vkc.load_scene("household")
    out, rack = vkc.Actuate("dishwasher", {"rack": 0.4}), vkc.Place("cup", (-2.8, 3.2, 0.4735))
    for each in (False, True):
        check(scene, out, rack, each=each)
        with expect_error("'cup' would not stay where it is released", field="steps[0]"):
            check(scene, rack, out, each=each)


def test_support_whose_heading_the_motion_chooses_is_left_to_validation() -> None:
    """A block beyond the middle of a plank may or may not rest on it."""
    plank = describe_block("plank", size=(0.1, 0.5, 0.02), at=[1.0, 0.0, TOP + ABOVE])
    block = describe_block(at=[0.75, -0.25, TOP + ABOVE])
    scene = make_block_scene(plank, block)
    x, y, z = 1.0, 1.0, ABOVE
    on_it, far = (x, y + 0.2, z + 0.02 + ABOVE), (x, y + 0.8, z + 0.02 + ABOVE)
    for each in (False, True):
        check(scene, vkc.Place("plank", (x, y, z)), vkc.Place("block", on_it), each=each)
        with expect_error("mid-air", field="steps[1]"):
            check(scene, vkc.Place("plank", (x, y, z)), vkc.Place("block", far), each=each)
        turned = vkc.Place("plank", (x, y, z, 0, 0, np.pi / 2))
        with expect_error("mid-air", field="steps[1]"):
            check(scene, turned, vkc.Place("block", on_it), each=each)


@pytest.mark.parametrize("name", sorted(CHORES))
def test_steps_of_chores_are_supported(name: str) -> None:
    scene = CHORES[name].scene()
    check(scene, *CHORES[name].steps(scene), each=True)


HEAVY = describe_block("anvil", size=(0.06, 0.06, 0.1), mass=6.0)


@pytest.mark.parametrize("steps", [[vkc.Grasp("anvil")], [vkc.Place("anvil", ON_TABLE)]])
def test_object_heavier_than_the_payload_is_refused(steps: Sequence[vkc.Step]) -> None:
    """A UR5e carries 5 kg with its gripper of 0.925 kg."""
    scene = make_block_scene(HEAVY)
    assert scene.robot.payload == pytest.approx(5.0 - 0.925)
    tasks = [compile_task(scene, steps, vkc.Options())]
    with expect_error("would carry 6 kg, 'anvil'.*at most 4.08 kg", field="steps[0]"):
        check_loads(scene, tasks, vkc.Options())
    with expect_error("at most 5.71 kg"):
        check_loads(scene, tasks, vkc.Options(payload_factor=1.4))
    check_loads(scene, tasks, vkc.Options(payload_factor=1.5))


def make_tray(mass: float) -> dict[str, Any]:
    return describe_block("board", size=(0.1, 0.4, 0.02), mass=mass)


@pytest.mark.parametrize(("mass", "is_refused"), [(2.0, False), (2.2, True)])
def test_what_rests_on_an_object_counts(mass: float, is_refused: bool) -> None:
    weight = describe_block(mass=2.0, at=[1.0, 0.1, TOP + 0.02 + 2 * ABOVE])
    scene = make_block_scene(make_tray(mass), weight)
    tasks = [compile_task(scene, [vkc.Place("board", (1.0, 0.0, TOP + ABOVE))], vkc.Options())]
    if is_refused:
        with expect_error("would carry 4.2 kg, 'board' and 'block'"):
            check_loads(scene, tasks, vkc.Options())
    else:
        check_loads(scene, tasks, vkc.Options())


def test_mass_of_what_is_not_carried_does_not_count() -> None:
    scene = make_block_scene(HEAVY, describe_block(at=[1.0, -0.2, TOP + ABOVE]))
    steps = [vkc.Place("block", ON_TABLE), vkc.GoTo(0.0, 0.0)]
    check_loads(scene, [compile_task(scene, steps, vkc.Options())], vkc.Options())
    door = vkc.load_scene("door")
    steps = [vkc.Actuate("door", {"hinge": 1.0})]
    check_loads(door, [compile_task(door, steps, vkc.Options())], vkc.Options(payload_factor=1e-6))


def test_robot_without_a_stated_payload_carries_anything() -> None:
    scene = make_block_scene(describe_block("anvil", mass=600.0))
    scene = dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, payload=None))
    check_loads(scene, [compile_task(scene, [vkc.Grasp("anvil")], vkc.Options())], vkc.Options())


@pytest.mark.parametrize("step", [vkc.Place, vkc.Release])
def test_unsupported_is_true_or_false(step: Any) -> None:
    with expect_error(rf"{step.__name__}\.unsupported"):
        step("block", *([IN_AIR] if step is vkc.Place else []), unsupported="yes")


def test_pose_in_any_form_is_checked() -> None:
    pose = pin.SE3(np.eye(3), np.array(IN_AIR))
    with expect_error("mid-air"):
        check(make_block_scene(), vkc.Place("block", pose))


def test_place_inside_something_is_explained_by_planning() -> None:
    solid = describe_box("solid", [0.4, 0.4, 0.4], [0.5, 1.0, 0.3])
    scene = make_block_scene(obstacles=[TABLE, solid])
    check(scene, vkc.Place("block", (0.5, 1.0, 0.25)))
