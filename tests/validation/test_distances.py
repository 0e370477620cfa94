"""Tests distances of a world's shapes, and their bounds, against coal."""

from __future__ import annotations

import itertools
from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import make_full_scene, sample_configurations

from vkc_pin.validation.distances import POINT_RADIUS, CollisionShapes
from vkc_pin.world.models.shapes import compute_shape_distance
from vkc_pin.world.trajectory.world_model import World

COAL = 1e-5  # accuracy of coal's distances [m]


@cache
def make_shapes() -> CollisionShapes:
    return CollisionShapes(World(make_full_scene()))


def sample_configuration(seed: int) -> np.ndarray:
    world, rng = make_shapes().world, np.random.default_rng(seed)
    lower, upper = (np.full(world.coordinates.size, limit) for limit in (-1.0, 1.0))
    return np.asarray(world.coordinates.q(sample_configurations(lower, upper, 1, rng)[0]))


def place_shapes(q: np.ndarray) -> list[pin.SE3]:
    world = make_shapes().world
    placed = pin.GeometryData(world.collision)
    pin.updateGeometryPlacements(world.model, world.model.createData(), world.collision, placed, q)
    return list(placed.oMg)


@pytest.mark.parametrize("seed", range(3))
def test_distances_and_nearest_pair_agree_with_coal(seed: int) -> None:
    shapes, q = make_shapes().world.shapes, sample_configuration(seed)
    placed, at = make_shapes().place(q[None]), place_shapes(q)
    pairs = np.array(
        [
            (a, b)
            for a, b in itertools.combinations(range(len(shapes)), 2)
            if a < make_shapes().body_count
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
    assert np.isfinite(bounds).mean() > 0.8, "most bounds must be finite"
    ((best,), (least,)) = placed.find_nearest(pairs)
    assert least == pytest.approx(expected.min(), abs=COAL)
    assert expected[best] == pytest.approx(least, abs=COAL)


@pytest.mark.parametrize("seed", range(3))
def test_shapes_near_a_point_are_found(seed: int) -> None:
    q, rng = sample_configuration(seed), np.random.default_rng(seed)
    placed, at = make_shapes().place(q[None]), place_shapes(q)
    counted = 0
    for point in [at[0].translation + rng.normal(scale=0.3, size=3) for _ in range(5)]:
        ball, here = coal.Sphere(POINT_RADIUS), pin.SE3(np.eye(3), point)
        distances = [
            compute_shape_distance(ball, here, shape.geometry, at[k])
            for k, shape in enumerate(make_shapes().world.shapes)
        ]
        near = [k for k, distance in enumerate(distances) if distance < 0.2]
        assert placed.find_shapes_near(point, 0.2) == near
        counted += len(near)
    assert counted > 0


def test_results_of_many_configurations_are_those_of_single_ones() -> None:
    q = np.array([sample_configuration(seed) for seed in range(6)])
    together, count = make_shapes().place(q), make_shapes().body_count
    pairs = np.array(
        [(a, b) for a in range(count) for b in range(count, len(make_shapes().world.shapes))]
    )
    nearest, distances = together.find_nearest(pairs)
    for state, row in enumerate(q):
        alone, none = make_shapes().place(row[None]), np.zeros(len(pairs), int)
        np.testing.assert_array_equal(
            alone.find_nearest(pairs), ([nearest[state]], [distances[state]])
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
