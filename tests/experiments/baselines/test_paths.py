"""Tests base paths: straight where possible, around obstacles, or none."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers.base_scenes import MARGIN, MARGIN_TOLERANCE, compute_distance, interpolate_poses
from helpers.carrying import describe_box, make_room
from helpers.drawers import (
    SHORT,
    add_boxes,
    load_drawer_scene,
    make_drawer_scene,
    replace_scene_fields,
)
from helpers.drives import make_hall
from helpers.small_problems import load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.experiments.baselines.paths import BasePaths, find_goal_poses
from vkc_pin.planning.base_paths.base_path import shortest_path
from vkc_pin.world.models.shapes import list_placed_shapes
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes

START, BESIDE = np.array([-1.5, 1.5, 0.0]), np.array([0.5, 1.0, 0.8])
AISLE = np.array([1.0, -1.4, 0.0])  # behind the post
# [m], where waypoints may cut a corner
CUT_MARGIN = MARGIN - MARGIN_TOLERANCE - 0.01
POST = describe_box("post", [0.2, 0.2, 1.0], [-0.3, -0.1, 0.5])


def make_paths(scene: vkc.Scene, name: str = "drawer", **joints: float) -> BasePaths:
    step = vkc.Actuate(name, joints or {"slide": 0.3})
    return BasePaths(make_program(scene, [step], options=SHORT))


def compute_clearance(scene: vkc.Scene, *poses: np.ndarray, without: str = "drawer") -> float:
    """Return the clearance of the base on straight lines between poses, shape (n, 3) [m]."""
    base = [
        (s.geometry, s.placement)
        for s in scene.robot.collision.geometryObjects
        if s.parentJoint == 1
    ]
    labels = zip(scene.obstacle_labels, scene.obstacles, strict=True)
    fixed = [shape for label, shape in labels if label != FLOOR]
    for name, placed in scene.objects.items():
        fixed += make_world_shapes(placed) if name != without else []
    lines = itertools.pairwise(np.vstack(poses))
    rows = [interpolate_poses(a, b, length=0.05, angle=0.1) for a, b in lines]
    obstacles = list_placed_shapes(fixed)
    return min(compute_distance(base, obstacles, row.tolist()) for row in np.vstack(rows))


def test_free_path_is_straight() -> None:
    path = make_paths(make_drawer_scene(POST)).path(START, BESIDE, 10)
    u = np.arange(1, 11)[:, None] / 10
    expected = START + (3 * u**2 - 2 * u**3) * (BESIDE - START)  # from rest to rest
    np.testing.assert_allclose(path, expected, atol=1e-12)


def test_path_leads_around_an_obstacle() -> None:
    scene = make_drawer_scene(POST)
    assert compute_clearance(scene, START, AISLE) < 0.0
    path = make_paths(scene).path(START, AISLE, 80)
    assert path is not None
    assert path.shape == (80, 3)
    np.testing.assert_array_equal(path[-1, :2], AISLE[:2])
    assert np.cos(path[-1, 2] - AISLE[2]) == pytest.approx(1.0)
    assert compute_clearance(scene, START, path) >= CUT_MARGIN
    steps = np.linalg.norm(np.diff(np.vstack([START, path])[:, :2], axis=0), axis=1)
    assert steps.sum() < 1.3 * np.hypot(*(AISLE - START)[:2])
    assert steps.max() < 0.15
    assert max(steps[0], steps[-1]) < 0.01, "slow at both ends"


@pytest.mark.parametrize(
    "walls",
    [
        {"wall": ([0.1, 4.6, 1.0], [0.0, 0.0, 0.5])},  # from side to side
        {
            "wall": ([2.4, 0.1, 1.0], [-1.4, 0.6, 0.5]),
            "other": ([0.1, 4.0, 1.0], [-0.2, 1.5, 0.5]),
        },
    ],
    ids=["a wall across", "walled in"],
)
def test_walls_leave_no_path(walls: dict[str, tuple[list[float], list[float]]]) -> None:
    scene = add_boxes(make_drawer_scene(), **walls)
    for pose in (START, AISLE):
        assert compute_clearance(scene, pose, pose) > MARGIN
    assert make_paths(scene).path(START, AISLE, 10) is None
    drive = make_drive(scene, *AISLE[:2].tolist())
    assert list(BasePaths(drive, whole=True).make_guesses(drive, AISLE[None])) == []


def test_other_objects_are_obstacles_in_their_state() -> None:
    door = {"name": "door", "type": "door", "position": [0.0, 0.44, 0.0]}
    objects = [*load_drawer_scene().document["objects"], door]
    both = replace_scene_fields(make_drawer_scene(), objects=objects)
    before, after = np.array([-0.9, -0.05, 0.0]), np.array([0.8, -0.05, 0.0])
    for hinge, straight in ((0.0, False), (1.5, True)):
        scene = both.with_state("door", {"hinge": hinge})
        assert (compute_clearance(scene, before, after) > MARGIN) == straight
        path = make_paths(scene).path(before, after, 80)
        assert path is not None
        assert (np.ptp(path[:, 1]) < 1e-9) == straight
        assert compute_clearance(scene, before, path) >= CUT_MARGIN


def test_grasped_door_is_no_obstacle() -> None:
    scene = load_door_scene()
    before, after = np.array([1.8, -0.05, 0.0]), np.array([3.3, -0.05, 0.0])
    assert compute_clearance(scene, before, after, without="") < 0.0
    paths = make_paths(scene, "door", hinge=1.2)
    path = paths.path(before, after, 10)
    assert path is not None
    np.testing.assert_allclose(path[:, 1:], np.tile(before[1:], (10, 1)), atol=1e-12)
    assert not paths.grid.is_pose_free(2.55, -0.5, 0.0)


SHELF = describe_box("shelf", [0.3, 1.0, 0.1], [-0.4, 0.65, 1.0])  # over the base
ARM_UP = np.array([-1.5, -1.57, 0.0, 0.0, 0.0, 0.0])  # the arm stretched out upwards


def make_drive(
    scene: vkc.Scene, x: float, y: float, yaw: float | None = None
) -> vkc.TrajectoryProblem:
    return make_program(scene.with_start(base=START), [vkc.GoTo(x, y, yaw)], options=SHORT)


def test_path_avoids_collisions_of_the_arm() -> None:
    problem = make_drive(make_drawer_scene(SHELF).with_start(arm=ARM_UP), 0.5, 0.6)
    goal = np.array([0.5, 0.6, 0.0])
    base_path = BasePaths(problem).path(START, goal, 80)
    assert base_path is not None
    # The path is straight below the shelf.
    np.testing.assert_allclose(
        np.diff(base_path[:, 0]) * 0.9 / 2.0, -np.diff(base_path[:, 1]), atol=1e-9
    )
    whole_robot = BasePaths(problem, whole=True)
    assert not all(whole_robot.grid.is_pose_free(*pose) for pose in base_path)
    path = whole_robot.path(START, goal, 80)
    assert path is not None
    np.testing.assert_array_equal(path[-1, :2], goal[:2])
    z = np.tile(problem.start, (len(path), 1))
    z[:, :3] = path
    contacts = problem.contacts.evaluate(z, np.ones(len(z), int), reach=MARGIN)
    assert contacts.compute_violation() < MARGIN - CUT_MARGIN


def test_grasped_object_adds_its_shapes_to_the_base() -> None:
    scene = make_room(objects=["stick"])
    held = scene.with_held({"stick": "grip"})
    shapes = [
        len(BasePaths(make_drive(one, 1.0, 1.0), whole=True).grid.base.solids)
        for one in (scene, held)
    ]
    assert shapes[1] == shapes[0] + len(scene.objects["stick"].object.collision.geometryObjects)


def test_nearest_reachable_goal_is_chosen() -> None:
    paths = make_paths(make_drawer_scene(POST))
    path = paths.path(START, np.array([AISLE, BESIDE]), 10)
    assert path is not None
    np.testing.assert_array_equal(path[-1], BESIDE)  # the path to the other goal is not straight
    near, start = np.array([-0.3, -0.7, 0.0]), np.array([-0.3, 0.9, -np.pi / 2])
    for goals in ([AISLE, near], [near, AISLE]):
        path = paths.path(start, np.array(goals), 10)
        assert path is not None
        np.testing.assert_array_equal(path[-1, :2], near[:2])


def test_initial_guess_has_a_constant_arm() -> None:
    problem = make_drive(make_drawer_scene(POST), *AISLE[:2].tolist())
    goals = find_goal_poses(vkc.GoTo(*AISLE[:2].tolist()), 0.0)
    (guess,) = BasePaths(problem, whole=True).make_guesses(problem, goals)
    np.testing.assert_array_equal(guess.z[:, 3:], np.tile(problem.start[3:], (problem.segments, 1)))
    np.testing.assert_allclose(guess.z[-1, :2], AISLE[:2], atol=1e-12)


def test_path_leads_through_a_narrow_gate() -> None:
    """The gate is 0.73 m wide, the base 0.67 m; a coarse grid has no path."""
    walls = [
        describe_box(str(side), [0.2, 6.0, 1.5], [0.0, 0.09 + 3.365 * side, 0.75])
        for side in (1, -1)
    ]
    narrow = make_hall(obstacles=walls).with_start(arm=[1.57, -2.2, 2.5, -1.9, -1.57, 0.0])
    paths = BasePaths(make_drive(narrow, 1.5, 0.5, 0.0), whole=True)
    goal = np.array([1.5, 0.5, 0.0])
    assert shortest_path(paths.grid, START.tolist(), goal[None]) is None
    path = paths.path(START, goal, 80)
    assert path is not None
    np.testing.assert_array_equal(path[-1, :2], goal[:2])
    through = path[np.abs(path[:, 0]) < 0.3]
    assert len(through)
    assert np.abs(through[:, 1] - 0.09).max() < 0.04


@pytest.mark.parametrize("yaw", [-3.0, 0.4, 7.0])
def test_goal_headings_are_sorted_by_distance(yaw: float) -> None:
    poses = find_goal_poses(vkc.GoTo(1.0, 2.0), yaw)
    assert poses.shape == (16, 3)
    np.testing.assert_array_equal(poses[:, :2], np.tile([1.0, 2.0], (16, 1)))
    turns = np.abs(poses[:, 2] - yaw)
    assert turns[0] < 1e-9
    assert np.all(np.diff(turns) > -1e-9)
    assert turns[-1] == pytest.approx(np.pi)
    (pose,) = find_goal_poses(vkc.GoTo(1.0, 2.0, 1.0), yaw)
    assert np.cos(pose[2] - 1.0) == pytest.approx(1.0)
    assert abs(pose[2] - yaw) <= np.pi, "the nearest of equal headings"
