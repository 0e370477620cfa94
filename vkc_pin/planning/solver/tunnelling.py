"""Where a motion carries one shape through another, which no planes can undo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.chain.contacts import ContactModel, Contacts
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["Passage", "new", "passages"]


class Passage(NamedTuple):
    """A pair of geometries of which one goes through the other, from one segment to another, both counted from 0."""

    pair: tuple[int, int]
    first: int
    last: int


def passages(
    contacts: ContactModel, states: Floats, segments: Ints, found: Contacts
) -> list[Passage]:
    """Return where pairs overlap that part on another side than they met: their normals before and after are opposite.

    What dips into something and comes out again where it went in is none.

    Args:
        contacts: What can collide.
        states: Configurations along a motion, shape (S, n).
        segments: The segment in which each is, from 0, shape (S,).
        found: Pairs that are close at the states.
    """
    overlapping = found.select(np.flatnonzero(found.distance < 0.0))
    if not len(overlapping.waypoint):
        return []
    order = np.lexsort((overlapping.waypoint, overlapping.pair[:, 1], overlapping.pair[:, 0]))
    rows, pairs = overlapping.waypoint[order], overlapping.pair[order]
    apart = np.append((np.diff(rows) != 1) | (np.diff(pairs, axis=0) != 0).any(axis=1), True)
    ends = np.flatnonzero(apart)
    begins = np.append(0, ends[:-1] + 1)
    before, after, pairs = rows[begins] - 1, rows[ends] + 1, pairs[begins]
    phases = contacts.find_phases(segments + 1)
    inside = np.flatnonzero((before >= 0) & (after < len(states)))
    inside = inside[
        phases[before[inside]] == phases[after[inside]]
    ]  # shapes are others in another phase
    before, after, pairs = before[inside], after[inside], pairs[inside]
    here, there = (
        contacts.compute_normals(states[rows], segments[rows] + 1, pairs)
        for rows in (before, after)
    )
    through = np.einsum("ci,ci->c", here, there) < 0.0
    parts = zip(
        pairs[through].tolist(),
        segments[before[through]].tolist(),
        segments[after[through]].tolist(),
        strict=True,
    )
    return [Passage((first, second), begin, end) for (first, second), begin, end in parts]


def new(passed: Sequence[Passage], before: Sequence[Passage]) -> list[Passage]:
    """Return those of pairs that did not go through each other `before`."""
    known = {passage.pair for passage in before}
    return [passage for passage in passed if passage.pair not in known]
