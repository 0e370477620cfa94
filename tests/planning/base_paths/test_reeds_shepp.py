"""Compares Reeds-Shepp paths with their definition and with random paths."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.base_paths.reeds_shepp import compute_lengths, find_shortest_path_pieces

GOALS = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(-np.pi, np.pi))
RADII = st.floats(0.2, 3.0)


def follow(pieces: list[tuple[float, float]]) -> np.ndarray:
    """Return the end pose of pieces (length, turn), each followed along its chord."""
    pose = np.zeros(3)
    for length, turn in pieces:
        heading, chord = pose[2] + turn / 2, length * np.sinc(turn / (2 * np.pi))
        pose = pose + np.array([chord * np.cos(heading), chord * np.sin(heading), turn])
    return pose


@settings(deadline=None)
@given(GOALS, RADII)
def test_pieces_are_arcs_and_lines_that_reach_the_goal(
    goal: tuple[float, float, float], radius: float
) -> None:
    pieces = find_shortest_path_pieces(np.array(goal), radius)
    assert len(pieces) <= 5
    for length, turn in pieces:
        assert turn == 0.0 or abs(turn) == pytest.approx(abs(length) / radius)
    where = follow(pieces)
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


def test_shortest_path_is_no_longer_than_random_words() -> None:
    rng = np.random.default_rng(0)
    for count, _ in itertools.product(range(1, 6), range(100)):
        pieces = [
            (length, length * curvature)
            for length, curvature in zip(
                rng.uniform(-2, 2, count), rng.integers(-1, 2, count), strict=True
            )
        ]
        end = follow(pieces)
        end[2] = (end[2] + np.pi) % (2 * np.pi) - np.pi
        (length,), _ = compute_lengths(end[None], 1.0)
        assert length <= sum(abs(piece) for piece, _ in pieces) + 1e-6
