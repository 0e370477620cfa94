"""How far the gripper is open: what attachments ask for, from the plan to its validation, files and pictures."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.grippers import WIDEST, between_cheeks, write_gripper
from helpers.judging import check, names
from oracle.changes import changed
from oracle.judge import judge

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
    found = vkc.plan(between_cheeks(robot, opening=NARROW), PULL)
    assert found.success, found.summary()
    return found


def with_openings(motion: Trajectory, *openings: float | None) -> Trajectory:
    both = zip(motion.phases, openings, strict=True)
    return dataclasses.replace(
        motion, phases=tuple(dataclasses.replace(phase, opening=opening) for phase, opening in both)
    )


def test_fingers_that_are_fully_open_are_too_close_and_narrower_ones_are_not(
    robot: Path, plan: vkc.Plan
) -> None:
    """The cheeks are 10 mm from fingers that are fully open; those are asked to keep 20 mm from what is no part of the drawer."""
    wide = vkc.plan(between_cheeks(robot), PULL)
    assert not wide.success
    assert {("clearance", "finger_a – left"), ("clearance", "finger_b – right")} & names(
        wide.report
    )
    assert [phase.opening for phase in wide.trajectory.phases] == [None, None, None]
    assert [phase.opening for phase in plan.trajectory.phases] == [NARROW, NARROW, NARROW]


def test_a_motion_is_judged_with_the_fingers_where_it_has_them(robot: Path, plan: vkc.Plan) -> None:
    """The same motion: too close with the fingers fully open, and not as it was asked for."""
    motion = plan.trajectory
    open_ = with_openings(motion, None, None, None)
    found = names(validate(plan.scene, PULL, open_, plan.options))
    assert ("opening", "drawer.grip") in found
    assert ("clearance", "finger_a – left") in found
    report = validate(plan.scene, PULL, with_openings(motion, 0.05, 0.05, 0.05), plan.options)
    (opening,) = [one for one in report.violations if one.constraint == "opening"]
    assert opening.amount == pytest.approx(0.01)
    assert "50.0 mm open, 40.0 mm are required" in opening.detail
    assert opening.waypoint == 0


def test_fingers_that_open_where_they_let_go_are_looked_at_on_their_way(
    robot: Path, plan: vkc.Plan
) -> None:
    """The hand lets go behind cheeks that are nearer: to open there takes the fingers into them."""
    near = between_cheeks(robot, opening=NARROW, gap=0.055)
    asked = [vkc.Grasp("drawer"), vkc.Release()]
    found = vkc.plan(near, asked)
    assert found.success, found.summary()
    motion = found.trajectory
    last = motion.phases[-1]
    assert last.last - last.first == 1  # one step of time, in which the robot rests
    widened = with_openings(motion, *[phase.opening for phase in motion.phases[:-1]], WIDEST)
    close = validate(near, asked, widened, found.options)
    assert {("clearance", "finger_a – left"), ("clearance", "finger_b – right")} <= names(close)
    inside = between_cheeks(robot, opening=NARROW, gap=0.045)
    deep = [
        one
        for one in validate(inside, asked, widened, found.options).violations
        if one.constraint == "penetration"
    ]
    assert {one.subject for one in deep} == {"finger_a – left", "finger_b – right"}
    assert all(one.amount == pytest.approx(0.005, abs=2e-4) for one in deep)
    assert all(one.time > motion.times[last.first] for one in deep)


@pytest.mark.parametrize(
    ("openings", "rule"), [((0.06, 0.06, 0.06), "opening"), ((None, None, None), "clearance")]
)
def test_the_oracle_finds_openings_that_are_wrong(
    plan: vkc.Plan, tmp_path: Path, openings: tuple[float | None, ...], rule: str
) -> None:
    """Fingers that are fully open are 10 mm from the cheeks."""

    def otherwise(content: dict[str, Any]) -> None:
        for phase, opening in zip(content["phases"], openings, strict=True):
            phase["opening"] = opening

    path = plan.save(tmp_path / "plan.npz")
    assert judge(path).found == []
    assert rule in {
        one.rule for one in judge(changed(path, tmp_path / "changed.npz", otherwise)).found
    }
    assert rule in {
        one.constraint
        for one in check(plan, trajectory=with_openings(plan.trajectory, *openings)).violations
    }


def test_an_opening_beyond_the_gripper_is_refused_in_a_motion(plan: vkc.Plan) -> None:
    with pytest.raises(
        vkc.InputError, match=r"phases\[2\].opening.*so far open.*0 to 0.07996 m.*0.2"
    ):
        validate(plan.scene, PULL, with_openings(plan.trajectory, NARROW, NARROW, 0.2))


def test_the_robot_stands_still_while_fingers_move(plan: vkc.Plan) -> None:
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
    assert ("dwell", "gripper") in names(report)


def test_program_and_validation_put_the_fingers_in_the_same_places(robot: Path) -> None:
    """Each in its own way: shapes that are locked elsewhere in the wrist, and joints that move."""
    scene = between_cheeks(robot, opening=0.03)
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
        here = data.oMi[shape.parentJoint] * shape.placement
        np.testing.assert_allclose(here.homogeneous, shapes.oMg[k].homogeneous, atol=1e-9)
        assert scene.robot.link_of(k) == world.collision_labels[k]


def test_the_gripper_changes_where_it_lets_go_and_takes_hold(robot: Path) -> None:
    """The second drawer asks for nothing: from the first one on the gripper is fully open again."""
    scene = between_cheeks(robot, opening=NARROW, other=(1.2, -1.5, 1.1))
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
    np.testing.assert_allclose(fingers[spans[2].first + 1 :], WIDEST / 2.0)
    drawn = sample_motion(world, found.trajectory)
    assert drawn.moving[np.array(world.coordinates.joints)[columns]].all()
    assert (
        found.trajectory.times[spans[2].first + 1] - found.trajectory.times[spans[2].first]
        >= found.options.grasp_time
    )


@pytest.mark.parametrize("opening", [None, 0.0, 0.03])
def test_a_finger_gets_where_it_is_asked_to_with_the_gripper_as_it_is(
    robot: Path, opening: float | None
) -> None:
    """The frame of a finger is where the finger stands, not where it would be fully open: 20 mm or more from there."""
    scene, finger = between_cheeks(robot, start=opening), "finger_a"
    opened = scene.robot.opened(opening)
    bent = opened.coordinates.q(scene.start + np.array([0.2, 0.1, 0.3, 0.1, 0.2, -0.1, 0.1, 0.1]))
    data = opened.model.createData()
    pin.framesForwardKinematics(opened.model, data, bent)
    place = data.oMf[opened.model.getFrameId(finger)].copy()
    for step in (vkc.Reach(place, finger), vkc.Touch(finger, place.translation.tolist())):
        found = vkc.plan(scene, [step])
        assert found.success, found.summary()
        assert [phase.opening for phase in found.trajectory.phases] == [opening]
        end = opened.coordinates.q(found.trajectory.positions[-1])
        pin.framesForwardKinematics(opened.model, data, end)
        np.testing.assert_allclose(
            data.oMf[opened.model.getFrameId(finger)].translation, place.translation, atol=2e-3
        )


def test_own_terms_about_a_finger_see_it_where_it_stands(robot: Path) -> None:
    """It is to stay beside where it is closed; a program that has it fully open would begin 40 mm from there."""
    scene = between_cheeks(robot, start=0.0)
    model = scene.robot.opened(0.0).model
    data = model.createData()
    pin.framesForwardKinematics(model, data, scene.robot.coordinates.q(scene.start))
    y = float(data.oMf[model.getFrameId("finger_a")].translation[1])
    beside = vkc.Constraint(
        "beside", lambda s: s.position("finger_a")[1], lower=y - 5e-3, upper=y + 5e-3
    )
    found = vkc.plan(scene, [vkc.GoTo(-0.2, 0.0, 0.0)], terms=[beside])
    assert found.success, found.summary()


def test_a_chore_rests_where_its_parts_change_the_opening(robot: Path) -> None:
    """Driving is planned by itself, and without a thought of the drawer: the fingers move before the hand reaches for it."""
    found = vkc.plan(
        between_cheeks(robot, opening=NARROW), [vkc.GoTo(-0.3, 0.2), PULL[0]], window=1
    )
    assert found.success, found.summary()
    go, reach, _ = found.trajectory.phases
    assert (go.opening, reach.opening) == (None, NARROW)
    times, rows = found.trajectory.times, found.trajectory.positions
    assert times[reach.first + 1] - times[reach.first] >= found.options.grasp_time
    assert np.array_equal(rows[reach.first], rows[reach.first + 1])


def test_what_is_drawn_moves_with_the_fingers(robot: Path) -> None:
    scene = between_cheeks(robot, start=0.02)
    world, opened = World(scene), scene.robot.opened(0.02)
    data, drawn = world.model.createData(), world.visual.createData()
    pin.updateGeometryPlacements(
        world.model, data, world.visual, drawn, world.coordinates.q(world.start)
    )
    other, right = opened.model.createData(), opened.visual.createData()
    pin.updateGeometryPlacements(
        opened.model, other, opened.visual, right, opened.coordinates.q(scene.start)
    )
    for k, shape in enumerate(opened.visual.geometryObjects):
        np.testing.assert_allclose(drawn.oMg[k].homogeneous, right.oMg[k].homogeneous, atol=1e-9)
        assert world.visual_labels[k] == shape.name.rpartition("_")[0]
    joints = [
        str(world.model.names[world.visual.geometryObjects[k].parentJoint])
        for k in range(len(right.oMg))
    ]
    assert {"finger_a_joint", "finger_b_joint"} < set(joints)


def test_a_plan_ends_and_goes_on_with_the_fingers_where_they_are(
    robot: Path, plan: vkc.Plan
) -> None:
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
    assert compute_start_opening(between_cheeks(robot)) is None
    assert "opening" not in between_cheeks(robot).document["start"]


def test_openings_are_saved(plan: vkc.Plan, tmp_path: Path) -> None:
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert loaded.success
    assert loaded.trajectory.phases == plan.trajectory.phases
    for read, write in (
        (Trajectory.from_csv, plan.trajectory.to_csv),
        (Trajectory.from_json, plan.trajectory.to_json),
    ):
        assert read(write(tmp_path / "motion")).phases == plan.trajectory.phases
    mixed = with_openings(plan.trajectory, 0.0, None, NARROW)
    assert [
        phase.opening for phase in Trajectory.from_csv(mixed.to_csv(tmp_path / "mixed")).phases
    ] == [0.0, None, NARROW]
    assert "opening" not in json.dumps(with_openings(plan.trajectory, None, None, None).to_dict())


def test_without_openings_nothing_changes(tmp_path: Path) -> None:
    """To the bit: whether the robot's description says how its gripper opens, or only where its fingers are locked."""
    found = []
    for name, gripper in (("one", None), ("other", "locked_joints: {finger_a_joint: 0.04}\n")):
        robot = (
            write_gripper(tmp_path / name)
            if gripper is None
            else write_gripper(tmp_path / name, gripper=gripper)
        )
        found.append(vkc.plan(between_cheeks(robot, gap=0.2), PULL))
        assert found[-1].success, found[-1].summary()
    one, other = (plan.trajectory for plan in found)
    assert np.array_equal(one.positions, other.positions)
    assert np.array_equal(one.times, other.times)
    assert one.to_dict() == other.to_dict()


@pytest.mark.parametrize(("opening", "stands"), [(0.3, WIDEST), (0.0801, WIDEST)])
def test_an_opening_beyond_the_gripper_is_as_near_as_it_gets_and_tells_so(
    robot: Path, opening: float, stands: float
) -> None:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scene = between_cheeks(robot, opening=opening)
    assert compile_task(scene, PULL, vkc.Options()).phases[0].opening == pytest.approx(
        stands, abs=2e-4
    )
    said = [str(one.message) for one in told]
    if opening == 0.3:
        text = "the gripper of 'mine' opens from 0.0 to 80.0 mm, not 300 mm as requested for drawer.grip: it opens to 80.0 mm"
        assert said == [f"cheeks: {text}"]
    else:  # what is measured is not that exact
        assert said == []


def test_a_robot_whose_gripper_does_not_open_tells_so(tmp_path: Path) -> None:
    robot = write_gripper(tmp_path / "plain", gripper="locked_joints: {finger_a_joint: 0.04}\n")
    with pytest.warns(
        UserWarning,
        match=r"'plain' cannot open as requested \(the start 20 mm, drawer.grip 40 mm\).*`gripper`",
    ):
        scene = between_cheeks(robot, opening=NARROW, start=0.02)
    assert [phase.opening for phase in compile_task(scene, PULL, vkc.Options()).phases] == [
        None,
        None,
    ]
    motion = vkc.plan(scene, PULL).trajectory
    with pytest.raises(vkc.InputError, match=r"phases\[1\].opening.*does not open"):
        validate(scene, PULL, with_openings(motion, None, NARROW, None))


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
def test_openings_that_are_none(robot: Path, opening: Any, problem: str) -> None:
    with pytest.raises(vkc.InputError, match=problem) as caught:
        between_cheeks(robot, opening=opening)
    assert "attachments[0].opening" in str(caught.value)
    with pytest.raises(vkc.InputError, match=problem) as caught:
        between_cheeks(robot, start=opening)
    assert caught.value.field == "start.opening"


@pytest.mark.parametrize("opening", [-0.1, "wide", 2.0, True])
def test_phases_with_openings_that_are_none(opening: Any) -> None:
    with pytest.raises(vkc.InputError, match=r"PhaseSpan\.opening"):
        PhaseSpan("reach", 0, 1, (), opening)
