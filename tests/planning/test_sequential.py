"""Tests sequential planning, alternative attachments, and final scenes of motions."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    STICK,
    MotionBuilder,
    compute_grasp_pose,
    describe_table,
    lift,
    make_carrying_motion,
    make_room,
    move_base,
    solve_above,
)
from helpers.drawers import add_boxes, compute_tool_pose
from helpers.judging import replace_object
from helpers.litter import BIN_POSITION, LITTER_POSITION, describe_shelf, make_littered_scene
from helpers.schedules import plan_each_step
from helpers.small_problems import make_full_scene

import vkc_pin as vkc
from tests.benchmarks.robot_object_matrix.pairs import load_description, make_hall
from vkc_pin.experiments.initialization import TARGET
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import compute_final_scene


def test_final_scene_has_the_final_coordinates_clamped_to_their_limits() -> None:
    scene, excess = make_full_scene().with_state("door", {"knob": 0.2}), 1e-4
    robot, (_, east, _, north) = scene.robot, scene.arena
    slide, turn = scene.objects["cabinet"].object.attachment("sleeve").freedoms
    hinge = scene.objects["door"].object.upper[0]
    objects = {
        "door.hinge": hinge + excess,
        "cabinet.sleeve_slide": slide.lower - excess,
        "cabinet.sleeve_turn": turn.upper + excess,
    }
    base = [east + excess, north - 1.0, 4.0]
    last = [*base, *(robot.upper[3:] + excess), *objects.values()]
    motion = Trajectory(
        (*robot.coordinates.names, *objects),
        np.array([0.0, 1.0]),
        np.array([np.zeros(len(last)), last]),
        (PhaseSpan("move", 0, 1),),
        len(scene.start),
    )
    after = compute_final_scene(scene, motion, [Hold("cabinet", "sleeve")])
    np.testing.assert_array_equal(after.start, [east, north - 1.0, 4.0, *robot.upper[3:]])
    np.testing.assert_array_equal(after.objects["door"].state, [hinge, 0.2])
    for name in ("drawer", "cabinet"):
        np.testing.assert_array_equal(after.objects[name].state, scene.objects[name].state)
    (hold,) = after.holds
    assert (hold, hold.at) == (Hold("cabinet", "sleeve"), (slide.lower, turn.upper))


def test_fixed_base_stays_where_it_is() -> None:
    """Its limits, 0, are relative to the start."""
    document = vkc.load_scene("door").document
    robot = {**document["robot"], "base": "fixed"}
    scene = vkc.Scene.from_document({**document, "robot": robot})
    (x, y, yaw), tool = scene.start[:3].tolist(), scene.tool_placement()
    steps = [vkc.Reach(tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.1]))), vkc.Reach(tool)]
    for simultaneous in (True, False):
        plan = vkc.plan(scene, steps, simultaneous=simultaneous)
        assert plan.success, plan.summary()
        assert plan.end_scene().start[:3].tolist() == [x, y, yaw]
    plan = vkc.plan(plan.end_scene(), [vkc.GoTo(x, y, yaw + 1.0)])
    assert "base_yaw: 3.2 rad is beyond the limits 2.2 to 2.2 rad by 1 rad" in plan.summary()


def test_final_placement_of_a_grasped_object() -> None:
    scene, values = make_room(describe_table()), (0.03, 0.2)
    down = solve_above(STICK, values=values)
    script = MotionBuilder(scene).go(down).take("stick", values=values)
    motion = script.go(move_base(down, x=-0.4, yaw=0.5)).motion()
    after = compute_final_scene(scene, motion, [Hold("stick", "grip")])
    assert [(hold, hold.at) for hold in after.holds] == [(Hold("stick", "grip"), values)]
    tool = compute_tool_pose(scene, script.rows[-1])
    placed = compute_grasp_pose(after.objects["stick"].placement, values=values)
    np.testing.assert_allclose(placed.homogeneous, tool.homogeneous, atol=1e-9)


def test_final_placement_of_a_released_object() -> None:
    scene = make_room(describe_table())
    after = compute_final_scene(scene, make_carrying_motion(scene).motion(), [])
    assert dict(after.held) == {}
    placed = Scene.from_document(after.document).objects["stick"].placement
    assert placed.isApprox(lift(STICK, [0.0, 0.5, 0.0]), 1e-9)


def test_final_holds_by_a_tool() -> None:
    scene = make_room(describe_table(), objects=("stick", "ball")).with_held({"stick": "grip"})
    turns = scene.objects["ball"].object.attachment("pull").freedoms
    values = [0.5 * (turn.lower + turn.upper) for turn in turns]
    script = MotionBuilder(scene).take("ball", "pull", values, by="stick.tip")
    motion = script.go(move_base(scene.start, y=0.3)).motion()
    stick = Hold("stick", "grip")
    holds = (stick, Hold("ball", "pull", stick, "tip"))
    after = compute_final_scene(scene, motion, holds)
    assert after.holds == holds
    assert after.holds[1].at == tuple(values)


INTO_BIN = vkc.Place("litter", BIN_POSITION, unsupported=True)


@functools.cache
def grasp_litter() -> vkc.Plan:
    """Return a plan that grasps a piece of litter on a shelf from the side."""
    plan = vkc.plan(
        make_littered_scene(describe_shelf(*LITTER_POSITION[:2])), [vkc.Grasp("litter", "grip")]
    )
    assert plan.success, plan.summary()
    return plan


@pytest.mark.parametrize("offset", [0.0, pytest.param(0.003, marks=pytest.mark.long)])
def test_object_is_regrasped_to_be_placed(offset: float) -> None:
    """An object grasped from the side is regrasped from above, to be placed in a bin.

    The second grasp is nominal, even if the first one is displaced by `offset` [m].
    """
    grasped = grasp_litter()
    (hold,) = grasped.end_scene().holds
    free = compute_final_scene(make_littered_scene(), grasped.trajectory, [hold])
    if offset:
        base = free.start[:3] + np.array([offset, 0.0, 0.0])
        free = free.with_measured_grasp("litter", base=base)
        assert free.holds[0] != hold
    plan = vkc.plan(free, [INTO_BIN])
    assert plan.success
    assert plan.steps == (vkc.Release("litter"), dataclasses.replace(INTO_BIN, attachment="grip"))
    assert validate(free, plan.steps, plan.trajectory).ok
    first, *_, last = (phase for phase in plan.trajectory.phases if phase.holds)
    assert (first.holds, last.holds) == (free.holds, (hold,))
    np.testing.assert_array_equal(
        np.ptp(plan.trajectory.positions[: first.last + 1, : len(free.start)], axis=0), 0.0
    )
    np.testing.assert_allclose(
        plan.end_scene().objects["litter"].placement.translation, BIN_POSITION, atol=2e-3
    )


@pytest.mark.long
@pytest.mark.parametrize("simultaneous", [True, pytest.param(False, marks=pytest.mark.long)])
def test_another_grasp_replaces_one_that_prevents_placing(
    simultaneous: bool,
) -> None:
    """From its start, the robot grasps the object from the side without any motion."""
    grasped = grasp_litter()
    (hold,) = grasped.end_scene().holds
    scene = compute_final_scene(make_littered_scene(), grasped.trajectory, [hold]).with_held({})
    grasp = vkc.Grasp("litter", "grip")
    plan = vkc.plan(scene, [grasp, INTO_BIN], simultaneous=simultaneous)
    assert plan.success, plan.summary()
    if simultaneous:  # with another grasp
        assert plan.steps == (grasp, INTO_BIN)
    else:
        again = dataclasses.replace(INTO_BIN, attachment="grip")
        assert plan.steps == (grasp, vkc.Release("litter"), again)
    np.testing.assert_allclose(
        plan.end_scene().objects["litter"].placement.translation, BIN_POSITION, atol=2e-3
    )


PLANNERS = [
    vkc.plan,
    pytest.param(functools.partial(vkc.plan, window=2), marks=pytest.mark.long),
]


def add_attachment(scene: Scene, owner: str, name: str, z: float, *, depth: float = 0.0) -> Scene:
    """Return the scene with another first attachment, higher by `z` and deeper by `depth`."""
    item = scene.objects[owner].object
    grip = item.attachment()
    rotation, position = grip.placement.rotation, grip.placement.translation
    lifted = pin.SE3(rotation, position + [0.0, 0.0, z] + depth * rotation[:, 2])
    added = dataclasses.replace(grip, name=name, placement=lifted)
    return replace_object(scene, owner, attachments={name: added, **item.attachments})


def make_refrigerator() -> Scene:
    hall = make_hall("husky_ur5e", "refrigerator_0", load_description("refrigerator_0"))
    return hall.sample_start(np.random.default_rng(0))


@pytest.mark.parametrize("planner", PLANNERS)
def test_another_attachment_is_tried_if_the_first_one_fails(
    planner: Callable[..., vkc.Plan],
) -> None:
    scene = add_attachment(vkc.load_scene("drawer"), "drawer", "ceiling", 4.0)
    step = vkc.Actuate("drawer", {"slide": 0.2})
    result = planner(scene, [step])
    assert result.success, result.summary()
    (planned_step,) = result.steps
    assert planned_step == dataclasses.replace(step, attachment="handle")
    assert result.trajectory.phases[-1].held == {"drawer": "handle"}
    alone = planner(scene, [planned_step])
    np.testing.assert_array_equal(result.trajectory.positions, alone.trajectory.positions)
    assert result.metrics["evaluations"] > alone.metrics["evaluations"], (
        "evaluations of the first attachment must count"
    )
    named = planner(scene, [dataclasses.replace(step, attachment="ceiling")])
    assert not named.success, "a named attachment must not be replaced"


@pytest.mark.parametrize("planner", PLANNERS)
def test_attachments_share_the_budget(planner: Callable[..., vkc.Plan]) -> None:
    scene = add_attachment(vkc.load_scene("drawer"), "drawer", "behind", 0.0, depth=0.04)
    step = vkc.Actuate("drawer", {"slide": 0.2})
    budget = {"max_evaluations": 30_000}
    alone = vkc.plan(scene, [dataclasses.replace(step, attachment="behind")], **budget)
    assert alone.status == "evaluation limit"
    note, ending = alone.report.notes
    assert "limit of 30000 evaluations" in ending
    assert note.startswith("the best trajectory lacks ")
    assert alone.report.violations[0].subject in note
    result = planner(scene, [step], **budget)
    assert result.success, result.summary()
    assert result.steps[0].attachment == "handle"


@pytest.mark.long
def test_failed_attachments_are_noted() -> None:
    scene = add_attachment(vkc.load_scene("drawer"), "drawer", "ceiling", 4.0)
    ceiling = scene.objects["drawer"].object.attachments["ceiling"]
    roof = dataclasses.replace(ceiling, name="roof")
    scene = replace_object(scene, "drawer", attachments={"ceiling": ceiling, "roof": roof})
    result = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.2})])
    assert result.status == "infeasible"
    assert result.steps == (vkc.Actuate("drawer", {"slide": 0.2}),)
    assert result.report.notes[-1].startswith("at drawer.roof: reach drawer.roof: out of reach")


ONTO_RACK = vkc.Place("cup", (-2.8, 3.2, 0.4735))
GRASP, AWAY = vkc.Grasp("cup"), vkc.GoTo(-0.5, -0.3)


def make_kitchen() -> Scene:
    """Return a home with an extended rack, on which a cup held at `side` cannot be placed."""
    return vkc.load_scene("household").with_state("dishwasher", {"door": 1.57, "rack": 0.4})


LONG = pytest.mark.long


@pytest.mark.parametrize(
    ("steps", "options", "grasping"),
    [
        ([ONTO_RACK], {}, 0),
        pytest.param([ONTO_RACK], {"window": 1}, 0, marks=LONG),
        pytest.param([GRASP, ONTO_RACK], {}, 0, marks=LONG),
        pytest.param([GRASP, AWAY, ONTO_RACK], {}, 0, marks=LONG),
        pytest.param([GRASP, ONTO_RACK, AWAY], {}, 0, marks=LONG),
        pytest.param([AWAY, ONTO_RACK, AWAY], {}, 1, marks=LONG),
        pytest.param([GRASP, ONTO_RACK, AWAY], {"window": 2}, 0, marks=LONG),
        pytest.param([GRASP, AWAY, ONTO_RACK], {"window": 2}, 0, marks=LONG),
    ],
)
def test_object_is_grasped_where_it_can_be_placed(
    steps: list[vkc.Step], options: dict[str, Any], grasping: int
) -> None:
    """An attachment that an earlier step chooses suits the later one."""
    plan = vkc.plan(make_kitchen(), steps, **options)
    assert plan.success, plan.summary()
    used = {phase.held["cup"] for phase in plan.trajectory.phases if phase.held}
    assert len(used) == 1
    assert used < {"oblique", "top"}
    (attachment,) = used
    named = dataclasses.replace(steps[grasping], attachment=attachment)
    assert plan.steps == (*steps[:grasping], named, *steps[grasping + 1 :])


@pytest.mark.long
@pytest.mark.parametrize(
    "steps",
    [
        [dataclasses.replace(ONTO_RACK, attachment="side")],
        pytest.param([vkc.Grasp("cup", "side"), ONTO_RACK], marks=LONG),
    ],
)
@pytest.mark.parametrize("options", [{}, pytest.param({"simultaneous": False}, marks=LONG)])
def test_named_attachment_is_never_replaced(steps: list[vkc.Step], options: dict[str, Any]) -> None:
    plan = vkc.plan(make_kitchen(), steps, **options)
    assert plan.status == "infeasible"
    assert {phase.held.get("cup", "side") for phase in plan.trajectory.phases} == {"side"}
    assert not any("oblique" in note for note in plan.report.notes)


@pytest.mark.long
def test_touch_tries_other_attachments() -> None:
    scene = add_attachment(vkc.load_scene("init_1"), "stick", "ceiling", 4.0)
    steps = [vkc.Touch("stick.tip", TARGET)]
    plan = vkc.plan(scene, steps)
    assert plan.success, plan.summary()
    assert plan.steps == (vkc.Touch("stick.tip", TARGET, "grip"),)


@pytest.mark.long
def test_cheap_attempts_come_first() -> None:
    """An attachment whose goal is blocked is left after its first guess, for one that suits."""
    plan = vkc.plan(make_kitchen(), [ONTO_RACK])
    assert plan.success, plan.summary()
    refused = vkc.plan(make_kitchen(), [dataclasses.replace(ONTO_RACK, attachment="side")])
    assert refused.status == "infeasible"
    assert plan.statistics.evaluations < refused.statistics.evaluations


@pytest.mark.long
def test_another_attachment_is_tried_for_one_of_two_steps() -> None:
    scene = add_attachment(vkc.load_scene("drawer"), "drawer", "ceiling", 4.0)
    drive = vkc.GoTo(*(scene.start[:2] + 0.1))
    result = vkc.plan(scene, [drive, vkc.Actuate("drawer", {"slide": 0.2})])
    assert result.success, result.summary()
    assert result.steps == (drive, vkc.Actuate("drawer", {"slide": 0.2}, "handle"))


def test_failure_of_one_step_fails_all_steps() -> None:
    """The motion is stationary; it does not perform the first step alone."""
    steps = [vkc.GoTo(-1.5, 0.0), vkc.GoTo(30.0, 0.0)]
    result = vkc.plan(make_refrigerator(), steps)
    assert result.status == "infeasible"
    assert result.steps == tuple(steps)
    assert np.ptp(result.trajectory.positions, axis=0).max() == 0.0


def test_two_leaves_are_opened_in_one_problem() -> None:
    steps = [vkc.Actuate("it", {"hinge_left": 0.6}), vkc.Actuate("it", {"hinge_right": 0.5})]
    result = vkc.plan(make_refrigerator(), steps)
    assert result.success, result.summary()
    assert result.initialization.endswith("then all at once")
    held = [dict(phase.held) for phase in result.trajectory.phases]
    assert held == [{}, {"it": "handle_left"}, {}, {"it": "handle_right"}]
    after = result.end_scene()
    assert after.objects["it"].state == pytest.approx([0.6, 0.5], abs=1e-3)
    assert after.held == held[-1]


@pytest.mark.long
def test_holds_of_the_same_joint_are_planned_sequentially() -> None:
    first = vkc.Actuate("it", {"hinge_left": 0.3}, "handle_left")
    second = vkc.Actuate("it", {"hinge_left": 0.6}, "handle_left_free")
    both = vkc.plan(make_refrigerator(), [first, second])
    assert both.success, both.summary()
    held = [dict(phase.held) for phase in both.trajectory.phases]
    assert held == [{}, {"it": "handle_left"}, {}, {"it": "handle_left_free"}]
    begun = vkc.plan(make_refrigerator(), [first])
    ended = vkc.plan(begun.end_scene(), [second])
    assert ended.success, ended.summary()
    assert "it.handle_left" not in ended.trajectory.names
    windowed = vkc.plan(make_refrigerator(), [first, second], window=2)
    assert windowed.success, windowed.summary()


def test_steps_are_retimed_and_validated_if_no_budget_remains_for_the_whole() -> None:
    scene = vkc.load_scene("init_1").sample_start(np.random.default_rng(5))
    steps = [vkc.Grasp("stick", "grip"), vkc.Touch("stick.tip", TARGET)]
    begin, alone = scene, list[vkc.Plan]()
    for step in steps:
        alone.append(vkc.plan(begin, [step]))
        begin = alone[-1].end_scene()
    needed = sum(plan.statistics.evaluations for plan in alone)
    found = vkc.plan(scene, steps, max_evaluations=needed)
    assert found.success, found.summary()
    assert found.initialization == ", ".join(plan.initialization for plan in alone)
    duration = sum(np.ptp(plan.trajectory.times) for plan in alone) + vkc.Options().grasp_time
    assert np.ptp(found.trajectory.times) == pytest.approx(duration, abs=1e-6)


def test_step_that_begins_in_a_dead_end_is_planned_with_the_one_before() -> None:
    """After the least motion that pulls the door open, the robot is behind it."""
    scene, options = vkc.load_scene("door"), vkc.Options()
    steps = [vkc.Actuate("door", {"hinge": -1.5}), vkc.GoTo(4.1, -0.3), vkc.GoTo(3.9, 0.3)]
    request = PlanningRequest("auto", options, random_seed=1, wants_draft=True)
    first, last = plan_each_step(scene, compile_task(scene, steps, options), request)
    assert (first.first, first.last, last.first, last.last) == (0, 1, 2, 2)
    for part, names in ((first, ["reach", "turn", "move", "go"]), (last, ["go"])):
        assert part.result.is_solved
        assert [phase.name.split()[0] for phase in part.result.task.phases] == names
    draft = first.result.found.trajectory
    assert draft.column("door.hinge")[-1] == pytest.approx(-1.5, abs=1e-3)
    np.testing.assert_allclose(draft.positions[-1, :2], [4.1, -0.3], atol=1e-3)


def test_failed_step_stays_alone_if_its_holds_cannot_be_joined() -> None:
    """Two holds of one joint are no chain, so that the step is not planned with the one before.

    A post blocks the door between the ends of both steps.
    """
    scene, options = make_refrigerator(), vkc.Options()
    refrigerator = scene.objects["it"]
    (handle, free), half = ("handle_left", "handle_left_free"), {"hinge_left": 0.45}
    grip = refrigerator.object.attachments[handle]
    post = refrigerator.with_state(half).link_placement(grip.link) * grip.placement
    x, y, z = post.translation.tolist()
    scene = add_boxes(scene, post=((0.02, 0.02, 0.1), (x, y, z + 0.6)))
    steps = [
        vkc.GoTo(*(scene.start[:2] + 0.1)),
        vkc.Actuate("it", {"hinge_left": 0.2}, handle),
        vkc.Actuate("it", {"hinge_left": 0.8}, free),
    ]
    request = PlanningRequest("auto", options, random_seed=1, wants_draft=True)
    parts = plan_each_step(scene, compile_task(scene, steps, options), request)
    assert [(part.first, part.last) for part in parts] == [(0, 0), (1, 1), (2, 2)]
    assert [part.result.is_solved for part in parts] == [True, True, False]
    last = parts[-1].result
    assert last.plan.steps == (steps[-1],)
    assert not last.is_blocked_after(scene)
    (note,) = last.plan.report.notes
    assert "no path for it.hinge_left, proven" in note
    assert "it.door_left – post" in note
