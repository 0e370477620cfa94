"""Tests contacts between waypoints, and shapes that pass through each other."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.drives import make_hall, move_start
from helpers.small_problems import make_program
from helpers.straight_drives import make_straight_drive

import vkc_pin as vkc
from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.loop import solve
from vkc_pin.planning.solver.segment_planes import (
    CLEARANCE_TOLERANCE,
    REFINEMENT_RANGE,
    SEGMENT_MARGIN,
    Crossing,
    _select_deepest,
    find_crossings,
    find_new_crossings,
    find_segment_contacts,
    merge_contacts,
)

REACH, GRAZING = 8, -0.353


def describe_post(name: str, radius: float, x: float, y: float) -> dict[str, Any]:
    where = {"position": [float(x), float(y), 0.8], "length": 1.6, "radius": radius}
    return {"name": name, "type": "cylinder", **where}


@cache
def make_posts_problem() -> TrajectoryProblem:
    """Return a drive through posts at x = 2 and 4 m and back; the base is 1 m long."""
    posts = [describe_post(f"post_{x}", 0.02, x, y) for x, y in ((2, 0.0), (4, 0.1))]
    steps = [vkc.GoTo(6.0, 0.0), vkc.GoTo(0.0, 0.0)]
    return make_program(
        make_hall(obstacles=posts), steps, options=vkc.Options(reach_waypoints=REACH)
    )


def find_base_crossings(
    xs: list[float], segments: list[int], y: float = 0.0
) -> dict[str, list[tuple[int, int]]]:
    """Return the first and last segments in which the base crosses each post."""
    problem = make_posts_problem()
    states = np.array([move_start(problem.start, x=x, y=y) for x in xs])
    indices = np.array(segments)
    near = problem.contacts.evaluate(states, indices + 1, reach=0.05)
    labels = problem.contacts.phases[0].labels
    found: dict[str, list[tuple[int, int]]] = {}
    for (a, b), first, last in find_crossings(problem.contacts, states, indices, near):
        if labels[a] == "base_link":
            found.setdefault(labels[b], []).append((first, last))
    return found


@pytest.mark.parametrize(
    ("xs", "segments", "expected"),
    [
        ([0, 1.8, 2.1, 3], [0, 1, 2, 3], {"post_2": [(0, 3)]}),
        ([3, 2.1, 1.8, 0], [0, 0, 1, 1], {"post_2": [(0, 1)]}),
        ([0, 2.1, 3, 3.8, 4.2, 5], [0, 1, 2, 3, 4, 5], {"post_2": [(0, 2)], "post_4": [(2, 5)]}),
        ([0, 2.1, 4.1, 5], [0, 1, 2, 3], {"post_2": [(0, 2)], "post_4": [(1, 3)]}),
        # there and back: two crossings
        ([0, 1.9, 3, 2.1, 0], [0, 1, 2, 3, 4], {"post_2": [(0, 2), (2, 4)]}),
        # in and out on one side, still inside at the end, inside from the start, and free
        ([0, 1.7, 0], [0, 1, 2], {}),
        ([0, 1.8, 2.1], [0, 1, 2], {}),
        ([1.8, 2.1, 3], [0, 1, 2], {}),
        ([0, 0.5, 1.0], [0, 1, 2], {}),
        # geometry indices are comparable only within a phase
        ([0, 2.1, 3], [5, 6, 7], {"post_2": [(5, 7)]}),
        ([0, 2.1, 3], [6, 7, 8], {}),
        ([0, 2.1, 3], [8, 8, 9], {"post_2": [(8, 9)]}),
    ],
)
def test_crossings_enter_and_leave_on_opposite_sides(
    xs: list[float], segments: list[int], expected: dict[str, list[tuple[int, int]]]
) -> None:
    assert find_base_crossings(xs, segments) == expected


def test_grazing_is_no_crossing() -> None:
    """The side of the base overlaps the post, and the normal turns by less than a right angle."""
    xs, problem = np.linspace(1.0, 3.0, 200).tolist(), make_posts_problem()
    assert find_base_crossings(xs, [0] * 200, y=-0.3) == {"post_2": [(0, 0)]}
    assert find_base_crossings(xs, [0] * 200, y=GRAZING) == {}
    states = np.array([move_start(problem.start, x=x, y=GRAZING) for x in xs])
    near = problem.contacts.evaluate(states, np.ones(200, int), reach=0.0)
    labels = problem.contacts.phases[0].labels
    assert "base_link" in {labels[pair[0]] for pair in near.pair}


def test_new_crossings_have_new_pairs() -> None:
    first, moved_on, other = Crossing((1, 2), 3, 4), Crossing((1, 2), 5, 6), Crossing((1, 3), 3, 4)
    assert find_new_crossings([moved_on], [first]) == []
    assert find_new_crossings([first, other], [moved_on]) == [other]
    assert find_new_crossings([first], []) == [first]


ARM = [np.pi, -1.2, 1.9, -0.7, np.pi / 2, 0.0]  # stretched out ahead of the base
WIDTH = 2.0  # [m] the base drives sideways


def make_drive(
    *obstacles: dict[str, Any], arm: list[float] | None = None, **goal: float
) -> tuple[TrajectoryProblem, np.ndarray]:
    """Return a drive in few steps and its straight path."""
    scene = make_hall(obstacles=obstacles).with_start(arm=arm)
    return make_straight_drive(scene, vkc.Options(reach_waypoints=5, dt=1.0), **goal)


@cache
def make_post_case() -> tuple[TrajectoryProblem, np.ndarray]:
    """The hand, moving sideways, passes through a post between the second and third waypoint."""
    tool = make_hall().with_start(arm=ARM).tool_placement().translation
    post = describe_post("post", 0.03, tool[0] + 0.02, tool[1] + WIDTH / 2)
    return make_drive(post, arm=ARM, y=WIDTH)


def sample_segment(
    problem: TrajectoryProblem, z: np.ndarray, segment: int, count: int = 400
) -> Contacts:
    """Return the contacts at evenly spaced states of a segment, including its ends."""
    path, s = problem.waypoints(z), np.linspace(0.0, 1.0, count)[:, None]
    states = (1 - s) * path[segment] + s * path[segment + 1]
    reach = SEGMENT_MARGIN + REFINEMENT_RANGE
    return problem.contacts.evaluate(states, np.full(count, segment + 1), reach=reach)


def test_thin_obstacle_between_waypoints_is_avoided() -> None:
    problem, z = make_post_case()
    assert problem.evaluate_contacts(z, reach=0.02).compute_clearance() == np.inf
    assert not find_segment_contacts(problem, z).is_free
    solution = solve(problem, z)
    assert solution.converged
    for segment in range(problem.segments):
        contacts = sample_segment(problem, solution.z, segment)
        assert not len(contacts.distance) or contacts.distance.min() > 0.0


def test_deepest_samples_become_planes_at_both_ends() -> None:
    """For each pair, both planes have the shortfall of the segment's deepest sample."""
    problem, z = make_post_case()
    found, dense = find_segment_contacts(problem, z).contacts, sample_segment(problem, z, 2)
    labels = problem.contacts.phases[0].labels
    assert {labels[j] for j in found.pair[:, 1]} == {"post"}
    assert set(found.waypoint) == {1, 2}  # rows of z_2 and z_3
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-9)
    pairs = np.unique(found.pair, axis=0)
    assert len(pairs) > 1
    assert len(found.pair) == 2 * len(pairs)
    for pair in pairs:
        deepest = dense.distance[(dense.pair == pair).all(axis=1)].min()
        shortfall = (found.margin - found.distance)[(found.pair == pair).all(axis=1)]
        np.testing.assert_allclose(shortfall, SEGMENT_MARGIN - deepest, atol=1e-3)


def test_lifting_both_ends_lifts_the_segment_to_first_order() -> None:
    """Moving both waypoints by ε along the normal moves the sample's distance by ε + O(ε²)."""
    problem, z = make_post_case()
    found = find_segment_contacts(problem, z).contacts
    index = int(np.argmax(found.margin - found.distance))
    pair, normal = found.pair[index], found.normal[index]

    def compute_distance(lift: float) -> float:
        lifted = z.copy()
        lifted[1:3, :2] -= lift * normal[:2]  # the normal points away from the robot
        contacts = sample_segment(problem, lifted, 2, 2000)
        return float(contacts.distance[(contacts.pair == pair).all(axis=1)].min())

    horizontal = float(normal[:2] @ normal[:2])
    for lift in (1e-3, 4e-3):
        rise = compute_distance(lift) - compute_distance(0.0)
        assert rise == pytest.approx(lift * horizontal, rel=0.15, abs=2e-4)


def test_witness_points_are_fixed_in_their_bodies() -> None:
    post = describe_box("post", [0.04, 0.04, 1.6], [0.0, 1.0, 0.8])
    problem, z = make_drive(post, y=WIDTH)
    found = find_segment_contacts(problem, z).contacts
    along = np.einsum("ci,ci->c", found.normal, found.second - found.first)
    np.testing.assert_allclose(found.distance, along, atol=1e-12)
    labels = problem.contacts.phases[0].labels
    on_base = np.array([labels[i] == "base_link" for i in found.pair[:, 0]])
    ends = [np.flatnonzero(on_base & (found.waypoint == row))[0] for row in (1, 2)]
    np.testing.assert_allclose(np.diff(found.second[ends], axis=0), 0.0, atol=1e-12)
    step = z[2, :2] - z[1, :2]
    np.testing.assert_allclose(np.diff(found.first[ends], axis=0)[0], [*step, 0.0], atol=1e-9)


@pytest.mark.parametrize(("gap", "is_free"), [(0.9, False), (1.1, True)])
def test_segments_need_some_clearance(gap: float, is_free: bool) -> None:
    """The base passes a wall at `gap` times the tolerance."""
    problem, _ = make_drive(describe_box("wall", [4.0, 0.1, 0.5], [1.0, 1.0, 0.25]), x=2.0)
    y = problem.scene.start_clearance() - gap * CLEARANCE_TOLERANCE
    z = np.array([move_start(problem.start, x=x, y=y) for x in (0.5, 1.0, 1.5, 2.0, 2.5)])
    found = find_segment_contacts(problem, z)
    assert found.is_free == is_free
    assert found.contacts.compute_violation() > 0.0


def test_start_close_to_an_obstacle_can_be_left() -> None:
    wall = describe_box("wall", [0.1, 2.0, 0.5], [0.546, 0.0, 0.25])
    for x, is_in_collision in ((-1.0, False), (1.0, True)):
        problem, z = make_drive(wall, x=x)
        assert 0.0 < problem.scene.start_clearance() < SEGMENT_MARGIN
        found = find_segment_contacts(problem, z)
        assert (0 in found.contacts.waypoint) == is_in_collision
        assert found.is_free != is_in_collision


def test_merged_contacts_are_sorted_by_waypoint_and_violation() -> None:
    problem, z = make_post_case()
    parts = problem.evaluate_contacts(z, reach=0.3), find_segment_contacts(problem, z).contacts
    both = merge_contacts(*parts)
    assert len(both.waypoint) == sum(len(part.waypoint) for part in parts)
    order = np.lexsort((both.distance - both.margin, both.waypoint))
    np.testing.assert_array_equal(order, np.arange(len(order)))
    shuffled = both.select(np.random.default_rng(0).permutation(len(order)))
    np.testing.assert_array_equal(merge_contacts(shuffled).distance, both.distance)


def test_stationary_segments_have_no_contacts() -> None:
    problem, _ = make_post_case()
    found = find_segment_contacts(problem, problem.still)
    assert (len(found.contacts.waypoint), found.is_free, found.crossings) == (0, True, [])


def test_deepest_contact_is_kept_for_each_segment_and_pair() -> None:
    """Neither pairs with a shape in common nor segments beside each other are confused."""
    segment = np.array([1, 1, 2, 2, 1])
    pair = np.array([[5, 8], [5, 9], [5, 8], [5, 7], [4, 8]])
    count = 2 * len(pair)
    vectors = np.zeros((count, 3))
    found = Contacts(
        waypoint=np.tile(np.arange(len(segment)), 2),
        pair=np.tile(pair, (2, 1)),
        distance=np.concatenate([np.full(len(pair), 0.01), np.full(len(pair), -0.02)]),
        margin=np.zeros(count),
        normal=vectors,
        first=vectors,
        second=vectors,
    )
    kept = _select_deepest(found, segment)
    assert len(kept.waypoint) == len(pair)
    assert set(kept.waypoint.tolist()) == set(range(len(pair)))
    np.testing.assert_array_equal(kept.distance, -0.02)
