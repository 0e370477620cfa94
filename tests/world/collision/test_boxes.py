"""Tests the search for close bounding boxes against the same formulas, pair by pair."""

from __future__ import annotations

import itertools

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.collision import boxes as boxes_module
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


def rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.array([pin.exp3(rng.normal(size=3)) for _ in range(count)])


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.sampled_from([0.0, 0.02, 0.3, 10.0]), st.booleans())
def test_close_pairs_are_found_with_their_bounds(seed: int, reach: float, standing: bool) -> None:
    """Bounds follow the formula, and no pair with points that are close is missed."""
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
    if reach == 10.0:  # larger than any distance
        assert len(at) == STATES * counts.sum()
    close = {
        (w, k)
        for w, k in itertools.product(range(STATES), np.flatnonzero(counts).tolist())
        if has_close_points(room, w, k, reach)
    }
    assert close <= set(zip(at.tolist(), pairs.tolist(), strict=True))


def has_close_points(room: Room, w: int, k: int, reach: float) -> bool:
    """Return whether a sampled point of the first box is within `reach` of the second."""
    (a, b), joints = room.pairs[k], room.joints
    turns = [room.turned[w, joints[g]] @ room.rotations[g] for g in (a, b)]
    centers = [
        room.turned[w, joints[g]] @ room.centers[g] + room.moved[w, joints[g]] for g in (a, b)
    ]
    grid = np.array(list(itertools.product([-1.0, -0.5, 0.0, 0.5, 1.0], repeat=3))) * room.halves[a]
    inside = (grid @ turns[0].T + centers[0] - centers[1]) @ turns[1]
    away = np.linalg.norm(np.maximum(np.abs(inside) - room.halves[b], 0.0), axis=1)
    return bool(away.min() < reach - 1e-9)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_results_do_not_depend_on_threads_or_batch_size(seed: int) -> None:
    room = Room(seed)
    expected = room.boxes(1).find_close_pairs(0.1, room.turned, room.moved)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(boxes_module, "_MIN_ROWS_PER_THREAD", 1)
        for one, other in zip(
            expected, room.boxes(3).find_close_pairs(0.1, room.turned, room.moved), strict=True
        ):
            np.testing.assert_array_equal(one, other)
    alone = [
        room.boxes().find_close_pairs(0.1, room.turned[[w]], room.moved[[w]]) for w in range(STATES)
    ]
    np.testing.assert_array_equal(np.concatenate([pairs for _, pairs, _ in alone]), expected[1])
    np.testing.assert_array_equal(np.concatenate([bounds for _, _, bounds in alone]), expected[2])


def test_fixed_boxes_can_be_moved() -> None:
    room, rng = Room(3), np.random.default_rng(4)
    boxes, which = room.boxes(), np.array([MOVING + 2, MOVING + 5])
    before = boxes.find_close_pairs(0.2, room.turned, room.moved)
    room.rotations[which], room.centers[which] = rotations(rng, 2), rng.uniform(-1.0, 1.0, (2, 3))
    moved = boxes.move_fixed(which, room.rotations[which], room.centers[which])
    for one, other in zip(
        moved.find_close_pairs(0.2, room.turned, room.moved),
        room.boxes().find_close_pairs(0.2, room.turned, room.moved),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(
        boxes.find_close_pairs(0.2, room.turned, room.moved), before, strict=True
    ):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(IndexError, match="stands"):
        boxes.move_fixed(np.array([0]), np.eye(3)[None], np.zeros((1, 3)))


def test_empty_input_gives_empty_output() -> None:
    room = Room(0)
    for found in room.boxes().find_close_pairs(0.1, room.turned[:0], room.moved[:0]):
        assert found.shape == (0,)
    nothing = Boxes(
        np.zeros(0, int),
        np.zeros((0, 3, 3)),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        np.zeros((0, 2), int),
    )
    for found in nothing.find_close_pairs(0.1, room.turned, room.moved):
        assert found.shape == (0,)


def test_invalid_arrays_raise() -> None:
    room = Room(0)
    with pytest.raises(ValueError, match="first"):
        Boxes(room.joints[::-1].copy(), room.rotations, room.centers, room.halves, room.pairs)
    for wrong in ([[MOVING, 0]], [[0, MOVING + STANDING]], [[-1, 2]]):
        with pytest.raises(IndexError, match="first moves"):
            Boxes(room.joints, room.rotations, room.centers, room.halves, np.array(wrong))
    with pytest.raises(ValueError, match="shapes"):
        Boxes(room.joints, room.rotations, room.centers[:3], room.halves, room.pairs)
    with pytest.raises(IndexError, match="joint"):
        room.boxes().find_close_pairs(0.1, room.turned[:, :2].copy(), room.moved[:, :2].copy())
    with pytest.raises(ValueError, match="shapes"):
        room.boxes().find_close_pairs(0.1, room.turned, room.moved[:3])
