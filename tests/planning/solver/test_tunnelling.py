"""Tests of the detection of shapes that pass through each other."""

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
    """Return a problem in a hall and the straight path ahead to `x` [m], shape (N, n)."""
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
def test_base_passes_through_a_post(y: float) -> None:
    problem, z = past(4.0, post(2.0, y))
    assert ("base_link", "post") in pairs(problem, z)
    found = find_segment_contacts(problem, z).crossings
    length = 4.0 / STEPS
    for _, first, last in found:
        assert first <= 2.0 / length <= last + 1
        assert last - first < 1.0 / length + 2


def test_entering_and_leaving_on_one_side_is_no_crossing() -> None:
    """The base enters the post and leaves it on the same side."""
    problem, z = past(1.6, post(2.0))
    there_and_back = np.concatenate([z[1::2], z[1::2][::-1]])
    there_and_back[-1] = problem.start
    assert find_segment_contacts(problem, there_and_back).contacts.compute_violation() > 0.05
    assert ("base_link", "post") not in pairs(problem, there_and_back)


def test_grazing_is_no_crossing() -> None:
    """The post passes the front corner of the base on one side."""
    problem, z = past(4.0, post(2.0, 0.37, radius=0.04))
    between = find_segment_contacts(problem, z)
    assert between.contacts.compute_violation() > 0.0
    assert not between.is_free
    assert ("base_link", "post") not in pairs(problem, z)


def test_no_crossing_if_free_or_still_inside() -> None:
    problem, z = past(4.0, post(2.0, 2.0))
    assert pairs(problem, z) == set()
    problem, z = past(1.6, post(2.0))
    assert not find_segment_contacts(problem, z).is_free
    assert ("base_link", "post") not in pairs(problem, z)


def test_new_crossings_are_of_new_pairs() -> None:
    first, moved_on, other = Crossing((1, 2), 3, 4), Crossing((1, 2), 5, 6), Crossing((1, 3), 3, 4)
    assert find_new_crossings([moved_on], [first]) == []
    assert find_new_crossings([first, other], [moved_on]) == [other]
    assert find_new_crossings([first], []) == [first]
    assert find_new_crossings([], [first]) == []
