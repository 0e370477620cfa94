"""Tests the separation of motions from obstacles that the initial guess passes through."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.drives import make_hall
from helpers.straight_drives import make_straight_drive

import vkc_pin as vkc
from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.segment_planes import find_segment_contacts, merge_contacts
from vkc_pin.planning.solver.separation import Separation

GOAL = 6.0


@cache
def make_problem(*crates: tuple[float, ...]) -> tuple[TrajectoryProblem, np.ndarray]:
    """Return a drive to x = 6 m and the straight path; crates have x, y and sizes along them [m].

    A crate with one size is square.
    """
    obstacles = [
        describe_box(f"crate_{k}", [size[0], size[-1], 0.5], [x, y, 0.25])
        for k, (x, y, *size) in enumerate(crates)
    ]
    scene = make_hall(obstacles=obstacles)
    return make_straight_drive(scene, vkc.Options(reach_waypoints=30), x=GOAL)


def separate(
    problem: TrajectoryProblem, z: np.ndarray
) -> tuple[Separation, Contacts, Contacts, Contacts]:
    """Return the separation of z, its contacts, and coal's at and between waypoints."""
    at = problem.evaluate_contacts(z, reach=0.2)
    between = find_segment_contacts(problem, z)
    separation = Separation(problem)
    separation.update(z, at, between.crossings)
    contacts = separation.replace_contacts(z, at, between.contacts)
    return separation, contacts, at, between.contacts


@pytest.mark.parametrize(
    ("crates", "sides"),
    [
        ([(3.0, 0.1, 0.6)], [-1]),
        ([(3.0, -0.1, 0.6)], [1]),
        ([(2.0, 0.1, 0.4), (4.2, -0.1, 0.4)], [-1, 1]),
        # A wall to the right leaves only the left side, although it is farther.
        ([(3.0, 0.1, 0.6), (3.0, -1.2, 1.4)], [1, 1]),
    ],
)
def test_straight_paths_pass_each_crate_on_one_side(
    crates: list[tuple[float, float, float]], sides: list[int]
) -> None:
    problem, guess = make_problem(*crates)
    solution = solve(problem, guess)
    assert solution.converged
    path = problem.waypoints(solution.z)
    assert find_segment_contacts(problem, solution.z).is_free
    assert problem.evaluate_contacts(solution.z, reach=0.0).compute_violation() < 1e-3
    for (x, y, _), side in zip(crates, sides, strict=True):
        beside = np.interp(x, path[:, 0], path[:, 1])
        assert np.sign(beside - y) == side


def test_stretch_has_one_direction_whose_distance_is_a_lower_bound() -> None:
    problem, z = make_problem((3.0, 0.1, 0.6))
    separation, contacts, at, _ = separate(problem, z)
    assert separation.is_active
    labels = problem.contacts.phases[0].labels
    is_base = np.array([labels[first] == "base_link" for first, _ in at.pair.tolist()])
    inside = at.select(np.flatnonzero(is_base & (at.distance < -0.01)))
    keys, wanted = (
        list(map(tuple, np.column_stack([each.waypoint, each.pair]).tolist()))
        for each in (contacts, inside)
    )
    own = contacts.select(np.array([keys.index(key) for key in wanted]))
    np.testing.assert_allclose(own.normal, np.tile(own.normal[0], (len(own.normal), 1)), atol=1e-9)
    assert abs(own.normal[0, 1]) > 0.99  # across the motion
    assert (own.distance <= inside.distance + 1e-6).all()
    assert (inside.normal @ own.normal[0] < 0.5).any()  # coal's normals differ
    # Moved apart by the distance, base and crate just touch.
    deepest = int(np.argmin(own.distance))
    moved = z[own.waypoint[[deepest]]].copy()
    moved[:, :2] += own.distance[deepest] * own.normal[deepest, :2]
    left = problem.contacts.evaluate(moved, own.waypoint[[deepest]] + 1, reach=0.1)
    is_same = (left.pair == own.pair[deepest]).all(axis=1)
    np.testing.assert_allclose(left.distance[is_same], 0.0, atol=1e-6)


def test_gradients_of_a_direction_equal_finite_differences() -> None:
    problem, z = make_problem((3.0, 0.1, 0.6))
    rng, step = np.random.default_rng(0), 1e-6
    z = z + rng.uniform(0.01, 0.05, z.shape)  # no face is parallel to another
    separation, contacts, at, between = separate(problem, z)
    change = rng.normal(size=z.shape)
    gradient = problem.contacts.compute_gradients(z, contacts)
    directed = np.flatnonzero(contacts.distance < -0.05)
    expected = np.einsum("ci,ci->c", gradient, change[contacts.waypoint])[directed]
    ahead, behind = (
        separation.replace_contacts(z + sign * step * change, at, between).select(directed)
        for sign in (1, -1)
    )
    np.testing.assert_array_equal(ahead.pair, contacts.pair[directed])
    slope = (ahead.distance - behind.distance) / (2 * step)
    np.testing.assert_allclose(slope, expected, atol=1e-5)


def test_allowed_overlaps_may_be_passed_through() -> None:
    scene = make_problem((3.0, 0.0, 0.2))[0].scene
    allow = [{"pair": [link, "crate_0"], "margin": -2.0} for link in scene.robot.links]
    scene = vkc.Scene.from_document({**scene.document, "allow": allow})
    plan = vkc.plan(scene, [vkc.GoTo(GOAL, 0.0, 0.0)], initialization="interpolated")
    assert plan.success
    assert np.abs(plan.trajectory.positions[:, 1]).max() < 0.05


@pytest.mark.parametrize("crates", [(), ((3.0, 1.0, 0.6),), ((3.0, 0.645, 0.6),)])
def test_free_and_grazing_motions_keep_coals_contacts(
    crates: tuple[tuple[float, float, float], ...],
) -> None:
    problem, z = make_problem(*crates)
    separation, contacts, at, between = separate(problem, z)
    assert not separation.is_active
    for found, expected in zip(
        contacts.arrays(), merge_contacts(at, between).arrays(), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("depth", "is_active"), [(0.008, False), (0.012, True)])
def test_shallow_overlaps_keep_coals_contacts(depth: float, is_active: bool) -> None:
    """The base touches a crate with its front, its side and its rear, at three waypoints."""
    problem, path = make_problem((3.0, 0.1, 0.6))
    z = np.tile(path[0], (len(path), 1))
    z[:3, :2] = [2.205 + depth, 0.1], [3.0, 0.735 - depth], [3.795 - depth, 0.1]
    at = problem.evaluate_contacts(z, reach=0.0)
    assert at.distance[at.waypoint < 3].min() == pytest.approx(-depth, abs=1e-4)
    separation = Separation(problem)
    separation.update(z, at, [])
    assert separation.is_active == is_active


def test_waypoints_beside_a_stretch_do_not_change_sides() -> None:
    """Backing out of the crate is shorter than moving aside, but the next waypoint is behind it."""
    problem, path = make_problem((3.0, 0.1, 1.0))
    z = np.where(np.arange(len(path))[:, None] < 10, path[0], path[-1])
    z[10, :2] = 2.5, 0.1
    _, contacts, _, _ = separate(problem, z)
    inside = contacts.select(np.flatnonzero((contacts.waypoint == 10) & (contacts.distance < -0.3)))
    np.testing.assert_allclose(inside.normal, [[0.0, 1.0, 0.0]] * len(inside.normal), atol=1e-6)
    assert len(inside.normal)


@pytest.mark.parametrize("length", [0.06, 0.3])
def test_waypoints_around_a_stretch_stay_where_no_segment_crosses(length: float) -> None:
    """Backing out of a thin wall is shorter than moving aside, but then a segment crosses it."""
    problem, z = make_problem((3.0, 0.1, length, 2.6))
    separation, contacts, _, _ = separate(problem, z)
    assert separation.is_active
    inside = contacts.select(np.flatnonzero(contacts.distance < -0.3))
    assert len(inside.normal)
    np.testing.assert_allclose(np.abs(inside.normal[:, 1]), 1.0, atol=1e-6)
