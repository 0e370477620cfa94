"""Shortest paths of a car, against their definition and against a search."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.base_paths.reeds_shepp import compute_lengths, find_shortest_path_pieces

GOALS = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(-np.pi, np.pi))
RADII = st.floats(0.2, 3.0)


def driven(pieces: list[tuple[float, float]]) -> np.ndarray:
    """Return the end of the pieces, by small steps along them."""
    x = y = yaw = 0.0
    for length, turn in pieces:
        count = 4000
        for _ in range(count):
            yaw += turn / count / 2
            x, y = x + length / count * np.cos(yaw), y + length / count * np.sin(yaw)
            yaw += turn / count / 2
    return np.array([x, y, yaw])


@settings(deadline=None)
@given(GOALS, RADII)
def test_pieces_are_arcs_and_lines_that_reach_the_goal(
    goal: tuple[float, float, float], radius: float
) -> None:
    pieces = find_shortest_path_pieces(np.array(goal), radius)
    assert len(pieces) <= 5
    for length, turn in pieces:
        assert turn == 0.0 or abs(turn) == pytest.approx(abs(length) / radius)
    where = np.zeros(3)
    for length, turn in pieces:  # a chord for each arc
        middle, chord = where[2] + turn / 2, length * np.sinc(turn / (2 * np.pi))
        where = where + np.array([chord * np.cos(middle), chord * np.sin(middle), turn])
    np.testing.assert_allclose(where[:2], radius * np.array(goal[:2]), atol=1e-6 * radius)
    assert np.cos(where[2] - goal[2]) == pytest.approx(1.0, abs=1e-9)
    length, turned = compute_lengths(np.array([goal]), radius)
    assert length[0] == pytest.approx(sum(abs(length) for length, _ in pieces))
    assert turned[0] == pytest.approx(sum(abs(turn) for _, turn in pieces))


@settings(deadline=None)
@given(GOALS)
def test_length_is_invariant_to_reversal_and_mirroring(goal: tuple[float, float, float]) -> None:
    x, y, yaw = goal
    back = [-(x * np.cos(yaw) + y * np.sin(yaw)), x * np.sin(yaw) - y * np.cos(yaw), -yaw]
    lengths, _ = compute_lengths(np.array([goal, back, (x, -y, -yaw), (-x, y, -yaw)]), 1.0)
    np.testing.assert_allclose(lengths, lengths[0], atol=1e-6)
    assert lengths[0] >= np.hypot(x, y) - 1e-9
    assert lengths[0] >= abs(yaw) - 1e-9


def test_no_random_word_is_shorter() -> None:
    """Random words of up to five pieces are no shorter than the shortest path."""
    rng = np.random.default_rng(0)
    for count, _ in itertools.product(range(1, 6), range(100)):
        pieces = [
            (length, length * way)
            for length, way in zip(
                rng.uniform(-2, 2, count), rng.integers(-1, 2, count), strict=True
            )
        ]
        where = np.zeros(3)
        for length, turn in pieces:
            middle, chord = where[2] + turn / 2, length * np.sinc(turn / (2 * np.pi))
            where = where + np.array([chord * np.cos(middle), chord * np.sin(middle), turn])
        where[2] = (where[2] + np.pi) % (2 * np.pi) - np.pi
        (length,), _ = compute_lengths(where[None], 1.0)
        assert length <= sum(abs(piece) for piece, _ in pieces) + 1e-6


@pytest.mark.parametrize(
    ("goal", "length"),
    [
        ((3.0, 0.0, 0.0), 3.0),  # straight ahead
        ((-3.0, 0.0, 0.0), 3.0),  # straight back
        ((0.0, 2.0, np.pi), np.pi),  # half a circle
        ((1.0, 1.0, np.pi / 2), np.pi / 2),  # a quarter
        (
            (0.0, 0.0, np.pi),
            np.pi,
        ),  # three arcs, of which the one in the middle goes the other way: 60 degrees each
        ((0.0, 0.0, 0.0), 0.0),
    ],
)
def test_known_lengths(goal: tuple[float, float, float], length: float) -> None:
    assert compute_lengths(np.array([goal]), 1.0)[0][0] == pytest.approx(length, abs=1e-6)
    np.testing.assert_allclose(
        driven(find_shortest_path_pieces(np.array(goal), 1.0))[:2], goal[:2], atol=1e-5
    )
