"""Tests by brute force that a sweep finds all pairs that come close along a motion."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.carrying import (
    STICK,
    MotionBuilder,
    compute_grasp_pose,
    describe_box,
    describe_table,
    make_room,
    move_base,
    solve_above,
    solve_reach,
)
from helpers.clutter import make_cluttered_room
from helpers.drives import make_hall, make_trajectory, move_start
from helpers.motions import (
    compute_all_distances,
    get_pair_names,
    make_random_door_motion,
    make_random_stick_motion,
)
from helpers.small_problems import load_door_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.validation.collisions import Hit, PairTable, sweep
from vkc_pin.validation.contact_windows import Window
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.samples import Samples
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

COAL = 2e-5  # accuracy of coal's distances [m]


def test_closest_pair_of_every_waypoint_is_found() -> None:
    door = load_door_scene()
    parts = [make_random_door_motion(door, seed, size=0.5).positions for seed in range(8)]
    rows = np.concatenate([*parts, parts[0] + 30.0 * np.eye(parts[0].shape[1])[0]])
    one = make_random_door_motion(door, 0, size=0.5)
    phases = (replace(one.phases[0], last=len(rows) - 1),)
    motion = replace(one, times=np.arange(len(rows)), positions=rows, phases=phases)
    world = World(door)
    table, z = (
        PairTable(door, CollisionShapes(world), motion, 0.02),
        world.compute_positions(motion, motion.times),
    )
    robots = np.array([group == "robot" for group in table.groups])
    with_others = np.flatnonzero(
        robots[table.pairs].sum(axis=1) == 1
    )  # the robot is close to itself everywhere, as is the door
    table.pairs, table.margins = table.pairs[with_others], table.margins[with_others]
    least = np.full(len(z), np.inf)
    for hit in sweep(table, z, np.arange(len(z))):
        if hit.at_waypoint:
            least[hit.row] = min(least[hit.row], hit.distance)
    np.testing.assert_allclose(least, compute_all_distances(table, z).min(axis=1), atol=1e-5)
    assert least.min() < 0.0 < 10.0 < least.max()


def sweep_motion(scene: Scene, motion: Trajectory) -> tuple[PairTable, Samples, list[Hit]]:
    samples = Samples(scene, motion)
    table = PairTable(scene, CollisionShapes(samples.world), motion, 0.02, samples=samples)
    return table, samples, list(sweep(table, samples.z, samples.waypoint_rows))


def check_sweep(scene: Scene, motion: Trajectory) -> None:
    """Compare the hits with the distances of all pairs, at five times as many samples."""
    table, samples, hits = sweep_motion(scene, motion)
    robot = np.array([group == "robot" for group in table.groups])[table.pairs].any(axis=1)
    distances = compute_all_distances(table, samples.z)
    for rows in map(samples.get_rows, motion.phases):  # pairs at rest are not checked
        distances[np.ix_(rows, ~robot & (np.ptp(distances[rows], axis=0) == 0.0))] = np.inf
    found = {(hit.row, hit.first, hit.second) for hit in hits}
    for row, k in np.argwhere(distances < -COAL):
        assert (row, *get_pair_names(table, k)) in found
    for t, k in np.argwhere(distances[samples.waypoint_rows] < 0.02 - COAL):
        assert (samples.waypoint_rows[t], *get_pair_names(table, k)) in found
    assert all(hit.row in samples.waypoint_rows for hit in hits if hit.at_waypoint)
    grid = [np.linspace(a, b, 6) for a, b in itertools.pairwise(samples.times)]
    fine = compute_all_distances(
        table, samples.world.compute_positions(motion, np.unique(np.concatenate(grid)))
    )
    least = min(hit.distance for hit in hits)
    assert min(fine.min() - 2e-3, 0.0) <= least <= distances.min() + COAL
    touched = {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    deep = {
        get_pair_names(table, k)
        for k in np.flatnonzero((fine.min(axis=0) < -1.001e-3) & (distances.min(axis=0) < np.inf))
    }
    near = {get_pair_names(table, k) for k in np.flatnonzero(fine.min(axis=0) < 2e-3)}
    assert deep <= touched <= near


@pytest.mark.parametrize("seed", range(5))
def test_hits_are_those_of_brute_force(seed: int) -> None:
    check_sweep(
        load_door_scene(),
        make_random_door_motion(load_door_scene(), seed, size=(0.1, 0.5)[seed % 2]),
    )


@pytest.mark.parametrize("seed", range(4))
def test_hits_of_grasped_objects_among_obstacles_are_those_of_brute_force(seed: int) -> None:
    scene = make_cluttered_room(seed, (0, 40)[seed % 2])
    check_sweep(*make_random_stick_motion(seed, size=(0.1, 0.5)[seed // 2], scene=scene))


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.6]))
def test_no_penetration_is_missed_between_sparse_samples(seed: int, size: float) -> None:
    door = load_door_scene()
    motion = make_random_door_motion(door, seed, size=size)
    samples = Samples(door, motion)
    table = PairTable(door, CollisionShapes(samples.world), motion, 0.02)
    found = {
        (hit.row, hit.first, hit.second)
        for hit in sweep(table, samples.z[samples.waypoint_rows], np.arange(4))
        if hit.distance < 0
    }
    distances = compute_all_distances(table, samples.z)
    for t, (first, last) in enumerate(itertools.pairwise(samples.waypoint_rows)):
        within = distances[first : last + 1].min(axis=0)
        for k in np.flatnonzero(within < -1.001e-3):
            assert {(t, *get_pair_names(table, k)), (t + 1, *get_pair_names(table, k))} & found


def test_wire_between_two_samples_is_found() -> None:
    wire = {
        "name": "wire",
        "type": "cylinder",
        "radius": 0.001,
        "length": 0.2,
        "position": [2.0, 0.0, 0.1],
    }
    scene = make_hall(obstacles=[wire])
    motion = make_trajectory(
        scene, np.vstack([scene.start, move_start(scene.start, x=4.0)]), dt=20.0
    )
    samples = Samples(scene, motion)
    table = PairTable(scene, CollisionShapes(samples.world), motion, 0.02)
    hits = list(sweep(table, samples.z[[0, -1]], np.array([0, 1])))
    assert ("base_link", "wire") in {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    assert all(hit.distance > 1.0 for hit in hits if hit.at_waypoint and hit.second == "wire")
    through = [hit.shapes for hit in hits if hit.distance < 0]
    assert len(through) == len(set(through)), "one sample per overlapping pair is enough"


@pytest.mark.parametrize("y", [0.31, 0.53, 0.75, 0.97])
def test_fence_crossed_between_two_samples_is_found(y: float) -> None:
    scene = make_room(describe_box("fence", [0.6, 0.001, 0.1], [0.8, y, 0.56]))
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    script = MotionBuilder(scene).go(down).take("stick").go(move_base(down, y=1.0), steps=1)
    motion, world = script.motion(dt=10.0), World(scene)
    table = PairTable(scene, CollisionShapes(world), motion, 0.02)
    hits = list(sweep(table, world.compute_positions(motion), np.arange(len(motion.times))))
    through = {hit.first for hit in hits if hit.second == "fence" and hit.distance < -5e-4}
    assert through >= {"stick.stick", "stick.tip"}


def test_overlaps_at_a_sample_are_not_searched_between_samples() -> None:
    scene = make_hall(obstacles=[describe_box("box", [0.4, 0.4, 0.6], [2.0, 0.0, 0.3])])
    motion = make_trajectory(scene, np.vstack([scene.start, move_start(scene.start, x=2.0)]))
    samples = Samples(scene, motion)
    table = PairTable(scene, CollisionShapes(samples.world), motion, 0.02)
    hits = list(sweep(table, samples.z[[0, -1]], np.array([0, 1])))
    inside = {hit.shapes for hit in hits if hit.distance < 0 and hit.at_waypoint}
    assert inside
    assert not [hit for hit in hits if hit.shapes in inside and not hit.at_waypoint]


@pytest.mark.parametrize(
    ("overlap", "together", "before"),
    [(None, False, 0), (0.0, True, 0), (0.0, True, 1), (0.0, False, 0), (1e-4, False, 0)],
)
def test_windows_permit_contact_but_no_crossing(
    overlap: float | None, together: bool, before: int
) -> None:
    """A stick crosses a fence beside it between two samples, neither of which is in collision."""
    fence = describe_box("fence", [0.6, 0.001, 0.1], [0.8, 0.262, 0.56])
    scene = make_room(fence)
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    motion = (
        MotionBuilder(scene)
        .go(down)
        .take("stick")
        .go(move_base(down, y=1.0), steps=1)
        .motion(dt=10.0)
    )
    world = World(scene)
    labels = world.collision_labels
    post = labels.index("fence")
    pairs = np.array([(i, post) for i in range(post) if labels[i] in ("stick.stick", "stick.tip")])
    near = (
        []
        if overlap is None
        else [Window(pairs, 0, len(motion.times) - 1 - before, 0.0, overlap, together)]
    )
    table = PairTable(scene, CollisionShapes(world), motion, 0.02, windows=near)
    hits = list(sweep(table, world.compute_positions(motion), np.arange(len(motion.times))))
    assert all(hit.distance > 0.0 for hit in hits if hit.at_waypoint and hit.second == "fence")
    through = {hit.first for hit in hits if hit.second == "fence" and hit.distance < -5e-4}
    if together and not before:  # like a hand and the grasped object until its release
        assert not through & {"stick.stick", "stick.tip"}
    else:
        assert through >= {"stick.stick", "stick.tip"}


def test_constant_penetration_is_reported_at_every_sample() -> None:
    scene = make_hall(obstacles=[describe_box("box", [0.4, 0.4, 0.6], [2.0, 0.0, 0.3])])
    inside = move_start(scene.start, x=1.5)
    turned = inside + np.append(np.zeros(len(inside) - 1), 1.0)
    motion = make_trajectory(scene, np.vstack([scene.start, inside, turned, scene.start]), dt=4.0)
    _, samples, hits = sweep_motion(scene, motion)
    first, last = samples.waypoint_rows[1:3]
    assert last - first > 3, "too few samples: turn the arm further"
    rows = {
        hit.row
        for hit in hits
        if (hit.first, hit.second) == ("base_link", "box") and hit.distance < 0
    }
    assert rows >= set(range(first, last + 1))


def test_objects_at_rest_are_not_checked_again() -> None:
    scene = make_room(describe_table(gap=5e-4))
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    script = (
        MotionBuilder(scene)
        .go(down)
        .take("stick")
        .go(move_base(down, y=0.05), steps=1)
        .go(down, steps=1)
        .let_go("stick")
    )
    motion = script.go(move_base(down, x=-1.0), steps=3).motion()
    resting = sweep_motion(scene, motion)[2]
    last = motion.phases[-1]
    pair = {frozenset((hit.first, hit.second)) for hit in resting if hit.distance < 1e-3} & {
        frozenset((one, "table")) for one in ("stick.stick", "stick.tip")
    }
    assert pair, "no contact: choose another placement"
    samples = Samples(scene, motion)
    begin = samples.waypoint_rows[last.first]
    assert not [
        hit for hit in resting if hit.row > begin and frozenset((hit.first, hit.second)) in pair
    ]
