"""Which pairs are looked at, and that none that comes close is left out: against brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import STICK, Script, above, box, moved_base, reaching, room, stand, table, tool_at
from helpers.drives import hall, moved, of_rows
from helpers.motions import brute_force, pair_names, wander, whirl
from helpers.small_problems import door_scene, full_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.motion.trajectory import PhaseSpan, Trajectory
from vkc_pin.motion.world import World
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.scene.scene import Scene
from vkc_pin.validation import pairs as validation_pairs
from vkc_pin.validation.pairs import Hit, PairTable
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.touching import may_touch
from vkc_pin.validation.travel import travelled


@pytest.fixture(scope="module")
def door() -> Scene:
    return door_scene()


def swept(scene: Scene, motion: Trajectory) -> tuple[PairTable, Samples, list[Hit]]:
    samples = Samples(scene, motion)
    table = PairTable(scene, samples.world, motion, 0.02)
    return table, samples, list(table.sweep(samples.z, samples.waypoint_rows))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.5, 1.5]))
def test_no_pair_that_comes_close_is_left_out(seed: int, size: float) -> None:
    door = door_scene()
    motion = wander(door, seed, size=size)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validation_pairs, "RESOLUTION", np.inf)  # at the samples alone
        table, samples, hits = swept(door, motion)
    distances = brute_force(table, samples.z)
    assert min(hit.distance for hit in hits) == pytest.approx(distances.min(), abs=1e-5)  # as exact as coal is
    found = {(hit.row, hit.first, hit.second) for hit in hits}
    for row, k in np.argwhere(distances < -1e-5):
        assert (row, *pair_names(table, k)) in found
    for t, k in np.argwhere(distances[samples.waypoint_rows] < table.margins - 1e-5):
        assert (samples.waypoint_rows[t], *pair_names(table, k)) in found
    for hit in hits:
        assert hit.at_waypoint == (hit.row in samples.waypoint_rows)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 0.6]))
def test_nothing_slips_through_between_two_samples(seed: int, size: float) -> None:
    """Whatever overlaps by more than a millimetre anywhere, ten times as finely seen, is found."""
    door = door_scene()
    motion = wander(door, seed, size=size)
    table, samples, hits = swept(door, motion)
    fine = np.unique(np.concatenate([np.linspace(a, b, 11) for a, b in itertools.pairwise(samples.times)]))
    distances = brute_force(table, samples.world.positions(motion, fine))
    found = {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    deep = {pair_names(table, k) for k in np.flatnonzero((distances.min(axis=0) < -1.001e-3) & (table.margins > 0))}
    assert deep <= found
    assert found <= {pair_names(table, k) for k in np.flatnonzero(distances.min(axis=0) < 2e-3)}


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0]))
def test_no_point_moves_further_than_the_bound(seed: int, size: float) -> None:
    """Turning joints, sliding ones, far out too, and one on the other: the room has a drawer and a cabinet as well."""
    scene, rng = full_scene(), np.random.default_rng(seed)
    motion = wander(door_scene(), seed, size=size)
    world = World(scene)
    table = PairTable(scene, world, motion, 0.02)
    z = world.positions(motion)
    z[:, 11:] += rng.uniform(0.0, 2.0, z.shape[1] - 11)
    z[1:, 11:] += size * rng.uniform(-1.0, 1.0, (len(z) - 1, z.shape[1] - 11))
    bounds = np.diff(travelled(table.solids, z), axis=0)
    data, shapes = world.model.createData(), pin.GeometryData(world.collision)
    corners = [np.array(box_corners(shape)) for shape in world.shapes]
    for t in range(len(z) - 1):
        path = np.zeros(len(corners))
        before: list[np.ndarray] = []
        for share in np.linspace(0.0, 1.0, 60):  # the way of each corner of the bounding boxes, not only its ends
            q = world.coordinates.q((1 - share) * z[t] + share * z[t + 1])
            pin.updateGeometryPlacements(world.model, data, world.collision, shapes, q)
            now = [points @ where.rotation.T + where.translation for points, where in zip(corners, shapes.oMg, strict=True)]
            if before:
                path += [np.linalg.norm(a - b, axis=1).max() for a, b in zip(now, before, strict=True)]
            before = now
        assert (path <= bounds[t] + 1e-9).all()
        assert (bounds[t][path == 0] == 0).all()


def box_corners(shape: pin.GeometryObject) -> list[list[float]]:
    shape.geometry.computeLocalAABB()
    box = shape.geometry.aabb_local
    return [[x, y, z] for x in (box.min_[0], box.max_[0]) for y in (box.min_[1], box.max_[1]) for z in (box.min_[2], box.max_[2])]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.6]))
def test_nothing_slips_through_even_without_samples(seed: int, size: float) -> None:
    """Shown the waypoints alone, it looks between them by itself."""
    door = door_scene()
    motion = wander(door, seed, size=size)
    samples = Samples(door, motion)
    table = PairTable(door, samples.world, motion, 0.02)
    found = {
        (hit.row, hit.first, hit.second)
        for hit in table.sweep(samples.z[samples.waypoint_rows], np.arange(4))
        if hit.distance < 0
    }
    distances = brute_force(table, samples.z)
    for t, (first, last) in enumerate(itertools.pairwise(samples.waypoint_rows)):
        within = distances[first : last + 1].min(axis=0)
        for k in np.flatnonzero((within < -1.001e-3) & (table.margins > 0)):
            assert {(t, *pair_names(table, k)), (t + 1, *pair_names(table, k))} & found


def test_a_wire_that_is_passed_between_two_samples() -> None:
    """Neither sample touches it, and they are far apart."""
    wire = {"name": "wire", "type": "cylinder", "radius": 0.001, "length": 0.2, "position": [2.0, 0.0, 0.1]}
    scene = hall(obstacles=[wire])
    motion = of_rows(scene, np.vstack([scene.start, moved(scene.start, x=4.0)]), dt=20.0)
    samples = Samples(scene, motion)
    table = PairTable(scene, samples.world, motion, 0.02)
    hits = list(table.sweep(samples.z[[0, -1]], np.array([0, 1])))
    assert ("base_link", "wire") in {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    assert all(hit.distance > 1.0 for hit in hits if hit.at_waypoint and hit.second == "wire")


def test_which_pairs_count(door: Scene) -> None:
    motion = wander(door, 0, size=0.1)
    samples = Samples(door, motion)
    touching = may_touch(door, samples.world, motion, (), 0.02)
    table = PairTable(door, samples.world, motion, 0.02, touching=touching)
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
    plain = PairTable(door, world, motion, 0.02)
    assert (plain.margins == 0.02).all()
    assert (plain.contact == 0.0).all()
    first, second = (tuple(plain.pairs[k].tolist()) for k in (3, 70))
    table = PairTable(door, world, motion, 0.02, touching={first: 1e-4, second: 0.0})
    np.testing.assert_array_equal(table.pairs, plain.pairs)
    np.testing.assert_array_equal(np.flatnonzero(table.margins == 0.0), [3, 70])
    np.testing.assert_array_equal(np.flatnonzero(table.contact), [3])
    assert table.contact[3] == 1e-4


def test_a_side_branch_that_nothing_moves_hits_nothing_that_stands() -> None:
    """A second door in a cabinet may well be shut next to a wall."""
    scene = full_scene()
    names = (*scene.robot.coordinates.names, "cabinet.slide", "cabinet.swing")
    positions = np.tile(np.concatenate([scene.start, [0.1, 0.3]]), (2, 1))
    motion = Trajectory(names, np.arange(2.0), positions, (PhaseSpan("all", 0, 1, {"cabinet": "grip"}),), 9)
    table = PairTable(scene, Samples(scene, motion).world, motion, 0.02)
    paired = {frozenset(table.world.collision_labels[k] for k in pair) for pair in table.pairs.tolist()}
    for still in ("cabinet.lid", "cabinet.case"):
        assert {"forearm_link", still} in paired
        assert {still, "wall_north"} not in paired
        assert {still, "drawer.tray"} not in paired
    for moving in ("cabinet.arm", "cabinet.tray", "cabinet.flap"):
        assert {moving, "wall_north"} in paired
        assert {moving, "drawer.tray"} in paired
        assert {moving, "cabinet.lid"} not in paired


# --- what is carried --------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 1.0, 3.0]))
def test_no_point_of_what_is_carried_moves_further_than_the_bound(seed: int, size: float) -> None:
    scene, motion = whirl(seed, size=size)
    samples = Samples(scene, motion)
    table_of_pairs = PairTable(scene, samples.world, motion, 0.02)
    bounds = np.diff(travelled(table_of_pairs.solids, samples.z)[samples.waypoint_rows], axis=0)
    world = samples.world
    data, shapes = world.model.createData(), pin.GeometryData(world.collision)
    corners = [np.array(box_corners(shape)) for shape in world.shapes]
    carried = [i for i, label in enumerate(world.collision_labels) if label.partition(".")[0] in ("stick", "ball")]
    assert len(carried) == 6
    total = 0.0
    for t, (first, last) in enumerate(itertools.pairwise(samples.waypoint_rows)):
        path = np.zeros(len(corners))
        before: list[np.ndarray] = []
        for row in np.linspace(first, last, 4 * (last - first) + 1):  # the way of each corner, between the samples too
            low, share = int(row), row - int(row)
            z = samples.z[low] if not share else (1 - share) * samples.z[low] + share * samples.z[low + 1]
            pin.updateGeometryPlacements(world.model, data, world.collision, shapes, world.coordinates.q(z))
            now = [points @ where.rotation.T + where.translation for points, where in zip(corners, shapes.oMg, strict=True)]
            if before:
                path += [np.linalg.norm(a - b, axis=1).max() for a, b in zip(now, before, strict=True)]
            before = now
        assert (path <= bounds[t] + 1e-6).all()
        assert (bounds[t][path == 0] <= 1e-6).all()
        total += path[carried].max()
        for i in carried:  # and it is no idle bound
            assert bounds[t][i] <= 100 * path[i] + 1e-6
    assert total > 0.0 or np.ptp(motion.positions, axis=0).max() == 0.0


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.5]))
def test_nothing_carried_that_comes_close_is_left_out(seed: int, size: float) -> None:
    """Whatever overlaps by more than a millimetre anywhere, five times as finely seen, is found."""
    scene, motion = whirl(seed, size=size)
    table, samples, hits = swept(scene, motion)
    fine = np.unique(np.concatenate([np.linspace(a, b, 6) for a, b in itertools.pairwise(samples.times)]))
    distances = brute_force(table, samples.world.positions(motion, fine))
    found = {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    deep = {pair_names(table, k) for k in np.flatnonzero((distances.min(axis=0) < -1.001e-3) & ~table.together)}
    assert deep <= found
    assert min(hit.distance for hit in hits) <= distances.min() + 2e-3


@pytest.mark.parametrize("overlap", [None, 0.0, 1e-4])
def test_what_may_touch_is_not_passed_through_between_two_samples(overlap: float | None) -> None:
    """A stick through a fence that it lay beside; neither sample touches it. Only a hand is known to move with what it holds."""
    fence = box("fence", [0.6, 0.001, 0.1], [0.8, 0.262, 0.56])
    scene = room(fence)
    down = reaching(tool_at(STICK), above(STICK))
    motion = Script(scene).go(down).take("stick").go(moved_base(down, y=1.0), steps=1).motion(dt=10.0)
    world = World(scene)
    labels = world.collision_labels
    post = labels.index("fence")
    touching = {(i, post): overlap for i in range(post) if labels[i] in ("stick.stick", "stick.tip") and overlap is not None}
    table = PairTable(scene, world, motion, 0.02, touching=touching)
    hits = list(table.sweep(world.positions(motion)[-2:], np.array([0, 1])))
    assert all(hit.distance > 0.0 for hit in hits if hit.at_waypoint and hit.second == "fence")
    through = {hit.first for hit in hits if hit.second == "fence" and hit.distance < -5e-4}
    if overlap == 0.0:  # as for a hand and what it grasps
        assert not through & {"stick.stick", "stick.tip"}
    else:
        assert through >= {"stick.stick", "stick.tip"}


def test_which_pairs_of_free_objects_count() -> None:
    """What is carried can hit everything but itself, the floor too; what stands by hits only what moves."""
    scene = room(table(), stand(), objects=("stick", "ball"))
    still = Script(scene).go(moved_base(scene.start, y=0.1)).motion()
    carried = Script(scene).take("stick").go(moved_base(scene.start, y=0.1)).motion()

    def paired(motion: Trajectory) -> dict[str, set[str]]:
        found = PairTable(scene, World(scene), motion, 0.02)
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
    touching = may_touch(scene, world, motion, (), 0.02)
    table = PairTable(scene, world, motion, 0.02, touching=touching)
    together = {pair_names(table, k) for k in np.flatnonzero(table.together)}
    hands = {(link, "stick.stick") for link in scene.robot.touch_links}
    assert together == {*hands, ("stick.tip", "ball.ball")}


def test_what_lies_still_is_looked_at_only_at_waypoints(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stick that is put down on its table goes on touching it while the robot drives away."""
    scene = room(table(gap=5e-4))
    down = reaching(tool_at(STICK), above(STICK))
    script = Script(scene).go(down).take("stick").go(moved_base(down, y=0.05), steps=1).go(down, steps=1).let_go("stick")
    motion = script.go(moved_base(down, x=-1.0), steps=3).motion()
    resting = swept(scene, motion)[2]
    last = motion.phases[-1]
    pair = {frozenset((hit.first, hit.second)) for hit in resting if hit.distance < 1e-3} & {
        frozenset((one, "table")) for one in ("stick.stick", "stick.tip")
    }
    assert pair, "it touches nothing: choose another way of putting it down"
    samples = Samples(scene, motion)
    begin = samples.waypoint_rows[last.first]
    assert not [hit for hit in resting if hit.row > begin and not hit.at_waypoint and frozenset((hit.first, hit.second)) in pair]
    monkeypatch.setattr(validation_pairs, "STILL", -1.0)  # all the same, if everything is looked at
    everything = swept(scene, motion)[2]
    assert [hit for hit in everything if hit.row > begin and not hit.at_waypoint and frozenset((hit.first, hit.second)) in pair]
    assert min(hit.distance for hit in everything) == min(hit.distance for hit in resting)
