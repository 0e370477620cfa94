"""Tests the detection of shapes that pass through each other."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.drives import make_hall, move_start
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.segment_planes import Crossing, find_crossings, find_new_crossings

REACH, GRAZING = 8, -0.353


@cache
def make_posts_problem() -> TrajectoryProblem:
    """Return a drive through posts at x = 2 and 4 m and back; the base is 1 m long."""
    obstacles = [
        {
            "name": f"post_{x}",
            "type": "cylinder",
            "radius": 0.02,
            "length": 1.6,
            "position": [x, y, 0.8],
        }
        for x, y in ((2, 0.0), (4, 0.1))
    ]
    steps = [vkc.GoTo(6.0, 0.0), vkc.GoTo(0.0, 0.0)]
    options = vkc.Options(reach_waypoints=REACH)
    return make_program(make_hall(obstacles=obstacles), steps, options=options)


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
    xs = np.linspace(1.0, 3.0, 200).tolist()
    assert find_base_crossings(xs, [0] * 200, y=-0.3) == {"post_2": [(0, 0)]}
    assert find_base_crossings(xs, [0] * 200, y=GRAZING) == {}
    states = np.array([move_start(make_posts_problem().start, x=x, y=GRAZING) for x in xs])
    near = make_posts_problem().contacts.evaluate(states, np.ones(200, int), reach=0.0)
    labels = make_posts_problem().contacts.phases[0].labels
    assert "base_link" in {labels[pair[0]] for pair in near.pair}


def test_new_crossings_have_new_pairs() -> None:
    first, moved_on, other = Crossing((1, 2), 3, 4), Crossing((1, 2), 5, 6), Crossing((1, 3), 3, 4)
    assert find_new_crossings([moved_on], [first]) == []
    assert find_new_crossings([first, other], [moved_on]) == [other]
    assert find_new_crossings([first], []) == [first]
