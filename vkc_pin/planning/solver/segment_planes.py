"""Continuous refinement: what collides between two waypoints becomes planes at both of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts, make_empty_contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLOSE_ENOUGH
from vkc_pin.planning.solver.tunnelling import Passage, passages
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["Between", "collisions_between", "merge"]

SPACING = 0.02  # [m] or [rad] between the states looked at first, in the coordinate that moves most
KEEP = 1e-2  # [m] clearance asked for between waypoints
CLOSE = 0.015  # [m] beyond `KEEP` within which a state is looked at closer
FINER = 4  # states there instead of one


class Between(NamedTuple):
    """What is close between waypoints.

    Attributes:
        contacts: At z_1..z_N. Their margin exceeds their distance by what is missing in between, or
            falls below it by what is to spare: they guard against what is close already.
        free: Whether no sub-state is closer than `CLOSE_ENOUGH`.
        passages: What goes through each other.
    """

    contacts: Contacts
    free: bool
    passages: list[Passage]


def collisions_between(problem: TrajectoryProblem, z: Floats) -> Between:
    """Return contacts at waypoints that stand for closeness inside the segments around them.

    At a sub-state (1 − s)·z_t + s·z_{t+1} with distance d < KEEP (or than the pair's margin, where
    that is less), the witness points, fixed in their bodies, are carried to both waypoints. There
    n·(b − a) has some value v; asking for v + KEEP − d at both lifts the sub-state by KEEP − d, to
    first order. Of each segment and pair only the deepest sub-state counts.

    Args:
        problem: The problem.
        z: z_1..z_N, shape (N, n).
    """
    path, contacts = problem.waypoints(z), problem.contacts.with_released_objects(z)
    counts = np.maximum(np.ceil(np.abs(np.diff(path, axis=0)).max(axis=1) / SPACING).astype(int), 1)
    segment = np.repeat(np.arange(len(z)), counts)
    piece = np.arange(len(segment)) - np.searchsorted(segment, segment)
    # The middles of the pieces first, and of pieces that something is close to the rest.
    middles, waypoints = _states(path, segment, (piece + 0.5) / counts[segment])
    near = contacts.evaluate(middles, waypoints, reach=KEEP + CLOSE)
    passed = passages(contacts, middles, segment, near)
    rows = np.unique(near.waypoint)
    segment, begin, length = (
        segment[rows],
        piece[rows] / counts[segment[rows]],
        1 / counts[segment[rows]],
    )
    if not len(rows):
        return Between(make_empty_contacts(), True, [])
    segment = np.repeat(segment, FINER)
    s = (begin[:, None] + length[:, None] * (np.arange(FINER) + 0.5) / FINER).ravel()
    states, waypoints = _states(path, segment, s)
    found = _deepest(contacts.evaluate(states, waypoints, reach=KEEP + CLOSE), segment)
    # A start that is close to something leaves it as it can: only what collides on the way counts.
    found = found.select(np.flatnonzero((segment[found.waypoint] > 0) | (found.distance < 0)))
    keep = np.minimum(KEEP, found.margin)
    joints = contacts.get_joints(found.pair)
    rotations, translations = contacts.compute_placements(states[found.waypoint])
    ends = problem.chain.joint_placements(path)
    parts = []
    for offset in (0, 1):
        waypoint = segment[found.waypoint] + offset
        points = []
        for column, witness in ((0, found.first), (1, found.second)):
            j, contact = joints[:, column], np.arange(len(joints))
            local = np.einsum(
                "cji,cj->ci", rotations[contact, j], witness - translations[contact, j]
            )
            points.append(
                np.einsum("cij,cj->ci", ends[0][waypoint, j], local) + ends[1][waypoint, j]
            )
        value = np.einsum("ci,ci->c", found.normal, points[1] - points[0])
        inside = waypoint > 0  # the start cannot be moved
        part = Contacts(
            waypoint - 1,
            found.pair,
            value,
            value + keep - found.distance,
            found.normal,
            points[0],
            points[1],
        )
        parts.append(part.select(np.flatnonzero(inside)))
    return Between(
        merge(*parts), bool(np.all(found.distance >= np.minimum(CLOSE_ENOUGH, keep))), passed
    )


def _states(path: Floats, segment: Ints, s: Floats) -> tuple[Floats, Ints]:
    """Return the states at 0 < s < 1 of segments, and the waypoints whose phases they belong to."""
    share = s[:, None]
    return (1 - share) * path[segment] + share * path[segment + 1], segment + 1


def _deepest(found: Contacts, segment: Ints) -> Contacts:
    """Return the contact of smallest distance for each segment and pair."""
    shapes = int(found.pair.max(initial=0)) + 1
    keys = (segment[found.waypoint] * shapes + found.pair[:, 0]) * shapes + found.pair[:, 1]
    order = np.lexsort((found.distance, keys))
    return found.select(order[np.diff(keys[order], prepend=-1) > 0])


def merge(*parts: Contacts) -> Contacts:
    """Return all contacts of `parts`, per waypoint those first that fall shortest of their margins."""
    joined = Contacts(
        *(np.concatenate(arrays) for arrays in zip(*(part.arrays() for part in parts), strict=True))
    )
    return joined.select(np.lexsort((joined.distance - joined.margin, joined.waypoint)))
