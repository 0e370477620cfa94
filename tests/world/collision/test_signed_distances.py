"""Tests of signed distances, normals and witness points against support functions."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.support_functions import compute_gaps, find_widest_gap
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.collision.distances import Shapes
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.files.meshes import make_convex_hull
from vkc_pin.world.models.shapes import compute_shape_distance

KINDS = ("Box", "Sphere", "Capsule", "Cylinder", "Cone", "Ellipsoid", "Convex")
EXACT = ({"Sphere"}, {"Capsule"}, {"Sphere", "Capsule"}, {"Sphere", "Cylinder"}, {"Sphere", "Box"})
QUARTER = np.pi / 2.0


def make_shape(kind: str, rng: np.random.Generator) -> coal.ShapeBase:
    a, b, c = 10.0 ** rng.uniform(-2.0, -0.5, 3)
    match kind:
        case "Box" | "Ellipsoid":
            return getattr(coal, kind)(a, b, c)
        case "Sphere":
            return coal.Sphere(a)
        case "Convex":
            return make_convex_hull(rng.normal(scale=0.1, size=(20, 3)))
    return getattr(coal, kind)(a, b)


def sample_rotation(kind: str, rng: np.random.Generator) -> Floats:
    """Return a rotation at random, about an axis, or by quarter turns."""
    axis = np.eye(3)[rng.integers(3)]
    angles = {
        "generic": rng.normal(size=3),
        "one axis": axis * rng.uniform(0.0, np.pi),
        "quarter": axis * QUARTER * rng.integers(4),
    }
    return np.asarray(pin.exp3(angles[kind]))


def sample_offset(kind: str, rng: np.random.Generator) -> Floats:
    """Return an offset at random, in a plane, on an axis, tiny or zero."""
    offset, axis = rng.uniform(-0.3, 0.3, 3), rng.integers(3)
    offsets = {
        "generic": offset,
        "plane": np.where(np.arange(3) == axis, 0.0, offset),
        "axis": np.where(np.arange(3) == axis, offset, 0.0),
        "tiny": rng.normal(size=3) * 10.0 ** rng.uniform(-12.0, -4.0),
        "zero": np.zeros(3),
    }
    return np.asarray(offsets[kind])


def check_pair(
    first: coal.ShapeBase, first_at: pin.SE3, second: coal.ShapeBase, second_at: pin.SE3
) -> None:
    """Check distance, normal and witness points of two shapes."""
    placed = first, first_at, second, second_at
    shapes = Shapes([first, second], tolerance=1e-8)
    where = flatten_placements([first_at, second_at])[None]
    found = shapes.compute_witnesses(where, np.zeros(1, int), np.array([[0, 1]]))
    distance, normal = found.distance[0], found.normal[0]
    exact = {type(first).__name__, type(second).__name__} in EXACT
    # EPA approximates the surfaces of round shapes that overlap by facets.
    depth = max(0.0, -distance)
    tolerance = 1e-8 if exact else 2e-5 + 1e-2 * depth
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-9)
    assert compute_gaps(*placed, normal[None])[0] == pytest.approx(distance, abs=tolerance)
    assert find_widest_gap(*placed) <= distance + tolerance
    np.testing.assert_allclose(found.second[0] - found.first[0], distance * normal, atol=1e-9)
    for shape, at, point, sign in (
        (first, first_at, found.first[0], 1.0),
        (second, second_at, found.second[0], -1.0),
    ):
        middle = pin.SE3(at.rotation, at.translation - point)
        outwards = compute_gaps(
            coal.Sphere(0.0), pin.SE3.Identity(), shape, middle, -sign * normal[None]
        )
        assert outwards == pytest.approx(0.0, abs=tolerance)


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(KINDS),
    st.sampled_from(KINDS),
    st.sampled_from(["generic", "one axis", "quarter"]),
    st.sampled_from(["generic", "plane", "axis", "tiny", "zero"]),
    st.sampled_from([0.0, 0.0, 0.02]),
    st.integers(0, 2**32 - 1),
)
def test_distances_equal_those_of_support_functions(
    first_kind: str, second_kind: str, rotation: str, offset: str, swept: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    first, second = make_shape(first_kind, rng), make_shape(second_kind, rng)
    first.setSweptSphereRadius(swept)
    at = pin.SE3(sample_rotation("generic", rng), rng.uniform(-0.5, 0.5, 3))
    other = at * pin.SE3(sample_rotation(rotation, rng), sample_offset(offset, rng))
    check_pair(first, at, second, other)


@settings(max_examples=80, deadline=None)
@given(
    st.sampled_from(KINDS),
    st.sampled_from(KINDS),
    st.sampled_from(["generic", "one axis", "quarter"]),
    st.sampled_from([-0.005, -1e-4, 0.0, 1e-4, 0.005]),
    st.integers(0, 2**32 - 1),
)
def test_distances_of_shapes_that_all_but_touch(
    first_kind: str, second_kind: str, rotation: str, gap: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    first, second = make_shape(first_kind, rng), make_shape(second_kind, rng)
    at = pin.SE3(sample_rotation("generic", rng), rng.uniform(-0.5, 0.5, 3))
    away = at.rotation @ sample_offset(str(rng.choice(["generic", "plane", "axis"])), rng)
    other = pin.SE3(at.rotation @ sample_rotation(rotation, rng), at.translation)
    n = away / np.linalg.norm(away)
    other.translation += (gap - compute_gaps(first, at, second, other, n[None])[0]) * n
    check_pair(first, at, second, other)


@pytest.mark.parametrize(("inside", "offset"), [(0.003, 0.0), (0.003, 0.01), (0.03, 0.045)])
def test_sphere_leaves_a_cylinder_by_its_nearest_surface(inside: float, offset: float) -> None:
    can, ball = coal.Cylinder(0.05, 0.1), coal.Sphere(0.004)
    at = pin.SE3(np.eye(3), np.array([offset, 0.0, 0.05 - inside]))
    depth = min(inside, 0.05 - offset) + 0.004
    assert compute_shape_distance(can, pin.SE3.Identity(), ball, at) == pytest.approx(-depth)
    assert compute_shape_distance(ball, at, can, pin.SE3.Identity()) == pytest.approx(-depth)


def test_capsules_that_cross_are_separated_across_both() -> None:
    first, second = coal.Capsule(0.05, 0.6), coal.Capsule(0.03, 0.4)
    turned = pin.SE3(pin.exp3(np.array([QUARTER, 0.0, 0.0])), np.zeros(3))
    where = flatten_placements([pin.SE3.Identity(), turned])[None]
    pair = np.zeros(1, int), np.array([[0, 1]])
    found = Shapes([first, second]).compute_witnesses(where, *pair)
    assert found.distance[0] == pytest.approx(-0.08)
    np.testing.assert_allclose(np.abs(found.normal[0]), [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.second - found.first, -0.08 * found.normal, atol=1e-9)
