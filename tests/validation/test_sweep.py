"""No pair that comes close is left out: against brute force."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.carrying import STICK, Script, above, box, moved_base, reaching, room, table, tool_at
from helpers.drives import hall, moved, of_rows
from helpers.motions import brute_force, pair_names, wander, whirl
from helpers.small_problems import door_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.validation import sweep as validation_sweep
from vkc_pin.validation.contact_windows import Window
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.pairs import PairTable
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.sweep import Hit, sweep
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World


def swept(scene: Scene, motion: Trajectory) -> tuple[PairTable, Samples, list[Hit]]:
    samples = Samples(scene, motion)
    table = PairTable(scene, CollisionShapes(samples.world), motion, 0.02)
    return table, samples, list(sweep(table, samples.z, samples.waypoint_rows))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.5, 1.5]))
def test_no_pair_that_comes_close_is_left_out(seed: int, size: float) -> None:
    door = door_scene()
    motion = wander(door, seed, size=size)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validation_sweep, "RESOLUTION", np.inf)  # at the samples alone
        table, samples, hits = swept(door, motion)
    distances = brute_force(table, samples.z)
    assert min(hit.distance for hit in hits) == pytest.approx(
        distances.min(), abs=1e-5
    )  # as exact as coal is
    found = {(hit.row, hit.first, hit.second) for hit in hits}
    for row, k in np.argwhere(distances < -1e-5):
        assert (row, *pair_names(table, k)) in found
    for t, k in np.argwhere(distances[samples.waypoint_rows] < 0.02 - 1e-5):
        assert (samples.waypoint_rows[t], *pair_names(table, k)) in found
    for hit in hits:
        assert hit.at_waypoint == (hit.row in samples.waypoint_rows)


def test_the_closest_pair_of_every_waypoint_is_told() -> None:
    """Also where all is far away, and however many waypoints there are."""
    door = door_scene()
    parts = [wander(door, seed, size=0.5).positions for seed in range(25)]
    rows = np.concatenate([*parts, parts[0] + 30.0 * np.eye(parts[0].shape[1])[0]])
    one = wander(door, 0, size=0.5)
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
    np.testing.assert_allclose(least, brute_force(table, z).min(axis=1), atol=1e-5)
    assert least.min() < 0.0 < 10.0 < least.max()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 0.6]))
def test_nothing_slips_through_between_two_samples(seed: int, size: float) -> None:
    """Whatever overlaps by more than a millimetre anywhere, ten times as finely seen, is found."""
    door = door_scene()
    motion = wander(door, seed, size=size)
    table, samples, hits = swept(door, motion)
    fine = np.unique(
        np.concatenate([np.linspace(a, b, 11) for a, b in itertools.pairwise(samples.times)])
    )
    distances = brute_force(table, samples.world.compute_positions(motion, fine))
    found = {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    deep = {pair_names(table, k) for k in np.flatnonzero(distances.min(axis=0) < -1.001e-3)}
    assert deep <= found
    assert found <= {pair_names(table, k) for k in np.flatnonzero(distances.min(axis=0) < 2e-3)}


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.6]))
def test_nothing_slips_through_even_without_samples(seed: int, size: float) -> None:
    """Shown the waypoints alone, it looks between them by itself."""
    door = door_scene()
    motion = wander(door, seed, size=size)
    samples = Samples(door, motion)
    table = PairTable(door, CollisionShapes(samples.world), motion, 0.02)
    found = {
        (hit.row, hit.first, hit.second)
        for hit in sweep(table, samples.z[samples.waypoint_rows], np.arange(4))
        if hit.distance < 0
    }
    distances = brute_force(table, samples.z)
    for t, (first, last) in enumerate(itertools.pairwise(samples.waypoint_rows)):
        within = distances[first : last + 1].min(axis=0)
        for k in np.flatnonzero(within < -1.001e-3):
            assert {(t, *pair_names(table, k)), (t + 1, *pair_names(table, k))} & found


def test_a_wire_that_is_passed_between_two_samples() -> None:
    """Neither sample touches it, and they are far apart."""
    wire = {
        "name": "wire",
        "type": "cylinder",
        "radius": 0.001,
        "length": 0.2,
        "position": [2.0, 0.0, 0.1],
    }
    scene = hall(obstacles=[wire])
    motion = of_rows(scene, np.vstack([scene.start, moved(scene.start, x=4.0)]), dt=20.0)
    samples = Samples(scene, motion)
    table = PairTable(scene, CollisionShapes(samples.world), motion, 0.02)
    hits = list(sweep(table, samples.z[[0, -1]], np.array([0, 1])))
    assert ("base_link", "wire") in {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    assert all(hit.distance > 1.0 for hit in hits if hit.at_waypoint and hit.second == "wire")


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.5]))
def test_nothing_carried_that_comes_close_is_left_out(seed: int, size: float) -> None:
    """Whatever overlaps by more than a millimetre anywhere, five times as finely seen, is found."""
    scene, motion = whirl(seed, size=size)
    table, samples, hits = swept(scene, motion)
    fine = np.unique(
        np.concatenate([np.linspace(a, b, 6) for a, b in itertools.pairwise(samples.times)])
    )
    distances = brute_force(table, samples.world.compute_positions(motion, fine))
    found = {(hit.first, hit.second) for hit in hits if hit.distance < 0}
    deep = {pair_names(table, k) for k in np.flatnonzero(distances.min(axis=0) < -1.001e-3)}
    assert deep <= found
    assert min(hit.distance for hit in hits) <= distances.min() + 2e-3


@pytest.mark.parametrize(
    ("overlap", "together", "before"),
    [(None, False, 0), (0.0, True, 0), (0.0, True, 1), (0.0, False, 0), (1e-4, False, 0)],
)
def test_what_may_touch_is_not_passed_through_between_two_samples(
    overlap: float | None, together: bool, before: int
) -> None:
    """A stick through a fence that it lay beside; neither sample touches it. Only a hand is known to move with what it holds."""
    fence = box("fence", [0.6, 0.001, 0.1], [0.8, 0.262, 0.56])
    scene = room(fence)
    down = reaching(tool_at(STICK), above(STICK))
    motion = (
        Script(scene).go(down).take("stick").go(moved_base(down, y=1.0), steps=1).motion(dt=10.0)
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
    if together and not before:  # as for a hand and what it grasps, until it lets go
        assert not through & {"stick.stick", "stick.tip"}
    else:
        assert through >= {"stick.stick", "stick.tip"}


def test_what_stands_in_something_is_told_of_at_every_sample() -> None:
    """The base drives into a box and rests there; the arm turns meanwhile, so that there are samples."""
    scene = hall(obstacles=[box("box", [0.4, 0.4, 0.6], [2.0, 0.0, 0.3])])
    inside = moved(scene.start, x=1.5)
    turned = inside + np.append(np.zeros(len(inside) - 1), 1.0)
    motion = of_rows(scene, np.vstack([scene.start, inside, turned, scene.start]), dt=4.0)
    _, samples, hits = swept(scene, motion)
    first, last = samples.waypoint_rows[1:3]
    assert last - first > 3, "there is nothing to look at: turn the arm further"
    rows = {
        hit.row
        for hit in hits
        if (hit.first, hit.second) == ("base_link", "box") and hit.distance < 0
    }
    assert rows >= set(range(first, last + 1))


def test_what_lies_still_is_not_looked_at_again() -> None:
    """A stick that is put down on its table goes on touching it while the robot drives away."""
    scene = room(table(gap=5e-4))
    down = reaching(tool_at(STICK), above(STICK))
    script = (
        Script(scene)
        .go(down)
        .take("stick")
        .go(moved_base(down, y=0.05), steps=1)
        .go(down, steps=1)
        .let_go("stick")
    )
    motion = script.go(moved_base(down, x=-1.0), steps=3).motion()
    resting = swept(scene, motion)[2]
    last = motion.phases[-1]
    pair = {frozenset((hit.first, hit.second)) for hit in resting if hit.distance < 1e-3} & {
        frozenset((one, "table")) for one in ("stick.stick", "stick.tip")
    }
    assert pair, "it touches nothing: choose another way of putting it down"
    samples = Samples(scene, motion)
    begin = samples.waypoint_rows[last.first]
    assert not [
        hit for hit in resting if hit.row > begin and frozenset((hit.first, hit.second)) in pair
    ]
