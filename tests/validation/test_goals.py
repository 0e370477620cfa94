"""Tests that validation checks the goals of steps and their order."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import drive_through, move_start
from helpers.executions import make_grasping_scene, make_stationary_motion
from helpers.judging import check_only_violation, get_approach, get_violation_names, replace_object
from helpers.motions import make_object_motion
from helpers.robots import compute_placement

import vkc_pin as vkc
from vkc_pin import InputError, Report, Scene, Trajectory, UnknownNameError, validate
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.curve import Curve


def validate_door(plan: vkc.Plan, *steps: Step, scene: Scene | None = None) -> Report:
    """Validate the motion of the door with other steps."""
    return validate(scene or plan.scene, steps, plan.trajectory, plan.options)


def test_missed_goal_of_an_object_joint_is_reported(door_plan: vkc.Plan) -> None:
    amount = pytest.approx(0.05 - vkc.Tolerances().goal_angle, abs=1e-6)
    report = validate_door(door_plan, vkc.Actuate("door", {"hinge": 1.25}))
    last = len(door_plan.trajectory.times) - 1
    check_only_violation(report, "goal", "door.hinge", "rad", waypoint=last, amount=amount)


def test_missed_grasp_is_reported(door_plan: vkc.Plan) -> None:
    motion, options, scene = get_approach(door_plan), door_plan.options, door_plan.scene
    for step in (vkc.Grasp("door"), vkc.Grasp("door", "handle"), vkc.Grasp("door", "handle_free")):
        report = validate(scene, [step], motion, options)
        assert {found.constraint for found in report.violations} <= {"acceleration"}, report
    here = scene.objects["door"].placement
    above = pin.SE3(here.rotation, here.translation + np.array([0.0, 0.0, 0.003]))
    report = validate(replace_object(scene, placement=above), [vkc.Grasp("door")], motion, options)
    (found,) = [one for one in report.violations if one.constraint == "goal"]
    assert (found.subject, found.unit) == ("door.handle", "m")
    assert found.waypoint == len(motion.times) - 1
    assert found.amount == pytest.approx(0.003 - vkc.Tolerances().goal_position, abs=5e-4)


def test_grasp_step_without_attachment_accepts_any_attachment(door_plan: vkc.Plan) -> None:
    grasps = door_plan.scene.objects["door"].object.attachments
    handle = grasps["handle"]
    above = pin.SE3(
        handle.placement.rotation, handle.placement.translation + np.array([0.0, 0.05, 0.0])
    )
    decoy = dataclasses.replace(handle, name="decoy", placement=above)
    scene = replace_object(door_plan.scene, attachments={"decoy": decoy, **grasps})
    assert validate_door(door_plan, vkc.Grasp("door"), *door_plan.steps, scene=scene).ok
    report = validate_door(door_plan, vkc.Grasp("door", "decoy"), *door_plan.steps, scene=scene)
    assert {found.constraint for found in report.violations} == {"goal"}


@pytest.mark.parametrize("frame", [None, "forearm_link"])
def test_missed_reach_is_reported(hall: Scene, drive: Trajectory, frame: str | None) -> None:
    name = frame or hall.robot.tool_frame
    pose = compute_placement(hall.robot, name, drive.positions[-1])
    assert validate(hall, [vkc.Reach(pose, frame)], drive).ok
    for shift, turn, unit, error in (
        ([0.0, 0.003, 0.004], [0.0, 0.0, 0.0], "m", 0.005),
        ([0.0, 0.0, 0.0], [0.0, 0.01, 0.0], "rad", 0.01),
        ([0.0, 0.0, 0.0], [np.pi, 0.0, 0.0], "rad", np.pi),
    ):
        missed = pose * pin.SE3(pin.exp3(np.array(turn)), np.array(shift))
        report = validate(hall, [vkc.Reach(missed, frame)], drive)
        amount = pytest.approx(error - 1e-3, abs=1e-6)
        check_only_violation(report, "goal", name, unit, waypoint=40, amount=amount)


@pytest.mark.parametrize(
    ("goal", "subject", "unit", "error"),
    [
        ((2.003, 0.004, np.pi / 2), "base", "m", 0.005),
        ((2.0, 0.0, np.pi / 2 + 2 * np.pi - 0.02), "base heading", "rad", 0.02),
        ((2.0, 0.0, np.pi / 2 + 0.02), "base heading", "rad", 0.02),
    ],
)
def test_missed_base_pose_is_reported(
    hall: Scene, drive: Trajectory, goal: Sequence[float], subject: str, unit: str, error: float
) -> None:
    report, amount = validate(hall, [vkc.GoTo(*goal)], drive), pytest.approx(error - 1e-3)
    check_only_violation(report, "goal", subject, unit, waypoint=40, amount=amount)
    field = {"m": "goal_position", "rad": "goal_angle"}[unit]
    for accepted, ok in ((1.01 * error, True), (0.99 * error, False)):
        tolerances = dataclasses.replace(vkc.Tolerances(), **{field: accepted})
        assert validate(hall, [vkc.GoTo(*goal)], drive, tolerances=tolerances).ok == ok


@pytest.mark.parametrize("between", [False, True])
def test_object_must_not_move_and_return_before_its_step(
    door_plan: vkc.Plan, between: bool
) -> None:
    """The door is opened and shut again, at or between waypoints, although a drive comes first."""
    scene, here = door_plan.scene, door_plan.scene.start[:3].tolist()
    hold = (vkc.Hold("door", "handle"),)
    phases = (vkc.PhaseSpan("swing", 0, 2, hold), vkc.PhaseSpan("drive", 2, 3, hold))
    swing = [0.0, 0.0 if between else 0.1, 0.0, 0.0]
    motion = make_object_motion(scene, "door", *phases, hinge=swing, knob=[0.0] * 4)
    rows = motion.positions.copy()
    rows[3, 0] += 1.0
    rates = np.zeros_like(rows)
    rates[:2, motion.names.index("door.hinge")] = np.array([4.0, -4.0]) * 0.1
    curve = Curve(motion.times, rows, rates) if between else None
    motion = dataclasses.replace(motion, positions=rows, curve=curve)
    steps = [vkc.GoTo(here[0] + 1.0, *here[1:]), vkc.Actuate("door", {"hinge": 0.0})]
    report = validate(scene, steps, motion)
    (found,) = [one for one in report.violations if one.constraint == "order"]
    assert (found.subject, found.waypoint) == ("door", 0)
    overshoot = 0.4 * 4.0 / 27.0  # in the second segment, to the other side
    assert found.amount == pytest.approx(0.1 + between * overshoot)


def test_goals_must_hold_in_order_at_phase_ends(hall: Scene) -> None:
    one, two = move_start(hall.start, x=1.0), move_start(hall.start, x=1.0, y=1.0)
    motion = drive_through(hall, hall.start, one, two)
    first, second, home = vkc.GoTo(1.0, 0.0), vkc.GoTo(1.0, 1.0), vkc.GoTo(0.0, 0.0)
    assert validate(hall, [first, second], motion).ok
    amount = pytest.approx(1.0 - 1e-3)
    check_only_violation(validate(hall, [second, first], motion), "goal", "base", amount=amount)
    further, halfway = drive_through(hall, hall.start, one, two, hall.start), vkc.GoTo(0.5, 0.0)
    assert validate(hall, [first, second, home], further).ok
    for steps, wrong in (
        ([halfway, second], motion),  # reached, but not at a phase end
        ([first], motion),  # the base leaves the goal again
        ([second, first, home], further),
    ):
        assert get_violation_names(validate(hall, steps, wrong)) == {("goal", "base")}


def test_object_must_not_move_before_its_step(door_plan: vkc.Plan) -> None:
    """All goals hold at the end, but the robot should have driven first."""
    drive, open_door = vkc.GoTo(*door_plan.trajectory.positions[-1, :3]), door_plan.steps[0]
    assert validate_door(door_plan, open_door, drive).ok
    moved = door_plan.trajectory.phases[1].first
    report = validate_door(door_plan, drive, open_door)
    check_only_violation(report, "order", "door", waypoint=moved)


def test_steps_without_effect_are_accepted_anywhere(door_plan: vkc.Plan) -> None:
    here, own = vkc.GoTo(*door_plan.scene.start[:3].tolist()), door_plan.steps
    for steps in (
        [here, *own],
        [vkc.Grasp("door"), *own],
        [vkc.Actuate("door", {"hinge": 0.0}), *own],
        [*own, *own],
        [*own, vkc.Grasp("door")],
    ):
        report = validate_door(door_plan, *steps)
        assert report.ok, report.lines()


@pytest.mark.parametrize(
    ("step", "field", "nearest"),
    [
        (vkc.Actuate("dor", {"hinge": 1.0}), "object", "door"),
        (vkc.Actuate("door", {"hinges": 1.0}), "joints", "hinge"),
        (vkc.Actuate("door", {"hinge": 1.0}, "handel"), "attachment", "handle"),
        (vkc.Grasp("door", "handel"), "attachment", "handle"),
        (vkc.Grasp("cup", by="cupp.cup"), "by", "cup"),
        (vkc.Grasp("cup", by="cup.cap"), "by", "cup"),
        (vkc.Place("cupp", (0.0, 0.0, 1.0)), "object", "cup"),
        (vkc.Place("cup", (0.0, 0.0, 1.0), "sides"), "attachment", "side"),
        (vkc.Reach([0.0] * 6, "tol"), "frame", "tool"),
        (vkc.Release("cupp"), "object", "cup"),
        (vkc.Touch("cup.cap", (0.0, 0.0, 1.0)), "frame", "cup"),
        (vkc.Touch("tol", (0.0, 0.0, 1.0)), "frame", "tool"),
    ],
    ids=str,
)
def test_steps_with_unknown_names_are_refused(step: Step, field: str, nearest: str) -> None:
    scene = vkc.load_scene("household")
    with pytest.raises(UnknownNameError) as caught:
        validate(scene, [step], make_stationary_motion(scene))
    assert (caught.value.field, caught.value.nearest) == (f"steps[0].{field}", nearest)


def test_frames_must_be_links_of_free_objects() -> None:
    scene, step = vkc.load_scene("household"), vkc.Grasp("cup", by="door.panel")
    with pytest.raises(InputError, match="stands fixed"):
        validate(scene, [step], make_stationary_motion(scene))


@pytest.mark.parametrize("steps", [[], ["open the door"]])
def test_steps_must_be_a_list_of_steps(hall: Scene, drive: Trajectory, steps: Any) -> None:
    with pytest.raises(InputError, match="steps"):
        validate(hall, steps, drive)


def test_release_requires_an_empty_hand() -> None:
    scene = make_grasping_scene()
    report = validate(scene, [vkc.Release()], make_stationary_motion(scene))
    check_only_violation(report, "goal", "stick", "holds", amount=1.0)
