"""Tests gripper openings that attachments require, in plans, validation and files."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import make_trajectory
from helpers.grippers import MAX_OPENING, write_cheeks_scene, write_gripper
from helpers.judging import get_violation_names
from helpers.robots import compute_placement

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
CLOSE_PAIRS = {("clearance", "finger_a – left"), ("clearance", "finger_b – right")}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gripper(tmp_path_factory.mktemp("gripper") / "mine")


@pytest.fixture(scope="module")
def plan(robot: Path) -> vkc.Plan:
    found = vkc.plan(write_cheeks_scene(robot, opening=NARROW), PULL)
    assert found.success, found.summary()
    return found


def replace_openings(motion: Trajectory, *openings: float | None) -> Trajectory:
    phases = (
        dataclasses.replace(phase, opening=opening)
        for phase, opening in zip(motion.phases, openings, strict=True)
    )
    return dataclasses.replace(motion, phases=tuple(phases))


def get_openings(motion: Trajectory) -> list[float | None]:
    return [phase.opening for phase in motion.phases]


def test_narrow_opening_avoids_a_collision(robot: Path, plan: vkc.Plan) -> None:
    """Fully open fingers are 10 mm from the cheeks, less than the required 20 mm."""
    wide = vkc.plan(write_cheeks_scene(robot), PULL)
    assert not wide.success
    assert CLOSE_PAIRS & get_violation_names(wide.report)
    assert set(get_openings(wide.trajectory)) == {None}
    assert get_openings(plan.trajectory) == [NARROW, NARROW, NARROW]


def test_validation_uses_the_opening_of_each_phase(plan: vkc.Plan) -> None:
    wide = replace_openings(plan.trajectory, 0.05, 0.05, 0.05)
    violations = validate(plan.scene, PULL, wide, plan.options).violations
    (opening,) = [one for one in violations if one.constraint == "opening"]
    assert opening.amount == pytest.approx(0.01)
    assert opening.waypoint == 0
    assert "50.0 mm open, 40.0 mm are required" in opening.detail
    full = validate(plan.scene, PULL, replace_openings(wide, None, None, None), plan.options)
    assert ("clearance", "finger_a – left") in get_violation_names(full)


def test_opening_fingers_must_not_collide(robot: Path) -> None:
    """The hand releases the drawer and opens between narrower cheeks."""
    near = write_cheeks_scene(robot, opening=NARROW, gap=0.055)
    steps = [vkc.Grasp("drawer"), vkc.Release()]
    found = vkc.plan(near, steps)
    assert found.success, found.summary()
    motion = found.trajectory
    *before, last = motion.phases
    assert last.last - last.first == 1  # one time step, in which the robot rests
    widened = replace_openings(motion, *[phase.opening for phase in before], MAX_OPENING)
    assert get_violation_names(validate(near, steps, widened, found.options)) >= CLOSE_PAIRS
    inside = write_cheeks_scene(robot, opening=NARROW, gap=0.045)
    violations = validate(inside, steps, widened, found.options).violations
    deep = [one for one in violations if one.constraint == "penetration"]
    assert {one.subject for one in deep} == {pair for _, pair in CLOSE_PAIRS}
    assert all(one.amount == pytest.approx(0.005, abs=2e-4) for one in deep)
    assert all(one.time > motion.times[last.first] for one in deep)


def test_opening_beyond_the_gripper_is_refused(plan: vkc.Plan) -> None:
    problem = r"phases\[2\].opening.*so far open.*0 to 0.07996 m.*0.2"
    with pytest.raises(vkc.InputError, match=problem):
        validate(plan.scene, PULL, replace_openings(plan.trajectory, NARROW, NARROW, 0.2))


def test_planner_and_validator_place_the_fingers_alike(robot: Path) -> None:
    scene, options = write_cheeks_scene(robot, opening=0.03), vkc.Options()
    task = compile_task(scene, PULL, options)
    chain = consolidate(scene, task.holds)
    contacts, world = ContactModel(scene, chain, task, options), World(scene)
    z = np.random.default_rng(0).uniform(-0.5, 0.5, chain.size)
    data = chain.model.createData()
    pin.forwardKinematics(chain.model, data, chain.coordinates.q(z))
    rows = np.tile(z[: len(scene.start)], (2, 1))
    still = make_trajectory(scene, rows, phases=(PhaseSpan("still", 0, 1, (), 0.03),))
    q = world.coordinates.q(world.compute_positions(still)[1])
    placed, shapes = world.model.createData(), world.bodies.createData()
    pin.updateGeometryPlacements(world.model, placed, world.bodies, shapes, q)
    for k in range(len(scene.robot.collision.geometryObjects)):
        shape = contacts.phases[0].shapes[k]
        placement = data.oMi[shape.parentJoint] * shape.placement
        np.testing.assert_allclose(placement.homogeneous, shapes.oMg[k].homogeneous, atol=1e-9)
        assert scene.robot.link_of(k) == world.collision_labels[k]


def test_opening_changes_at_release_and_grasp(robot: Path) -> None:
    """The second drawer requires no opening."""
    scene = write_cheeks_scene(robot, opening=NARROW, other=(1.2, -1.5, 1.1))
    pulls = [vkc.Actuate(name, {"slide": 0.1}) for name in ("drawer", "other")]
    found = vkc.plan(scene, [*pulls, vkc.GoTo(0.0, 0.0)])
    assert found.success, found.summary()
    motion, world = found.trajectory, World(scene)
    assert get_openings(motion) == [NARROW, NARROW, None, None, None]
    columns = [world.coordinates.index(f"finger_{name}_joint") for name in "ab"]
    fingers, opened = world.compute_positions(motion)[:, columns], motion.phases[2].first
    np.testing.assert_allclose(fingers[: opened + 1], NARROW / 2.0, atol=1e-5)
    np.testing.assert_allclose(fingers[opened + 1 :], MAX_OPENING / 2.0)
    moving = sample_motion(world, motion).moving
    assert moving[np.array(world.coordinates.joints)[columns]].all()
    assert motion.times[opened + 1] - motion.times[opened] >= found.options.grasp_time


@pytest.mark.parametrize("opening", [None, 0.0, 0.03])
def test_finger_frames_depend_on_the_opening(robot: Path, opening: float | None) -> None:
    scene, finger = write_cheeks_scene(robot, start=opening), "finger_a"
    opened = scene.robot.opened(opening)

    def place_finger(row: np.ndarray) -> pin.SE3:
        return compute_placement(opened, finger, row)

    target = place_finger(scene.start + np.array([0.2, 0.1, 0.3, 0.1, 0.2, -0.1, 0.1, 0.1]))
    for step in (vkc.Reach(target, finger), vkc.Touch(finger, target.translation.tolist())):
        found = vkc.plan(scene, [step])
        assert found.success, found.summary()
        assert get_openings(found.trajectory) == [opening]
        reached = place_finger(found.trajectory.positions[-1])
        np.testing.assert_allclose(reached.translation, target.translation, atol=2e-3)


def test_robot_rests_between_actions_that_change_the_opening(robot: Path) -> None:
    scene = write_cheeks_scene(robot, opening=NARROW)
    found = vkc.plan(scene, [vkc.GoTo(-0.3, 0.2), PULL[0]], window=1)
    assert found.success, found.summary()
    assert get_openings(found.trajectory)[:2] == [None, NARROW]
    times, rows = found.trajectory.times, found.trajectory.positions
    first = found.trajectory.phases[1].first
    assert times[first + 1] - times[first] >= found.options.grasp_time
    assert np.array_equal(rows[first], rows[first + 1])


def test_planning_continues_with_the_opening(robot: Path, plan: vkc.Plan) -> None:
    end = plan.end_scene()
    again = Scene.from_document(end.document, end.folder)
    for scene in (end, again):
        assert (scene.opening, compute_start_opening(scene)) == (NARROW, NARROW)
    assert compile_task(again, [vkc.GoTo(0.0, 0.0)], vkc.Options()).phases[0].opening == NARROW
    world = World(again)
    finger = world.start[world.coordinates.index("finger_a_joint")]
    assert finger == pytest.approx(NARROW / 2.0, abs=1e-5)
    assert compute_start_opening(write_cheeks_scene(robot)) is None


def test_openings_are_saved(plan: vkc.Plan, tmp_path: Path) -> None:
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert loaded.success
    assert loaded.trajectory.phases == plan.trajectory.phases
    mixed = replace_openings(plan.trajectory, 0.0, None, NARROW)
    csv, json = mixed.to_csv(tmp_path / "a.csv"), mixed.to_json(tmp_path / "a.json")
    assert Trajectory.from_csv(csv).phases == Trajectory.from_json(json).phases == mixed.phases


def test_opening_is_clamped_with_a_warning(robot: Path) -> None:
    text = "opens from 0.0 to 80.0 mm, not 300 mm as requested for drawer.grip: it opens to 80.0 mm"
    with pytest.warns(UserWarning, match=f"cheeks: the gripper of 'mine' {text}") as caught:
        scene = write_cheeks_scene(robot, opening=0.3)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # within the accuracy of the measured range
        almost = write_cheeks_scene(robot, opening=0.0801)
    for one in (scene, almost):
        opening = compile_task(one, PULL, vkc.Options()).phases[0].opening
        assert opening == pytest.approx(MAX_OPENING, abs=2e-4)


def test_opening_without_a_gripper_is_ignored_with_a_warning(tmp_path: Path) -> None:
    robot = write_gripper(tmp_path / "plain", gripper="locked_joints: {finger_a_joint: 0.04}\n")
    text = r"'plain' cannot open as requested \(the start 20 mm, drawer.grip 40 mm\).*`gripper`"
    with pytest.warns(UserWarning, match=text):
        scene = write_cheeks_scene(robot, opening=NARROW, start=0.02)
    motion = vkc.plan(scene, PULL).trajectory
    assert set(get_openings(motion)) == {None}
    with pytest.raises(vkc.InputError, match=r"phases\[1\].opening.*does not open"):
        validate(scene, PULL, replace_openings(motion, None, NARROW))


@pytest.mark.parametrize("place", ["opening", "start"])
@pytest.mark.parametrize(
    ("opening", "problem"), [(-0.01, ">= 0"), ("wide", "a number"), (float("nan"), "finite")]
)
def test_invalid_openings_are_refused(robot: Path, place: str, opening: Any, problem: str) -> None:
    field = "start.opening" if place == "start" else r"attachments\[0\].opening"
    with pytest.raises(vkc.InputError, match=rf"{field}.*{problem}"):
        write_cheeks_scene(robot, **{place: opening})
