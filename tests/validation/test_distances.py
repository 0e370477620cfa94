"""Distances of a world's shapes: bounds that hold, and what is nearest, against coal asked about everything."""

from __future__ import annotations

import itertools
from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import door_scene, full_scene, random_configurations

from vkc_pin.validation.distances import POINT_RADIUS, CollisionShapes
from vkc_pin.world.models.shapes import compute_shape_distance
from vkc_pin.world.trajectory.world_model import World

COAL = 1e-5  # [m]


@cache
def solids() -> CollisionShapes:
    return CollisionShapes(World(full_scene()))


def configuration(seed: int) -> np.ndarray:
    world, rng = solids().world, np.random.default_rng(seed)
    lower, upper = (np.full(world.coordinates.size, limit) for limit in (-1.0, 1.0))
    return np.asarray(world.coordinates.q(random_configurations(lower, upper, 1, rng)[0]))


def where(q: np.ndarray) -> list[pin.SE3]:
    """Return where all shapes are, by Pinocchio."""
    world = solids().world
    placed = pin.GeometryData(world.collision)
    pin.updateGeometryPlacements(world.model, world.model.createData(), world.collision, placed, q)
    return list(placed.oMg)


@pytest.mark.parametrize("seed", range(3))
def test_bounds_hold_and_the_nearest_is_the_nearest(seed: int) -> None:
    shapes, q = solids().world.shapes, configuration(seed)
    placed, at = solids().place(q[None]), where(q)
    pairs = np.array(
        [
            (a, b)
            for a, b in itertools.combinations(range(len(shapes)), 2)
            if a < solids().body_count
        ]
    )
    pairs = pairs[np.random.default_rng(seed).permutation(len(pairs))[:400]]
    first = np.zeros(len(pairs), int)
    expected = np.array(
        [
            compute_shape_distance(shapes[a].geometry, at[a], shapes[b].geometry, at[b])
            for a, b in pairs.tolist()
        ]
    )
    np.testing.assert_allclose(placed.compute_distances(first, pairs), expected, atol=COAL)
    bounds = placed.compute_lower_bounds(first, pairs)
    assert (bounds <= expected + COAL).all()
    assert np.isfinite(bounds).mean() > 0.8, "and most say something"
    ((best,), (least,)) = placed.find_nearest(pairs)
    assert least == pytest.approx(expected.min(), abs=COAL)
    assert expected[best] == pytest.approx(least, abs=COAL)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_around_a_point(seed: int) -> None:
    q, rng = configuration(seed), np.random.default_rng(seed)
    placed, at = solids().place(q[None]), where(q)
    counted = 0
    for point in [at[0].translation + rng.normal(scale=0.3, size=3) for _ in range(5)]:
        ball, here = coal.Sphere(POINT_RADIUS), pin.SE3(np.eye(3), point)
        distances = [
            compute_shape_distance(ball, here, shape.geometry, at[k])
            for k, shape in enumerate(solids().world.shapes)
        ]
        near = [k for k, distance in enumerate(distances) if distance < 0.2]
        assert placed.find_shapes_near(point, 0.2) == near
        counted += len(near)
    assert counted > 0


def test_many_configurations_are_as_one_by_one() -> None:
    q = np.array([configuration(seed) for seed in range(6)])
    together, count = solids().place(q), solids().body_count
    pairs = np.array(
        [(a, b) for a in range(count) for b in range(count, len(solids().world.shapes))]
    )
    which, distances = together.find_nearest(pairs)
    for state, row in enumerate(q):
        alone, none = solids().place(row[None]), np.zeros(len(pairs), int)
        np.testing.assert_array_equal(
            alone.find_nearest(pairs), ([which[state]], [distances[state]])
        )
        np.testing.assert_array_equal(
            alone.compute_distances(none, pairs), together.compute_distances(none + state, pairs)
        )
        np.testing.assert_array_equal(
            alone.compute_lower_bounds(none, pairs),
            together.compute_lower_bounds(none + state, pairs),
        )
        for one, other in zip(alone.corners, together.corners, strict=True):
            np.testing.assert_array_equal(one[0], other[state])


def test_only_what_may_be_nearest_is_asked_of_coal(monkeypatch: pytest.MonkeyPatch) -> None:
    """What bounds show to be further away than another is not looked at, even where they are wrong."""
    mine = CollisionShapes(World(door_scene()))
    pairs = np.array(
        [
            (a, b)
            for a in range(mine.body_count)
            for b in range(mine.body_count, len(mine.world.shapes))
        ]
    )
    placed = mine.place(mine.world.coordinates.q(np.zeros((1, mine.world.coordinates.size))))
    distances = placed.compute_distances(np.zeros(len(pairs), int), pairs)
    (best,), _ = placed.find_nearest(pairs)
    assert distances[best] == distances.min()
    wrong = int(np.argmax(distances))
    bounds = np.where(np.arange(len(pairs)) == wrong, 0.0, distances[wrong] + 1.0)
    monkeypatch.setattr(placed, "compute_lower_bounds", lambda *_: bounds)
    assert placed.find_nearest(pairs)[0].tolist() == [wrong]
