"""Tests the grouping of steps into actions, and the check of steps before planning."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.expected_errors import expect_error
from helpers.litter import BIN_POSITION, LITTER_POSITION, make_littered_scene

import vkc_pin as vkc
from vkc_pin.world.task.actions import compile_each_step, generate_alternatives, group_into_actions
from vkc_pin.world.task.compiler import compile_task

TABLE = (-3.0, 1.3, 1.051)  # on the bar table


OPEN, SHUT = (
    vkc.Actuate("refrigerator", {"hinge": 1.57}),
    vkc.Actuate("refrigerator", {"hinge": 0.0}),
)
CUP = (vkc.Grasp("cold_cup"), vkc.Place("cold_cup", TABLE))


def test_steps_with_one_object_form_one_action() -> None:
    actions: list[tuple[vkc.Step, ...]] = [
        (vkc.Grasp("refrigerator"), OPEN),
        CUP,
        (SHUT,),
        (vkc.Grasp("broom"),),
        (
            vkc.Grasp("litter", "pull", by="broom.bristles"),
            vkc.Place("litter", (1.1, -2.9, 0.036)),
            vkc.Release(),
        ),
        (vkc.GoTo(0, 0),),
    ]
    assert group_into_actions([step for action in actions for step in action]) == actions


def test_steps_are_compiled_in_the_scene_after_the_previous_steps() -> None:
    scene, options = vkc.load_scene("household"), vkc.Options()
    steps = [OPEN, *CUP, SHUT]
    tasks = compile_each_step(scene, steps, options)
    assert [task.steps for task in tasks] == [(step,) for step in steps]
    assert [[phase.name for phase in task.phases] for task in tasks] == [
        ["reach refrigerator.handle", "move refrigerator.hinge"],
        ["reach cold_cup.side"],
        ["place cold_cup"],
        ["reach refrigerator.handle", "move refrigerator.hinge"],
    ]
    assert tasks[-1].state["refrigerator.hinge"] == pytest.approx(1.57), "it is not open yet"
    assert tasks[-1].phases[-1].values == {"refrigerator.hinge": 0.0}
    assert [hold.object for hold in tasks[1].after] == ["cold_cup"]
    again = compile_each_step(scene, [*steps, vkc.Grasp("cold_cup")], options)[-1]
    (grasp,) = again.phases
    np.testing.assert_allclose(grasp.resting["cold_cup"].translation, TABLE, atol=1e-6)


@pytest.mark.parametrize(
    ("steps", "field", "problem"),
    [
        ([OPEN, vkc.Grasp("cold_cup"), SHUT], "steps[2].object", "one hand"),
        ([OPEN, *CUP, vkc.Release()], "steps[3]", "hand is empty"),
        ([OPEN, vkc.Grasp("no_cup")], "steps[1].object", "no object"),
    ],
)
def test_error_names_the_first_infeasible_step(
    steps: list[vkc.Step], field: str, problem: str
) -> None:
    with expect_error(rf"{re.escape(field)}.*{problem}"):
        compile_each_step(vkc.load_scene("household"), steps, vkc.Options())


@pytest.mark.parametrize("is_supported", [True, False])
def test_free_object_is_regrasped_only_if_it_rests_on_a_support(is_supported: bool) -> None:
    """Without a support it would fall."""
    x, y, z = (
        make_littered_scene().with_held({"litter": "grip"}).objects["litter"].placement.translation
    )
    table = describe_box("table", [0.2, 0.2, 0.02], [x, y, z - LITTER_POSITION[2] - 0.01])
    scene = make_littered_scene(*[table] * is_supported).with_held({"litter": "grip"})
    place = vkc.Place("litter", BIN_POSITION)
    task = compile_task(scene, [place], vkc.Options())
    again = (vkc.Release("litter"), vkc.Place("litter", BIN_POSITION, "grip"))
    assert (
        list(generate_alternatives(scene, task, anew=True))
        == [("litter.grip, grasped again", again)] * is_supported
    )
    assert not list(generate_alternatives(scene, task)), "a regrasp needs anew=True"


def test_only_the_grasp_of_a_step_is_repeated() -> None:
    """Neither one that moves other joints, nor one by a tool, which cannot be put down."""
    scene = vkc.load_scene("household").with_held({"dishwasher": "handle"})
    task = compile_task(scene, [vkc.Actuate("dishwasher", {"door": 0.0})], vkc.Options())
    found = [name for name, _ in generate_alternatives(scene, task, anew=True)]
    assert found == ["dishwasher.door_push"]
    fetch = vkc.load_scene("fetch").with_held(
        {"stick": "grip", "ball": "pull"}, by={"ball": "stick.tip"}
    )
    x, y, _ = fetch.objects["ball"].placement.translation
    task = compile_task(fetch, [vkc.Place("ball", (x, y, 0.05))], vkc.Options())
    assert not list(generate_alternatives(fetch, task, anew=True))
