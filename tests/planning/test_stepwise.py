"""The scene in which a motion ends, from motions that nobody planned; steps one after the other, and which plan is returned."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import STICK, Script, above, carried_over, lifted, moved_base, room, table, tool_at
from helpers.drives import hall
from helpers.small_problems import full_scene, program_of

import vkc_pin as vkc
from vkc_pin.motion.trajectory import PhaseSpan, Trajectory
from vkc_pin.motion.world import scene_after
from vkc_pin.options import Options
from vkc_pin.planning import stepwise as module
from vkc_pin.planning.outcome import TIMES
from vkc_pin.planning.settings import Settings
from vkc_pin.scene.hold import Hold
from vkc_pin.scene.scene import Scene
from vkc_pin.task.compiler import compile_task
from vkc_pin.task.phases import Task
from vkc_pin.task.steps import GoTo


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
    assert after.holds == ()


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
    (hold,) = after.holds
    assert (hold, hold.at) == (Hold("cabinet", "sleeve"), (sleeve.freedoms[0].lower, sleeve.freedoms[1].upper))


def test_what_is_carried_is_in_the_hand() -> None:
    """Where its attachment says it hangs; so a hand that has closed beside it does not matter any more."""
    scene, values = room(table()), (0.03, 0.2)
    down = above(STICK, values=values)
    script = Script(scene).go(down).take("stick", values=values).go(moved_base(down, x=-0.4, yaw=0.5))
    after = scene_after(scene, script.motion(), [Hold("stick", "grip")])
    assert [(hold, hold.at) for hold in after.holds] == [(Hold("stick", "grip"), values)]
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
    assert [(hold, hold.at) for hold in kept.holds] == [(Hold("stick", "grip"), (0.02, -0.1))]
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
    assert after.holds == holds
    assert after.holds[1].at == tuple(values)


@pytest.mark.parametrize("brief", [False, True])
def test_in_brief_all_steps_but_the_first_give_up_soon(brief: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first step's start is given, so that what it takes is worth while; where others start may be a dead end."""
    given: list[tuple[object, Options]] = []

    class One:
        def __init__(self, scene: Scene, task: Task, settings: Settings) -> None:
            (step,) = task.steps
            assert isinstance(step, GoTo)
            self.scene, self.step, self.task = scene, step, task
            given.append((step, settings.options))

        def run(self) -> SimpleNamespace:
            motion = ending(self.scene, [self.step.x, self.step.y, 0.0], self.scene.start[3:])
            return SimpleNamespace(success=True, trajectory=motion, metrics={"planning_time": 1.0})

    monkeypatch.setattr(module, "OneProblem", One)
    steps = [GoTo(0.0, 0.0, 0.0), GoTo(1.0, 0.0), GoTo(2.0, 0.0), GoTo(3.0, 0.0)]
    for rounds in (16, 4):
        given.clear()
        usual = Options(max_restarts=3, max_outer=rounds)
        parts = module.stages(hall(), compile_task(hall(), steps, usual), Settings("auto", usual), brief=brief)
        assert len(parts) == len(given) == 4
        assert [step for step, _ in given] == steps
        assert given[0][1] == usual
        for _, options in given[1:]:
            soon = dataclasses.replace(usual, max_restarts=1, max_outer=min(rounds, 10))
            assert options == (soon if brief else usual)


def fake(status: str, spent: float) -> vkc.Plan:
    metrics = {"planning_time": spent, "build_time": 0.0, "iterations": spent, "rounds": 1.0, "own": spent}
    return vkc.Plan(
        scene=None,  # type: ignore[arg-type]
        steps=(),
        options=vkc.Options(),
        trajectory=None,  # type: ignore[arg-type]
        validation=SimpleNamespace(ok=status == "success"),  # type: ignore[arg-type]
        status=status,
        metrics=metrics | {f"time_{key}": 0.0 for key in TIMES},
    )


@pytest.mark.parametrize(
    ("steps", "runs", "joined", "status", "spent", "own"),
    [
        # Steps, then the whole, works.
        (["success", "success"], ["success"], None, "success", 1 + 2 + 10, 10),
        # The whole fails; the steps one after the other are a motion, whose check takes 0.5.
        (["success", "success"], ["rejected"], "success", "success", 1 + 2 + 0.5 + 10, 3.5),
        # They are none either: searched seeds.
        (["success", "success"], ["rejected", "success"], "rejected", "success", 1 + 2 + 0.5 + 10 + 20, 20),
        (["success", "success"], ["rejected", "not converged"], "rejected", "not converged", 1 + 2 + 0.5 + 10 + 20, 20),
        # A step fails.
        (["success", "rejected"], ["success"], None, "success", 1 + 2 + 10, 10),
        # Ctrl-C in the whole: nothing more is tried, but what there is is taken.
        (["success", "success"], ["interrupted"], "rejected", "interrupted", 1 + 2 + 0.5 + 10, 10),
        (["success", "success"], ["interrupted"], "success", "success", 1 + 2 + 0.5 + 10, 3.5),
        # Ctrl-C in a step.
        (["success", "interrupted"], [], "interrupted", "interrupted", 1 + 2 + 0.5, 3.5),
    ],
)
def test_what_is_returned_and_what_it_took(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[str],
    runs: list[str],
    joined: str | None,
    status: str,
    spent: float,
    own: float,
) -> None:
    plans = [fake(name, k + 1.0) for k, name in enumerate(steps)]
    queue = [fake(name, 10.0 * (k + 1)) for k, name in enumerate(runs)]
    limits: list[float] = []

    class One:
        def __init__(self, scene: Any, task: Any, settings: Settings) -> None:
            self.settings = settings

        def run(self, seed: Any = None) -> vkc.Plan:
            assert self.settings.time_limit is not None
            limits.append(self.settings.time_limit)
            self.settings.interrupt.pressed = queue[0].status == "interrupted"
            return queue.pop(0)

    part = SimpleNamespace(task=SimpleNamespace(phases=(1,)), piece=lambda: None)
    monkeypatch.setattr(module, "OneProblem", One)
    brief: list[bool] = []

    def stages(*_: Any, **keywords: Any) -> list[tuple[Any, vkc.Plan]]:
        brief.append(keywords.get("brief", False))
        settings.interrupt.pressed = plans[-1].status == "interrupted"
        return [(part, p) for p in plans]

    monkeypatch.setattr(module, "stages", stages)
    monkeypatch.setattr(
        module, "joined", lambda *_: fake(joined or "never", 0.5 + sum(p.metrics["planning_time"] for p in plans))
    )
    settings = Settings("auto", vkc.Options(), time_limit=100.0)
    task = SimpleNamespace(steps=(1, 2), phases=(1, 2, 3))
    result = module.all_at_once(None, task, settings)  # type: ignore[arg-type]
    assert result.status == status
    assert brief == [True]  # where steps lead is a seed only: no long time for what may be a dead end
    assert not queue
    assert result.metrics["planning_time"] == pytest.approx(spent)
    assert result.metrics["own"] == own  # what is no time stays that of the plan that is returned
    assert limits == pytest.approx([97.0, 86.5][: len(runs)])


def test_building_before_planning_costs_no_negative_time() -> None:
    scene = vkc.load_scene("drawer")
    steps = [vkc.Actuate("drawer", {"slide": 0.2})]
    options = vkc.Options(reach_waypoints=23, move_waypoints=11)  # a structure of its own
    program_of(scene, steps, options=options)
    metrics = vkc.plan(scene, steps, options=options).metrics
    parts = sum(value for key, value in metrics.items() if key.startswith("time_"))
    assert metrics["planning_time"] >= parts > 0.0
