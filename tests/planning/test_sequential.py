"""The scene in which a motion ends, from motions that nobody planned; steps one after the other, and which plan is returned."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    STICK,
    Script,
    above,
    carried_over,
    lifted,
    moved_base,
    room,
    table,
    tool_at,
)
from helpers.litter import AT, BIN, littered, shelf
from helpers.small_problems import full_scene, program_of, with_objects

import vkc_pin as vkc
from vkc_pin.benchmarks.robot_object_matrix.pairs import description_of, hall
from vkc_pin.planning import sequential as module
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.solve_task import TaskResult
from vkc_pin.planning.statistics import PlanningStatistics
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import compute_final_scene


def ending(scene: Scene, base: list[float], arm: np.ndarray, **objects: float) -> Trajectory:
    """Return a motion that ends with base and arm, and joints of objects, there."""
    names = (*scene.robot.coordinates.names, *(name.replace("__", ".") for name in objects))
    last = [*base, *arm, *objects.values()]
    rows = np.array([np.zeros(len(last)), last])
    return Trajectory(
        names, np.array([0.0, 1.0]), rows, (PhaseSpan("move", 0, 1),), len(scene.start)
    )


def test_robot_and_joints_are_where_the_motion_ends() -> None:
    scene = full_scene().with_state("door", {"knob": 0.2})
    arm = np.linspace(-0.5, 0.5, len(scene.start) - 3)
    after = compute_final_scene(scene, ending(scene, [0.1, -0.2, 4.0], arm, door__hinge=0.4), [])
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
    after = compute_final_scene(scene, motion, [Hold("cabinet", "sleeve")])
    np.testing.assert_array_equal(
        after.start, [scene.arena[1], scene.arena[2], 0.0, *robot.upper[3:]]
    )
    np.testing.assert_array_equal(after.objects["door"].state, [door.upper[0], door.lower[1]])
    (hold,) = after.holds
    assert (hold, hold.at) == (
        Hold("cabinet", "sleeve"),
        (sleeve.freedoms[0].lower, sleeve.freedoms[1].upper),
    )


def test_what_is_carried_is_in_the_hand() -> None:
    """Where its attachment says it hangs; so a hand that has closed beside it does not matter any more."""
    scene, values = room(table()), (0.03, 0.2)
    down = above(STICK, values=values)
    script = (
        Script(scene).go(down).take("stick", values=values).go(moved_base(down, x=-0.4, yaw=0.5))
    )
    after = compute_final_scene(scene, script.motion(), [Hold("stick", "grip")])
    assert [(hold, hold.at) for hold in after.holds] == [(Hold("stick", "grip"), values)]
    data = scene.robot.model.createData()
    pin.framesForwardKinematics(scene.robot.model, data, scene.robot.coordinates.q(script.rows[-1]))
    tool = data.oMf[scene.robot.model.getFrameId(scene.robot.tool_frame)]
    placed = after.objects["stick"].placement
    np.testing.assert_allclose(
        tool_at(placed, values=values).homogeneous, tool.homogeneous, atol=1e-9
    )


def test_what_was_let_go_of_stands_where_it_was_left() -> None:
    scene = room(table())
    script = carried_over(scene, values=(0.03, 0.2))
    after = compute_final_scene(scene, script.motion(), [])
    assert dict(after.held) == {}
    np.testing.assert_allclose(
        after.objects["stick"].placement.homogeneous,
        lifted(STICK, [0.0, 0.5, 0.0]).homogeneous,
        atol=1e-9,
    )
    assert (
        Scene.from_document(after.document)
        .objects["stick"]
        .placement.isApprox(after.objects["stick"].placement, 1e-9)
    )


def test_what_was_held_at_the_start_can_be_let_go_of() -> None:
    """And does not follow the hand from there on."""
    scene = room(table()).with_held({"stick": "grip"}, at={"stick": (0.02, -0.1)})
    script = Script(scene).go(moved_base(scene.start, y=0.3))
    kept = compute_final_scene(scene, script.motion(), [Hold("stick", "grip")])
    left = compute_final_scene(
        scene, script.let_go().go(moved_base(scene.start, x=-0.5)).motion(), []
    )
    assert [(hold, hold.at) for hold in kept.holds] == [(Hold("stick", "grip"), (0.02, -0.1))]
    assert dict(left.held) == {}
    there = lifted(scene.objects["stick"].placement, [0.0, 0.3, 0.0]).homogeneous
    for after in (kept, left):
        np.testing.assert_allclose(after.objects["stick"].placement.homogeneous, there, atol=1e-9)


def test_what_is_held_through_another_thing_stays_there() -> None:
    scene = room(table(), objects=("stick", "ball")).with_held({"stick": "grip"})
    turns = scene.objects["ball"].object.attachment("pull").freedoms
    values = [0.5 * (turn.lower + turn.upper) for turn in turns]
    script = (
        Script(scene)
        .take("ball", "pull", values, by="stick.tip")
        .go(moved_base(scene.start, y=0.3))
    )
    stick = Hold("stick", "grip")
    holds = (stick, Hold("ball", "pull", stick, "tip"))
    after = compute_final_scene(scene, script.motion(), holds)
    assert after.holds == holds
    assert after.holds[1].at == tuple(values)


def make_plan(status: str, seconds: float) -> vkc.Plan:
    return vkc.Plan(
        scene=None,  # type: ignore[arg-type]
        steps=(),
        options=vkc.Options(),
        trajectory=None,  # type: ignore[arg-type]
        validation=SimpleNamespace(ok=status == "success"),  # type: ignore[arg-type]
        status=status,
        statistics=PlanningStatistics(seconds, iterations=int(seconds), rounds=1),
    )


@pytest.mark.parametrize(
    ("whole", "apart", "status", "seconds"),
    [
        ("success", None, "success", 10),
        # Where the problem of all steps fails, the steps planned sequentially may succeed.
        ("rejected", "success", "success", 10 + 3),
        ("not converged", "rejected", "not converged", 10 + 3),
        # Steps planned sequentially are no better, or the budget has ended.
        ("infeasible", None, "infeasible", 10),
        ("time limit", None, "time limit", 10),
        ("interrupted", None, "interrupted", 10),
    ],
)
def test_steps_are_planned_sequentially_only_after_a_failure_that_this_may_help(
    monkeypatch: pytest.MonkeyPatch, whole: str, apart: str | None, status: str, seconds: float
) -> None:
    result = SimpleNamespace(plan=make_plan(whole, 10.0))
    monkeypatch.setattr(module, "solve_task", lambda *_: result)

    def plan_sequentially(scene: Any, task: Any, request: PlanningRequest) -> vkc.Plan:
        assert apart is not None
        return make_plan(apart, 3.0)

    monkeypatch.setattr(module, "plan_sequentially", plan_sequentially)
    task: Any = SimpleNamespace(steps=(1, 2), holds=())
    scene: Any = None
    plan = module.plan_simultaneously(scene, task, PlanningRequest("auto", vkc.Options()))
    assert plan.status == status
    assert plan.statistics.planning_time == pytest.approx(seconds)


def replace_results(
    monkeypatch: pytest.MonkeyPatch, change: Callable[[TaskResult], vkc.Plan]
) -> None:
    """Let `change` replace the plan of every solved task."""
    real = module.solve_task

    def solve_task(*arguments: Any, **named: Any) -> TaskResult:
        result = real(*arguments, **named)
        return dataclasses.replace(result, plan=change(result))

    monkeypatch.setattr(module, "solve_task", solve_task)


def test_where_one_problem_fails_the_steps_are_really_planned_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of the whole only the solver's word is withheld; that of each step, the joining and validation are the real ones."""
    scene = vkc.load_scene("drawer")
    steps = [
        vkc.Actuate("drawer", {"slide": 0.2}),
        vkc.Release("drawer"),
        vkc.GoTo(*scene.start[:2]),
    ]
    lengths, evaluations = list[int](), list[int]()

    def change(result: TaskResult) -> vkc.Plan:
        lengths.append(len(result.task.steps))
        evaluations.append(result.plan.statistics.evaluations)
        if lengths[-1] == 1:
            return result.plan
        return dataclasses.replace(result.plan, status="not converged", report=wrong)

    wrong = vkc.Report(
        (vkc.Violation("goal", "base", waypoint=0, time=0.0, amount=1.0, unit="m", detail=""),)
    )
    replace_results(monkeypatch, change)
    plan = vkc.plan(scene, steps)
    assert plan.success, plan.summary()
    assert lengths == [3, 1, 1, 1]
    assert plan.statistics.evaluations == sum(evaluations)
    assert plan.steps == tuple(steps)
    assert validate(scene, steps, plan.trajectory).ok
    after = plan.end_scene()
    assert after.objects["drawer"].state[0] == pytest.approx(0.2, abs=1e-3)
    assert not after.held
    np.testing.assert_allclose(after.start[:2], scene.start[:2], atol=1e-3)


def test_one_step_that_fails_is_not_planned_again(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    replace_results(
        monkeypatch,
        lambda result: calls.append(1) or dataclasses.replace(result.plan, status="rejected"),
    )
    scene = vkc.load_scene("door")
    plan = vkc.plan(scene, [vkc.GoTo(*scene.start[:2] + 0.1)])
    assert (plan.status, len(calls)) == ("rejected", 1)


@pytest.mark.made_up
@pytest.mark.parametrize(("held", "asked"), [(True, None), (True, "handle"), (False, "handle")])
def test_what_cannot_be_moved_as_it_is_held_is_taken_anew(
    monkeypatch: pytest.MonkeyPatch, held: bool, asked: str | None
) -> None:
    """Only where the step moves what is held: then letting go of it comes first, and the motion ends as it should."""
    scene = vkc.load_scene("drawer")
    if held:
        scene = vkc.plan(scene, [vkc.Grasp("drawer", "handle")]).end_scene()
    tried, evaluations = list[str](), list[int]()

    def change(result: TaskResult) -> vkc.Plan:
        tried.append(type(result.task.steps[0]).__name__)
        evaluations.append(result.plan.statistics.evaluations)
        if tried[-1] == "Release":
            return result.plan
        return dataclasses.replace(result.plan, status="not converged")

    replace_results(monkeypatch, change)
    plan = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.2}, asked)])
    if not held:
        assert (plan.success, tried) == (False, ["Actuate"])
        return
    assert plan.success
    assert tried == ["Actuate", "Release"]
    assert plan.steps == (vkc.Release("drawer"), vkc.Actuate("drawer", {"slide": 0.2}, "handle"))
    assert plan.statistics.evaluations == sum(evaluations)
    after = plan.end_scene()
    assert dict(after.held) == {"drawer": "handle"}
    assert after.objects["drawer"].state[0] == pytest.approx(0.2, abs=1e-3)
    assert validate(scene, plan.steps, plan.trajectory).ok


def test_what_cannot_be_put_down_as_it_is_held_is_taken_anew() -> None:
    """What is taken from under a shelf is held from the side, and goes into a bin only from above."""
    shelved = littered(shelf(*AT[:2]))
    taken = vkc.plan(shelved, [vkc.Grasp("litter", "grip")])
    assert taken.success
    free = compute_final_scene(littered(), taken.trajectory, taken.end_scene().holds)
    plan = vkc.plan(free, [vkc.Place("litter", BIN)])
    assert plan.success
    assert plan.steps == (vkc.Release("litter"), vkc.Place("litter", BIN, "grip"))
    assert validate(free, plan.steps, plan.trajectory).ok
    first = plan.trajectory.phases[0]
    np.testing.assert_array_equal(
        np.ptp(plan.trajectory.positions[: first.last + 1, : len(free.start)], axis=0), 0.0
    )
    np.testing.assert_allclose(
        plan.end_scene().objects["litter"].placement.translation, BIN, atol=2e-3
    )


@pytest.mark.made_up
def test_what_is_taken_anew_is_taken_anew_among_other_steps_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Then the steps of the plan are more than those that were asked for, and the motion is one of them all."""

    def change(result: TaskResult) -> vkc.Plan:
        if isinstance(result.task.steps[0], vkc.Actuate):
            return dataclasses.replace(result.plan, status="not converged")
        return result.plan

    replace_results(monkeypatch, change)
    scene, grasp, opened = (
        vkc.load_scene("drawer"),
        vkc.Grasp("drawer", "handle"),
        vkc.Actuate("drawer", {"slide": 0.2}, "handle"),
    )
    plan = vkc.plan(scene, [grasp, opened], simultaneous=False)
    assert plan.success, plan.summary()
    assert plan.steps == (grasp, vkc.Release("drawer"), opened)
    assert validate(scene, plan.steps, plan.trajectory).ok
    assert plan.end_scene().objects["drawer"].state[0] == pytest.approx(0.2, abs=1e-3)


def test_a_goal_beyond_a_limit_is_not_asked_of_other_attachments(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No grasp helps, and the report says why."""
    tried = list[str]()

    def note(result: TaskResult) -> vkc.Plan:
        tried.append(str(result.task.holds[0]))
        return result.plan

    replace_results(monkeypatch, note)
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 3.0})])
    assert (plan.status, tried) == ("infeasible", ["door.handle"])
    assert plan.report.notes == ()
    assert "3 is beyond the limits" in plan.summary()


def test_building_before_planning_costs_no_negative_time() -> None:
    scene = vkc.load_scene("drawer")
    steps = [vkc.Actuate("drawer", {"slide": 0.2})]
    options = vkc.Options(reach_waypoints=23, move_waypoints=11)  # a structure of its own
    program_of(scene, steps, options=options)
    metrics = vkc.plan(scene, steps, options=options).metrics
    parts = sum(value for key, value in metrics.items() if key.startswith("time_"))
    assert metrics["planning_time"] >= parts > 0.0


# --- attachments that the steps leave open
# ----------------------------------------------------------------------------


def with_first(scene: Scene, owner: str, name: str, z: float) -> Scene:
    """Return the scene with one more attachment of an object before its others: the first one, so much higher."""
    placed = scene.objects[owner]
    grip = placed.object.attachment()
    lifted = pin.SE3(grip.placement.rotation, grip.placement.translation + np.array([0.0, 0.0, z]))
    attachments = {
        name: dataclasses.replace(grip, name=name, placement=lifted),
        **placed.object.attachments,
    }
    return with_objects(
        scene,
        {
            owner: dataclasses.replace(
                placed, object=dataclasses.replace(placed.object, attachments=attachments)
            )
        },
    )


def refrigerator() -> Scene:
    """Two leaves side by side, each with a handle, before the robot."""
    return hall("husky_ur5e", "refrigerator_0", description_of("refrigerator_0")).sample_start(
        np.random.default_rng(0)
    )


@pytest.mark.parametrize("planned", [vkc.plan, functools.partial(vkc.plan, window=2)])
def test_where_the_first_attachment_leads_nowhere_another_does(
    planned: Callable[..., vkc.Plan],
) -> None:
    scene = with_first(vkc.load_scene("drawer"), "drawer", "ceiling", 4.0)
    step = vkc.Actuate("drawer", {"slide": 0.2})
    result = planned(scene, [step])
    assert result.success, result.summary()
    (asked,) = result.steps
    assert asked == dataclasses.replace(step, attachment="handle")
    assert result.trajectory.phases[-1].held == {"drawer": "handle"}
    alone = planned(scene, [asked])
    np.testing.assert_array_equal(result.trajectory.positions, alone.trajectory.positions)
    assert result.metrics["evaluations"] > alone.metrics["evaluations"], (
        "it took what the first one took as well"
    )
    named = planned(scene, [dataclasses.replace(step, attachment="ceiling")])
    assert not named.success, "who names one means it"


def test_what_was_tried_is_said_where_all_fail() -> None:
    scene = with_first(vkc.load_scene("drawer"), "drawer", "ceiling", 4.0)
    thing = scene.objects["drawer"]
    attachments = {name: one for name, one in thing.object.attachments.items() if name == "ceiling"}
    attachments["roof"] = dataclasses.replace(attachments["ceiling"], name="roof")
    scene = with_objects(
        scene,
        {
            "drawer": dataclasses.replace(
                thing, object=dataclasses.replace(thing.object, attachments=attachments)
            )
        },
    )
    result = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.2})])
    assert result.status == "infeasible"
    assert result.steps == (vkc.Actuate("drawer", {"slide": 0.2}),)
    assert result.report.notes[-1].startswith("at drawer.roof: reach drawer.roof: out of reach")


def test_of_several_steps_only_the_one_that_fails_is_held_elsewhere() -> None:
    scene = with_first(vkc.load_scene("drawer"), "drawer", "ceiling", 4.0)
    there = vkc.GoTo(*(scene.start[:2] + 0.1))
    result = vkc.plan(scene, [there, vkc.Actuate("drawer", {"slide": 0.2})])
    assert result.success, result.summary()
    assert result.steps == (there, vkc.Actuate("drawer", {"slide": 0.2}, "handle"))


def test_two_leaves_of_one_thing_are_opened_as_one_problem() -> None:
    steps = [vkc.Actuate("it", {"hinge_left": 0.6}), vkc.Actuate("it", {"hinge_right": 0.5})]
    result = vkc.plan(refrigerator(), steps)
    assert result.success, result.summary()
    assert "," not in result.initialization, "of one seed"
    assert [phase.held for phase in result.trajectory.phases] == [
        {},
        {"it": "handle_left"},
        {},
        {"it": "handle_right"},
    ]
    ends = dict(zip(result.trajectory.names, result.trajectory.positions[-1], strict=True))
    assert (ends["it.hinge_left"], ends["it.hinge_right"]) == (
        pytest.approx(0.6, abs=1e-3),
        pytest.approx(0.5, abs=1e-3),
    )
    assert result.end_scene().held == {"it": "handle_right"}


def test_one_leaf_opened_here_and_then_there_is_planned_step_by_step() -> None:
    """The hinge has no place twice in one chain; nor is it held twice where a second plan begins at the end of the first."""
    first, second = (
        vkc.Actuate("it", {"hinge_left": value}, name)
        for value, name in ((0.3, "handle_left"), (0.6, "handle_left_free"))
    )
    both = vkc.plan(refrigerator(), [first, second])
    assert both.success, both.summary()
    assert [phase.held for phase in both.trajectory.phases] == [
        {},
        {"it": "handle_left"},
        {},
        {"it": "handle_left_free"},
    ]
    begun = vkc.plan(refrigerator(), [first])
    ended = vkc.plan(begun.end_scene(), [second])
    assert ended.success, ended.summary()
    assert "it.handle_left" not in ended.trajectory.names
    chore = vkc.plan(refrigerator(), [first, second], window=2)
    assert chore.success, chore.summary()
