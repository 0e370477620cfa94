"""Tests the collision pairs of the table, and their clearances."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.carrying import MotionBuilder, describe_stand, describe_table, make_room, move_base
from helpers.motions import get_pair_names, make_random_door_motion
from helpers.small_problems import load_door_scene, make_full_scene, make_program

from vkc_pin.options import Options
from vkc_pin.validation.collisions import PairTable
from vkc_pin.validation.contact_windows import Window
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.samples import Samples
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import GoTo
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World


@pytest.fixture(scope="module")
def door() -> Scene:
    return load_door_scene()


def test_robot_objects_and_walls_are_paired(door: Scene) -> None:
    motion = make_random_door_motion(door, 0, size=0.1)
    table = PairTable(door, CollisionShapes(World(door)), motion, 0.02)
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
    plain = PairTable(door, CollisionShapes(World(door)), motion, 0.02)
    every = np.arange(len(plain.pairs))
    first, second = plain.pairs[[3]], plain.pairs[[3, 70]]
    near = [Window(first, 0, 1, 0.005, 1e-4, moves_together=True), Window(second, 1, 3, 0.01, 0.0)]
    table = PairTable(door, CollisionShapes(World(door)), motion, 0.02, windows=near)
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
    for begin, together in (
        (0, [3]),
        (1, []),
        (2, []),
    ):  # throughout the interval between two waypoints
        at = np.full(len(every), begin)
        np.testing.assert_array_equal(
            np.flatnonzero(table.find_moving_together(every, at, at + 1)), together
        )


def test_windows_of_unlisted_pairs_have_no_effect(door: Scene) -> None:
    motion = make_random_door_motion(door, 0, size=0.1)
    plain = PairTable(door, CollisionShapes(World(door)), motion, 0.02)
    known, count = {(min(pair), max(pair)) for pair in plain.pairs.tolist()}, len(plain.groups)
    absent = np.array(
        [(i, j) for i in range(count) for j in range(i + 1, count) if (i, j) not in known]
    )
    assert len(absent) > 10
    table = PairTable(
        door,
        CollisionShapes(World(door)),
        motion,
        0.02,
        windows=[Window(absent, 0, 3, -1.0, 1.0, moves_together=True)],
    )
    every = np.arange(len(plain.pairs))
    assert (table.get_margins(every, np.zeros_like(every)) == 0.02).all()
    assert not table.get_contact_overlaps(every, np.zeros_like(every), np.ones_like(every)).any()


def test_static_links_are_not_paired_with_obstacles() -> None:
    scene = make_full_scene()
    names = (*scene.robot.coordinates.names, "cabinet.slide", "cabinet.swing")
    positions = np.vstack(
        [np.concatenate([scene.start, values]) for values in ([0.1, 0.3], [0.11, 0.31])]
    )
    motion = Trajectory(
        names, np.arange(2.0), positions, (PhaseSpan("all", 0, 1, (Hold("cabinet", "grip"),)),), 9
    )
    table = PairTable(scene, CollisionShapes(Samples(scene, motion).world), motion, 0.02)
    paired = {
        frozenset(table.world.collision_labels[k] for k in pair) for pair in table.pairs.tolist()
    }
    for still in ("cabinet.lid", "cabinet.case"):
        assert {"forearm_link", still} in paired
        assert {still, "wall_north"} not in paired
        assert {still, "drawer.tray"} not in paired
    for moving in ("cabinet.arm", "cabinet.tray", "cabinet.flap"):
        assert {moving, "wall_north"} in paired
        assert {moving, "drawer.tray"} in paired
        assert {moving, "cabinet.lid"} not in paired


def test_free_objects_are_paired_with_obstacles_while_carried() -> None:
    scene = make_room(describe_table(), describe_stand(), objects=("stick", "ball"))
    still = MotionBuilder(scene).go(move_base(scene.start, y=0.1)).motion()
    carried = MotionBuilder(scene).take("stick").go(move_base(scene.start, y=0.1)).motion()

    def find_partners(motion: Trajectory) -> dict[str, set[str]]:
        found = PairTable(scene, CollisionShapes(World(scene)), motion, 0.02)
        names: dict[str, set[str]] = {}
        for first, second in (get_pair_names(found, k) for k in range(len(found.pairs))):
            for one, other in ((first, second), (second, first)):
                names.setdefault(one, set()).add(other)
        return names

    robots = {scene.robot.link_of(i) for i in range(len(scene.robot.collision.geometryObjects))}
    partners = find_partners(still)
    for name in ("stick.stick", "stick.tip", "ball.ball"):
        assert partners[name] == robots
    partners = find_partners(carried)
    for name in ("stick.stick", "stick.tip"):
        assert partners[name] == robots | {"ball.ball", "table", "stand", FLOOR}
    assert partners["ball.ball"] == robots | {"stick.stick", "stick.tip"}


def test_close_pairs_are_those_that_move_in_the_phase() -> None:
    """The stick lies on a table, is carried, and lies there again."""
    scene = make_room(describe_table())
    script = (
        MotionBuilder(scene)
        .go(move_base(scene.start, y=0.1))
        .take("stick")
        .go(move_base(scene.start, y=0.3))
        .let_go()
    )
    motion = script.go(move_base(scene.start, y=0.5)).motion()
    samples = Samples(scene, motion)
    solids = CollisionShapes(samples.world)
    found = PairTable(scene, solids, motion, 0.02)
    supports = [
        k
        for k in range(len(found.pairs))
        if {name.partition(".")[0] for name in get_pair_names(found, k)} == {"stick", "table"}
    ]
    assert supports
    still = np.zeros((1, len(found.groups)))
    placed = solids.place(samples.world.coordinates.q(samples.z[samples.waypoint_rows]))
    for waypoint in range(61):
        here = np.array([waypoint])
        _, pairs = found.find_close_pairs(placed, here, here, still, np.inf)
        assert (
            set(supports) <= set(pairs.tolist())
            if 20 < waypoint <= 40
            else set(supports).isdisjoint(pairs.tolist())
        )
        if waypoint < 60:  # and between this waypoint and the next
            _, pairs = found.find_close_pairs(placed, here, here + 1, still, np.inf)
            assert (
                set(supports) <= set(pairs.tolist())
                if 20 <= waypoint < 40
                else set(supports).isdisjoint(pairs.tolist())
            )


def test_links_of_an_object_are_paired() -> None:
    scene = load_scene("household")
    names = (*scene.robot.coordinates.names, "dishwasher.rack")
    rows = np.vstack([np.append(scene.start, value) for value in (0.0, 0.2)])
    motion = Trajectory(
        names, np.arange(2.0), rows, (PhaseSpan("pull", 0, 1, (Hold("dishwasher", "handle"),)),), 9
    )
    table = PairTable(scene, CollisionShapes(World(scene)), motion, 0.02)
    own = {
        pair
        for pair in (get_pair_names(table, k) for k in range(len(table.pairs)))
        if all("dishwasher." in name for name in pair)
    }
    assert own == {("dishwasher.door", "dishwasher.rack")}


def test_self_clearances_agree_with_the_program(door: Scene) -> None:
    first, second = next(iter(door.robot.own_margins(0.02)))
    one, other = sorted((door.robot.link_of(first), door.robot.link_of(second)))
    scene = dataclasses.replace(
        door, robot=dataclasses.replace(door.robot, tight={(one, other): 0.006})
    )
    motion = make_random_door_motion(scene, 0, size=0.1)
    table = PairTable(scene, CollisionShapes(World(scene)), motion, 0.02, 0.01)
    margins = table.get_margins(np.arange(len(table.pairs)), np.zeros(len(table.pairs), int))
    by_pair = {
        frozenset(pair): float(margin)
        for pair, margin in zip(table.pairs.tolist(), margins, strict=True)
    }
    problem = make_program(scene, [GoTo(1.0, 0.0)], options=Options(self_distance=0.01))
    robots = len(scene.robot.collision.geometryObjects)
    part, own = problem.contacts.phases[0], 0
    for pair, margin in zip(part.pairs.tolist(), part.margins.tolist(), strict=True):
        if max(pair) < robots:
            assert by_pair[frozenset(pair)] == margin
            tight = {scene.robot.link_of(i) for i in pair} == {one, other}
            assert margin == (0.003 if tight else 0.01)
            own += 1
    assert own == len(scene.robot.collision.collisionPairs)
    assert {margin for pair, margin in by_pair.items() if max(pair) >= robots} == {0.02}
