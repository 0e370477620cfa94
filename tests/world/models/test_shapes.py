"""Tests distances by brute force, and surfaces and boxes by formulas."""

from __future__ import annotations

from collections.abc import Callable

import coal
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.files.meshes import MeshPart, make_bvh
from vkc_pin.world.models.shapes import (
    compute_bounding_box,
    compute_clearance,
    compute_shape_distance,
    compute_world_box,
    triangulate,
)

Solid = tuple[coal.CollisionGeometry, pin.SE3]

# Shapes and their volumes [m³].
SOLIDS: list[tuple[Callable[[], coal.CollisionGeometry], float]] = [
    (lambda: coal.Box(0.2, 0.3, 0.4), 0.024),
    (lambda: coal.Sphere(0.2), 4 / 3 * np.pi * 0.008),
    (lambda: coal.Ellipsoid(0.1, 0.2, 0.3), 4 / 3 * np.pi * 0.006),
    (lambda: coal.Cylinder(0.1, 0.4), np.pi * 0.01 * 0.4),
    (lambda: coal.Cone(0.1, 0.6), np.pi * 0.01 * 0.2),
    (lambda: coal.Capsule(0.1, 0.4), np.pi * 0.01 * 0.4 + 4 / 3 * np.pi * 0.001),
]


def make_random_solids(rng: np.random.Generator, count: int, size: float) -> list[Solid]:
    kinds = [SOLIDS[int(k)][0]() for k in rng.integers(len(SOLIDS), size=count)]
    return [
        (kind, pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-size, size, 3))) for kind in kinds
    ]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.4, 1.0, 3.0]))
def test_clearance_is_the_smallest_pair_distance(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    first, second = make_random_solids(rng, 4, size), make_random_solids(rng, 6, size)
    smallest = min(compute_shape_distance(*one, *other) for one in first for other in second)
    assert compute_clearance(first, second) == pytest.approx(smallest, abs=1e-6)
    assert compute_clearance(first, []) == np.inf
    near = compute_clearance(first, second, reach=0.2)
    assert near == pytest.approx(smallest, abs=1e-6) if smallest < 0.2 - 1e-6 else near >= 0.2


@pytest.mark.parametrize("number", range(len(SOLIDS)))
def test_surfaces_are_closed_and_have_the_right_volume(number: int) -> None:
    make, volume = SOLIDS[number]
    mesh = trimesh.Trimesh(*triangulate(make()))
    assert mesh.is_watertight
    assert 0.94 * volume <= mesh.volume <= volume * (1 + 1e-9)
    shape = pin.GeometryObject("s", 0, 0, pin.SE3.Identity(), make())
    center, half = compute_bounding_box(shape)
    np.testing.assert_allclose(mesh.bounds, [center - half, center + half], atol=0.02)
    assert (mesh.bounds[0] >= center - half - 1e-9).all()
    assert (mesh.bounds[1] <= center + half + 1e-9).all()


def test_meshes_keep_their_triangles() -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh = make_bvh(MeshPart(np.asarray(box.vertices), np.asarray(box.faces)))
    mesh.buildConvexRepresentation(False)
    for shape in (mesh, mesh.convex):
        vertices, faces = triangulate(shape)
        assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(0.006)


def test_unbounded_shapes_raise() -> None:
    with expect_error("cannot be drawn"):
        triangulate(coal.Halfspace(0.0, 0.0, 1.0, 0.0))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_world_boxes_enclose_the_surface(seed: int) -> None:
    ((shape, placement),) = make_random_solids(np.random.default_rng(seed), 1, 1.0)
    low, high = compute_world_box(shape, placement)
    points = triangulate(shape)[0] @ placement.rotation.T + placement.translation
    assert (points >= low - 1e-9).all()
    assert (points <= high + 1e-9).all()
    diagonal = 2 * np.linalg.norm(
        compute_bounding_box(pin.GeometryObject("s", 0, 0, placement, shape))[1]
    )
    assert (high - low <= diagonal + 1e-9).all()
