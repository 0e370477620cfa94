"""Tests the compilation of steps in which objects are carried, placed or used as tools."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import BALL, STICK, make_room, place_object
from helpers.expected_errors import expect_error
from helpers.small_problems import make_full_scene, replace_objects

from vkc_pin import Actuate, GoTo, Grasp, Hold, Options, Place, Reach, Release, Scene, Touch
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Phase, Task
from vkc_pin.world.task.steps import Step

OPTIONS = Options(reach_waypoints=10, turn_waypoints=3, move_waypoints=7)
GRIP = Hold("stick", "grip")
END = Hold("stick", "end")
PULLED = Hold("ball", "pull", GRIP, "tip")
HANDLE = Hold("door", "handle")
POINT = (0.4, 0.2, 0.9)
POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -2.0, 0.7), np.array(POINT))


@cache
def make_scene() -> Scene:
    """Return the door scene with drawer, cabinet, stick and ball."""
    return replace_objects(make_full_scene(), make_room(objects=("stick", "ball")).objects)


def compile_steps(*steps: Step, scene: Scene | None = None) -> Task:
    return compile_task(scene or make_scene(), steps, OPTIONS)


def get_names(task: Task) -> list[str]:
    return [phase.name for phase in task.phases]


def get_holds(task: Task) -> list[tuple[Hold, ...]]:
    return [phase.held for phase in task.phases]


def get_goal(phase: Phase) -> tuple[object, ...]:
    (goal,) = phase.frames
    return goal.frame, goal.kind, goal.hold, goal.touches


def test_touch_with_a_stick_grasps_it_first() -> None:
    task = compile_steps(Touch("stick.tip", POINT))
    reach, touch = task.phases
    assert get_names(task) == ["reach stick.grip", "touch with stick.tip"]
    assert (task.segments, task.holds, task.after) == (20, (GRIP,), (GRIP,))
    assert (reach.held, reach.grasps, reach.released, reach.frames) == ((), (GRIP,), (), ())
    assert (touch.held, touch.grasps, touch.released) == ((GRIP,), (), ())
    assert get_goal(touch) == ("tip", "point", GRIP, True)
    np.testing.assert_array_equal(touch.frames[0].placement.translation, POINT)
    assert task.state == {}  # a stick has no joints


def test_place_grasps_carries_and_releases() -> None:
    task = compile_steps(Place("stick", POSE), GoTo(0.0, 0.0))
    assert get_names(task) == ["reach stick.grip", "place stick", "go to"]
    reach, place, leave = task.phases
    assert get_goal(place) == ("stick", "pose", GRIP, False)
    assert place.frames[0].placement == POSE
    assert (place.held, place.lifted, place.lowered) == ((GRIP,), {GRIP: STICK}, {GRIP: POSE})
    assert (leave.held, leave.released, leave.released_by) == ((), (GRIP,), {})
    assert leave.resting["stick"] == POSE
    assert task.after == reach.released == place.released == ()


def test_place_at_a_point_keeps_the_object_upright() -> None:
    lying = place_object(make_scene(), "stick", POSE)
    task = compile_steps(Place("stick", (0.0, 1.0, 0.5)), GoTo(0.0, 0.0), scene=lying)
    _, place, leave = task.phases
    assert get_goal(place) == ("stick", "upright", GRIP, False)
    assert place.frames[0].placement == pin.SE3(POSE.rotation, np.array([0.0, 1.0, 0.5]))
    assert place.released_by == {}
    assert leave.released_by == {"stick": (GRIP, 1)}  # placement at the end of phase 1
    assert "stick" in leave.resting


def test_release_ends_the_holds() -> None:
    touch = Touch("stick.tip", POINT)
    task = compile_steps(touch, Release(), GoTo(0.0, 0.0))
    assert get_names(task) == ["reach stick.grip", "touch with stick.tip", "go to"]
    last = task.phases[2]
    assert (last.held, last.released, last.released_by) == ((), (GRIP,), {"stick": (GRIP, 1)})
    assert task.after == compile_steps(touch, Release("stick")).after == ()
    assert compile_steps(Grasp("door"), Release(), GoTo(0.0, 0.0)).phases[1].released == (HANDLE,)


def test_release_of_objects_held_at_the_start() -> None:
    held = make_scene().with_held({"stick": "grip"})
    task = compile_steps(Release(), scene=held)
    assert (get_names(task), get_holds(task), task.after) == (["stand still"], [(GRIP,)], ())
    for steps, released_by in (
        ((Release(), GoTo(0.0, 0.0)), {}),  # the release precedes all motion
        ((GoTo(0.0, 1.0), Release(), GoTo(0.0, 0.0)), {"stick": (GRIP, 0)}),
    ):
        phase = compile_steps(*steps, scene=held).phases[1]
        assert (phase.released, phase.released_by) == ((GRIP,), released_by)


def test_released_object_takes_along_what_is_held_through_it() -> None:
    held = make_scene().with_held({"stick": "grip", "ball": "pull"}, by={"ball": "stick.tip"})
    tasks = [compile_steps(step, scene=held) for step in (Release("stick"), Release())]
    assert [hold.object for hold in tasks[0].phases[0].lowered] == ["ball", "stick"]
    assert tasks[0].phases == tasks[1].phases
    assert tasks[0].after == ()


def test_fixed_objects_are_released_before_other_steps() -> None:
    for step in (Reach(POSE), GoTo(0.0, 0.0), Touch("forearm_link", POINT)):
        assert get_holds(compile_steps(Grasp("stick"), step)) == [(), (GRIP,)]
        assert compile_steps(Grasp("door"), step).phases[1].released == (HANDLE,)


def test_ball_is_fetched_with_the_stick() -> None:
    task = compile_steps(
        Grasp("stick"),
        Grasp("ball", by="stick.tip"),
        GoTo(0.0, 0.0),
        Place("ball", POINT),
        Place("stick", POSE),
    )
    assert get_names(task) == [
        "reach stick.grip",
        "reach ball.pull by stick.tip",
        "go to",
        "place ball",
        "place stick",
    ]
    assert get_holds(task) == [(), (GRIP,), (GRIP, PULLED), (GRIP, PULLED), (GRIP,)]
    assert task.holds == (GRIP, PULLED)
    assert [phase.grasps for phase in task.phases] == [(GRIP,), (PULLED,), (), (), ()]
    assert [phase.released for phase in task.phases] == [(), (), (), (), (PULLED,)]
    assert task.phases[2].lifted == {PULLED: BALL}
    assert task.phases[3].frames[0].hold == PULLED
    assert task.phases[4].released_by == {"ball": (PULLED, 3)}
    assert task.after == ()


def test_releasing_the_stick_releases_the_ball_on_it() -> None:
    fetch = [Grasp("stick"), Grasp("ball", "pull", by="stick.tip")]
    for step in (Release(), Release("stick"), Place("stick", POSE)):
        task = compile_steps(*fetch, step, GoTo(0.0, 0.0))
        assert (task.phases[-1].held, task.after) == ((), ())
        assert {hold.object for hold in task.phases[-1].released} == {"stick", "ball"}
        assert "ball" in task.phases[-1].released_by
        assert ("stick" in task.phases[-1].released_by) == isinstance(step, Release)
    task = compile_steps(*fetch, Release("ball"), GoTo(0.0, 0.0))
    assert (task.phases[-1].held, task.after) == ((GRIP,), (GRIP,))


@pytest.mark.parametrize(
    "second",
    [
        Grasp("ball"),
        Grasp("door"),
        Actuate("drawer", {"slide": 0.2}),
        Touch("ball.ball", POINT),
        Place("ball", POINT),
    ],
    ids=lambda step: f"{type(step).__name__} {getattr(step, 'object', 'ball')}",
)
def test_hand_holds_one_object_only(second: Step) -> None:
    held = make_scene().with_held({"stick": "grip"})
    for steps, scene in (([GoTo(0.0, 0.0), Grasp("stick")], None), ([], held)):
        with expect_error(rf"steps\[{len(steps)}\].* one hand.*stick\.grip"):
            compile_steps(*steps, second, scene=scene)
    compile_steps(Grasp("stick"), Release(), second)


def test_placed_object_can_be_grasped_again() -> None:
    task = compile_steps(Place("stick", POSE), GoTo(0.0, 0.0), Touch("stick.tip", POINT))
    assert get_names(task) == [
        "reach stick.grip",
        "place stick",
        "go to",
        "reach stick.grip",
        "touch with stick.tip",
    ]
    assert task.holds == (GRIP,)
    again, touch = task.phases[3:]
    assert again.grasps == (GRIP,)
    assert again.resting["stick"] == POSE
    assert touch.lifted == {GRIP: POSE}
    elsewhere = compile_steps(Place("stick", POSE), Grasp("stick", "end"))
    assert elsewhere.holds == (GRIP, END)
    assert elsewhere.phases[2].released == (GRIP,)


@pytest.mark.parametrize(
    "before",
    [
        [Grasp("stick"), Release()],
        [Touch("stick.tip", POINT), Release("stick")],
        [Place("stick", POINT)],
    ],
    ids=["grasped and released", "used and released", "placed at a point"],
)
def test_object_of_uncertain_placement_cannot_be_grasped(before: Sequence[Step]) -> None:
    with expect_error(rf"steps\[{len(before)}\].* known only after planning"):
        compile_steps(*before, Touch("stick.tip", POSE))
    other = compile_steps(*before, Grasp("ball"))
    assert other.phases[-1].grasps == (Hold("ball", "grip"),)


HOLDING = [Grasp("stick")]


@pytest.mark.parametrize(
    ("before", "step", "field", "message"),
    [
        ([], Touch("stick.top", POINT), "frame", "did you mean 'tip'"),
        ([], Touch("stik.tip", POINT), "frame", "there is no object"),
        ([], Touch("tol", POINT), "frame", "did you mean 'tool'"),
        ([], Reach(POSE, "tol"), "frame", "did you mean 'tool'"),
        ([], Place("stik", POINT), "object", "did you mean 'stick'"),
        ([], Place("stick", POINT, "gripp"), "attachment", "did you mean 'grip'"),
        ([], Actuate("dor", {"hinge": 1.0}), "object", "did you mean 'door'"),
        ([], Actuate("door", {"hing": 1.0}), "joints", "did you mean 'hinge'"),
        ([], Actuate("door", {"hinge": 1.0}, "handel"), "attachment", "did you mean 'handle'"),
        ([], Actuate("ball", {"x": 0.0}), "object", "a free object"),
        ([], Actuate("stick", {"tip_joint": 0.0}), "object", "a free object"),
        ([], Touch("stick", POINT), "frame", "an object, not .* one of stick.stick, stick.tip"),
        ([], Touch("universe", POINT), "frame", "there is no frame of the robot"),
        ([], Reach(POSE, "universe"), "frame", "there is no frame of the robot"),
        ([], Touch("door.lever", POINT), "frame", "cannot be carried"),
        ([], Place("door", POSE), "object", "is fixed in the world"),
        (HOLDING, Place("stick", POSE, "end"), "attachment", "held elsewhere"),
        (HOLDING, Release("stik"), "object", "did you mean 'stick'"),
        ([], Release(), "", "hand is empty"),
        ([Place("stick", POSE)], Release(), "", "hand is empty"),
        (HOLDING, Grasp("ball", by="tip"), "by", "not a link of an object"),
        (HOLDING, Grasp("ball", by="stik.tip"), "by", "did you mean 'stick'"),
        (HOLDING, Grasp("ball", by="stick.top"), "by", "did you mean 'tip'"),
        (HOLDING, Grasp("ball", by="door.lever"), "by", "does not carry"),
        (HOLDING, Grasp("ball", by="ball.ball"), "by", "does not carry"),
        ([], Grasp("ball", by="stick.tip"), "by", "does not carry .*got 'stick.tip'"),
        ([Place("stick", POSE)], Grasp("ball", by="stick.tip"), "by", "does not carry"),
        ([Grasp("door")], Grasp("ball", by="door.lever"), "by", "does not carry"),  # it is fixed
        (HOLDING, Grasp("stick", by="stick.tip"), "", "held already"),
        (HOLDING, Grasp("stick", "end"), "", "held already"),
        (HOLDING, Grasp("door", by="stick.tip"), "by", "is fixed in the world"),
    ],
)
def test_invalid_steps_are_rejected(
    before: Sequence[Step], step: Step, field: str, message: str
) -> None:
    place = f"steps[{len(before)}]"
    with expect_error(message, field=f"{place}.{field}" if field else place):
        compile_steps(*before, step)


def test_every_phase_has_placements_of_all_free_objects() -> None:
    """A free object is either held or at rest, never both."""
    task = compile_steps(
        Touch("stick.tip", POINT),
        Grasp("ball", by="stick.tip"),
        Place("ball", POSE),
        Place("stick", POSE),
        Grasp("ball"),
        Release(),
        Actuate("drawer", {"slide": 0.1}),
    )

    for phase in task.phases:
        carried, resting = {hold.object for hold in phase.held}, set(phase.resting)
        assert not carried & resting
        assert (carried | resting) >= {"stick", "ball"}
        assert set(phase.released_by) <= resting
    for before, after in itertools.pairwise(task.phases):
        assert set(after.held) == ({*before.held, *before.grasps} - set(after.released))
        assert set(after.lifted) == {
            hold
            for hold in before.grasps
            if hold in after.held and hold.object in ("stick", "ball")
        }
