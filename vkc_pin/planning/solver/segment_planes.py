"""Turns collisions between waypoints into witness planes at both ends of the segment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.chain.contacts import ContactModel, Contacts, make_empty_contacts
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
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
    before, after, pairs = _find_overlap_ends(overlapping)
    phases = contacts.find_phases(segments + 1)
    inside = np.flatnonzero((before >= 0) & (after < len(states)))
    # Geometry indices are valid within one phase only.
    inside = inside[phases[before[inside]] == phases[after[inside]]]
    before = before[inside]
    after = after[inside]
    pairs = pairs[inside]
    normals_before = contacts.compute_normals(states[before], segments[before] + 1, pairs)
    normals_after = contacts.compute_normals(states[after], segments[after] + 1, pairs)
    cosines = np.einsum("ci,ci->c", normals_before, normals_after)
    crossings = []
    for k in np.flatnonzero(cosines < 0.0):
        pair = (int(pairs[k, 0]), int(pairs[k, 1]))
        crossings.append(Crossing(pair, int(segments[before[k]]), int(segments[after[k]])))
    return crossings


def _find_overlap_ends(overlapping: Contacts) -> tuple[Ints, Ints, Ints]:
    """Return the states before and after each run of consecutive overlaps of a pair, and the pair.

    Returns:
        Rows before and after the R runs, shape (R,) each, and pairs, shape (R, 2).
    """
    order = np.lexsort((overlapping.waypoint, overlapping.pair[:, 1], overlapping.pair[:, 0]))
    rows = overlapping.waypoint[order]
    pairs = overlapping.pair[order]
    is_interrupted = np.diff(rows) != 1
    is_other_pair = (np.diff(pairs, axis=0) != 0).any(axis=1)
    ends = np.flatnonzero(np.append(is_interrupted | is_other_pair, True))
    begins = np.append(0, ends[:-1] + 1)
    return rows[begins] - 1, rows[ends] + 1, pairs[begins]


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


def find_segment_contacts(problem: KinematicProblem, z: Floats) -> SegmentContacts:
    """Find close pairs within segments and express them as contacts at the adjacent waypoints.

    Only the deepest sample of each segment and pair counts. See `_transfer_to_waypoints`.

    Args:
        problem: Problem.
        z: z_1..z_N, shape (N, n).
    """
    path = problem.waypoints(z)
    contacts = problem.contacts.with_released_objects(z)
    reach = SEGMENT_MARGIN + REFINEMENT_RANGE
    largest_changes = np.abs(np.diff(path, axis=0)).max(axis=1)
    counts = np.maximum(np.ceil(largest_changes / SPACING).astype(int), 1)
    segment = np.repeat(np.arange(len(z)), counts)
    piece = np.arange(len(segment)) - np.searchsorted(segment, segment)
    # Check the middle of each piece first, and refine only the pieces that are close to something.
    middles, waypoints = _interpolate_states(path, segment, (piece + 0.5) / counts[segment])
    near = contacts.evaluate(middles, waypoints, reach=reach)
    crossings = find_crossings(contacts, middles, segment, near)
    rows = np.unique(near.waypoint)
    if not len(rows):
        return SegmentContacts(make_empty_contacts(), True, [])
    segment = segment[rows]
    begin = piece[rows] / counts[segment]
    length = 1 / counts[segment]
    fractions = np.arange(REFINEMENT) + 0.5
    s = (begin[:, None] + length[:, None] * fractions / REFINEMENT).ravel()
    segment = np.repeat(segment, REFINEMENT)
    states, waypoints = _interpolate_states(path, segment, s)
    found = _select_deepest(contacts.evaluate(states, waypoints, reach=reach), segment)
    # The start may be close to something, so only collisions count in the first segment.
    found = found.select(np.flatnonzero((segment[found.waypoint] > 0) | (found.distance < 0)))
    margin = np.minimum(SEGMENT_MARGIN, found.margin)
    is_free = bool(np.all(found.distance >= np.minimum(CLEARANCE_TOLERANCE, margin)))
    transferred = _transfer_to_waypoints(problem, contacts, path, states, segment, found, margin)
    return SegmentContacts(transferred, is_free, crossings)


def _transfer_to_waypoints(
    problem: KinematicProblem,
    contacts: ContactModel,
    path: Floats,
    states: Floats,
    segment: Ints,
    found: Contacts,
    margin: Floats,
) -> Contacts:
    """Return contacts at z_1..z_N whose planes keep samples within segments apart.

    At a sample (1 − s)·z_t + s·z_{t+1} with distance d and margin m, the witness points a and b,
    fixed in their bodies, are transferred to both waypoints. There n·(b − a) has some value v.
    Requiring v + m − d at both waypoints lifts the sample by m − d, to first order: n·(b − a) grows
    there by (1 − s) times its growth at z_t plus s times that at z_{t+1}.

    Args:
        problem: Problem.
        contacts: Contact model.
        path: z_0..z_N, shape (N + 1, n).
        states: Samples, shape (S, n).
        segment: Segment of each sample, shape (S,).
        found: Contacts of the samples, C of them.
        margin: Margin m of each contact, shape (C,) [m].
    """
    first_joint, second_joint = contacts.get_joints(found.pair).T
    contact = np.arange(len(margin))
    R, p = contacts.compute_placements(states[found.waypoint])
    # Witness points in the frames of their bodies, Rᵀ(a − p).
    to_first = found.first - p[contact, first_joint]
    to_second = found.second - p[contact, second_joint]
    first_local = np.einsum("cji,cj->ci", R[contact, first_joint], to_first)
    second_local = np.einsum("cji,cj->ci", R[contact, second_joint], to_second)
    R, p = problem.chain.joint_placements(path)
    parts = []
    for offset in (0, 1):
        t = segment[found.waypoint] + offset
        first = np.einsum("cij,cj->ci", R[t, first_joint], first_local) + p[t, first_joint]
        second = np.einsum("cij,cj->ci", R[t, second_joint], second_local) + p[t, second_joint]
        value = np.einsum("ci,ci->c", found.normal, second - first)
        required = value + margin - found.distance
        part = Contacts(t - 1, found.pair, value, required, found.normal, first, second)
        parts.append(part.select(np.flatnonzero(t > 0)))  # the start is fixed
    return merge_contacts(*parts)


def _interpolate_states(path: Floats, segment: Ints, s: Floats) -> tuple[Floats, Ints]:
    """Return states at 0 < s < 1 of segments, and the waypoints that determine their phases."""
    s = s[:, None]
    states = (1 - s) * path[segment] + s * path[segment + 1]
    return states, segment + 1


def _select_deepest(found: Contacts, segment: Ints) -> Contacts:
    """Return the contact of smallest distance for each segment and pair."""
    shapes = int(found.pair.max(initial=0)) + 1
    keys = (segment[found.waypoint] * shapes + found.pair[:, 0]) * shapes + found.pair[:, 1]
    order = np.lexsort((found.distance, keys))
    is_first_of_key = np.diff(keys[order], prepend=-1) > 0
    return found.select(order[is_first_of_key])


def merge_contacts(*parts: Contacts) -> Contacts:
    """Concatenate contacts and sort them by waypoint, largest margin violation first."""
    arrays = zip(*[part.arrays() for part in parts], strict=True)
    merged = Contacts(*[np.concatenate(parts_of_array) for parts_of_array in arrays])
    violation_order = merged.distance - merged.margin
    return merged.select(np.lexsort((violation_order, merged.waypoint)))
