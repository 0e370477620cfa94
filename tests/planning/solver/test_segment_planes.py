from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.drives import hall, moved, through
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.segment_planes import (
    REFINEMENT_RANGE,
    SEGMENT_MARGIN,
    SegmentContacts,
    find_segment_contacts,
    merge_contacts,
)

ARM = [np.pi, -1.2, 1.9, -0.7, np.pi / 2, 0.0]  # stretched out ahead of the base
WIDTH = 2.0  # [m] the base drives sideways
FEW = vkc.Options(reach_waypoints=5, dt=1.0)


def past_a_post(reach: float = 0.02) -> vkc.Scene:
    """Return a hall in which the hand, moving sideways, passes through a post."""
    tool = hall().with_start(arm=ARM).tool_placement().translation
    x, y = float(tool[0]) + reach, float(tool[1]) + WIDTH / 2
    post = {
        "name": "post",
        "type": "cylinder",
        "radius": 0.03,
        "length": 1.6,
        "position": [x, y, 0.8],
    }
    return hall(obstacles=[post]).with_start(arm=ARM)


def straight(scene: vkc.Scene) -> tuple[TrajectoryProblem, np.ndarray]:
    """Return a problem with few waypoints and the straight sideways path, shape (N, n)."""
    problem = program_of(scene, [vkc.GoTo(0.0, WIDTH, 0.0)], options=FEW)
    return problem, through(
        scene, scene.start, moved(scene.start, y=WIDTH), steps=FEW.reach_waypoints
    ).positions[1:]


def sub_states(problem: TrajectoryProblem, z: np.ndarray, segment: int, count: int) -> np.ndarray:
    """Return states of one segment including its ends, shape (count, n)."""
    path, s = problem.waypoints(z), np.linspace(0.0, 1.0, count)[:, None]
    return (1 - s) * path[segment] + s * path[segment + 1]


def test_thin_obstacle_between_waypoints_is_avoided(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, steps = past_a_post(), [vkc.GoTo(0.0, WIDTH, 0.0)]
    plan = vkc.plan(scene, steps, options=FEW)
    assert plan.success, plan.summary()
    assert (
        plan.trajectory.arm_path_length() + plan.trajectory.base_path_length() > WIDTH + 0.005
    )  # it went round the post

    problem, _ = straight(scene)
    nothing, free, passed = find_segment_contacts(
        problem, np.tile(problem.start, (problem.segments, 1))
    )
    assert free
    assert passed == []
    assert nothing.compute_violation() == 0.0
    nothing = nothing.select(np.zeros(0, int))
    monkeypatch.setattr(
        "vkc_pin.planning.solver.loop.find_segment_contacts",
        lambda problem, z: SegmentContacts(nothing, True, []),
    )
    blind = vkc.plan(scene, steps, options=FEW, initialization="interpolated")
    assert not blind.success
    assert blind.status == "rejected"  # the solver was content, validation was not
    assert {(v.constraint, "post" in v.subject) for v in blind.report.violations} == {
        ("penetration", True)
    }
    segment = int(blind.report.violations[0].waypoint)
    ends = problem.contacts.evaluate(
        blind.trajectory.positions[segment : segment + 2], np.array([1, 1]), reach=0.02
    )
    assert len(ends.waypoint) == 0  # free at both waypoints


def test_planes_are_placed_at_both_ends_of_the_segment() -> None:
    problem, z = straight(past_a_post())
    assert problem.evaluate_contacts(z, reach=0.02).compute_clearance() == np.inf
    found = find_segment_contacts(problem, z).contacts
    labels = problem.contacts.phases[0].labels
    assert {labels[j] for j in found.pair[:, 1]} == {"post"}
    assert all(labels[i].startswith("gripper") for i in found.pair[:, 0])
    assert set(found.waypoint) == {1, 2}  # rows of z_2 and z_3, the segment in the middle
    keys = np.column_stack([found.waypoint, found.pair])
    assert len(np.unique(keys, axis=0)) == len(keys)  # one contact a pair and end
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-9)


def test_required_lift_equals_the_missing_clearance() -> None:
    problem, z = straight(past_a_post())
    found = find_segment_contacts(problem, z).contacts
    states = sub_states(problem, z, 2, 400)
    dense = problem.contacts.evaluate(
        states, np.full(len(states), 3), reach=SEGMENT_MARGIN + REFINEMENT_RANGE
    )
    pairs = np.unique(found.pair, axis=0)
    assert len(pairs) > 1
    for pair in pairs:
        deepest = dense.distance[(dense.pair == pair).all(axis=1)].min()
        missing = (found.margin - found.distance)[(found.pair == pair).all(axis=1)]
        np.testing.assert_allclose(missing, SEGMENT_MARGIN - deepest, atol=1e-3)


def test_lifting_both_ends_lifts_the_segment_to_first_order() -> None:
    """Moving both waypoints by ε along the normal moves the sample's distance by ε + O(ε²)."""
    problem, z = straight(past_a_post())
    found = find_segment_contacts(problem, z).contacts
    index = int(np.argmax(found.margin - found.distance))
    pair, normal = found.pair[index], found.normal[index]

    def depth(lift: float) -> float:
        lifted = z.copy()
        lifted[1:3, :2] -= (
            lift * normal[:2]
        )  # the robot is the first of the pair, the normal points from it
        states = sub_states(problem, lifted, 2, 2000)
        contacts = problem.contacts.evaluate(states, np.full(len(states), 3), reach=0.1)
        return float(contacts.distance[(contacts.pair == pair).all(axis=1)].min())

    value = (
        found.margin[index] - SEGMENT_MARGIN
    )  # n·(b − a) there, lifted by what is missing: v + SEGMENT_MARGIN − d
    assert value == pytest.approx(found.distance[index] - depth(0.0), abs=1e-3)
    for lift in (1e-3, 4e-3):
        horizontal = float(normal[:2] @ normal[:2])
        assert depth(lift) - depth(0.0) == pytest.approx(lift * horizontal, rel=0.15, abs=2e-4)


def test_start_close_to_an_obstacle_can_be_left() -> None:
    wall = {"name": "wall", "type": "box", "size": [0.1, 2.0, 0.5], "position": [0.546, 0.0, 0.25]}
    scene = hall(obstacles=[wall])
    assert 0.0 < scene.start_clearance() < SEGMENT_MARGIN
    problem = program_of(scene, [vkc.GoTo(-1.0, 0.0, 0.0)], options=FEW)
    away = through(
        scene, scene.start, moved(scene.start, x=-1.0), steps=FEW.reach_waypoints
    ).positions[1:]
    assert len(find_segment_contacts(problem, away).contacts.waypoint) == 0
    into = through(
        scene, scene.start, moved(scene.start, x=1.0), steps=FEW.reach_waypoints
    ).positions[1:]
    assert 0 in find_segment_contacts(problem, into).contacts.waypoint


def test_merged_contacts_are_sorted() -> None:
    problem, z = straight(past_a_post())
    found = find_segment_contacts(problem, z).contacts
    near = problem.evaluate_contacts(z, reach=0.3)
    both = merge_contacts(near, found)
    assert len(both.waypoint) == len(near.waypoint) + len(found.waypoint)
    assert np.all(np.diff(both.waypoint) >= 0)
    missing = both.distance - both.margin
    for row in np.unique(both.waypoint):
        assert np.all(np.diff(missing[both.waypoint == row]) >= 0)
    shuffled = dataclasses.replace(both).select(np.random.default_rng(0).permutation(len(missing)))
    np.testing.assert_array_equal(merge_contacts(shuffled).waypoint, both.waypoint)


def test_stationary_segments_have_no_contacts() -> None:
    problem, _ = straight(hall().with_start(arm=ARM))
    assert (
        len(
            find_segment_contacts(
                problem, np.tile(problem.start, (problem.segments, 1))
            ).contacts.waypoint
        )
        == 0
    )
