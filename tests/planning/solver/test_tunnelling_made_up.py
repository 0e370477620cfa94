"""Tests of crossings with fake normals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.solver.tunnelling import Crossing, find_crossings

S = 8
SEGMENTS = np.array([0, 0, 0, 1, 1, 2, 3, 3])


class Made:
    """Fake `ContactModel` whose normals point along ±x by state."""

    def __init__(self, back: set[int], *, boundary: int = 99, aside: bool = False) -> None:
        self.back, self.boundary, self.aside = back, boundary, aside

    def find_phases(self, waypoints: np.ndarray) -> np.ndarray:
        np.testing.assert_array_equal(
            waypoints, SEGMENTS + 1
        )  # each is at the end of its segment's phase
        return (waypoints > self.boundary).astype(int)

    def compute_normals(
        self, z: np.ndarray, waypoints: np.ndarray, pairs: np.ndarray
    ) -> np.ndarray:
        rows = z[:, 0].astype(int)
        np.testing.assert_array_equal(waypoints, SEGMENTS[rows] + 1)
        assert pairs.shape == (len(rows), 2)
        signs = np.where(np.isin(rows, list(self.back)), -1.0, 1.0)
        other = np.where(np.isin(rows, list(self.back)), 1.0, 0.0)
        turned = np.column_stack([1.0 - other, other, 0.0 * other])
        return turned if self.aside else signs[:, None] * np.array([[1.0, 0.0, 0.0]])


def overlaps(*where: tuple[int, int, int], depth: float = 0.01) -> Contacts:
    """Return contacts (state, first, second), by state as they are found."""
    rows = np.array(sorted(where), int).reshape(-1, 3)
    vectors, numbers = np.zeros((len(rows), 3)), np.full(len(rows), -depth)
    return Contacts(rows[:, 0], rows[:, 1:], numbers, numbers, vectors, vectors, vectors)


def found(contacts: Contacts, back: set[int], **how: Any) -> list[Crossing]:
    made: Any = Made(back, **how)
    return find_crossings(made, np.arange(float(S))[:, None], SEGMENTS, contacts)


def test_opposite_normals_make_a_crossing() -> None:
    """The crossing spans the segments of the states before and after."""
    assert found(overlaps((3, 0, 1), (4, 0, 1)), {5, 6, 7}) == [Crossing((0, 1), 0, 2)]
    assert found(overlaps((5, 0, 1)), {6, 7}) == [Crossing((0, 1), 1, 3)]
    assert found(overlaps((3, 0, 1), (4, 0, 1)), set()) == []
    assert (
        found(overlaps((3, 0, 1), (4, 0, 1)), {3, 4}) == []
    )  # what normals are inside does not matter


@pytest.mark.parametrize("state", range(S))
def test_overlap_at_either_end_is_no_crossing(state: int) -> None:
    back = set(range(state + 1, S))
    expected = (
        [Crossing((0, 1), int(SEGMENTS[state - 1]), int(SEGMENTS[state + 1]))]
        if 0 < state < S - 1
        else []
    )
    assert found(overlaps((state, 0, 1)), back) == expected


def test_separate_overlaps_are_separate_crossings() -> None:
    """The shape leaves between states 2 and 4, and crosses back."""
    twice = overlaps((2, 0, 1), (4, 0, 1), (5, 0, 1))
    assert found(twice, {3}) == [Crossing((0, 1), 0, 1), Crossing((0, 1), 1, 3)]
    assert found(twice, {6, 7}) == [Crossing((0, 1), 1, 3)]
    assert found(overlaps((2, 0, 1), (3, 0, 1), (4, 0, 1), (5, 0, 1)), {3}) == []


@pytest.mark.parametrize("other", [(0, 2), (2, 1), (1, 2)])
def test_pairs_are_separate_crossings(other: tuple[int, int]) -> None:
    """The second pair begins where the first ends."""
    both = found(overlaps((2, 0, 1), (3, *other)), {3})
    assert both == [Crossing((0, 1), 0, 1)]
    both = found(overlaps((2, 0, 1), (3, *other)), {4, 5, 6, 7})
    assert both == [Crossing(other, 0, 1)]


def test_simultaneous_pairs_do_not_mix() -> None:
    both = overlaps(
        *((row, 0, k) for row in (2, 3, 4) for k in (1, 2)), *((row, 1, 2) for row in (2, 3, 4))
    )
    assert found(both, {5, 6, 7}) == [Crossing(pair, 0, 2) for pair in ((0, 1), (0, 2), (1, 2))]


def test_overlap_across_phases_is_no_crossing() -> None:
    """Geometry indices differ between phases."""
    contacts = overlaps((4, 0, 1))
    assert found(contacts, {5, 6, 7}, boundary=3) == [Crossing((0, 1), 1, 2)]
    assert found(contacts, {5, 6, 7}, boundary=2) == []


def test_only_overlaps_count() -> None:
    for depth in (0.0, -0.5):
        assert found(overlaps((3, 0, 1), depth=depth), {4, 5, 6, 7}) == []


def test_only_opposite_normals_count() -> None:
    """Normals are perpendicular at a corner."""
    assert found(overlaps((3, 0, 1)), {4, 5, 6, 7}, aside=True) == []
