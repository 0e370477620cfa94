"""Which boxes may be close, against the same formulas for every pair, one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.collision import boxes as looking
from vkc_pin.world.collision.boxes import Boxes

SEEDS = st.integers(0, 2**32 - 1)
JOINTS, MOVING, STANDING, STATES = 3, 6, 8, 12


class Room:
    """Random boxes on joints and in the world, and joints that are anywhere."""

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
        """Return by how much face normals separate every pair, shape (W, P) [m]."""
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
def test_what_may_be_close(seed: int, reach: float, standing: bool) -> None:
    """What is kept has the bounds of the formula; what is close, as some points of it show, is kept."""
    room = Room(seed)
    gaps = room.gaps()
    at, pairs, bounds = room.boxes().near(reach, room.turned, room.moved, standing=standing)
    assert (np.diff(at * len(room.pairs) + pairs) > 0).all(), "in order, none twice"
    np.testing.assert_allclose(bounds, gaps[at, pairs], rtol=0.0, atol=1e-12)
    assert (bounds < reach).all()
    counts = np.ones(len(room.pairs), bool) if standing else room.joints[room.pairs[:, 1]] != 0
    assert counts[pairs].all()
    if reach == 10.0:  # nothing is as far as that
        assert len(at) == STATES * counts.sum()
    close = {
        (w, k)
        for w, k in itertools.product(range(STATES), np.flatnonzero(counts).tolist())
        if touch(room, w, k, reach)
    }
    assert close <= set(zip(at.tolist(), pairs.tolist(), strict=True))


def touch(room: Room, w: int, k: int, reach: float) -> bool:
    """Return whether one of many points of the first box is closer than `reach` to the second, or inside."""
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
def test_threads_and_how_many_at_once_make_no_difference(seed: int) -> None:
    room = Room(seed)
    expected = room.boxes(1).near(0.1, room.turned, room.moved)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(looking, "_WORTH", 1)
        for one, other in zip(
            expected, room.boxes(3).near(0.1, room.turned, room.moved), strict=True
        ):
            np.testing.assert_array_equal(one, other)
    alone = [room.boxes().near(0.1, room.turned[[w]], room.moved[[w]]) for w in range(STATES)]
    np.testing.assert_array_equal(np.concatenate([pairs for _, pairs, _ in alone]), expected[1])
    np.testing.assert_array_equal(np.concatenate([bounds for _, _, bounds in alone]), expected[2])


def test_what_stands_elsewhere() -> None:
    room, rng = Room(3), np.random.default_rng(4)
    boxes, which = room.boxes(), np.array([MOVING + 2, MOVING + 5])
    before = boxes.near(0.2, room.turned, room.moved)
    room.rotations[which], room.centers[which] = rotations(rng, 2), rng.uniform(-1.0, 1.0, (2, 3))
    moved = boxes.placed(which, room.rotations[which], room.centers[which])
    for one, other in zip(
        moved.near(0.2, room.turned, room.moved),
        room.boxes().near(0.2, room.turned, room.moved),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(boxes.near(0.2, room.turned, room.moved), before, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(IndexError, match="stands"):
        boxes.placed(np.array([0]), np.eye(3)[None], np.zeros((1, 3)))


def test_nothing_asked_nothing_found() -> None:
    room = Room(0)
    for found in room.boxes().near(0.1, room.turned[:0], room.moved[:0]):
        assert found.shape == (0,)
    nothing = Boxes(
        np.zeros(0, int),
        np.zeros((0, 3, 3)),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        np.zeros((0, 2), int),
    )
    for found in nothing.near(0.1, room.turned, room.moved):
        assert found.shape == (0,)


def test_wrong_numbers_are_refused() -> None:
    room = Room(0)
    with pytest.raises(ValueError, match="first"):
        Boxes(room.joints[::-1].copy(), room.rotations, room.centers, room.halves, room.pairs)
    for wrong in ([[MOVING, 0]], [[0, MOVING + STANDING]], [[-1, 2]]):
        with pytest.raises(IndexError, match="first moves"):
            Boxes(room.joints, room.rotations, room.centers, room.halves, np.array(wrong))
    with pytest.raises(ValueError, match="shapes"):
        Boxes(room.joints, room.rotations, room.centers[:3], room.halves, room.pairs)
    with pytest.raises(IndexError, match="joint"):
        room.boxes().near(0.1, room.turned[:, :2].copy(), room.moved[:, :2].copy())
    with pytest.raises(ValueError, match="shapes"):
        room.boxes().near(0.1, room.turned, room.moved[:3])
