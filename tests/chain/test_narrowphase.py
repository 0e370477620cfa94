"""Distances asked for one by one are coal's, whatever was asked before."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.chain.narrowphase import Distances

MOVING, STANDING = 4, 3


@pytest.fixture
def shapes() -> list[pin.GeometryObject]:
    rng = np.random.default_rng(0)
    solids = [coal.Box(0.3, 0.2, 0.1), coal.Sphere(0.1), coal.Cylinder(0.1, 0.4), coal.Capsule(0.05, 0.3)]
    solids += [coal.Box(1.0, 1.0, 0.1), coal.Cylinder(0.2, 0.5), coal.Sphere(0.3)]
    return [pin.GeometryObject(f"s{k}", int(k < MOVING), 0, anywhere(rng), solid) for k, solid in enumerate(solids)]


def anywhere(rng: np.random.Generator) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-0.6, 0.6, 3))


def alone(
    shapes: list[pin.GeometryObject], where: list[pin.SE3], first: int, second: int
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Return distance, witness points and normal, as coal gives them when asked for nothing else."""
    places = [*where, *(shape.placement for shape in shapes[MOVING:])]
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = 1e-8
    here, there = (coal.Transform3s(places[k].rotation, places[k].translation) for k in (first, second))
    coal.distance(shapes[first].geometry, here, shapes[second].geometry, there, request, result)
    return told(result)


def told(result: coal.DistanceResult) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    points = result.getNearestPoint1(), result.getNearestPoint2(), result.normal
    return (result.min_distance, *(np.array(point) for point in points))


def same(one: tuple[float, np.ndarray, np.ndarray, np.ndarray], other: tuple[float, np.ndarray, np.ndarray, np.ndarray]) -> None:
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_distances_at_one_configuration_after_the_other(shapes: list[pin.GeometryObject]) -> None:
    """The placements are the same objects all the time, as Pinocchio's are."""
    rng, where = np.random.default_rng(1), pin.StdVec_SE3()
    where.extend([pin.SE3.Identity()] * MOVING)
    distances, pairs = Distances(shapes, where), list(itertools.combinations(range(MOVING + STANDING), 2))
    pairs = [pair for pair in pairs if pair[0] < MOVING]
    overlaps = 0
    for _ in range(20):
        for k in range(MOVING):
            where[k] = anywhere(rng)
        at, now = distances.moved(), [pin.SE3(placement) for placement in where]
        for k in rng.permutation(len(pairs)).tolist():
            same(told(at.of(*pairs[k])), alone(shapes, now, *pairs[k]))
            overlaps += at.of(*pairs[k]).min_distance < 0
    assert 0 < overlaps < 20 * len(pairs)


def test_witness_points_are_on_the_surfaces(shapes: list[pin.GeometryObject]) -> None:
    """Of two balls everything is known: oracle by hand."""
    where = pin.StdVec_SE3()
    where.extend([pin.SE3(np.eye(3), np.array([k, 0.0, 0.0])) for k in range(MOVING)])
    shapes[6].placement = pin.SE3(np.eye(3), np.array([1.0, 0.0, 2.0]))
    distance, first, second, normal = told(Distances(shapes, where).of(1, 6))
    assert distance == pytest.approx(1.6, abs=1e-6)
    np.testing.assert_allclose(first, [1.0, 0.0, 0.1], atol=1e-6)
    np.testing.assert_allclose(second, [1.0, 0.0, 1.7], atol=1e-6)
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0], atol=1e-6)


def test_what_stands_elsewhere(shapes: list[pin.GeometryObject]) -> None:
    rng, where = np.random.default_rng(2), pin.StdVec_SE3()
    where.extend([anywhere(rng) for _ in range(MOVING)])
    distances, place = Distances(shapes, where), anywhere(rng)
    before = [told(distances.of(0, b)) for b in range(MOVING, MOVING + STANDING)]
    other, moved = distances.placed({5: place}), [pin.GeometryObject(shape) for shape in shapes]
    moved[5].placement = place
    for b, old in enumerate(before, start=MOVING):
        same(told(other.of(0, b)), alone(moved, list(where), 0, b))
        same(told(distances.of(0, b)), old)
    assert told(other.of(0, 5))[0] != before[1][0]
