"""Detects motions that carry one shape through another, which separating planes cannot undo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.chain.contacts import ContactModel, Contacts
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["Crossing", "find_crossings", "find_new_crossings"]


class Crossing(NamedTuple):
    """Indices of two geometries that pass through each other in segments `first` to `last`."""

    pair: tuple[int, int]
    first: int
    last: int


def find_crossings(
    contacts: ContactModel, states: Floats, segments: Ints, found: Contacts
) -> list[Crossing]:
    """Find pairs that overlap and separate on opposite sides: normals before and after oppose.

    A shape that enters another one and leaves it on the same side does not count.

    Args:
        contacts: Contact model.
        states: Configurations along a motion, shape (S, n).
        segments: Segment of each configuration, from 0, shape (S,).
        found: Close pairs at the configurations.
    """
    overlapping = found.select(np.flatnonzero(found.distance < 0.0))
    if not len(overlapping.waypoint):
        return []
    order = np.lexsort((overlapping.waypoint, overlapping.pair[:, 1], overlapping.pair[:, 0]))
    rows, pairs = overlapping.waypoint[order], overlapping.pair[order]
    is_last = np.append((np.diff(rows) != 1) | (np.diff(pairs, axis=0) != 0).any(axis=1), True)
    ends = np.flatnonzero(is_last)
    begins = np.append(0, ends[:-1] + 1)
    before, after, pairs = rows[begins] - 1, rows[ends] + 1, pairs[begins]
    phases = contacts.find_phases(segments + 1)
    inside = np.flatnonzero((before >= 0) & (after < len(states)))
    # Geometry indices are valid within one phase only.
    inside = inside[phases[before[inside]] == phases[after[inside]]]
    before, after, pairs = before[inside], after[inside], pairs[inside]
    normals = (
        contacts.compute_normals(states[rows], segments[rows] + 1, pairs)
        for rows in (before, after)
    )
    through = np.flatnonzero(np.einsum("ci,ci->c", *normals) < 0.0)
    return [
        Crossing((int(pairs[k, 0]), int(pairs[k, 1])), int(first), int(last))
        for k, first, last in zip(
            through, segments[before[through]], segments[after[through]], strict=True
        )
    ]


def find_new_crossings(crossings: Sequence[Crossing], before: Sequence[Crossing]) -> list[Crossing]:
    """Return the crossings of pairs without any crossing `before`."""
    known = {crossing.pair for crossing in before}
    return [crossing for crossing in crossings if crossing.pair not in known]
