"""Tests that validation checks the goals of steps and their order."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import drive_through, make_hall, move_start
from helpers.executions import make_grasping_scene, make_stationary_motion
from helpers.judging import get_approach, get_only_violation, get_violation_names, replace_object

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory


@pytest.fixture(scope="module")
def hall() -> Scene:
    return make_hall()


@pytest.fixture(scope="module")
def drive(hall: Scene) -> Trajectory:
    """Return a drive two metres ahead with a quarter turn."""
    return drive_through(hall, hall.start, move_start(hall.start, x=2.0, yaw=np.pi / 2))


def test_missed_goal_of_an_object_joint_is_reported(door_plan: vkc.Plan) -> None:
    steps = [vkc.Actuate("door", {"hinge": 1.25})]
    found = get_only_violation(
        validate(door_plan.scene, steps, door_plan.trajectory, door_plan.options)
    )
    assert (found.constraint, found.subject, found.unit) == ("goal", "door.hinge", "rad")
    assert found.waypoint == len(door_plan.trajectory.times) - 1
    assert found.amount == pytest.approx(0.05 - vkc.Tolerances().goal_angle, abs=1e-6)


def test_missed_grasp_is_reported(door_plan: vkc.Plan) -> None:
    motion = get_approach(door_plan)
    options = door_plan.options
    for step in (vkc.Grasp("door"), vkc.Grasp("door", "handle"), vkc.Grasp("door", "handle_free")):
        report = validate(door_plan.scene, [step], motion, options)
        assert {found.constraint for found in report.violations} <= {"acceleration"}, "\n".join(
            report.lines()
        )
    here = door_plan.scene.objects["door"].placement
    away = replace_object(
        door_plan.scene,
        placement=pin.SE3(here.rotation, here.translation + np.array([0.0, 0.0, 0.003])),
    )
    found = next(
        v
        for v in validate(away, [vkc.Grasp("door")], motion, options).violations
        if v.constraint == "goal"
    )
    assert (found.subject, found.unit, found.waypoint) == (
        "door.handle",
        "m",
        len(motion.times) - 1,
    )
    assert found.amount == pytest.approx(0.003 - vkc.Tolerances().goal_position, abs=5e-4)


def test_grasp_step_without_attachment_accepts_any_attachment(door_plan: vkc.Plan) -> None:
    grasps = door_plan.scene.objects["door"].object.attachments
    elsewhere = pin.SE3(
        grasps["handle"].placement.rotation,
        grasps["handle"].placement.translation + np.array([0.0, 0.05, 0.0]),
    )
    first = {
        "decoy": dataclasses.replace(grasps["handle"], name="decoy", placement=elsewhere),
        **grasps,
    }
    scene = replace_object(door_plan.scene, attachments=first)
    steps = [vkc.Grasp("door"), *door_plan.steps]
    assert validate(scene, steps, door_plan.trajectory, door_plan.options).ok
    steps = [vkc.Grasp("door", "decoy"), *door_plan.steps]
    assert {
        v.constraint
        for v in validate(scene, steps, door_plan.trajectory, door_plan.options).violations
    } == {"goal"}


def compute_final_placement(scene: Scene, motion: Trajectory, frame: str) -> pin.SE3:
    model = scene.robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, scene.robot.coordinates.q(motion.positions[-1]))
    return data.oMf[model.getFrameId(frame)].copy()


@pytest.mark.parametrize("frame", [None, "forearm_link"])
def test_missed_reach_is_reported(hall: Scene, drive: Trajectory, frame: str | None) -> None:
    name = frame or hall.robot.tool_frame
    pose = compute_final_placement(hall, drive, name)
    assert validate(hall, [vkc.Reach(pose, frame)], drive).ok
    beside = pin.SE3(pose.rotation, pose.translation + np.array([0.0, 0.003, 0.004]))
    found = get_only_violation(validate(hall, [vkc.Reach(beside, frame)], drive))
    assert (found.constraint, found.subject, found.waypoint, found.unit) == ("goal", name, 40, "m")
    assert found.amount == pytest.approx(0.005 - 1e-3)
    turned = pose * pin.SE3(pin.exp3(np.array([0.0, 0.01, 0.0])), np.zeros(3))
    found = get_only_violation(validate(hall, [vkc.Reach(turned, frame)], drive))
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "goal",
        name,
        40,
        "rad",
    )
    assert found.amount == pytest.approx(0.01 - 1e-3)
    half_round = pose * pin.SE3(pin.exp3(np.array([np.pi, 0.0, 0.0])), np.zeros(3))
    assert get_only_violation(
        validate(hall, [vkc.Reach(half_round, frame)], drive)
    ).amount == pytest.approx(np.pi - 1e-3, abs=1e-6)


def test_missed_base_pose_is_reported(hall: Scene, drive: Trajectory) -> None:
    found = get_only_violation(validate(hall, [vkc.GoTo(2.003, 0.004, np.pi / 2)], drive))
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "goal",
        "base",
        40,
        "m",
    )
    assert found.amount == pytest.approx(0.005 - 1e-3)
    found = get_only_violation(
        validate(hall, [vkc.GoTo(2.0, 0.0, np.pi / 2 + 2 * np.pi - 0.02)], drive)
    )
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "goal",
        "base heading",
        40,
        "rad",
    )
    assert found.amount == pytest.approx(0.02 - 1e-3)


def test_goals_must_hold_in_order_at_phase_ends(hall: Scene) -> None:
    one, two = move_start(hall.start, x=1.0), move_start(hall.start, x=1.0, y=1.0)
    motion = drive_through(hall, hall.start, one, two)
    first, second = vkc.GoTo(1.0, 0.0), vkc.GoTo(1.0, 1.0)
    assert validate(hall, [first, second], motion).ok
    found = get_only_violation(validate(hall, [second, first], motion))
    assert (found.constraint, found.subject) == ("goal", "base")
    assert found.amount == pytest.approx(1.0 - 1e-3)
    assert ("goal", "base") in get_violation_names(
        validate(hall, [vkc.GoTo(0.5, 0.0), second], motion)
    )  # reached, but not at a phase end
    assert get_violation_names(validate(hall, [first], motion)) == {
        ("goal", "base")
    }  # the base leaves the goal again
    further = drive_through(hall, hall.start, one, two, hall.start)
    home = vkc.GoTo(0.0, 0.0)
    assert validate(hall, [first, second, home], further).ok
    assert get_violation_names(validate(hall, [second, first, home], further)) == {("goal", "base")}


def test_object_must_not_move_before_its_step(door_plan: vkc.Plan) -> None:
    """All goals hold at the end, but the robot should have driven first."""
    x, y, yaw = door_plan.trajectory.positions[-1, :3]
    drive, open_door = vkc.GoTo(x, y, yaw), door_plan.steps[0]
    assert validate(door_plan.scene, [open_door, drive], door_plan.trajectory, door_plan.options).ok
    found = get_only_violation(
        validate(door_plan.scene, [drive, open_door], door_plan.trajectory, door_plan.options)
    )
    assert (found.constraint, found.subject) == ("order", "door")
    assert found.waypoint == door_plan.trajectory.phases[1].first


def test_steps_without_effect_are_accepted_anywhere(door_plan: vkc.Plan) -> None:
    scene, motion, options = door_plan.scene, door_plan.trajectory, door_plan.options
    here = vkc.GoTo(*scene.start[:3].tolist())
    for steps in (
        [here, *door_plan.steps],
        [vkc.Grasp("door"), *door_plan.steps],
        [vkc.Actuate("door", {"hinge": 0.0}), *door_plan.steps],
        [*door_plan.steps, *door_plan.steps],
        [*door_plan.steps, vkc.Grasp("door")],
    ):
        report = validate(scene, steps, motion, options)
        assert report.ok, "\n".join(report.lines())


@pytest.mark.parametrize(
    ("step", "field", "nearest"),
    [
        (vkc.Actuate("dor", {"hinge": 1.0}), "steps[0].object", "door"),
        (vkc.Actuate("door", {"hinges": 1.0}), "steps[0].joints", "hinge"),
        (vkc.Actuate("door", {"hinge": 1.0}, "handel"), "steps[0].attachment", "handle"),
        (vkc.Grasp("door", "handel"), "steps[0].attachment", "handle"),
        (vkc.Reach([0.0] * 6, "tol"), "steps[0].frame", "tool"),
    ],
)
def test_steps_with_unknown_names_are_refused(
    door_plan: vkc.Plan, step: object, field: str, nearest: str
) -> None:
    with pytest.raises(UnknownNameError) as caught:
        validate(door_plan.scene, [step], door_plan.trajectory, door_plan.options)
    assert (caught.value.field, caught.value.nearest) == (field, nearest)


def test_steps_must_be_a_list_of_steps(door_plan: vkc.Plan) -> None:
    for steps in ([], ["open the door"]):
        with pytest.raises(InputError, match="steps"):
            validate(door_plan.scene, steps, door_plan.trajectory, door_plan.options)


def test_release_requires_an_empty_hand() -> None:
    found = get_only_violation(
        validate(
            make_grasping_scene(), [vkc.Release()], make_stationary_motion(make_grasping_scene())
        )
    )
    assert (found.constraint, found.subject, found.amount, found.unit) == (
        "goal",
        "stick",
        1.0,
        "holds",
    )
