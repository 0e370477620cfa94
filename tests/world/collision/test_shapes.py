"""Tests that batched distances equal coal's bit for bit, for any number of threads.

Those that are corrected, of overlapping round shapes, are tested in `test_signed_distances`.
"""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin import InputError
from vkc_pin.world.collision.distances import Shapes, Witnesses, count_distance_queries
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.files.meshes import make_convex_hull

SEEDS = st.integers(0, 2**32 - 1)


def sample_placement(rng: np.random.Generator) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-0.6, 0.6, 3))


def make_mesh(rng: np.random.Generator) -> coal.BVHModelBase:
    shape, corners = coal.BVHModelOBBRSS(), rng.uniform(-0.3, 0.3, (12, 3))
    shape.beginModel(4, 12)
    shape.addVertices(corners)
    shape.addTriangles(np.arange(12).reshape(4, 3))
    shape.endModel()
    return shape


def sample_normal(rng: np.random.Generator) -> np.ndarray:
    n = rng.normal(size=3)
    return np.asarray(n / np.linalg.norm(n))


def make_solid(kind: str, rng: np.random.Generator) -> coal.CollisionGeometry:
    a, b, c = rng.uniform(0.05, 0.4, 3)
    corners = rng.uniform(-0.3, 0.3, (3, 3))
    makers = {
        "Box": lambda: coal.Box(a, b, c),
        "Sphere": lambda: coal.Sphere(a),
        "Capsule": lambda: coal.Capsule(a, b),
        "Cylinder": lambda: coal.Cylinder(a, b),
        "Cone": lambda: coal.Cone(a, b),
        "Ellipsoid": lambda: coal.Ellipsoid(a, b, c),
        "Convex": lambda: make_convex_hull(rng.normal(scale=0.2, size=(12, 3))),
        # coal uses hill climbing for hulls of this size.
        "large Convex": lambda: make_convex_hull(rng.normal(scale=0.2, size=(400, 3))),
        "TriangleP": lambda: coal.TriangleP(*corners),
        "Halfspace": lambda: coal.Halfspace(sample_normal(rng), a),
        "Plane": lambda: coal.Plane(sample_normal(rng), a),
        "BVHModelOBBRSS": lambda: make_mesh(rng),
    }
    return makers[kind]()


CONVEX = (
    *("Box", "Sphere", "Capsule", "Cylinder", "Cone", "Ellipsoid", "Convex", "large Convex"),
    "TriangleP",
)
KINDS = (*CONVEX, "Halfspace", "Plane", "BVHModelOBBRSS")
CORRECTED = ({"Sphere", "Cylinder"}, {"Sphere", "Capsule"}, {"Sphere"}, {"Capsule"})


def compute_with_bindings(
    first: coal.CollisionGeometry,
    first_placement: pin.SE3,
    second: coal.CollisionGeometry,
    second_placement: pin.SE3,
    tolerance: float,
) -> np.ndarray:
    """Return distance, normal and witness points from a fresh query of coal's bindings."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance, request.epa_max_iterations = tolerance, 256
    transforms = [
        coal.Transform3s(placement.rotation, placement.translation)
        for placement in (first_placement, second_placement)
    ]
    coal.distance(first, transforms[0], second, transforms[1], request, result)
    points = result.getNearestPoint1(), result.getNearestPoint2()
    return np.concatenate([[result.min_distance], result.normal, *points])


def stack_table(found: Witnesses) -> np.ndarray:
    return np.column_stack([found.distance, found.normal, found.first, found.second])


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(CONVEX),
    st.sampled_from(KINDS),
    SEEDS,
    st.sampled_from([0.0, 0.0, 0.03]),
    st.sampled_from([1e-6, 1e-8]),
)
def test_distances_equal_those_of_the_bindings(
    first_kind: str, second_kind: str, seed: int, swept: float, tolerance: float
) -> None:
    rng = np.random.default_rng(seed)
    first, second = make_solid(first_kind, rng), make_solid(second_kind, rng)
    if first_kind != "TriangleP":
        first.setSweptSphereRadius(swept)
    first_placement, second_placement = sample_placement(rng), sample_placement(rng)
    placements = flatten_placements([first_placement, second_placement])[None]
    pair = np.zeros(1, int), np.array([[0, 1]])
    shapes = Shapes([first, second], tolerance=tolerance)
    try:
        expected = compute_with_bindings(
            first, first_placement, second, second_placement, tolerance
        )
    except (
        RuntimeError,
        ValueError,
    ) as error:  # e.g. triangle–box, or meshes with swept spheres
        with pytest.raises(type(error), match="not yet supported"):
            shapes.compute_distances(placements, *pair)
        return
    if {first_kind, second_kind} in CORRECTED and expected[0] <= 0.0:
        expected = stack_table(shapes.compute_witnesses(placements, *pair))[0]
    np.testing.assert_array_equal(
        stack_table(shapes.compute_witnesses(placements, *pair))[0], expected
    )
    np.testing.assert_array_equal(shapes.compute_distances(placements, *pair), expected[:1])
    with_fixed = Shapes([first, second], [second_placement], tolerance=tolerance)
    np.testing.assert_array_equal(
        stack_table(with_fixed.compute_witnesses(placements[:, :1], *pair))[0], expected
    )


def test_invalid_arrays_raise() -> None:
    rng, one = np.random.default_rng(0), np.zeros(1, int)
    shapes = Shapes([make_solid("Box", rng) for _ in range(7)], [sample_placement(rng)] * 3)
    placements = flatten_placements([sample_placement(rng) for _ in range(4)])[None]
    before = count_distance_queries()
    shapes.compute_distances(placements, one.repeat(5), np.tile([[0, 6]], (5, 1)))
    assert count_distance_queries() - before == 5
    for states, pairs in ((one, [[0, 7]]), (one, [[-1, 0]]), (one + 1, [[0, 1]])):
        with pytest.raises(IndexError):
            shapes.compute_distances(placements, states, np.array(pairs))
    with pytest.raises(ValueError, match="shape"):
        shapes.compute_distances(placements[:, :2], one, np.array([[0, 1]]))
    with pytest.raises(InputError, match="HeightField"):
        Shapes([coal.HeightFieldAABB(1.0, 1.0, np.zeros((3, 3)), 0.0)])


def test_errors_of_coal_are_raised_from_threads() -> None:
    rng = np.random.default_rng(0)
    shapes = Shapes([make_solid("Box", rng), make_solid("TriangleP", rng)], threads=2)
    placements = flatten_placements([sample_placement(rng), sample_placement(rng)])[None]
    with pytest.raises(ValueError, match="not yet supported"):
        shapes.compute_distances(placements, np.zeros(1000, int), np.tile([[0, 1]], (1000, 1)))
