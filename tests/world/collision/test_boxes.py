"""Tests the search for close bounding boxes against coal and an exhaustive search."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.collision.boxes import Boxes, WorldBoxes

JOINTS, MOVING, FIXED, STATES = 3, 6, 8, 8


def sample_rotations(rng: np.random.Generator, *shape: int) -> np.ndarray:
    count = int(np.prod(shape))
    return np.reshape([pin.exp3(rng.normal(size=3)) for _ in range(count)], (*shape, 3, 3))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 0.3, 10.0]), st.booleans())
def test_close_pairs_match_an_exhaustive_search(seed: int, reach: float, with_fixed: bool) -> None:
    """No pair of close boxes is missed, and bounds are lower bounds of distances."""
    rng, count = np.random.default_rng(seed), MOVING + FIXED
    joints = np.concatenate([rng.integers(1, JOINTS + 1, MOVING), np.zeros(FIXED, int)])
    rotations, centers = sample_rotations(rng, count), rng.uniform(-1.0, 1.0, (count, 3))
    halves = rng.uniform(0.02, 0.3, (count, 3))
    pairs = np.array([(a, b) for a, b in itertools.combinations(range(count), 2) if a < MOVING])
    joint_rotations = sample_rotations(rng, STATES, JOINTS + 1)
    joint_translations = rng.uniform(-1.0, 1.0, (STATES, JOINTS + 1, 3))
    joint_rotations[:, 0], joint_translations[:, 0] = np.eye(3), 0.0
    rows, found, bounds = Boxes(joints, rotations, centers, halves, pairs).find_close_pairs(
        reach, joint_rotations, joint_translations, include_fixed=with_fixed
    )
    assert (np.diff(rows * len(pairs) + found) > 0).all(), "not strictly sorted"
    assert (bounds < reach).all()
    included = np.ones(len(pairs), bool) if with_fixed else joints[pairs[:, 1]] != 0
    assert included[found].all()
    shapes, request = [coal.Box(*(2.0 * half)) for half in halves], coal.DistanceRequest()
    distances = np.empty((STATES, len(pairs)))
    for w in range(STATES):
        turns, shifts = joint_rotations[w, joints], joint_translations[w, joints]
        positions = (turns @ centers[:, :, None])[:, :, 0] + shifts
        placed = list(zip(shapes, map(coal.Transform3s, turns @ rotations, positions), strict=True))
        for k, (a, b) in enumerate(pairs.tolist()):
            distances[w, k] = coal.distance(*placed[a], *placed[b], request, coal.DistanceResult())
    assert (bounds <= distances[rows, found] + 1e-6).all()
    close = (distances < reach - 1e-6) & included
    assert set(zip(*np.nonzero(close), strict=True)) <= set(zip(rows, found, strict=True))


def compute_gap(first: tuple[Floats, Floats], second: tuple[Floats, Floats]) -> float:
    """Return the distance of two boxes given by their corners; -inf if they overlap."""
    apart = np.maximum(second[0] - first[1], first[0] - second[1])
    return float(np.linalg.norm(np.maximum(apart, 0.0))) if apart.max() > 0.0 else -np.inf


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 40),
    st.booleans(),
    st.sampled_from([0.05, 0.5, np.inf]),
)
def test_close_pairs_between_two_states_match_an_exhaustive_search(
    seed: int, states: int, moving: bool, limit: float
) -> None:
    rng = np.random.default_rng(seed)
    lower = np.cumsum(rng.normal(0.0, 0.2, (states, 5, 3)), axis=0) + rng.uniform(-2.0, 2.0, (5, 3))
    upper = lower + rng.uniform(0.0, 0.8, (5, 3))
    fixed_lower = rng.uniform(-2.0, 2.0, (7, 3))
    fixed_upper = fixed_lower + rng.uniform(0.0, 1.0, (7, 3))
    boxes = WorldBoxes(lower, upper, fixed_lower, fixed_upper)
    all_lower, all_upper = (
        np.concatenate([own, np.broadcast_to(fixed, (states, 7, 3))], axis=1)
        for own, fixed in ((lower, fixed_lower), (upper, fixed_upper))
    )
    first = np.arange(states - moving)
    last = first + moving
    moved = np.zeros((len(first), 12))
    moved[:, :5] = rng.uniform(0.0, 0.4, (len(first), 5)) * moving
    moves = np.array([[True] * 5 + [False] * 7, [True, False, True, False, True] + [False] * 7])
    phases = (np.arange(len(first)) > len(first) // 2).astype(int)
    pairs = np.array([(i, j) for j in range(12) for i in range(min(j, 5))])
    intervals, found = boxes.find_close_pairs(
        first, last, pairs, moved=moved, moves=moves, phases=phases, limit=limit
    )
    expected = []
    for k, (a, b) in enumerate(zip(first, last, strict=True)):
        for p, (i, j) in enumerate(pairs.tolist()):
            gaps = sum(
                compute_gap((all_lower[s, i], all_upper[s, i]), (all_lower[s, j], all_upper[s, j]))
                for s in (a, b)
            )
            if moves[phases[k], [i, j]].any() and (gaps - moved[k, i] - moved[k, j]) / 2 < limit:
                expected.append((k, p))
    assert list(zip(intervals.tolist(), found.tolist(), strict=True)) == expected
