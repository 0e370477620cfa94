"""Tests the search for close bounding boxes against the same formulas, pair by pair."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.collision.boxes import Boxes

SEEDS = st.integers(0, 2**32 - 1)
JOINTS, MOVING, STANDING, STATES = 3, 6, 8, 12


class Room:
    """Random boxes on joints and in the world, at random joint placements."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        count = MOVING + STANDING
        self.joints = np.concatenate([rng.integers(1, JOINTS + 1, MOVING), np.zeros(STANDING, int)])
        self.rotations, self.halves = rotations(rng, count), rng.uniform(0.02, 0.3, (count, 3))
        self.centers = rng.uniform(-1.0, 1.0, (count, 3))
        pairs = [(a, b) for a, b in itertools.combinations(range(count), 2) if a < MOVING]
        self.pairs = np.array(pairs)[np.sort(rng.permutation(len(pairs))[: len(pairs) // 2])]
        self.turned, self.moved = (
            rotations(rng, STATES * (JOINTS + 1)),
            rng.uniform(-1.0, 1.0, (STATES, JOINTS + 1, 3)),
        )
        self.turned = self.turned.reshape(STATES, JOINTS + 1, 3, 3)
        self.turned[:, 0], self.moved[:, 0] = np.eye(3), 0.0

    def boxes(self, threads: int | None = None) -> Boxes:
        return Boxes(
            self.joints, self.rotations, self.centers, self.halves, self.pairs, threads=threads
        )

    def gaps(self) -> np.ndarray:
        """Return the separation of every pair along face normals, shape (W, P) [m]."""
        out = np.empty((STATES, len(self.pairs)))
        for w in range(STATES):
            turns = self.turned[w, self.joints] @ self.rotations
            centers = (
                np.einsum("gij,gj->gi", self.turned[w, self.joints], self.centers)
                + self.moved[w, self.joints]
            )
            for k, (a, b) in enumerate(self.pairs.tolist()):
                axes = np.concatenate([turns[a].T, turns[b].T])
                reach = (
                    np.abs(axes @ turns[a]) @ self.halves[a]
                    + np.abs(axes @ turns[b]) @ self.halves[b]
                )
                out[w, k] = (np.abs(axes @ (centers[b] - centers[a])) - reach).max()
        return out

    def distances(self) -> np.ndarray:
        """Return the distance of every pair by coal, shape (W, P) [m]."""
        shapes, request = [coal.Box(*(2.0 * half)) for half in self.halves], coal.DistanceRequest()
        out = np.empty((STATES, len(self.pairs)))
        for w in range(STATES):
            turns = self.turned[w, self.joints]
            centers = (turns @ self.centers[:, :, None])[:, :, 0] + self.moved[w, self.joints]
            places = [*map(coal.Transform3s, turns @ self.rotations, centers)]
            for k, (a, b) in enumerate(self.pairs.tolist()):
                out[w, k] = coal.distance(
                    shapes[a], places[a], shapes[b], places[b], request, coal.DistanceResult()
                )
        return out


def rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.array([pin.exp3(rng.normal(size=3)) for _ in range(count)])


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.sampled_from([0.0, 0.02, 0.3, 10.0]), st.booleans())
def test_close_pairs_match_an_exhaustive_search(seed: int, reach: float, standing: bool) -> None:
    """Bounds follow the formula, and no pair of boxes that are close is missed."""
    room = Room(seed)
    gaps = room.gaps()
    at, pairs, bounds = room.boxes().find_close_pairs(
        reach, room.turned, room.moved, include_fixed=standing
    )
    assert (np.diff(at * len(room.pairs) + pairs) > 0).all(), "not strictly sorted"
    np.testing.assert_allclose(bounds, gaps[at, pairs], rtol=0.0, atol=1e-12)
    assert (bounds < reach).all()
    counts = np.ones(len(room.pairs), bool) if standing else room.joints[room.pairs[:, 1]] != 0
    assert counts[pairs].all()
    close = (room.distances() < reach - 1e-6) & counts
    assert set(zip(*np.nonzero(close), strict=True)) <= set(zip(at, pairs, strict=True))
