"""Tests gripper openings that attachments require, in plans, validation and files."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.grippers import MAX_OPENING, write_cheeks_scene, write_gripper
from helpers.judging import get_violation_names

import vkc_pin as vkc
from vkc_pin.planning.chain.chain import consolidate
from vkc_pin.planning.chain.contacts import ContactModel
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.contact_rules import compute_start_opening
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.placements import sample_motion
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

PULL = [vkc.Actuate("drawer", {"slide": 0.15}), vkc.Release()]
NARROW = 0.04


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gripper(tmp_path_factory.mktemp("gripper") / "mine")


@pytest.fixture(scope="module")
def plan(robot: Path) -> vkc.Plan:
    found = vkc.plan(write_cheeks_scene(robot, opening=NARROW), PULL)
    assert found.success, found.summary()
    return found


def replace_openings(motion: Trajectory, *openings: float | None) -> Trajectory:
    both = zip(motion.phases, openings, strict=True)
    return dataclasses.replace(
        motion, phases=tuple(dataclasses.replace(phase, opening=opening) for phase, opening in both)
    )


def test_narrow_opening_avoids_a_collision(robot: Path, plan: vkc.Plan) -> None:
    """Fully open fingers are 10 mm from the cheeks, less than the required 20 mm."""
    wide = vkc.plan(write_cheeks_scene(robot), PULL)
    assert not wide.success
    assert {
        ("clearance", "finger_a – left"),
        ("clearance", "finger_b – right"),
    } & get_violation_names(wide.report)
    assert [phase.opening for phase in wide.trajectory.phases] == [None, None, None]
    assert [phase.opening for phase in plan.trajectory.phases] == [NARROW, NARROW, NARROW]


def test_validation_uses_the_opening_of_each_phase(robot: Path, plan: vkc.Plan) -> None:
    motion = plan.trajectory
    wide = replace_openings(motion, None, None, None)
    found = get_violation_names(validate(plan.scene, PULL, wide, plan.options))
    assert ("opening", "drawer.grip") in found
    assert ("clearance", "finger_a – left") in found
    report = validate(plan.scene, PULL, replace_openings(motion, 0.05, 0.05, 0.05), plan.options)
    (opening,) = [one for one in report.violations if one.constraint == "opening"]
    assert opening.amount == pytest.approx(0.01)
    assert "50.0 mm open, 40.0 mm are required" in opening.detail
    assert opening.waypoint == 0


def test_opening_fingers_must_not_collide(robot: Path, plan: vkc.Plan) -> None:
    """The hand releases the drawer and opens between narrower cheeks."""
    near = write_cheeks_scene(robot, opening=NARROW, gap=0.055)
    steps = [vkc.Grasp("drawer"), vkc.Release()]
    found = vkc.plan(near, steps)
    assert found.success, found.summary()
    motion = found.trajectory
    last = motion.phases[-1]
    assert last.last - last.first == 1  # one time step, in which the robot rests
    widened = replace_openings(
        motion, *[phase.opening for phase in motion.phases[:-1]], MAX_OPENING
    )
    close = validate(near, steps, widened, found.options)
    assert {
        ("clearance", "finger_a – left"),
        ("clearance", "finger_b – right"),
    } <= get_violation_names(close)
    inside = write_cheeks_scene(robot, opening=NARROW, gap=0.045)
    deep = [
        one
        for one in validate(inside, steps, widened, found.options).violations
        if one.constraint == "penetration"
    ]
    assert {one.subject for one in deep} == {"finger_a – left", "finger_b – right"}
    assert all(one.amount == pytest.approx(0.005, abs=2e-4) for one in deep)
    assert all(one.time > motion.times[last.first] for one in deep)


def test_opening_beyond_the_gripper_is_refused(plan: vkc.Plan) -> None:
    with pytest.raises(
        vkc.InputError, match=r"phases\[2\].opening.*so far open.*0 to 0.07996 m.*0.2"
    ):
        validate(plan.scene, PULL, replace_openings(plan.trajectory, NARROW, NARROW, 0.2))


def test_robot_must_rest_while_fingers_move(plan: vkc.Plan) -> None:
    motion = plan.trajectory
    reach, move, let_go = motion.phases
    middle = dataclasses.replace(move, name="on", first=move.first + 10)
    phases = (
        reach,
        dataclasses.replace(move, last=move.first + 10),
        dataclasses.replace(middle, opening=0.05),
        let_go,
    )
    report = validate(plan.scene, PULL, dataclasses.replace(motion, phases=phases), plan.options)
    assert ("dwell", "gripper") in get_violation_names(report)


def test_planner_and_validator_place_the_fingers_alike(robot: Path) -> None:
    scene = write_cheeks_scene(robot, opening=0.03)
    options = vkc.Options()
    task = compile_task(scene, PULL, options)
    chain = consolidate(scene, task.holds)
    contacts, world = ContactModel(scene, chain, task, options), World(scene)
    z = np.random.default_rng(0).uniform(-0.5, 0.5, chain.size)
    data = chain.model.createData()
    pin.forwardKinematics(chain.model, data, chain.coordinates.q(z))
    phases = (PhaseSpan("still", 0, 1, (), 0.03),)
    rows = np.tile(z[: len(scene.start)], (2, 1))
    motion = Trajectory(
        scene.robot.coordinates.names, np.arange(2.0), rows, phases, len(scene.start)
    )
    placed, shapes = world.model.createData(), world.bodies.createData()
    pin.updateGeometryPlacements(
        world.model,
        placed,
        world.bodies,
        shapes,
        world.coordinates.q(world.compute_positions(motion)[1]),
    )
    for k, shape in enumerate(
        contacts.phases[0].shapes[: len(scene.robot.collision.geometryObjects)]
    ):
        placement = data.oMi[shape.parentJoint] * shape.placement
        np.testing.assert_allclose(placement.homogeneous, shapes.oMg[k].homogeneous, atol=1e-9)
        assert scene.robot.link_of(k) == world.collision_labels[k]


def test_opening_changes_at_release_and_grasp(robot: Path) -> None:
    """The second drawer requires no opening."""
    scene = write_cheeks_scene(robot, opening=NARROW, other=(1.2, -1.5, 1.1))
    steps = [
        vkc.Actuate("drawer", {"slide": 0.1}),
        vkc.Actuate("other", {"slide": 0.1}),
        vkc.GoTo(0.0, 0.0),
    ]
    task = compile_task(scene, steps, vkc.Options())
    assert [phase.opening for phase in task.phases] == [NARROW, NARROW, None, None, None]
    found = vkc.plan(scene, steps)
    assert found.success, found.summary()
    spans = found.trajectory.phases
    assert [span.opening for span in spans] == [NARROW, NARROW, None, None, None]
    world = World(scene)
    columns = [world.coordinates.index(f"finger_{name}_joint") for name in "ab"]
    fingers = world.compute_positions(found.trajectory)[:, columns]
    np.testing.assert_allclose(fingers[: spans[1].last + 1], NARROW / 2.0, atol=1e-5)
    np.testing.assert_allclose(fingers[spans[2].first + 1 :], MAX_OPENING / 2.0)
    sampled = sample_motion(world, found.trajectory)
    assert sampled.moving[np.array(world.coordinates.joints)[columns]].all()
    assert (
        found.trajectory.times[spans[2].first + 1] - found.trajectory.times[spans[2].first]
        >= found.options.grasp_time
    )


@pytest.mark.parametrize("opening", [None, 0.0, 0.03])
def test_finger_frames_depend_on_the_opening(robot: Path, opening: float | None) -> None:
    scene, finger = write_cheeks_scene(robot, start=opening), "finger_a"
    opened = scene.robot.opened(opening)
    bent = opened.coordinates.q(scene.start + np.array([0.2, 0.1, 0.3, 0.1, 0.2, -0.1, 0.1, 0.1]))
    data = opened.model.createData()
    pin.framesForwardKinematics(opened.model, data, bent)
    target = data.oMf[opened.model.getFrameId(finger)].copy()
    for step in (vkc.Reach(target, finger), vkc.Touch(finger, target.translation.tolist())):
        found = vkc.plan(scene, [step])
        assert found.success, found.summary()
        assert [phase.opening for phase in found.trajectory.phases] == [opening]
        end = opened.coordinates.q(found.trajectory.positions[-1])
        pin.framesForwardKinematics(opened.model, data, end)
        np.testing.assert_allclose(
            data.oMf[opened.model.getFrameId(finger)].translation, target.translation, atol=2e-3
        )


def test_robot_rests_between_actions_that_change_the_opening(robot: Path) -> None:
    found = vkc.plan(
        write_cheeks_scene(robot, opening=NARROW), [vkc.GoTo(-0.3, 0.2), PULL[0]], window=1
    )
    assert found.success, found.summary()
    go, reach, _ = found.trajectory.phases
    assert (go.opening, reach.opening) == (None, NARROW)
    times, rows = found.trajectory.times, found.trajectory.positions
    assert times[reach.first + 1] - times[reach.first] >= found.options.grasp_time
    assert np.array_equal(rows[reach.first], rows[reach.first + 1])


def test_planning_continues_with_the_opening(robot: Path, plan: vkc.Plan) -> None:
    end = plan.end_scene()
    assert end.opening == NARROW
    assert compute_start_opening(end) == NARROW
    assert end.document["start"]["opening"] == NARROW
    again = Scene.from_document(end.document, end.folder)
    assert again.opening == NARROW
    assert compile_task(again, [vkc.GoTo(0.0, 0.0)], vkc.Options()).phases[0].opening == NARROW
    world = World(again)
    assert world.start[world.coordinates.index("finger_a_joint")] == pytest.approx(
        NARROW / 2.0, abs=1e-5
    )
    assert compute_start_opening(write_cheeks_scene(robot)) is None
    assert "opening" not in write_cheeks_scene(robot).document["start"]


def test_openings_are_saved(plan: vkc.Plan, tmp_path: Path) -> None:
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert loaded.success
    assert loaded.trajectory.phases == plan.trajectory.phases
    for read, write in (
        (Trajectory.from_csv, plan.trajectory.to_csv),
        (Trajectory.from_json, plan.trajectory.to_json),
    ):
        assert read(write(tmp_path / "motion")).phases == plan.trajectory.phases
    mixed = replace_openings(plan.trajectory, 0.0, None, NARROW)
    assert [
        phase.opening for phase in Trajectory.from_csv(mixed.to_csv(tmp_path / "mixed")).phases
    ] == [0.0, None, NARROW]
    assert "opening" not in json.dumps(
        replace_openings(plan.trajectory, None, None, None).to_dict()
    )


@pytest.mark.parametrize(("opening", "clamped"), [(0.3, MAX_OPENING), (0.0801, MAX_OPENING)])
def test_opening_is_clamped_with_a_warning(robot: Path, opening: float, clamped: float) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = write_cheeks_scene(robot, opening=opening)
    assert compile_task(scene, PULL, vkc.Options()).phases[0].opening == pytest.approx(
        clamped, abs=2e-4
    )
    messages = [str(one.message) for one in caught]
    if opening == 0.3:
        text = "opens from 0.0 to 80.0 mm, not 300 mm as requested for drawer.grip"
        assert messages == [f"cheeks: the gripper of 'mine' {text}: it opens to 80.0 mm"]
    else:  # within the accuracy of the measured range
        assert messages == []


def test_opening_without_a_gripper_is_ignored_with_a_warning(tmp_path: Path) -> None:
    robot = write_gripper(tmp_path / "plain", gripper="locked_joints: {finger_a_joint: 0.04}\n")
    with pytest.warns(
        UserWarning,
        match=r"'plain' cannot open as requested \(the start 20 mm, drawer.grip 40 mm\).*`gripper`",
    ):
        scene = write_cheeks_scene(robot, opening=NARROW, start=0.02)
    assert [phase.opening for phase in compile_task(scene, PULL, vkc.Options()).phases] == [
        None,
        None,
    ]
    motion = vkc.plan(scene, PULL).trajectory
    with pytest.raises(vkc.InputError, match=r"phases\[1\].opening.*does not open"):
        validate(scene, PULL, replace_openings(motion, None, NARROW, None))


@pytest.mark.parametrize(
    ("opening", "problem"),
    [
        (-0.01, ">= 0"),
        ("wide", "a number"),
        (True, "a number"),
        ([0.1], "a number"),
        (float("nan"), "finite"),
    ],
)
def test_invalid_openings_are_refused(robot: Path, opening: Any, problem: str) -> None:
    with pytest.raises(vkc.InputError, match=problem) as caught:
        write_cheeks_scene(robot, opening=opening)
    assert "attachments[0].opening" in str(caught.value)
    with pytest.raises(vkc.InputError, match=problem) as caught:
        write_cheeks_scene(robot, start=opening)
    assert caught.value.field == "start.opening"
