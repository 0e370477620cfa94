"""Tests collision pairs and their clearances, and by brute force the sweep along a motion."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.carrying import (
    MotionBuilder,
    describe_box,
    describe_stand,
    describe_table,
    make_room,
    move_base,
    solve_grasp,
)
from helpers.clutter import make_cluttered_room
from helpers.drives import make_hall, make_trajectory, move_start
from helpers.motions import (
    compute_all_distances,
    get_pair_names,
    make_object_motion,
    make_random_door_motion,
    make_random_stick_motion,
)
from helpers.small_problems import load_door_scene, make_full_scene, make_program
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin import GoTo, Hold, Options, PhaseSpan, Scene, Trajectory, load_scene
from vkc_pin.validation.collisions import Hit, PairTable, sweep
from vkc_pin.validation.contact_windows import Window
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.samples import Samples
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.trajectory.world_model import World


@pytest.fixture(scope="module")
def door() -> Scene:
    return load_door_scene()


def make_table(scene: Scene, motion: Trajectory, *windows: Window) -> PairTable:
    return PairTable(scene, CollisionShapes(World(scene)), motion, 0.02, windows=windows)


def find_partners(scene: Scene, motion: Trajectory) -> dict[str, set[str]]:
    """Return the link or obstacle → those it is paired with."""
    table, partners = make_table(scene, motion), dict[str, set[str]]()
    for pair in (get_pair_names(table, k) for k in range(len(table.pairs))):
        for one, other in (pair, pair[::-1]):
            partners.setdefault(one, set()).add(other)
    return partners


def test_robot_objects_and_walls_are_paired(door: Scene) -> None:
    motion = make_random_door_motion(door, 0, size=0.1)
    table = make_table(door, motion)
    robot, shapes = door.robot.collision, door.objects["door"].object.collision.geometryObjects
    walls = [label for label in door.obstacle_labels if label != FLOOR]
    arm = [shape for shape in robot.geometryObjects if shape.parentJoint > 1]
    leaves = [shape for shape in shapes if shape.parentJoint > 0]
    bodies = len(robot.geometryObjects)
    expected = (
        len(robot.collisionPairs)
        + bodies * (len(shapes) + len(walls))
        + len(arm)
        + len(leaves) * len(walls)
    )
    assert len(table.pairs) == expected
    assert len({frozenset(pair) for pair in table.pairs.tolist()}) == expected


def test_windows_change_margin_and_contact_of_their_pairs(door: Scene) -> None:
    motion = make_random_door_motion(door, 0, size=0.1)
    plain = make_table(door, motion)
    every, count = np.arange(len(plain.pairs)), len(plain.groups)
    first, second = plain.pairs[[3]], plain.pairs[[3, 70]]
    known = set(map(frozenset, plain.pairs.tolist()))
    unlisted = [one for one in itertools.combinations(range(count), 2) if set(one) not in known]
    table = make_table(
        door,
        motion,
        Window(first, 0, 1, 0.005, 1e-4, moves_together=True),
        Window(second, 1, 3, 0.01, 0.0),
        Window(np.array(unlisted), 0, 3, -1.0, 1.0, moves_together=True),
    )
    np.testing.assert_array_equal(table.pairs, plain.pairs)
    for waypoint, margins in enumerate(
        [{3: 0.005}, {3: 0.005, 70: 0.01}, {3: 0.01, 70: 0.01}, {3: 0.01, 70: 0.01}]
    ):
        at = np.full(len(every), waypoint)
        found = table.get_margins(every, at)
        assert {int(k): float(found[k]) for k in np.flatnonzero(found != 0.02)} == margins
        assert (plain.get_margins(every, at) == 0.02).all()
        contact = table.get_contact_overlaps(every, at, at)
        assert {int(k): float(contact[k]) for k in np.flatnonzero(contact)} == (
            {3: 1e-4} if waypoint < 2 else {}
        )
        together = table.find_moving_together(every, at, at + 1)  # until the next waypoint
        np.testing.assert_array_equal(np.flatnonzero(together), [3] if waypoint == 0 else [])


def test_static_links_are_not_paired_with_obstacles() -> None:
    scene = make_full_scene()
    phase = PhaseSpan("all", 0, 1, (Hold("cabinet", "grip"),))
    motion = make_object_motion(scene, "cabinet", phase, slide=[0.1, 0.11], swing=[0.3, 0.31])
    partners = find_partners(scene, motion)
    for still in ("cabinet.lid", "cabinet.case"):
        assert "forearm_link" in partners[still]
        assert partners[still].isdisjoint({"wall_north", "drawer.tray"})
    for moving in ("cabinet.arm", "cabinet.tray", "cabinet.flap"):
        assert partners[moving] >= {"wall_north", "drawer.tray"}
        assert "cabinet.lid" not in partners[moving]


def test_free_objects_are_paired_with_obstacles_while_carried() -> None:
    scene = make_room(describe_table(), describe_stand(), objects=("stick", "ball"))
    still = MotionBuilder(scene).go(move_base(scene.start, y=0.1)).motion()
    carried = MotionBuilder(scene).take("stick").go(move_base(scene.start, y=0.1)).motion()
    robots = {scene.robot.link_of(i) for i in range(len(scene.robot.collision.geometryObjects))}
    partners = find_partners(scene, still)
    for name in ("stick.stick", "stick.tip", "ball.ball"):
        assert partners[name] == robots
    partners = find_partners(scene, carried)
    for name in ("stick.stick", "stick.tip"):
        assert partners[name] == robots | {"ball.ball", "table", "stand", FLOOR}
    assert partners["ball.ball"] == robots | {"stick.stick", "stick.tip"}


def test_links_of_an_object_are_paired() -> None:
    scene = load_scene("household")
    phase = PhaseSpan("all", 0, 1, (Hold("dishwasher", "handle"),))
    motion = make_object_motion(scene, "dishwasher", phase, rack=[0.0, 0.2])
    partners = find_partners(scene, motion)
    own = {name for name in partners if name.startswith("dishwasher.")}
    assert {name: own & partners[name] for name in own if own & partners[name]} == {
        "dishwasher.door": {"dishwasher.rack"},
        "dishwasher.rack": {"dishwasher.door"},
    }


def test_links_of_the_robot_have_their_own_clearance(door: Scene) -> None:
    first, second = next(iter(door.robot.own_margins(0.02)))
    tight = frozenset({door.robot.link_of(first), door.robot.link_of(second)})
    robot = replace(door.robot, tight={tuple(sorted(tight)): 0.006})
    scene, robots = replace(door, robot=robot), len(robot.collision.geometryObjects)
    motion = make_random_door_motion(scene, 0, size=0.1)
    table = PairTable(scene, CollisionShapes(World(scene)), motion, 0.02, 0.01)
    margins = table.get_margins(np.arange(len(table.pairs)), np.zeros(len(table.pairs), int))
    problem = make_program(scene, [GoTo(1.0, 0.0)], options=Options(self_distance=0.01))
    part, planned = problem.contacts.phases[0], dict[frozenset[int], float]()
    for pair, margin in zip(part.pairs.tolist(), part.margins.tolist(), strict=True):
        planned[frozenset(pair)] = margin
    for pair, margin in zip(table.pairs.tolist(), margins.tolist(), strict=True):
        if max(pair) < robots:
            is_tight = {robot.link_of(k) for k in pair} == tight
            assert margin == planned[frozenset(pair)] == (0.003 if is_tight else 0.01)
        else:
            assert margin == 0.02


COAL = 2e-5  # accuracy of coal's distances [m]


def test_closest_pair_of_every_waypoint_is_found() -> None:
    door = load_door_scene()
    parts = [make_random_door_motion(door, seed, size=0.5).positions for seed in range(8)]
    rows = np.concatenate([*parts, parts[0] + 30.0 * np.eye(parts[0].shape[1])[0]])
    one = make_random_door_motion(door, 0, size=0.5)
    phases = (replace(one.phases[0], last=len(rows) - 1),)
    motion = replace(one, times=np.arange(len(rows)), positions=rows, phases=phases)
    table = make_table(door, motion)
    z = table.world.compute_positions(motion, motion.times)
    robots = np.array([group == "robot" for group in table.groups])
    # The robot is close to itself everywhere, as is the door.
    with_others = np.flatnonzero(robots[table.pairs].sum(axis=1) == 1)
    table.pairs, table.margins = table.pairs[with_others], table.margins[with_others]
    least = np.full(len(z), np.inf)
    for hit in list_hits(table, z, np.arange(len(z))):
        if hit.at_waypoint:
            least[hit.row] = min(least[hit.row], hit.distance)
    np.testing.assert_allclose(least, compute_all_distances(table, z).min(axis=1), atol=1e-5)
    assert least.min() < 0.0 < 10.0 < least.max()


def list_hits(table: PairTable, z: np.ndarray, waypoints: np.ndarray) -> list[Hit]:
    """Return all hits of a sweep."""
    listed: list[Hit] = []
    for hits in sweep(table, z, waypoints):
        listed += hits.to_list(np.ones(len(hits.rows), bool))
    return listed


def sweep_motion(scene: Scene, motion: Trajectory) -> tuple[PairTable, Samples, list[Hit]]:
    samples = Samples(scene, motion)
    table = PairTable(scene, CollisionShapes(samples.world), motion, 0.02, samples=samples)
    return table, samples, list_hits(table, samples.z, samples.waypoint_rows)


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
    samples, table = Samples(door, motion), make_table(door, motion)
    found = {
        (hit.row, hit.first, hit.second)
        for hit in list_hits(table, samples.z[samples.waypoint_rows], np.arange(4))
        if hit.distance < 0
    }
    distances = compute_all_distances(table, samples.z)
    for t, (first, last) in enumerate(itertools.pairwise(samples.waypoint_rows)):
        within = distances[first : last + 1].min(axis=0)
        for k in np.flatnonzero(within < -1.001e-3):
            assert {(t, *get_pair_names(table, k)), (t + 1, *get_pair_names(table, k))} & found


BOX = describe_box("box", [0.4, 0.4, 0.6], [2.0, 0.0, 0.3])


@pytest.mark.parametrize(
    ("overlap", "together", "before"),
    [(None, False, 0), (0.0, True, 0), (0.0, True, 1), (0.0, False, 0), (1e-4, False, 0)],
)
def test_windows_permit_contact_but_no_crossing(
    overlap: float | None, together: bool, before: int
) -> None:
    """A stick crosses a fence beside it between two samples, neither of which is in collision."""
    scene = make_room(describe_box("fence", [0.6, 0.001, 0.1], [0.8, 0.262, 0.56]))
    down, stick = solve_grasp(), {"stick.stick", "stick.tip"}
    script = MotionBuilder(scene).go(down).take("stick").go(move_base(down, y=1.0), steps=1)
    motion, world = script.motion(dt=10.0), World(scene)
    labels = world.collision_labels
    pairs = np.array([(i, labels.index("fence")) for i, one in enumerate(labels) if one in stick])
    last, near = len(motion.times) - 1 - before, list[Window]()
    if overlap is not None:
        near = [Window(pairs, 0, last, 0.0, overlap, together)]
    table = make_table(scene, motion, *near)
    hits = list_hits(table, world.compute_positions(motion), np.arange(len(motion.times)))
    assert all(hit.distance > 0.0 for hit in hits if hit.at_waypoint and hit.second == "fence")
    through = {hit.first for hit in hits if hit.second == "fence" and hit.distance < -5e-4}
    permitted = together and not before  # like a hand and the grasped object until its release
    assert through & stick == (set() if permitted else stick)


def test_constant_penetration_is_reported_at_every_sample() -> None:
    scene = make_hall(obstacles=[BOX])
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


def test_objects_at_rest_are_not_checked() -> None:
    """The stick lies on a table, is moved along it, and lies there again."""
    scene, down = make_room(describe_table(gap=5e-4)), solve_grasp()
    script = MotionBuilder(scene).go(down).take("stick")
    script.go(move_base(down, y=0.05), steps=1).go(down, steps=1).let_go("stick")
    motion = script.go(move_base(down, x=-1.0), steps=3).motion()
    _, samples, hits = sweep_motion(scene, motion)
    begin, end = samples.waypoint_rows[[motion.phases[1].first, motion.phases[2].last]]
    for name in ("stick.stick", "stick.tip"):
        rows = {hit.row for hit in hits if (hit.first, hit.second) == (name, "table")}
        assert rows == set() or begin <= min(rows) <= max(rows) <= end
    assert end in {hit.row for hit in hits if (hit.first, hit.second) == ("stick.stick", "table")}


BLADE = """<robot name="blade"><link name="rail"/>
<link name="blade"><collision><geometry><box size="0.003 0.1 0.1"/></geometry></collision></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="blade"/>
  <axis xyz="1 0 0"/><limit lower="0" upper="1" velocity="9" effort="9"/></joint></robot>"""


@pytest.mark.parametrize("part", [0.5, 3.5, 10.5, 21.5, 31.5])
def test_thin_shapes_that_pass_each_other_between_two_samples_are_found(part: float) -> None:
    """A blade moves by 0.2 m through a board; both are 3 mm thick, and overlap along 6 mm."""
    grip = {"name": "grip", "link": "blade", "approach": [1, 0, 0], "closing": [0, 0, 1]}
    blade = {"urdf": BLADE, "attachments": [grip]}
    document = {
        "robot": "husky_ur5e",
        "arena": {"x": [-3.0, 3.0], "y": [-3.0, 3.0]},
        "start": {"base": [-2.0, 0.0, 0.0]},
        "objects": [{"name": "blade", "type": blade, "position": [0.5, 0.0, 1.0]}],
        "obstacles": [describe_box("board", [0.003, 0.5, 0.5], [0.5 + part * 0.2 / 32, 0.0, 1.0])],
    }
    scene = Scene.from_document(document)
    phase = PhaseSpan("all", 0, 1, (Hold("blade", "grip"),))
    motion = make_object_motion(scene, "blade", phase, slide=[0.0, 0.2])
    hits = list_hits(
        make_table(scene, motion), World(scene).compute_positions(motion), np.arange(2)
    )
    found = [hit for hit in hits if (hit.first, hit.second) == ("blade.blade", "board")]
    assert min(hit.distance for hit in found) < 0.0
    assert {hit.row for hit in found if hit.distance < 0.0 and not hit.at_waypoint} == {0}


def test_penetration_of_a_robot_at_rest_is_reported() -> None:
    scene = make_hall(obstacles=[BOX])
    scene = scene.with_start(base=[1.5, 0.0, 0.0])
    _, _, hits = sweep_motion(scene, make_trajectory(scene, np.tile(scene.start, (3, 1))))
    inside = [hit for hit in hits if (hit.first, hit.second) == ("base_link", "box")]
    assert min(hit.distance for hit in inside) < -0.1
