"""Tests of the samples within segments and the contacts made of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.drives import hall, moved
from helpers.small_problems import program_of
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.chain.contacts import ContactModel, Contacts
from vkc_pin.planning.solver.segment_planes import (
    CLEARANCE_TOLERANCE,
    REFINEMENT,
    REFINEMENT_RANGE,
    SEGMENT_MARGIN,
    SPACING,
    _select_deepest,
    find_segment_contacts,
    merge_contacts,
)

POST = {
    "name": "post",
    "type": "cylinder",
    "radius": 0.02,
    "length": 1.6,
    "position": [0.0, 2.0, 0.8],
}


def contacts(
    rows: np.ndarray, pairs: np.ndarray, distance: np.ndarray, margin: np.ndarray | None = None
) -> Contacts:
    vectors = np.zeros((len(rows), 3))
    return Contacts(
        rows,
        pairs,
        distance,
        np.zeros(len(rows)) if margin is None else margin,
        vectors,
        vectors,
        vectors,
    )


def test_samples_are_even_and_refined_near_obstacles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Samples are `SPACING` apart, and refined by `REFINEMENT` near obstacles."""
    scene = hall(obstacles=[POST])
    problem = program_of(scene, [vkc.GoTo(0.0, 3.0)], options=vkc.Options(reach_waypoints=4))
    ways = np.array([0.0, 0.5, 0.5, 1.51, 3.0])  # [m] aside; in the second it stands still
    z = np.array([moved(scene.start, y=y) for y in ways[1:]])
    z[2:, 3] -= 0.7  # the arm turns meanwhile, by less than the base drives
    asked: list[tuple[np.ndarray, np.ndarray, float, Contacts]] = []
    evaluate = ContactModel.evaluate

    def noted(
        model: ContactModel, states: np.ndarray, waypoints: np.ndarray, **how: Any
    ) -> Contacts:
        found = evaluate(model, states, waypoints, **how)
        asked.append((states, waypoints, how["reach"], found))
        return found

    monkeypatch.setattr(ContactModel, "evaluate", noted)
    find_segment_contacts(problem, z)
    (states, waypoints, reach, near), (finer, ends, again, _) = asked
    assert reach == again == SEGMENT_MARGIN + REFINEMENT_RANGE
    counts = [25, 1, 51, 75]
    assert (SPACING, REFINEMENT) == (0.02, 4)
    np.testing.assert_array_equal(waypoints, np.repeat([1, 2, 3, 4], counts))
    shares = np.concatenate([(np.arange(count) + 0.5) / count for count in counts])
    path = problem.waypoints(z)
    expected = path[waypoints - 1] + shares[:, None] * (path[waypoints] - path[waypoints - 1])
    np.testing.assert_allclose(states, expected, atol=1e-12)
    rows = np.unique(near.waypoint)
    assert 0 < len(rows) < len(states)
    piece = np.arange(len(states)) - np.repeat(np.cumsum(counts) - counts, counts)
    shares = (
        (piece[rows][:, None] + (np.arange(REFINEMENT) + 0.5) / REFINEMENT)
        / np.repeat(counts, counts)[rows][:, None]
    ).ravel()
    np.testing.assert_array_equal(ends, np.repeat(waypoints[rows], REFINEMENT))
    np.testing.assert_allclose(
        finer, path[ends - 1] + shares[:, None] * (path[ends] - path[ends - 1]), atol=1e-12
    )


def test_contacts_at_both_ends_represent_the_segment() -> None:
    """Witness points are fixed in their bodies; for translations the lift is exact."""
    scene = hall(obstacles=[POST])
    problem = program_of(scene, [vkc.GoTo(0.0, 3.0)], options=vkc.Options(reach_waypoints=3))
    z = np.array([moved(scene.start, y=y) for y in (1.0, 2.0, 3.0)])
    found = find_segment_contacts(problem, z).contacts
    assert set(found.waypoint.tolist()) == {0, 1, 2}
    np.testing.assert_allclose(
        found.distance, np.einsum("ci,ci->c", found.normal, found.second - found.first), atol=1e-12
    )
    labels = problem.contacts.phases[0].labels
    base = [k for k in range(len(found.waypoint)) if labels[found.pair[k, 0]] == "base_link"]
    ends = {
        int(found.waypoint[k]): k
        for k in base
        if found.margin[k] - found.distance[k] > SEGMENT_MARGIN
    }
    assert {0, 1} <= set(ends)
    first, last = ends[0], ends[1]
    np.testing.assert_array_equal(found.second[first], found.second[last])  # the post stands
    np.testing.assert_allclose(
        found.first[last] - found.first[first], [0.0, 1.0, 0.0], atol=1e-9
    )  # the base drives a metre


@pytest.mark.parametrize(("gap", "free"), [(0.9, False), (1.1, True)])
def test_segment_clearance_threshold(gap: float, free: bool) -> None:
    """The base passes a wall at `gap` times the tolerance."""
    half = 0.5
    scene = hall(
        obstacles=[
            {
                "name": "wall",
                "type": "box",
                "size": [4.0, 0.1, half],
                "position": [1.0, 1.0, half / 2],
            }
        ]
    )
    problem = program_of(scene, [vkc.GoTo(2.0, 0.0)], options=vkc.Options(reach_waypoints=3))
    here = scene.start_clearance()
    y = here - gap * CLEARANCE_TOLERANCE
    z = np.array([moved(scene.start, x=x, y=y) for x in (0.5, 1.0, 1.5)])
    between = find_segment_contacts(problem, z)
    assert between.is_free == free
    assert between.contacts.compute_violation() > 0.0


pairs = st.tuples(st.integers(0, 6), st.integers(0, 6))


@given(st.lists(st.tuples(st.integers(0, 5), pairs, st.floats(-1.0, 1.0)), max_size=30))
def test_deepest_contact_of_each_segment_and_pair_is_kept(
    rows: list[tuple[int, tuple[int, int], float]],
) -> None:
    segment = np.array([0, 0, 1, 2, 2, 3])
    states, both = (np.array([row[k] for row in rows], int) for k in (0, 1))
    distance = np.array([row[2] for row in rows])
    found = _select_deepest(contacts(states.reshape(-1), both.reshape(-1, 2), distance), segment)
    least: dict[tuple[int, ...], float] = {}
    for state, pair, depth in rows:
        key = (int(segment[state]), *pair)
        least[key] = min(least.get(key, np.inf), depth)
    keys = [(int(s), *p) for s, p in zip(segment[found.waypoint], found.pair.tolist(), strict=True)]
    # (0, 0, 0) is no pair: nothing collides with itself
    assert dict(zip(keys, found.distance.tolist(), strict=True)) == least
    assert len(keys) == len(least)


def test_merged_contacts_are_sorted_by_waypoint_and_violation() -> None:
    one = contacts(
        np.array([0, 1]), np.array([[0, 1], [0, 2]]), np.array([0.3, 0.1]), np.array([0.02, 0.02])
    )
    other = contacts(
        np.array([0, 1, 0]),
        np.array([[0, 3], [0, 4], [0, 5]]),
        np.array([0.5, 0.2, 0.1]),
        np.array([0.4, 0.3, 0.0]),
    )
    joined = merge_contacts(one, other)
    assert joined.waypoint.tolist() == [0, 0, 0, 1, 1]
    assert joined.pair[:, 1].tolist() == [3, 5, 1, 4, 2]
