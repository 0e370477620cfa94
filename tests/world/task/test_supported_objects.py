"""Tests the objects that moving links support in the phases of a task."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_box
from helpers.expected_errors import expect_error
from helpers.supports import (
    TOP,
    describe_cup,
    make_plate_scene,
    make_scene,
    make_tray_scene,
)

import vkc_pin as vkc
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Task

GOAL = pin.SE3(np.eye(3), np.array([-0.5, -1.5, 0.7]))


def compile_steps(scene: vkc.Scene, *steps: vkc.Step) -> Task:
    return compile_task(scene, steps, vkc.Options())


def list_supported(task: Task) -> list[list[tuple[str, str]]]:
    return [[(item.object, item.support) for item in phase.supported] for phase in task.phases]


def test_cup_on_the_plate_moves_with_it() -> None:
    slide = vkc.Actuate("plate", {"slide": 0.4})
    task = compile_steps(make_plate_scene(cups=2), slide, vkc.Grasp("cup"), vkc.GoTo(0.0, 0.0))
    assert list_supported(task) == [[], [("cup", "plate.plate"), ("cup_1", "plate.plate")], [], []]
    for name, y in (("cup", 0.05), ("cup_1", -0.07)):
        for phase, x in ((1, 0.8), (2, 0.4)):
            found = task.phases[phase].resting[name].translation
            np.testing.assert_allclose(found, [x, y, TOP], rtol=0.0, atol=1e-12)
    assert [hold.object for hold in task.phases[3].held] == ["cup"]


@pytest.mark.parametrize(
    ("kind", "gap", "joints", "supported"),
    [
        ("plate", 0.05, {"slide": 0.4}, []),
        ("turntable", 0.0, {"turn": 0.5}, [("cup", "plate.plate")]),
        ("flap", 0.0, {"tip": 0.09}, [("cup", "plate.plate")]),
    ],
)
def test_supported_objects_touch_a_link_that_stays_level(
    kind: str, gap: float, joints: dict[str, float], supported: list[tuple[str, str]]
) -> None:
    task = compile_steps(make_plate_scene(kind, gap=gap), vkc.Actuate("plate", joints))
    assert list_supported(task) == [[], supported]


def test_tilting_support_is_rejected() -> None:
    message = r"'cup' rests on 'plate\.plate', which would tilt too much.*0\.5 rad"
    with expect_error(message, field="steps[0]"):
        compile_steps(make_plate_scene("flap"), vkc.Actuate("plate", {"tip": 0.5}))
    tips = [vkc.Actuate("plate", {"tip": tip}) for tip in (0.09, 0.0, 0.09, 0.18)]
    compile_steps(make_plate_scene("flap"), *tips[:3])
    with expect_error("would tilt too much", field="steps[3]", got="0.18 rad"):
        compile_steps(make_plate_scene("flap"), *tips)


def test_object_on_moving_and_fixed_links_is_rejected() -> None:
    plate = {"name": "plate", "type": "plate.yaml", "position": [0.8, 0.0, 0.0]}
    shelf = describe_box("shelf", [0.2, 0.4, 0.02], [1.1, 0.0, TOP - 0.01])
    between = make_scene([plate, describe_cup(at=(1.0, 0.0, TOP))], [shelf])
    with expect_error(r"rests both on a moving and on a fixed link: 'plate\.plate' and 'shelf'"):
        compile_steps(between, vkc.Actuate("plate", {"slide": 0.4}))
    assert list_supported(compile_steps(between, vkc.GoTo(0.0, 0.0))) == [[]]


def test_cup_placed_on_the_plate_moves_with_it() -> None:
    scene = make_plate_scene().with_placement("cup", pin.SE3(np.eye(3), np.array([0.0, 1.0, 0.0])))
    steps = vkc.Place("cup", [0.8, 0.05, TOP]), vkc.Actuate("plate", {"slide": 0.4})
    task = compile_steps(scene, *steps)
    assert list_supported(task)[-1] == [("cup", "plate.plate")]
    assert "cup" in task.phases[-2].released_by  # the motion determines its heading
    assert "cup" not in task.phases[-1].released_by


def test_cup_on_the_held_tray_moves_with_it() -> None:
    task = compile_steps(make_tray_scene(), vkc.Place("tray", GOAL), vkc.GoTo(0.0, 0.0))
    assert list_supported(task) == [[], [("cup", "tray.tray")], []]
    left = task.phases[2].resting["cup"].translation
    np.testing.assert_allclose(
        left, GOAL.translation + np.array([0.02, 0.05, 0.02]), rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda goal: vkc.Place("tray", goal), "steps[0].pose"),
        (lambda goal: vkc.Touch("tray.tray", goal), "steps[0].target"),
    ],
)
def test_goal_that_tilts_the_held_tray_is_rejected(
    make: Callable[[pin.SE3], vkc.Step], field: str
) -> None:
    level, tilted = (pin.SE3(pin.utils.rotate(axis, 0.2), GOAL.translation) for axis in "zx")
    assert compile_steps(make_tray_scene(), make(level)).phases
    with expect_error(r"'cup' rests on 'tray\.tray', which would tilt", field=field, got="0.2 rad"):
        compile_steps(make_tray_scene(), make(tilted))


def test_supported_object_cannot_be_grasped() -> None:
    with expect_error("'cup' rests on an object that the robot carries"):
        compile_steps(make_tray_scene(), vkc.Grasp("tray"), vkc.Grasp("cup", by="tray.tray"))


def test_supported_object_of_uncertain_placement_cannot_be_grasped() -> None:
    with expect_error("the placement of 'cup' at this step is known only after planning"):
        compile_steps(make_tray_scene(), vkc.Place("tray", [-0.5, -1.5, 0.7]), vkc.Grasp("cup"))
    compile_steps(make_tray_scene(), vkc.Place("tray", GOAL), vkc.Grasp("cup"))
