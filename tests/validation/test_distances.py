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


def test_distances_and_nearest_pair_agree_with_coal() -> None:
    shapes, count = make_shapes().world.shapes, make_shapes().body_count
    q = np.array([sample_configuration(seed) for seed in range(3)])
    placed = make_shapes().place(q)
    pairs = np.array(
        [(a, b) for a, b in itertools.combinations(range(len(shapes)), 2) if a < count]
    )
    pairs = pairs[np.random.default_rng(0).permutation(len(pairs))[:400]]
    nearest, least = placed.find_nearest(pairs)
    for state, row in enumerate(q):
        at, states = place_shapes(row), np.full(len(pairs), state)
        expected = np.array(
            [
                compute_shape_distance(shapes[a].geometry, at[a], shapes[b].geometry, at[b])
                for a, b in pairs.tolist()
            ]
        )
        np.testing.assert_allclose(placed.compute_distances(states, pairs), expected, atol=COAL)
        bounds = placed.compute_lower_bounds(states, pairs)
        assert (bounds <= expected + COAL).all()
        assert np.isfinite(bounds).mean() > 0.8, "most bounds must be finite"
        assert least[state] == pytest.approx(expected.min(), abs=COAL)
        assert expected[nearest[state]] == pytest.approx(least[state], abs=COAL)


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
