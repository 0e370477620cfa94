"""Tests the compilation of steps to phases: holds, moving joints and goals."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from helpers.small_problems import (
    CABINET_STATE,
    load_door_scene,
    make_full_scene,
    replace_attachment,
    replace_objects,
)

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actuation import find_shared_coordinate
from vkc_pin.world.task.compiler import LATCH_MARGIN, compile_task
from vkc_pin.world.task.lookup import find_path_joints
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Reach, Step

OPTIONS = Options(reach_waypoints=10, turn_waypoints=3, move_waypoints=7)
OPEN = Actuate("door", {"hinge": 1.2})
TURNED = 0.5 + LATCH_MARGIN  # threshold of the latch plus margin
SHUT = {"door.hinge": 0.0, "door.knob": 0.0}
HINGE, KNOB = (-1.57, 1.57), (0.0, 0.8)
HANDLE = Hold("door", "handle")


def compile_steps(steps: Sequence[Step], scene: Scene | None = None) -> Task:
    return compile_task(scene or load_door_scene(), steps, OPTIONS)


def add_attachment(scene: Scene, name: str, link: str) -> Scene:
    """Return the scene with one more attachment of the door, at the origin of `link`."""
    placed = scene.objects["door"]
    attachment = dataclasses.replace(
        placed.object.attachment(), name=name, link=link, placement=pin.SE3.Identity()
    )
    changed = dataclasses.replace(
        placed.object, attachments={**placed.object.attachments, name: attachment}
    )
    return dataclasses.replace(
        scene, objects={**scene.objects, "door": dataclasses.replace(placed, object=changed)}
    )


def test_opening_a_door_has_three_phases() -> None:
    task = compile_steps([OPEN])
    assert [phase.name for phase in task.phases] == [
        "reach door.handle",
        "turn door.knob",
        "move door.hinge, door.knob",
    ]
    assert [phase.segments for phase in task.phases] == [10, 3, 7]
    assert task.segments == 20
    assert task.holds == task.after == (HANDLE,)
    assert task.state == SHUT
    reach, turn, move = task.phases
    assert (reach.held, reach.grasps, reach.ranges, reach.values) == ((), (HANDLE,), {}, {})
    assert (turn.held, turn.grasps, turn.released) == ((HANDLE,), (), ())
    assert turn.ranges == {"door.knob": KNOB}
    assert turn.values == {"door.knob": TURNED}
    assert move.held == (HANDLE,)
    assert move.ranges == {"door.hinge": HINGE, "door.knob": (TURNED, KNOB[1])}
    assert move.values == {"door.hinge": 1.2, "door.knob": TURNED}
    assert [phase.initial_values for phase in task.phases] == [
        SHUT,
        SHUT,
        {**SHUT, "door.knob": TURNED},
    ]
    assert all(phase.base is None and phase.frames == () for phase in task.phases)


def test_latch_is_turned_only_if_it_is_engaged() -> None:
    for state, names in (
        ({"hinge": 0.3}, ["reach door.handle", "move door.hinge"]),
        ({"hinge": 0.03}, ["reach door.handle", "turn door.knob", "move door.hinge, door.knob"]),
    ):
        task = compile_steps([OPEN], load_door_scene().with_state("door", state))
        assert [phase.name for phase in task.phases] == names
    task = compile_steps([OPEN], load_door_scene().with_state("door", {"knob": 0.6}))
    assert [phase.name for phase in task.phases] == [
        "reach door.handle",
        "move door.hinge, door.knob",
    ]
    assert task.phases[1].ranges["door.knob"] == (TURNED, KNOB[1])
    assert task.phases[1].initial_values == {"door.hinge": 0.0, "door.knob": 0.6}


def test_hinge_and_knob_are_actuated_together() -> None:
    """The latch is released first; the knob reaches its goal once the door is open."""
    far = compile_steps([Actuate("door", {"hinge": 1.2, "knob": 0.7})])
    assert [phase.name for phase in far.phases] == [
        "reach door.handle",
        "turn door.knob",
        "move door.hinge, door.knob",
    ]
    assert far.phases[2].values == {"door.hinge": 1.2, "door.knob": 0.7}
    assert far.phases[2].ranges["door.knob"] == (TURNED, KNOB[1])
    back = compile_steps([Actuate("door", {"hinge": 1.2, "knob": 0.0})])
    assert [phase.name for phase in back.phases][2:] == [
        "move door.hinge, door.knob",
        "turn door.knob",
    ]
    assert back.phases[2].values == {"door.hinge": 1.2, "door.knob": TURNED}
    assert back.phases[3].values == {"door.knob": 0.0}
    assert back.phases[3].ranges == {"door.knob": KNOB}
    assert back.phases[3].initial_values == {"door.hinge": 1.2, "door.knob": TURNED}


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
    assert last.base == (1.0, 2.0, 0.3)
    assert last.initial_values == {"door.hinge": 1.2, "door.knob": TURNED}
    assert compile_steps([GoTo(1.0, 2.0)]).phases[0].base == (1.0, 2.0, None)
    held = load_door_scene().with_held({"door": "handle"})
    assert compile_steps([GoTo(1.0, 2.0)], held).phases[0].released == (HANDLE,)


def test_objects_keep_their_state_between_grasps() -> None:
    """The second object is static until it is grasped; the first keeps its last state."""
    task = compile_steps([OPEN, Actuate("drawer", {"slide": 0.2})], make_full_scene())
    names = [
        "reach door.handle",
        "turn door.knob",
        "move door.hinge, door.knob",
        "reach drawer.handle",
        "move drawer.slide",
    ]
    assert [phase.name for phase in task.phases] == names
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
    placed = make_full_scene().objects["cabinet"]
    assert find_path_joints(placed, placed.object.attachment()) == ["swing", "slide"]


def test_goal_beyond_a_limit_ends_at_the_limit() -> None:
    """Planning then reports the violation; later steps start from the limit."""
    task = compile_steps([Actuate("door", {"hinge": 2.0}), GoTo(0.0, 0.0)])
    assert task.phases[2].values["door.hinge"] == 2.0
    assert task.phases[3].initial_values["door.hinge"] == HINGE[1]


@pytest.mark.parametrize(
    ("step", "field", "nearest"),
    [
        (Actuate("dor", {"hinge": 1.0}), "steps[1].object", "door"),
        (Actuate("door", {"hing": 1.0}), "steps[1].joints", "hinge"),
        (Actuate("door", {"hinge": 1.0}, "handel"), "steps[1].attachment", "handle"),
        (Reach([0.0] * 6, "tol"), "steps[1].frame", "tool"),
    ],
)
def test_unknown_names_are_rejected(step: Step, field: str, nearest: str | None) -> None:
    with expect_error(field=field, nearest=nearest):
        compile_steps([GoTo(0.0, 0.0), step])


def test_joint_must_move_with_the_hand() -> None:
    with expect_error("does not move", field="steps[0].joints", expected="one of hinge"):
        compile_steps(
            [Actuate("door", {"knob": 0.3}, "plate")],
            add_attachment(load_door_scene(), "plate", "panel"),
        )
    with expect_error("does not move"):
        compile_steps(
            [Actuate("door", {"hinge": 0.3}, "post")],
            add_attachment(load_door_scene(), "post", "frame"),
        )


def test_hand_must_be_able_to_release_the_latch() -> None:
    plate = add_attachment(load_door_scene(), "plate", "panel")
    with expect_error("is latched", field="steps[0].attachment"):
        compile_steps([Actuate("door", {"hinge": 1.2}, "plate")], plate)
    for state in ({"knob": 0.6}, {"hinge": 0.2}):
        task = compile_steps(
            [Actuate("door", {"hinge": 1.2}, "plate")], plate.with_state("door", state)
        )
        assert [phase.name for phase in task.phases] == ["reach door.plate", "move door.hinge"]
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
    placed = make_full_scene().objects["cabinet"]
    named = {
        name: dataclasses.replace(placed.object.attachment(), name=name, link=name)
        for name in ("case", "arm", "lid")
    }
    changed = dataclasses.replace(placed.object, attachments={**named, **placed.object.attachments})
    scene = replace_objects(
        make_full_scene(), {"cabinet": dataclasses.replace(placed, object=changed)}
    )
    for joints, expected in (
        ({"swing": 0.5}, "arm"),
        ({"lid_hinge": 0.2}, "lid"),
        ({"swing": 0.5, "slide": 0.2}, "grip"),
    ):
        task = compile_steps([Actuate("cabinet", joints)], scene)
        assert task.holds == (Hold("cabinet", expected),)
        assert task == dataclasses.replace(
            compile_steps([Actuate("cabinet", joints, expected)], scene), steps=task.steps
        )
    assert compile_steps([Grasp("cabinet")], scene).holds == (Hold("cabinet", "case"),)
    with pytest.raises(
        InputError, match="no attachment of 'cabinet' can bring 'swing' and 'lid_hinge' there"
    ) as caught:
        compile_steps([Actuate("cabinet", {"swing": 0.5, "lid_hinge": 0.2})], scene)
    assert caught.value.field == "steps[0].joints"
    assert (
        "case moves nothing; arm moves swing; lid moves lid_hinge; grip moves swing, slide"
        in str(caught.value.expected)
    )


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
    lid = replace_objects(
        make_full_scene(),
        {
            "cabinet": replace_attachment(
                make_full_scene().objects["cabinet"],
                dataclasses.replace(
                    make_full_scene().objects["cabinet"].object.attachment(), name="lid", link="lid"
                ),
            )
        },
    )
    task = compile_steps(
        [Actuate("cabinet", {"swing": 0.5}), Actuate("cabinet", {"lid_hinge": 0.2})], lid
    )
    grip, other = Hold("cabinet", "grip"), Hold("cabinet", "lid")
    assert task.holds == (grip, other)
    assert [phase.name for phase in task.phases] == [
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
    assert find_shared_coordinate(lid, task.holds) is None
    both = compile_steps([OPEN, Actuate("door", {"hinge": 0.5}, "handle_free")])
    assert both.holds == (HANDLE, Hold("door", "handle_free"))
    assert find_shared_coordinate(load_door_scene(), both.holds) == "door.hinge"


def test_unused_initial_hold_is_dropped_if_another_moves_the_same_joints() -> None:
    """Joints that only the dropped hold moves are no longer part of the task."""
    scene = (
        add_attachment(load_door_scene(), "plate", "panel")
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
