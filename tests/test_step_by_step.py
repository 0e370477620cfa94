"""The scene in which a motion ends, from motions that nobody planned."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from carrying import STICK, Script, above, carried_over, lifted, moved_base, room, table, tool_at
from drives import hall
from small_problems import full_scene

from vkc_pin import step_by_step as module
from vkc_pin.hold import Hold
from vkc_pin.one_problem import Settings
from vkc_pin.options import Options
from vkc_pin.scene import Scene
from vkc_pin.steps import GoTo
from vkc_pin.trajectory import PhaseSpan, Trajectory
from vkc_pin.world import scene_after


def ending(scene: Scene, base: list[float], arm: np.ndarray, **objects: float) -> Trajectory:
    """Return a motion that ends with base and arm, and joints of objects, there."""
    names = (*scene.robot.coordinates.names, *(name.replace("__", ".") for name in objects))
    last = [*base, *arm, *objects.values()]
    rows = np.array([np.zeros(len(last)), last])
    return Trajectory(names, np.array([0.0, 1.0]), rows, (PhaseSpan("move", 0, 1),), len(scene.start))


def test_robot_and_joints_are_where_the_motion_ends() -> None:
    scene = full_scene().with_state("door", {"knob": 0.2})
    arm = np.linspace(-0.5, 0.5, len(scene.start) - 3)
    after = scene_after(scene, ending(scene, [0.1, -0.2, 4.0], arm, door__hinge=0.4), [])
    np.testing.assert_array_equal(after.start, [0.1, -0.2, 4.0, *arm])
    np.testing.assert_array_equal(after.objects["door"].state, [0.4, 0.2])
    for name in ("drawer", "cabinet"):
        np.testing.assert_array_equal(after.objects[name].state, scene.objects[name].state)
    assert (dict(after.held), dict(after.held_at)) == ({}, {})


def test_what_ends_a_little_outside_its_limits_is_at_them() -> None:
    """What a solver returns, and what rounding leaves, is further out than a scene may say."""
    scene, off = full_scene(), 1e-4
    robot, door = scene.robot, scene.objects["door"].object
    sleeve = scene.objects["cabinet"].object.attachment("sleeve")
    motion = ending(
        scene,
        [scene.arena[1] + off, scene.arena[2] - off, 0.0],
        robot.upper[3:] + off,
        door__hinge=door.upper[0] + off,
        door__knob=door.lower[1] - off,
        cabinet__sleeve_slide=sleeve.freedoms[0].lower - off,
        cabinet__sleeve_turn=sleeve.freedoms[1].upper + off,
    )
    after = scene_after(scene, motion, [Hold("cabinet", "sleeve")])
    np.testing.assert_array_equal(after.start, [scene.arena[1], scene.arena[2], 0.0, *robot.upper[3:]])
    np.testing.assert_array_equal(after.objects["door"].state, [door.upper[0], door.lower[1]])
    assert dict(after.held) == {"cabinet": "sleeve"}
    assert dict(after.held_at) == {"cabinet": (sleeve.freedoms[0].lower, sleeve.freedoms[1].upper)}


def test_what_is_carried_is_in_the_hand() -> None:
    """Where its attachment says it hangs; so a hand that has closed beside it does not matter any more."""
    scene, values = room(table()), (0.03, 0.2)
    down = above(STICK, values=values)
    script = Script(scene).go(down).take("stick", values=values).go(moved_base(down, x=-0.4, yaw=0.5))
    after = scene_after(scene, script.motion(), [Hold("stick", "grip")])
    assert (dict(after.held), dict(after.held_at)) == ({"stick": "grip"}, {"stick": values})
    data = scene.robot.model.createData()
    pin.framesForwardKinematics(scene.robot.model, data, scene.robot.coordinates.q(script.rows[-1]))
    tool = data.oMf[scene.robot.model.getFrameId(scene.robot.tool_frame)]
    placed = after.objects["stick"].placement
    np.testing.assert_allclose(tool_at(placed, values=values).homogeneous, tool.homogeneous, atol=1e-9)


def test_what_was_let_go_of_stands_where_it_was_left() -> None:
    scene = room(table())
    script = carried_over(scene, values=(0.03, 0.2))
    after = scene_after(scene, script.motion(), [])
    assert dict(after.held) == {}
    np.testing.assert_allclose(
        after.objects["stick"].placement.homogeneous, lifted(STICK, [0.0, 0.5, 0.0]).homogeneous, atol=1e-9
    )
    assert Scene.from_document(after.document).objects["stick"].placement.isApprox(after.objects["stick"].placement, 1e-9)


def test_what_was_held_at_the_start_can_be_let_go_of() -> None:
    """And does not follow the hand from there on."""
    scene = room(table()).with_held({"stick": "grip"}, at={"stick": (0.02, -0.1)})
    script = Script(scene).go(moved_base(scene.start, y=0.3))
    kept = scene_after(scene, script.motion(), [Hold("stick", "grip")])
    left = scene_after(scene, script.let_go().go(moved_base(scene.start, x=-0.5)).motion(), [])
    assert (dict(kept.held), dict(kept.held_at)) == ({"stick": "grip"}, {"stick": (0.02, -0.1)})
    assert dict(left.held) == {}
    there = lifted(scene.objects["stick"].placement, [0.0, 0.3, 0.0]).homogeneous
    for after in (kept, left):
        np.testing.assert_allclose(after.objects["stick"].placement.homogeneous, there, atol=1e-9)


def test_what_is_held_through_another_thing_stays_there() -> None:
    scene = room(table(), objects=("stick", "ball")).with_held({"stick": "grip"})
    turns = scene.objects["ball"].object.attachment("pull").freedoms
    values = [0.5 * (turn.lower + turn.upper) for turn in turns]
    script = Script(scene).take("ball", "pull", values, by="stick.tip").go(moved_base(scene.start, y=0.3))
    stick = Hold("stick", "grip")
    holds = (stick, Hold("ball", "pull", stick, "tip"))
    after = scene_after(scene, script.motion(), holds)
    assert (dict(after.held), dict(after.held_by)) == ({"stick": "grip", "ball": "pull"}, {"ball": "stick.tip"})
    assert after.held_at["ball"] == tuple(values)
    assert after.holds == holds


@pytest.mark.parametrize("brief", [False, True])
def test_in_brief_all_steps_but_the_first_give_up_soon(brief: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first step's start is given, so that what it takes is worth while; where others start may be a dead end."""
    given: list[tuple[object, Options]] = []

    class One:
        def __init__(self, scene: Scene, steps: Sequence[GoTo], settings: Settings) -> None:
            self.scene, self.step, self.task = scene, steps[0], SimpleNamespace(after=())
            given.append((steps[0], settings.options))

        def run(self) -> SimpleNamespace:
            motion = ending(self.scene, [self.step.x, self.step.y, 0.0], self.scene.start[3:])
            return SimpleNamespace(success=True, trajectory=motion, metrics={"planning_time": 1.0})

    monkeypatch.setattr(module, "OneProblem", One)
    steps = [GoTo(0.0, 0.0, 0.0), GoTo(1.0, 0.0), GoTo(2.0, 0.0), GoTo(3.0, 0.0)]
    for rounds in (16, 4):
        given.clear()
        usual = Options(max_restarts=3, max_outer=rounds)
        parts = module.stages(hall(), steps, Settings("auto", usual, None, None, 0, 0.0), brief=brief)
        assert len(parts) == len(given) == 4
        assert [step for step, _ in given] == steps
        assert given[0][1] == usual
        for _, options in given[1:]:
            soon = dataclasses.replace(usual, max_restarts=1, max_outer=min(rounds, 10))
            assert options == (soon if brief else usual)
