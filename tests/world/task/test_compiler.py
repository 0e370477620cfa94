"""Tests the compilation of steps to phases: holds, moving joints and goals."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from helpers.judging import replace_object
from helpers.small_problems import (
    CABINET_STATE,
    load_door_scene,
    make_full_scene,
)

from vkc_pin import Actuate, GoTo, Grasp, Hold, Options, Reach, Scene
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import LATCH_GAP, LATCH_MARGIN, compile_task
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Step

OPTIONS = Options(reach_waypoints=10, turn_waypoints=3, move_waypoints=7)
OPEN = Actuate("door", {"hinge": 1.2})
TURNED = 0.5 + LATCH_MARGIN  # threshold of the latch plus margin
SHUT = {"door.hinge": 0.0, "door.knob": 0.0}
HINGE, KNOB = (-1.57, 1.57), (0.0, 0.8)
HANDLE = Hold("door", "handle")


def compile_steps(steps: Sequence[Step], scene: Scene | None = None) -> Task:
    return compile_task(scene or load_door_scene(), steps, OPTIONS)


def add_attachments(scene: Scene, owner: str, **links: str) -> Scene:
    """Return the scene with more attachments of an object (name → link), listed first."""
    placed = scene.objects[owner]
    added = {
        name: dataclasses.replace(
            placed.object.attachment(), name=name, link=link, placement=pin.SE3.Identity()
        )
        for name, link in links.items()
    }
    return replace_object(scene, owner, attachments={**added, **placed.object.attachments})


def get_names(task: Task) -> list[str]:
    return [phase.name for phase in task.phases]


OPENING = ["reach door.handle", "turn door.knob", "move door.hinge, door.knob"]


def test_opening_a_door_has_three_phases() -> None:
    task = compile_steps([OPEN])
    assert get_names(task) == OPENING
    assert [phase.segments for phase in task.phases] == [10, 3, 7]
    assert task.segments == 20
    assert task.holds == task.after == (HANDLE,)
    assert task.state == SHUT
    reach, turn, move = task.phases
    assert (reach.held, reach.grasps, reach.ranges, reach.values) == ((), (HANDLE,), {}, {})
    assert (turn.held, turn.grasps, turn.released) == ((HANDLE,), (), ())
    assert (turn.ranges, turn.values) == ({"door.knob": KNOB}, {"door.knob": TURNED})
    assert move.held == (HANDLE,)
    assert move.ranges == {"door.hinge": HINGE, "door.knob": (TURNED, KNOB[1])}
    assert move.values == {"door.hinge": 1.2, "door.knob": TURNED}
    assert reach.initial_values == turn.initial_values == SHUT
    assert move.initial_values == {**SHUT, "door.knob": TURNED}
    assert all(not phase.configuration and phase.frames == () for phase in task.phases)


def test_latch_is_turned_only_if_it_is_engaged() -> None:
    for state, names in (
        ({"hinge": 0.3}, ["reach door.handle", "move door.hinge"]),
        ({"hinge": 0.03}, OPENING),
        ({"hinge": -0.3}, OPENING),  # it would pass the latched position
        ({"knob": 0.6}, [OPENING[0], OPENING[2]]),
    ):
        task = compile_steps([OPEN], load_door_scene().with_state("door", state))
        assert get_names(task) == names
    assert task.phases[1].ranges["door.knob"] == (TURNED, KNOB[1])
    assert task.phases[1].initial_values == {"door.hinge": 0.0, "door.knob": 0.6}


@pytest.mark.parametrize(
    ("begin", "end", "allowed"),
    [
        (1.2, 0.0, (0.05 + LATCH_GAP, 1.57)),
        (-1.2, 0.0, (-1.57, -0.05 - LATCH_GAP)),
        (1.2, 0.03, (0.05 + LATCH_GAP, 1.57)),  # within the range of the latch
        (0.0505, 0.0, (0.0505, 1.57)),
        (1.2, 0.06, HINGE),
    ],
)
def test_closing_joint_enters_the_range_of_its_latch_at_the_end(
    begin: float, end: float, allowed: tuple[float, float]
) -> None:
    """There it could not move back."""
    scene = load_door_scene().with_state("door", {"hinge": begin})
    move = compile_steps([Actuate("door", {"hinge": end})], scene).phases[-1]
    assert (move.name, move.values) == ("move door.hinge", {"door.hinge": end})
    assert move.ranges["door.hinge"] == pytest.approx(allowed)
    released = scene.with_state("door", {"knob": 0.5})
    for knob, expected in ((0.5, HINGE), (0.0, allowed)):
        step = Actuate("door", {"hinge": end, "knob": knob})
        ranges = compile_steps([step], released).phases[-1].ranges
        assert ranges == {"door.hinge": pytest.approx(expected), "door.knob": KNOB}


def test_closed_door_allows_the_knob_to_turn() -> None:
    turn = compile_steps([Actuate("door", {"knob": 0.3})]).phases[-1]
    assert (turn.ranges, turn.values) == ({"door.knob": KNOB}, {"door.knob": 0.3})


def test_hinge_and_knob_are_actuated_together() -> None:
    """The latch is released first; the knob reaches its goal once the door is open."""
    far = compile_steps([Actuate("door", {"hinge": 1.2, "knob": 0.7})])
    assert get_names(far) == OPENING
    assert far.phases[2].values == {"door.hinge": 1.2, "door.knob": 0.7}
    assert far.phases[2].ranges["door.knob"] == (TURNED, KNOB[1])
    back = compile_steps([Actuate("door", {"hinge": 1.2, "knob": 0.0})])
    assert get_names(back) == [*OPENING, "turn door.knob"]
    move, turn = back.phases[2:]
    assert move.values == turn.initial_values == {"door.hinge": 1.2, "door.knob": TURNED}
    assert (turn.values, turn.ranges) == ({"door.knob": 0.0}, {"door.knob": KNOB})


@pytest.mark.parametrize("thresholds", [(0.3, 0.5), (0.5, 0.3)])
@pytest.mark.parametrize("knob", [None, 0.0, 0.7])
def test_one_joint_releases_several_latches(
    thresholds: tuple[float, ...], knob: float | None
) -> None:
    """The largest threshold counts while the door moves, and the asked value at the end."""
    scene = load_door_scene()
    (latch,) = scene.objects["door"].object.latches
    latches = tuple(dataclasses.replace(latch, threshold=value) for value in thresholds)
    scene = replace_object(scene, "door", latches=latches)
    asked = {"hinge": 1.2} if knob is None else {"hinge": 1.2, "knob": knob}
    phases = compile_steps([Actuate("door", asked)], scene).phases
    (move,) = (phase for phase in phases if phase.name.startswith("move"))
    assert move.values["door.knob"] == max(knob or 0.0, TURNED)
    assert move.ranges["door.knob"] == (TURNED, KNOB[1])
    last = phases[-1]
    expected = {"door.knob": 0.0} if knob == 0.0 else move.values
    assert last.values == expected


def test_reach_has_one_frame_goal() -> None:
    pose = pin.SE3(np.eye(3), np.array([1.0, 0.0, 1.0]))
    (phase,) = compile_steps([Reach(pose)]).phases
    assert (phase.name, phase.held, phase.segments) == ("reach with tool", (), 10)
    (goal,) = phase.frames
    assert (goal.frame, goal.kind, goal.hold, goal.touches) == ("tool", "pose", None, False)
    assert goal.placement == pose
    (phase,) = compile_steps([Reach(pose, "forearm_link")]).phases
    assert phase.frames[0].frame == "forearm_link"


def test_go_to_releases_fixed_objects() -> None:
    task = compile_steps([OPEN, GoTo(1.0, 2.0, 0.3)])
    last = task.phases[-1]
    assert (last.name, last.held, last.released) == ("go to", (), (HANDLE,))
    assert last.configuration == {
        "base_x": (1.0, 1.0),
        "base_y": (2.0, 2.0),
        "base_yaw": (0.3, 0.3),
    }
    assert last.initial_values == {"door.hinge": 1.2, "door.knob": TURNED}
    anywhere = compile_steps([GoTo(1.0, 2.0)]).phases[0]
    assert anywhere.configuration == {"base_x": (1.0, 1.0), "base_y": (2.0, 2.0)}
    held = load_door_scene().with_held({"door": "handle"})
    assert compile_steps([GoTo(1.0, 2.0)], held).phases[0].released == (HANDLE,)


def test_objects_keep_their_state_between_grasps() -> None:
    """The second object is static until it is grasped; the first keeps its last state."""
    task = compile_steps([OPEN, Actuate("drawer", {"slide": 0.2})], make_full_scene())
    assert get_names(task) == [*OPENING, "reach drawer.handle", "move drawer.slide"]
    drawer = Hold("drawer", "handle")
    assert task.holds == (HANDLE, drawer)
    assert task.state == {**SHUT, "drawer.slide": 0.0}
    assert all(phase.initial_values["drawer.slide"] == 0.0 for phase in task.phases)
    assert (task.phases[3].released, task.phases[3].held) == ((HANDLE,), ())
    assert task.phases[4].initial_values["door.hinge"] == 1.2
    assert task.phases[4].held == task.after == (drawer,)


def test_task_has_only_joints_that_its_grasps_can_move() -> None:
    task = compile_steps([Actuate("cabinet", {"slide": 0.2})], make_full_scene())
    assert task.state == {f"cabinet.{joint}": CABINET_STATE[joint] for joint in ("swing", "slide")}


def test_goal_beyond_a_limit_ends_at_the_limit() -> None:
    """Planning then reports the violation; later steps start from the limit."""
    task = compile_steps([Actuate("door", {"hinge": 2.0}), GoTo(0.0, 0.0)])
    assert task.phases[2].values["door.hinge"] == 2.0
    assert task.phases[3].initial_values["door.hinge"] == HINGE[1]


@pytest.mark.parametrize(
    ("joint", "attachment", "link", "expected"),
    [("knob", "plate", "panel", "one of hinge"), ("hinge", "post", "frame", None)],
)
def test_joint_must_move_with_the_hand(
    joint: str, attachment: str, link: str, expected: str | None
) -> None:
    scene = add_attachments(load_door_scene(), "door", **{attachment: link})
    with expect_error(f"steps.0..joints: .*does not move.*{expected or ''}"):
        compile_steps([Actuate("door", {joint: 0.3}, attachment)], scene)


def test_hand_must_be_able_to_release_the_latch() -> None:
    plate = add_attachments(load_door_scene(), "door", plate="panel")
    step = Actuate("door", {"hinge": 1.2}, "plate")
    with expect_error("is latched", field="steps[0].attachment"):
        compile_steps([step], plate)
    for state in ({"knob": 0.6}, {"hinge": 0.2}):
        task = compile_steps([step], plate.with_state("door", state))
        assert get_names(task) == ["reach door.plate", "move door.hinge"]
        assert set(task.state) == {"door.hinge"}


@pytest.mark.parametrize("steps", [[], (), [Grasp("door")]])
def test_steps_without_motion_are_rejected(steps: list[Step]) -> None:
    with expect_error("nothing to do", field="steps"):
        compile_steps(steps, load_door_scene().with_held({"door": "handle"}))


@pytest.mark.parametrize(
    ("steps", "field"),
    [(OPEN, "steps"), (["open"], "steps[0]"), ([GoTo(0.0, 0.0), None], "steps[1]")],
)
def test_invalid_steps_are_rejected(steps: Any, field: str) -> None:
    with expect_error(field=field):
        compile_steps(steps)


def test_default_attachment_is_the_first_that_moves_the_joints() -> None:
    """The first attachment of the object moves only some of them."""
    scene = add_attachments(make_full_scene(), "cabinet", case="case", arm="arm", lid="lid")
    for joints, expected in (
        ({"swing": 0.5}, "arm"),
        ({"lid_hinge": 0.2}, "lid"),
        ({"swing": 0.5, "slide": 0.2}, "grip"),
    ):
        task = compile_steps([Actuate("cabinet", joints)], scene)
        assert task.holds == (Hold("cabinet", expected),)
        named = compile_steps([Actuate("cabinet", joints, expected)], scene)
        assert not named.open_attachments
        assert named == dataclasses.replace(task, steps=named.steps, open_attachments=())
    assert compile_steps([Grasp("cabinet")], scene).holds == (Hold("cabinet", "case"),)
    message = (
        "no attachment of 'cabinet' can bring 'swing' and 'lid_hinge' there.*"
        "case moves nothing; arm moves swing; lid moves lid_hinge; grip moves swing, slide"
    )
    with expect_error(message, field="steps[0].joints"):
        compile_steps([Actuate("cabinet", {"swing": 0.5, "lid_hinge": 0.2})], scene)


def test_present_or_previous_attachment_is_preferred() -> None:
    task = compile_steps(
        [
            Actuate("door", {"hinge": 1.2}, "handle_free"),
            GoTo(0.0, 0.0),
            Actuate("door", {"hinge": 0.5}),
        ]
    )
    assert task.holds == (Hold("door", "handle_free"),)
    task = compile_steps([OPEN], load_door_scene().with_held({"door": "handle_free"}))
    assert task.holds == (Hold("door", "handle_free"),)


def test_one_object_is_grasped_at_two_attachments_in_turn() -> None:
    """Holds of different joints can share a chain; holds of the same joint cannot."""
    scene = add_attachments(make_full_scene(), "cabinet", lid="lid")
    task = compile_steps(
        [Actuate("cabinet", {"swing": 0.5}), Actuate("cabinet", {"lid_hinge": 0.2})], scene
    )
    grip, other = Hold("cabinet", "grip"), Hold("cabinet", "lid")
    assert task.holds == (grip, other)
    assert get_names(task) == [
        "reach cabinet.grip",
        "move cabinet.swing",
        "reach cabinet.lid",
        "move cabinet.lid_hinge",
    ]
    assert [phase.held for phase in task.phases] == [(), (grip,), (), (other,)]
    assert task.phases[2].released == (grip,)
    assert task.phases[3].initial_values == {
        "cabinet.swing": 0.5,
        "cabinet.slide": 0.1,
        "cabinet.lid_hinge": -0.4,
    }
    assert find_shared_coordinate(scene, task.holds) is None
    both = compile_steps([OPEN, Actuate("door", {"hinge": 0.5}, "handle_free")])
    assert both.holds == (HANDLE, Hold("door", "handle_free"))
    assert find_shared_coordinate(load_door_scene(), both.holds) == "door.hinge"


def test_unused_initial_hold_is_dropped_if_another_moves_the_same_joints() -> None:
    """Joints that only the dropped hold moves are no longer part of the task."""
    scene = (
        add_attachments(load_door_scene(), "door", plate="panel")
        .with_state("door", {"hinge": 0.4, "knob": 0.6})
        .with_held({"door": "handle"})
    )
    for steps in (
        [Actuate("door", {"hinge": 0.9}, "plate")],
        [GoTo(0.0, 0.0), Actuate("door", {"hinge": 0.9}, "plate")],
    ):
        task = compile_steps(steps, scene)
        assert task.holds == (Hold("door", "plate"),)
        assert task.state == {"door.hinge": 0.4}
        assert all(phase.initial_values == {"door.hinge": 0.4} for phase in task.phases)
        assert task.phases[0].released == (HANDLE,)
