"""Tests the grouping of steps into actions, and the check of steps before planning."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.expected_errors import expect_error
from helpers.litter import BIN_POSITION, LITTER_POSITION, make_littered_scene

import vkc_pin as vkc
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.task.actions import (
    compile_each_step,
    generate_alternatives,
    generate_regrasps,
    group_into_actions,
)
from vkc_pin.world.task.compiler import compile_task

TABLE = (-3.0, 1.3, 1.051)  # on the bar table


OPEN = vkc.Actuate("refrigerator", {"hinge": 1.57})
SHUT = vkc.Actuate("refrigerator", {"hinge": 0.0})
CUP = (vkc.Grasp("cold_cup"), vkc.Place("cold_cup", TABLE))


@cache
def load_scene(name: str) -> vkc.Scene:
    """Return a packaged scene, which is loaded once."""
    return vkc.load_scene(name)


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
    scene, options = load_scene("household"), vkc.Options()
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
        compile_each_step(load_scene("household"), steps, vkc.Options())


@pytest.mark.parametrize("is_supported", [True, False])
def test_free_object_is_regrasped_only_if_it_rests_on_a_support(is_supported: bool) -> None:
    """Without a support it would fall."""
    x, y, z = (
        make_littered_scene().with_held({"litter": "grip"}).objects["litter"].placement.translation
    )
    table = describe_box("table", [0.2, 0.2, 0.02], [x, y, z - LITTER_POSITION[2] - 0.01])
    scene = make_littered_scene(*[table] * is_supported).with_held({"litter": "grip"})
    place, options = vkc.Place("litter", BIN_POSITION), vkc.Options()
    task = compile_task(scene, [place], options)
    again = (vkc.Release("litter"), vkc.Place("litter", BIN_POSITION, "grip"))
    found = list(generate_regrasps(scene, task, options))
    assert found == [("litter.grip, grasped again", again)] * is_supported
    assert not list(generate_alternatives(task)), "it keeps the present grasp"


def test_only_the_grasp_of_a_step_is_repeated() -> None:
    """Neither one that moves other joints, nor one by a tool, which cannot be put down."""
    options = vkc.Options()
    scene = load_scene("household").with_held({"dishwasher": "handle"})
    task = compile_task(scene, [vkc.Actuate("dishwasher", {"door": 0.0})], options)
    assert not list(generate_regrasps(scene, task, options))
    assert [name for name, _ in generate_alternatives(task)] == ["dishwasher.door_push"]
    fetch = load_scene("fetch").with_held(
        {"stick": "grip", "ball": "pull"}, by={"ball": "stick.tip"}
    )
    x, y, _ = fetch.objects["ball"].placement.translation
    task = compile_task(fetch, [vkc.Place("ball", (x, y, 0.05))], options)
    assert not list(generate_regrasps(fetch, task, options))


PUT_DOWN = vkc.Place("cup", (-0.6, -1.6, 0.751))
DOOR_SHUT = {"door": 0.0}


@pytest.mark.parametrize(
    ("name", "steps", "expected"),
    [
        ("household", [vkc.Grasp("cup")], ["oblique", "top"]),
        ("household", [PUT_DOWN], ["oblique", "top"]),
        ("household", [vkc.Touch("cup.cup", (0.5, -1.6, 1.0))], ["oblique", "top"]),
        ("household", [vkc.Grasp("cup"), PUT_DOWN], ["oblique", "top"]),
        ("household", [vkc.Grasp("cup"), vkc.GoTo(0.0, 0.0), PUT_DOWN], ["oblique", "top"]),
        ("household", [vkc.Actuate("dishwasher", DOOR_SHUT)], ["door_push"]),
        ("household", [vkc.Grasp("cup", "top"), PUT_DOWN], []),
        ("household", [vkc.Place("cup", PUT_DOWN.pose, "side")], []),
        ("household", [vkc.Touch("cup.cup", (0.5, -1.6, 1.0), "side")], []),
        ("fetch", [vkc.Grasp("stick")], ["end"]),
        ("fetch", [vkc.Grasp("stick", "end"), vkc.Grasp("ball", by="stick.tip")], []),
        ("fetch", [vkc.Grasp("ball")], []),
    ],
)
def test_alternatives_are_the_attachments_that_no_step_names(
    name: str, steps: list[vkc.Step], expected: list[str]
) -> None:
    """Neither a tool's attachments for the hand, nor the hand's for a tool."""
    scene, options = load_scene(name), vkc.Options()
    alternatives = list(generate_alternatives(compile_task(scene, steps, options)))
    assert [label.partition(".")[2] for label, _ in alternatives] == expected
    for label, others in alternatives:
        owner, _, attachment = label.partition(".")
        phases = compile_task(scene, others, options).phases
        held = {hold for phase in phases for hold in (*phase.held, *phase.grasps)}
        assert {(hold.object, hold.attachment) for hold in held} == {(owner, attachment)}


def test_tool_grasps_at_the_attachment_that_is_made_for_it() -> None:
    scene, options = load_scene("fetch"), vkc.Options()
    steps = [vkc.Grasp("stick"), vkc.Grasp("ball", by="stick.tip")]
    assert [hold.attachment for hold in compile_task(scene, steps, options).after] == [
        "grip",
        "pull",
    ]


def test_several_open_attachments_of_a_task_have_no_alternatives() -> None:
    """Each of them has been planned alone before."""
    steps = [PUT_DOWN, vkc.Actuate("dishwasher", DOOR_SHUT)]
    task = compile_task(load_scene("household"), steps, vkc.Options())
    assert [(one.step, one.object) for one in task.open_attachments] == [
        (0, "cup"),
        (1, "dishwasher"),
    ]
    assert not list(generate_alternatives(task))
    assert [label for label, _ in generate_alternatives(task.truncate(1))] == [
        "cup.oblique",
        "cup.top",
    ]


def test_grasp_is_open_only_where_the_next_step_can_use_it() -> None:
    """The rack is pulled by its bar or its posts, not by the door's rail."""
    scene = load_scene("household")
    steps = [vkc.Grasp("dishwasher"), vkc.Actuate("dishwasher", {"rack": 0.3})]
    task = compile_task(scene, steps, vkc.Options())
    others = [label.partition(".")[2] for label, _ in generate_alternatives(task)]
    assert others == ["handle_free", "side", "other_side"]


def test_object_is_grasped_again_at_another_attachment_unless_that_is_named() -> None:
    held = load_scene("household").with_held({"cup": "side"})
    shapes = make_world_shapes(held.objects["cup"])
    lowest = min(compute_world_box(one.geometry, one.placement)[0][2] for one in shapes)
    x, y, _ = held.objects["cup"].placement.translation
    below = describe_box("below", [0.3, 0.3, 0.02], [x, y, lowest - 0.011])
    document = held.document
    obstacles = [*document["obstacles"], below]
    held = vkc.Scene.from_document({**document, "obstacles": obstacles}, held.folder)
    options = vkc.Options()
    task = compile_task(held, [PUT_DOWN], options)
    labels = [label for label, _ in generate_regrasps(held, task, options)]
    assert labels == ["cup.side, grasped again", "cup.oblique", "cup.top"]
    assert len(list(generate_regrasps(held, task, options, {"cup"}))) == 1
    named = compile_task(held, [vkc.Place("cup", PUT_DOWN.pose, "side")], options)
    assert len(list(generate_regrasps(held, named, options))) == 1
