"""Which pairs are looked at, and what is asked of each."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.carrying import Script, moved_base, room, stand, table
from helpers.motions import pair_names, wander, whirl
from helpers.small_problems import door_scene, full_scene

from vkc_pin.motion.trajectory import PhaseSpan, Trajectory
from vkc_pin.motion.world import World
from vkc_pin.scene.hold import Hold
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.scene.scene import Scene
from vkc_pin.validation.distances import Solids
from vkc_pin.validation.pairs import PairTable
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.touching import may_touch


@pytest.fixture(scope="module")
def door() -> Scene:
    return door_scene()


def test_which_pairs_count(door: Scene) -> None:
    motion = wander(door, 0, size=0.1)
    samples = Samples(door, motion)
    touching = may_touch(door, Solids(samples.world), motion, (), 0.02)
    table = PairTable(door, Solids(samples.world), motion, 0.02, touching=touching)
    robot, things = door.robot.collision, door.objects["door"].object.collision.geometryObjects
    walls = [label for label in door.obstacle_labels if label != FLOOR]
    arm = [shape for shape in robot.geometryObjects if shape.parentJoint > 1]
    leaves = [shape for shape in things if shape.parentJoint > 0]
    bodies = len(robot.geometryObjects)
    expected = len(robot.collisionPairs) + bodies * (len(things) + len(walls)) + len(arm) + len(leaves) * len(walls)
    assert len(table.pairs) == expected
    assert len({frozenset(pair) for pair in table.pairs.tolist()}) == expected
    touching = {pair_names(table, k) for k in np.flatnonzero(table.margins == 0.0)}
    assert touching == {(link, "door.lever") for link in door.robot.touch_links}
    assert set(table.margins) == {0.0, 0.02}
    assert (table.contact == 0.0).all()


def test_what_may_touch_needs_no_clearance(door: Scene) -> None:
    """Only the pairs that were said to, and each with its own overlap that counts as contact."""
    motion = wander(door, 0, size=0.1)
    world = Samples(door, motion).world
    plain = PairTable(door, Solids(world), motion, 0.02)
    assert (plain.margins == 0.02).all()
    assert (plain.contact == 0.0).all()
    first, second = (tuple(plain.pairs[k].tolist()) for k in (3, 70))
    table = PairTable(door, Solids(world), motion, 0.02, touching={first: 1e-4, second: 0.0})
    np.testing.assert_array_equal(table.pairs, plain.pairs)
    np.testing.assert_array_equal(np.flatnonzero(table.margins == 0.0), [3, 70])
    np.testing.assert_array_equal(np.flatnonzero(table.contact), [3])
    assert table.contact[3] == 1e-4


def test_a_side_branch_that_nothing_moves_hits_nothing_that_stands() -> None:
    """A second door in a cabinet may well be shut next to a wall."""
    scene = full_scene()
    names = (*scene.robot.coordinates.names, "cabinet.slide", "cabinet.swing")
    positions = np.tile(np.concatenate([scene.start, [0.1, 0.3]]), (2, 1))
    motion = Trajectory(names, np.arange(2.0), positions, (PhaseSpan("all", 0, 1, (Hold("cabinet", "grip"),)),), 9)
    table = PairTable(scene, Solids(Samples(scene, motion).world), motion, 0.02)
    paired = {frozenset(table.world.collision_labels[k] for k in pair) for pair in table.pairs.tolist()}
    for still in ("cabinet.lid", "cabinet.case"):
        assert {"forearm_link", still} in paired
        assert {still, "wall_north"} not in paired
        assert {still, "drawer.tray"} not in paired
    for moving in ("cabinet.arm", "cabinet.tray", "cabinet.flap"):
        assert {moving, "wall_north"} in paired
        assert {moving, "drawer.tray"} in paired
        assert {moving, "cabinet.lid"} not in paired


def test_which_pairs_of_free_objects_count() -> None:
    """What is carried can hit everything but itself, the floor too; what stands by hits only what moves."""
    scene = room(table(), stand(), objects=("stick", "ball"))
    still = Script(scene).go(moved_base(scene.start, y=0.1)).motion()
    carried = Script(scene).take("stick").go(moved_base(scene.start, y=0.1)).motion()

    def paired(motion: Trajectory) -> dict[str, set[str]]:
        found = PairTable(scene, Solids(World(scene)), motion, 0.02)
        names: dict[str, set[str]] = {}
        for first, second in (pair_names(found, k) for k in range(len(found.pairs))):
            for one, other in ((first, second), (second, first)):
                names.setdefault(one, set()).add(other)
        return names

    robots = {scene.robot.link_of(i) for i in range(len(scene.robot.collision.geometryObjects))}
    stands = paired(still)
    for name in ("stick.stick", "stick.tip", "ball.ball"):
        assert stands[name] == robots
    moves = paired(carried)
    for name in ("stick.stick", "stick.tip"):
        assert moves[name] == robots | {"ball.ball", "table", "stand", FLOOR}
    assert moves["ball.ball"] == robots | {"stick.stick", "stick.tip"}


def test_what_moves_together() -> None:
    scene, motion = whirl(0, size=0.1)
    world = World(scene)
    touching = may_touch(scene, Solids(world), motion, (), 0.02)
    table = PairTable(scene, Solids(world), motion, 0.02, touching=touching)
    together = {pair_names(table, k) for k in np.flatnonzero(table.together)}
    hands = {(link, "stick.stick") for link in scene.robot.touch_links}
    assert together == {*hands, ("stick.tip", "ball.ball")}
