"""Tests the compilation of steps in which objects are carried, placed or used as tools."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import BALL, STICK, make_room, place_object
from helpers.expected_errors import expect_error
from helpers.small_problems import make_full_scene, replace_objects

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import Phase, Task
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Step, Touch

OPTIONS = Options(reach_waypoints=10, turn_waypoints=3, move_waypoints=7)
GRIP = Hold("stick", "grip")
END = Hold("stick", "end")
PULLED = Hold("ball", "grip", GRIP, "tip")
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


# Touch


def test_touch_with_a_stick_grasps_it_first() -> None:
    task = compile_steps(Touch("stick.tip", POINT))
    reach, touch = task.phases
    assert get_names(task) == ["reach stick.grip", "touch with stick.tip"]
    assert (task.segments, task.holds, task.after) == (20, (GRIP,), (GRIP,))
    assert (reach.held, reach.grasps, reach.released, reach.frames) == ((), (GRIP,), (), ())
    assert (touch.held, touch.grasps, touch.released) == ((GRIP,), (), ())
    (goal,) = touch.frames
    assert (goal.frame, goal.kind, goal.hold, goal.touches) == ("tip", "point", GRIP, True)
    np.testing.assert_array_equal(goal.placement.translation, POINT)
    assert str(goal) == "stick.tip"
    assert task.state == {}  # a stick has no joints


# Place and Release


def test_place_grasps_carries_and_releases() -> None:
    task = compile_steps(Place("stick", POSE), GoTo(0.0, 0.0))
    assert get_names(task) == ["reach stick.grip", "place stick", "go to"]
    reach, place, leave = task.phases
    (goal,) = place.frames
    assert (goal.frame, goal.kind, goal.hold, goal.touches, goal.placement) == (
        "stick",
        "pose",
        GRIP,
        False,
        POSE,
    )
    assert (place.held, place.lifted, place.lowered) == ((GRIP,), {GRIP: STICK}, {GRIP: POSE})
    assert (leave.held, leave.released) == ((), (GRIP,))
    assert leave.resting["stick"] == POSE
    assert leave.released_by == {}
    assert task.after == ()
    assert reach.released == place.released == ()


def test_place_at_a_point_keeps_the_object_upright() -> None:
    lying = place_object(make_scene(), "stick", POSE)
    task = compile_steps(Place("stick", (0.0, 1.0, 0.5)), GoTo(0.0, 0.0), scene=lying)
    (goal,) = task.phases[1].frames
    assert goal.kind == "upright"
    np.testing.assert_array_equal(goal.placement.translation, [0.0, 1.0, 0.5])
    np.testing.assert_array_equal(goal.placement.rotation, POSE.rotation)
    assert task.phases[1].released_by == {}
    assert task.phases[2].released_by == {"stick": (GRIP, 1)}  # placement at the end of phase 1
    assert "stick" in task.phases[2].resting


def test_release_ends_the_holds() -> None:
    task = compile_steps(Touch("stick.tip", POINT), Release(), GoTo(0.0, 0.0))
    assert get_names(task) == ["reach stick.grip", "touch with stick.tip", "go to"]
    assert (task.phases[2].held, task.phases[2].released) == ((), (GRIP,))
    assert task.phases[2].released_by == {"stick": (GRIP, 1)}
    assert task.after == ()
    assert compile_steps(Touch("stick.tip", POINT), Release("stick")).after == ()
    assert compile_steps(Grasp("door"), Release(), GoTo(0.0, 0.0)).phases[1].released == (HANDLE,)


def test_release_of_objects_held_at_the_start() -> None:
    task = compile_steps(Release(), scene=make_scene().with_held({"stick": "grip"}))
    assert (get_names(task), get_holds(task), task.after) == (["stand still"], [(GRIP,)], ())
    later = compile_steps(
        Release(), GoTo(0.0, 0.0), scene=make_scene().with_held({"stick": "grip"})
    )
    assert later.phases[1].released == (GRIP,)
    assert not later.phases[1].released_by, (
        "the placement is known, as the release precedes all motion"
    )
    moved = compile_steps(
        GoTo(0.0, 1.0), Release(), GoTo(0.0, 0.0), scene=make_scene().with_held({"stick": "grip"})
    )
    assert moved.phases[1].released_by == {"stick": (GRIP, 0)}


# Grasps through held objects


def test_invalid_placing_and_release_of_a_held_object_are_rejected() -> None:
    with expect_error("held elsewhere", field="steps[1].attachment"):
        compile_steps(Grasp("stick"), Place("stick", POSE, "end"))
    with pytest.raises(UnknownNameError, match="did you mean 'stick'"):
        compile_steps(Grasp("stick"), Release("stik"))


def test_release_with_an_empty_hand_is_rejected() -> None:
    for before in ([], [Place("stick", POSE)]):
        with expect_error("hand is empty", field=f"steps[{len(before)}]"):
            compile_steps(*before, Release())


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
        "reach ball.grip by stick.tip",
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
    ("by", "match", "error"),
    [
        ("tip", "not a link of an object", InputError),
        ("stik.tip", "stik", UnknownNameError),
        ("stick.top", "top", UnknownNameError),
        ("door.lever", "does not carry", InputError),
        ("ball.ball", "does not carry", InputError),
    ],
)
def test_invalid_holders_are_rejected(by: str, match: str, error: type[InputError]) -> None:
    with pytest.raises(error, match=match) as caught:
        compile_steps(Grasp("stick"), Grasp("ball", by=by))
    assert caught.value.field == "steps[1].by"


def test_only_carried_objects_can_hold_others() -> None:
    with expect_error("does not carry", field="steps[0].by", got="'stick.tip'"):
        compile_steps(Grasp("ball", by="stick.tip"))
    with expect_error("does not carry"):
        compile_steps(Place("stick", POSE), Grasp("ball", by="stick.tip"))
    with expect_error("does not carry"):  # a door in the hand is not carried
        compile_steps(Grasp("door"), Grasp("ball", by="door.lever"))
    for again in (Grasp("stick", by="stick.tip"), Grasp("stick", "end")):
        with expect_error("held already"):
            compile_steps(Grasp("stick"), again)
    with expect_error("is fixed in the world"):
        compile_steps(Grasp("stick"), Grasp("door", by="stick.tip"))


# One hand


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
    first = Grasp("stick")
    with pytest.raises(InputError, match="one hand") as caught:
        compile_steps(GoTo(0.0, 0.0), first, second)
    assert str(caught.value.field).startswith("steps[2]")
    assert "stick.grip" in str(caught.value)
    with pytest.raises(InputError, match="one hand") as caught:
        compile_steps(second, scene=make_scene().with_held({"stick": "end"}))
    assert str(caught.value.field).startswith("steps[0]")
    compile_steps(first, Release(), second)


# Repeated grasps


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
    with pytest.raises(InputError, match="known only after planning") as caught:
        compile_steps(*before, Touch("stick.tip", POSE))
    assert str(caught.value.field).startswith(f"steps[{len(before)}]")
    other = compile_steps(*before, Grasp("ball"))
    assert other.phases[-1].grasps == (Hold("ball", "grip"),)


# Invalid steps


@pytest.mark.parametrize(
    ("step", "field", "nearest"),
    [
        (Touch("stick.top", POINT), "steps[0].frame", "tip"),
        (Touch("stik.tip", POINT), "steps[0].frame", None),
        (Touch("tol", POINT), "steps[0].frame", "tool"),
        (Place("stik", POINT), "steps[0].object", "stick"),
        (Place("stick", POINT, "gripp"), "steps[0].attachment", "grip"),
    ],
)
def test_unknown_names_are_rejected(step: Step, field: str, nearest: str | None) -> None:
    with pytest.raises(UnknownNameError) as caught:
        compile_steps(step)
    assert caught.value.field == field
    if nearest:
        assert caught.value.nearest == nearest


@pytest.mark.parametrize(
    ("step", "field"),
    [
        (Actuate("ball", {"x": 0.0}), "steps[0].joints"),
        (Touch("door.lever", POINT), "steps[0].frame"),
        (Place("door", POSE), "steps[0].object"),
        (Actuate("stick", {"tip_joint": 0.0}), "steps[0].joints"),
    ],
)
def test_fixed_objects_are_not_carried_and_free_objects_not_actuated(
    step: Step, field: str
) -> None:
    with expect_error(field=field):
        compile_steps(step)


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

    def list_objects(phase: Phase) -> tuple[set[str], set[str]]:
        return {hold.object for hold in phase.held}, set(phase.resting)

    for phase in task.phases:
        carried, resting = list_objects(phase)
        assert not carried & resting
        assert (carried | resting) >= {"stick", "ball"}
        assert set(phase.released_by) <= resting
    for before, after in zip(task.phases[:-1], task.phases[1:], strict=True):
        assert set(after.held) == ({*before.held, *before.grasps} - set(after.released))
        assert set(after.lifted) == {
            hold
            for hold in before.grasps
            if hold in after.held and hold.object in ("stick", "ball")
        }
