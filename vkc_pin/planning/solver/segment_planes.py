"""Turns collisions between waypoints into witness planes at both ends of the segment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.chain.contacts import ContactModel, Contacts, make_empty_contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats, Ints

SPACING = 0.02  # [m] or [rad] between the first samples, in the coordinate that moves most
SEGMENT_MARGIN = 1e-2  # [m] clearance required between waypoints
REFINEMENT_RANGE = 0.015  # [m] beyond `SEGMENT_MARGIN` within which samples are refined
REFINEMENT = 4  # samples that replace one


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


class SegmentContacts(NamedTuple):
    """Close pairs between waypoints.

    Attributes:
        contacts: Equivalent contacts at z_1..z_N. Margin minus distance is the clearance that the
            segment lacks; it is negative for pairs that are far enough apart.
        is_free: Whether no sample is closer than `CLEARANCE_TOLERANCE`.
        crossings: Pairs that pass through each other.
    """

    contacts: Contacts
    is_free: bool
    crossings: list[Crossing]


def find_segment_contacts(problem: TrajectoryProblem, z: Floats) -> SegmentContacts:
    """Find close pairs within segments and express them as contacts at the adjacent waypoints.

    At a sample (1 − s)·z_t + s·z_{t+1} with distance d < m, m being `SEGMENT_MARGIN` or the pair's
    margin if that is less, the witness points, fixed in their bodies, are transferred to both
    waypoints. There n·(b − a) has some value v. Requiring v + m − d at both waypoints lifts the
    sample by m − d, to first order. Only the deepest sample of each segment and pair counts.

    Args:
        problem: Problem.
        z: z_1..z_N, shape (N, n).
    """
    path, contacts = problem.waypoints(z), problem.contacts.with_released_objects(z)
    counts = np.maximum(np.ceil(np.abs(np.diff(path, axis=0)).max(axis=1) / SPACING).astype(int), 1)
    segment = np.repeat(np.arange(len(z)), counts)
    piece = np.arange(len(segment)) - np.searchsorted(segment, segment)
    # Check the middle of each piece first, and refine only the pieces that are close to something.
    middles, waypoints = _interpolate_states(path, segment, (piece + 0.5) / counts[segment])
    near = contacts.evaluate(middles, waypoints, reach=SEGMENT_MARGIN + REFINEMENT_RANGE)
    crossings = find_crossings(contacts, middles, segment, near)
    rows = np.unique(near.waypoint)
    if not len(rows):
        return SegmentContacts(make_empty_contacts(), True, [])
    segment, piece = segment[rows], piece[rows]
    begin, length = piece / counts[segment], 1 / counts[segment]
    segment = np.repeat(segment, REFINEMENT)
    s = (begin[:, None] + length[:, None] * (np.arange(REFINEMENT) + 0.5) / REFINEMENT).ravel()
    states, waypoints = _interpolate_states(path, segment, s)
    found = _select_deepest(
        contacts.evaluate(states, waypoints, reach=SEGMENT_MARGIN + REFINEMENT_RANGE), segment
    )
    # The start may be close to something, so only collisions count in the first segment.
    found = found.select(np.flatnonzero((segment[found.waypoint] > 0) | (found.distance < 0)))
    margin = np.minimum(SEGMENT_MARGIN, found.margin)
    joints, contact = contacts.get_joints(found.pair).T, np.arange(len(margin))
    R, p = contacts.compute_placements(states[found.waypoint])
    witnesses = [  # in the frames of their bodies
        (j, np.einsum("cji,cj->ci", R[contact, j], point - p[contact, j]))
        for j, point in zip(joints, (found.first, found.second), strict=True)
    ]
    R, p = problem.chain.joint_placements(path)
    parts = []
    for offset in (0, 1):
        t = segment[found.waypoint] + offset
        first, second = (
            np.einsum("cij,cj->ci", R[t, j], local) + p[t, j] for j, local in witnesses
        )
        value = np.einsum("ci,ci->c", found.normal, second - first)
        required = value + margin - found.distance
        part = Contacts(t - 1, found.pair, value, required, found.normal, first, second)
        parts.append(part.select(np.flatnonzero(t > 0)))  # the start is fixed
    is_free = bool(np.all(found.distance >= np.minimum(CLEARANCE_TOLERANCE, margin)))
    return SegmentContacts(merge_contacts(*parts), is_free, crossings)


def _interpolate_states(path: Floats, segment: Ints, s: Floats) -> tuple[Floats, Ints]:
    """Return states at 0 < s < 1 of segments, and the waypoints that determine their phases."""
    s = s[:, None]
    return (1 - s) * path[segment] + s * path[segment + 1], segment + 1


def _select_deepest(found: Contacts, segment: Ints) -> Contacts:
    """Return the contact of smallest distance for each segment and pair."""
    shapes = int(found.pair.max(initial=0)) + 1
    keys = (segment[found.waypoint] * shapes + found.pair[:, 0]) * shapes + found.pair[:, 1]
    order = np.lexsort((found.distance, keys))
    return found.select(order[np.diff(keys[order], prepend=-1) > 0])


def merge_contacts(*parts: Contacts) -> Contacts:
    """Concatenate contacts and sort them by waypoint, largest margin violation first."""
    arrays = zip(*(part.arrays() for part in parts), strict=True)
    merged = Contacts(*map(np.concatenate, arrays))
    return merged.select(np.lexsort((merged.distance - merged.margin, merged.waypoint)))
