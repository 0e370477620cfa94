"""Tests the search for close bounding boxes between two states."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.collision.boxes import WorldBoxes


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
