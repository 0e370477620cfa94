"""Tests that the rest of a motion is judged like the whole one when obstacles move."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    STICK,
    MotionBuilder,
    describe_box,
    describe_table,
    lift,
    make_carrying_motion,
    make_room,
    move_base,
    solve_grasp,
)
from helpers.drives import DT, drive_through, make_hall, move_start
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin import Options, Scene, Trajectory, Violation, validate
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation import RemainingCheck
from vkc_pin.validation.samples import Samples
from vkc_pin.world.collision.distances import count_distance_queries
from vkc_pin.world.task.steps import Step

CONSTRAINTS = ("clearance", "penetration")
PERSON = {
    "name": "person",
    "type": "cylinder",
    "radius": 0.25,
    "length": 1.8,
    "position": [0.0, 4.0, 0.9],
}


def make_pose(x: float, y: float, z: float = 0.9) -> list[float]:
    return [x, y, z, 0.0, 0.0, 0.0]


def list_amounts(violations: Sequence[Violation]) -> dict[tuple[str, str], float]:
    return {(one.constraint, one.subject): one.amount for one in violations}


def validate_pairs(
    scene: Scene, steps: Sequence[Step], motion: Trajectory, options: Options
) -> dict[tuple[str, str], float]:
    """Return constraint and pair → amount [m] of the collisions that `validate` finds."""
    report = validate(scene, steps, motion, options)
    return list_amounts([one for one in report.violations if one.constraint in CONSTRAINTS])


def measure_distance(scene: Scene, obstacle: str, configuration: Floats) -> float:
    """Return the distance of the robot to an obstacle [m]; negative: they overlap."""
    robot = scene.robot
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.coordinates.q(configuration))
    (number,) = [k for k, label in enumerate(scene.obstacle_labels) if label == obstacle]
    wall = scene.obstacles[number]
    at = coal.Transform3s(wall.placement.rotation, wall.placement.translation)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = True
    smallest = np.inf
    for shape in robot.collision.geometryObjects:
        placement = data.oMi[shape.parentJoint] * shape.placement
        there = coal.Transform3s(placement.rotation, placement.translation)
        result.clear()
        distance = coal.distance(shape.geometry, there, wall.geometry, at, request, result)
        smallest = min(smallest, distance)
    return smallest


def assert_same(found: Sequence[Violation], expected: dict[tuple[str, str], float]) -> None:
    assert list_amounts(found) == pytest.approx(expected, rel=0.0, abs=1e-9)


@pytest.fixture(scope="module")
def door_check(door_plan: vkc.Plan) -> RemainingCheck:
    plan = door_plan
    return RemainingCheck(plan.scene, plan.steps, plan.trajectory, plan.options)


@pytest.mark.parametrize("seed", range(8))
def test_same_verdict_as_validation_wherever_an_obstacle_is(
    door_plan: vkc.Plan, door_check: RemainingCheck, seed: int
) -> None:
    plan = door_plan
    rng = np.random.default_rng(seed)
    for name in ("sofa", "armchair", "table_top"):
        waypoint = rng.integers(len(plan.trajectory.times))
        position = rng.normal(size=3)
        position[:2] = plan.trajectory.positions[waypoint, :2] + rng.normal(0.0, 0.7, 2)
        position[2] = rng.uniform(0.1, 1.8)
        scene = plan.scene.with_obstacle(name, [*position, *rng.uniform(-3.0, 3.0, 3)])
        expected = validate_pairs(scene, plan.steps, plan.trajectory, plan.options)
        found = door_check.find_violations(scene)
        assert_same(found, expected)
        # Collisions after a time remain, if they are the worst of their pair.
        time = rng.uniform(0.0, plan.trajectory.times[-1])
        left = list_amounts(door_check.find_violations(scene, time))
        for one in found:
            if one.time >= time:
                amount = left[one.constraint, one.subject]
                assert amount == pytest.approx(one.amount, rel=0.0, abs=1e-9)


@pytest.mark.parametrize("gap", [0.004, 0.012, -0.002, -0.03])
def test_neighbours_of_doors_are_exempt_as_in_validation(
    door_plan: vkc.Plan, door_check: RemainingCheck, gap: float
) -> None:
    plan = door_plan
    door = plan.scene.objects["door"]
    shapes = door.object.collision.geometryObjects
    panel = next(shape for shape in shapes if shape.name.startswith("panel"))
    half = np.array(panel.geometry.halfSide)
    leaf = door.link_placement("panel") * panel.placement
    sofa = plan.scene.obstacles[plan.scene.obstacle_labels.index("sofa")]
    for side in (-1.0, 1.0):
        for axis in range(2):
            shift = np.zeros(3)
            shift[axis] = side * (half[axis] + sofa.geometry.halfSide[axis] + gap)
            at = leaf * pin.SE3(np.eye(3), shift)
            scene = plan.scene.with_obstacle("sofa", at)
            expected = validate_pairs(scene, plan.steps, plan.trajectory, plan.options)
            assert_same(door_check.find_violations(scene), expected)


@pytest.mark.parametrize("height", [0.0, -2e-3, 3e-3, 0.02, 0.3])
def test_objects_are_lifted_and_put_down_as_in_validation(height: float) -> None:
    options = Options(dt=0.05, grasp_time=1e-6)
    scene = make_room(describe_table(), describe_box("post", [0.1, 0.1, 0.5], [0.8, 3.0, 0.25]))
    motion = make_carrying_motion(scene).motion()
    steps = [vkc.Place("stick", lift(STICK, [0.0, 0.5, 0.0]))]
    check = RemainingCheck(scene, steps, motion, options)
    table = scene.obstacles[0].placement.translation
    for y in (-0.1, 0.2, 0.4, 0.6):
        moved = scene.with_obstacle("table", make_pose(table[0], table[1], table[2] + height))
        moved = moved.with_obstacle("post", make_pose(0.8, y, 0.25 + height))
        expected = validate_pairs(moved, steps, motion, options)
        assert_same(check.find_violations(moved), expected)


def test_tolerated_overlaps_hide_no_smaller_ones_that_are_not() -> None:
    options = Options(dt=0.05, grasp_time=1e-6)
    scene = make_room(describe_table())
    down = solve_grasp()
    motion = MotionBuilder(scene).go(down).take("stick")
    drag = motion.go(move_base(down, y=0.5), steps=60).motion()
    check = RemainingCheck(scene, [vkc.Grasp("stick")], drag, options)
    # The table slopes: the stick leaves it slowly, and begins as deep in it as it may.
    pose = make_pose(*scene.obstacles[0].placement.translation)
    pose[2] += 0.02
    pose[3] = -0.02
    moved = scene.with_obstacle("table", pose)
    found = check.find_violations(moved)
    worst = {one.subject: one.time for one in found}["stick.stick – table"]
    assert not np.isclose(drag.times, worst, rtol=0.0, atol=1e-9).any(), "not between waypoints"
    assert_same(found, validate_pairs(moved, [vkc.Grasp("stick")], drag, options))


@pytest.mark.parametrize("gap", [0.0, 1e-3, -1e-3, -0.03])
def test_touched_obstacles_are_judged_as_in_validation(gap: float) -> None:
    options = Options(dt=0.05, grasp_time=1e-6)
    wall = describe_box("wall", [0.3, 0.1, 0.3], [3.0, 3.0, 1.0])
    scene = make_room(wall).with_held({"stick": "grip"})
    there = move_base(scene.start, y=0.4)
    tip = scene.with_start(base=there[:3]).objects["stick"].link_placement("tip").translation
    motion = MotionBuilder(scene).go(there).go(np.array(scene.start)).motion()
    steps = [vkc.Touch("stick.tip", tuple(tip)), vkc.GoTo(0.0, 0.0)]
    moved = scene.with_obstacle("wall", make_pose(tip[0], tip[1] + gap + 0.05, tip[2]))
    found = RemainingCheck(scene, steps, motion, options).find_violations(moved)
    assert_same(found, validate_pairs(moved, steps, motion, options))
    assert bool(found) == (gap < -1e-4)


@pytest.fixture(scope="module")
def crossing() -> tuple[Scene, Trajectory]:
    """Return a hall with a person far away, and a drive of two metres to and fro."""
    crate = describe_box("crate", [0.3, 0.3, 0.3], [-4.0, 4.0, 0.15])
    scene = make_hall(obstacles=[PERSON, crate])
    there = move_start(scene.start, x=2.0)
    return scene, drive_through(scene, scene.start, there, move_start(there, y=3.0))


def test_only_the_rest_of_the_motion_is_checked(crossing: tuple[Scene, Trajectory]) -> None:
    scene, drive = crossing
    check = RemainingCheck(scene, [vkc.GoTo(2.0, 3.0)], drive)
    begin = scene.with_obstacle("person", make_pose(1.0, 0.0))
    corner = float(drive.times[40])
    assert check.find_violations(begin)[0].constraint == "penetration"
    assert check.find_violations(begin, -1.0) == check.find_violations(begin)
    # At the corner the person is 1 m behind the robot, whose base is shorter.
    assert check.find_violations(begin, corner) == ()
    end = scene.with_obstacle("person", make_pose(2.0, 3.0))
    for time in (0.0, corner, drive.times[-1] - 1e-3, drive.times[-1], 1e3):
        (worst, *_) = sorted(check.find_violations(end, time), key=lambda one: -one.amount)
        assert worst.amount > 0.2, time
    samples = Samples(scene, drive).times
    for time in np.linspace(0.0, drive.times[-1], 7).tolist():
        first = samples[np.searchsorted(samples, time, side="right") - 1]
        assert all(one.time >= first for one in check.find_violations(begin, time))


def test_obstacles_may_be_added_removed_and_replaced(
    crossing: tuple[Scene, Trajectory], tmp_path: Any
) -> None:
    scene, drive = crossing
    steps = [vkc.GoTo(2.0, 3.0)]
    check = RemainingCheck(scene, steps, drive)
    person, crate = scene.document["obstacles"]
    (tmp_path / "pair.urdf").write_text(
        """<robot name="r"><link name="a"><collision><geometry><sphere radius="0.2"/></geometry>
        </collision><collision><origin xyz="0 2 0.4"/><geometry><box size="0.2 0.2 0.2"/></geometry>
        </collision></link></robot>"""
    )
    pair = {"name": "pair", "type": "urdf", "file": str(tmp_path / "pair.urdf")}
    for obstacles in (
        [person],
        [],
        [{**crate, "size": [3.0, 3.0, 0.3]}, person],
        [person, crate, describe_box("new", [0.2, 0.2, 0.5], [2.0, 1.0, 0.3])],
        [{**person, "position": [1.0, 0.2, 0.9]}, {**crate, "position": [2.0, 2.0, 0.2]}],
        [person, crate, {**pair, "position": [2.0, -0.5, 0.4]}],
        [{**crate, "name": "person", "position": [2.0, 1.5, 0.4]}],
    ):
        changed = Scene.from_document({**scene.document, "obstacles": obstacles}, scene.folder)
        expected = validate_pairs(changed, steps, drive, Options())
        assert_same(check.find_violations(changed), expected)
    assert check.find_violations(scene) == ()


def test_obstacles_that_stay_are_not_checked_again(crossing: tuple[Scene, Trajectory]) -> None:
    scene, drive = crossing
    blocked = scene.with_obstacle("crate", make_pose(1.0, 0.0, 0.3))
    check = RemainingCheck(blocked, [vkc.GoTo(2.0, 3.0)], drive)
    assert check.find_violations(blocked) == ()
    assert check.find_violations(blocked.with_obstacle("person", make_pose(0.0, -4.0))) == ()
    back = blocked.with_obstacle("crate", make_pose(1.0, 0.0, 0.3))
    assert check.find_violations(back) == ()


def test_few_distances_are_computed(door_plan: vkc.Plan, door_check: RemainingCheck) -> None:
    plan = door_plan
    for at, most in ((make_pose(0.5, 2.5, 0.3), 0.02), (make_pose(1.2, 1.2, 0.3), 0.2)):
        scene = plan.scene.with_obstacle("sofa", at)
        begin = count_distance_queries()
        door_check.find_violations(scene)
        middle = count_distance_queries()
        validate(scene, plan.steps, plan.trajectory, plan.options)
        assert middle - begin < most * (count_distance_queries() - middle)


def test_other_changes_than_obstacles_are_refused(
    door_plan: vkc.Plan, door_check: RemainingCheck
) -> None:
    scene = door_plan.scene
    for other, field in (
        (scene.with_state("door", {"hinge": 0.1}), "scene.objects.door"),
        (scene.with_placement("door", pin.SE3.Identity()), "scene.objects.door"),
        (scene.with_start(base=[0.0, 0.0, 0.0]), "scene.start"),
        (scene.with_held({"door": "handle"}), "scene.start"),
        (scene.with_robot("husky_ur5e", base="differential"), "scene.robot"),
        (Scene.from_document({**scene.document, "floor": False}, scene.folder), "scene.floor"),
    ):
        moved = other
        if "sofa" in other.obstacle_names:
            moved = other.with_obstacle("sofa", make_pose(0.5, 2.5))
        with expect_error("only obstacles may differ.* plan again", field=field):
            door_check.find_violations(moved)
    same = Scene.from_document(scene.document, scene.folder)
    assert door_check.find_violations(same) == ()


@pytest.mark.parametrize("time", [np.nan, np.inf, "now", None])
def test_invalid_times_are_refused(door_check: RemainingCheck, time: Any) -> None:
    with expect_error(field="time"):
        door_check.find_violations(vkc.load_scene("door"), time)


def test_invalid_arguments_are_refused(
    door_plan: vkc.Plan, door_check: RemainingCheck, crossing: tuple[Scene, Trajectory]
) -> None:
    scene, drive = crossing
    with expect_error(field="scene"):
        door_check.find_violations("door")  # type: ignore[arg-type]
    with expect_error(field="options"):
        RemainingCheck(scene, [], drive, 0.02)  # type: ignore[arg-type]
    with expect_error(field="trajectory.names"):
        RemainingCheck(scene, door_plan.steps, door_plan.trajectory)
    far = dataclasses.replace(drive, positions=1e3 * drive.positions)
    with expect_error("too long to be checked", field="trajectory"):
        RemainingCheck(scene, [vkc.GoTo(0.0, 0.0)], far)


def test_first_collision_comes_before_the_deepest_one(
    crossing: tuple[Scene, Trajectory],
) -> None:
    """A drive through a thick wall: the base meets it with its front, and goes on into it."""
    scene, drive = crossing
    options = Options()
    check = RemainingCheck(scene, [vkc.GoTo(2.0, 3.0)], drive, options)
    wall = describe_box("wall", [3.0, 0.4, 0.5], [2.7, 0.0, 0.5])
    document = {**scene.document, "obstacles": [*scene.document["obstacles"], wall]}
    changed = Scene.from_document(document, scene.folder)
    samples = Samples(scene, drive).times
    distances = np.array([measure_distance(changed, "wall", drive.at(time)) for time in samples])
    is_waypoint = np.isin(samples, drive.times)
    required = np.where(is_waypoint, options.dist_safe - 2e-3, 0.0)
    expected = float(samples[np.flatnonzero(distances < required)[0]])
    found = check.check(changed)
    assert expected - DT <= found.clear_until <= expected
    assert found.clear_until in drive.times
    assert found.violations == check.find_violations(changed)
    assert found.violations[0].time > expected + 0.5
    inside = expected + 0.1
    assert inside - DT <= check.check(changed, inside).clear_until <= inside
    assert check.check(scene) == ((), np.inf)
    beside = scene.with_obstacle("person", make_pose(-4.0, -4.0))
    assert check.check(beside, float(drive.times[-1])) == ((), np.inf)
