"""What goes through each other, and what only dips into something: against where the shapes are on either side."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.drives import hall, moved, through
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.segment_planes import find_segment_contacts
from vkc_pin.planning.solver.tunnelling import Crossing, find_new_crossings

STEPS = 8
FEW = vkc.Options(reach_waypoints=STEPS)


def past(x: float, *obstacles: dict[str, object]) -> tuple[TrajectoryProblem, np.ndarray]:
    """Return a problem in a hall, and the straight way of the base ahead to `x` [m], shape (N, n)."""
    scene = hall(obstacles=list(obstacles))
    problem = program_of(scene, [vkc.GoTo(x, 0.0, 0.0)], options=FEW)
    return problem, through(scene, scene.start, moved(scene.start, x=x), steps=STEPS).positions[1:]


def post(x: float, y: float = 0.0, radius: float = 0.02) -> dict[str, object]:
    return {
        "name": "post",
        "type": "cylinder",
        "radius": radius,
        "length": 1.6,
        "position": [x, y, 0.8],
    }


def pairs(problem: TrajectoryProblem, z: np.ndarray) -> set[tuple[str, str]]:
    labels = problem.contacts.phases[0].labels
    return {(labels[a], labels[b]) for (a, b), _, _ in find_segment_contacts(problem, z).crossings}


@pytest.mark.parametrize("y", [0.0, 0.1, -0.2])
def test_the_base_goes_through_a_post(y: float) -> None:
    problem, z = past(4.0, post(2.0, y))
    assert ("base_link", "post") in pairs(problem, z)
    found = find_segment_contacts(problem, z).crossings
    length = 4.0 / STEPS
    for _, first, last in found:
        assert first <= 2.0 / length <= last + 1
        assert last - first < 1.0 / length + 2


def test_what_is_dipped_into_is_none() -> None:
    """There and back again: into the post, and out where it came in."""
    problem, z = past(1.6, post(2.0))
    there_and_back = np.concatenate([z[1::2], z[1::2][::-1]])
    there_and_back[-1] = problem.start
    assert find_segment_contacts(problem, there_and_back).contacts.compute_violation() > 0.05
    assert ("base_link", "post") not in pairs(problem, there_and_back)


def test_what_is_grazed_is_none() -> None:
    """Past the front corner of the base, on the same side before and after."""
    problem, z = past(4.0, post(2.0, 0.37, radius=0.04))
    between = find_segment_contacts(problem, z)
    assert between.contacts.compute_violation() > 0.0
    assert not between.is_free
    assert ("base_link", "post") not in pairs(problem, z)


def test_what_is_free_and_what_does_not_come_out_again() -> None:
    problem, z = past(4.0, post(2.0, 2.0))
    assert pairs(problem, z) == set()
    problem, z = past(1.6, post(2.0))
    assert not find_segment_contacts(problem, z).is_free
    assert ("base_link", "post") not in pairs(problem, z)


def test_only_pairs_that_did_not_before_are_new() -> None:
    first, moved_on, other = Crossing((1, 2), 3, 4), Crossing((1, 2), 5, 6), Crossing((1, 3), 3, 4)
    assert find_new_crossings([moved_on], [first]) == []
    assert find_new_crossings([first, other], [moved_on]) == [other]
    assert find_new_crossings([first], []) == [first]
    assert find_new_crossings([], [first]) == []
