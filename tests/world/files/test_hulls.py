from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import trimesh
from helpers.meshes import compute_excess
from helpers.poles import POLE
from scipy.spatial import ConvexHull

from vkc_pin.errors import InputError
from vkc_pin.world.files.hulls import compute_hull, compute_outer_hull


def test_hulls_of_thin_poles_are_closed_and_face_outward() -> None:
    hull = compute_hull(POLE)
    assert hull.is_volume
    assert hull.volume == pytest.approx(ConvexHull(POLE).volume, rel=1e-12)
    assert hull.area == pytest.approx(ConvexHull(POLE).area, rel=1e-12)
    assert compute_excess(POLE, hull).max() < 1e-12


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box((0.1, 0.02, 1.3)),
        trimesh.creation.cylinder(0.05, height=0.4, sections=100),
        trimesh.creation.icosphere(subdivisions=2),
        trimesh.creation.torus(0.3, 0.02),
    ],
    ids=["box", "cylinder", "ball", "ring"],
)
def test_hulls_equal_those_of_trimesh(mesh: trimesh.Trimesh) -> None:
    points = mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])).vertices
    hull, expected = compute_hull(points), trimesh.convex.convex_hull(points)
    np.testing.assert_array_equal(hull.vertices, expected.vertices)
    np.testing.assert_array_equal(hull.faces, expected.faces)
    np.testing.assert_array_equal(hull.face_normals, expected.face_normals)


@pytest.mark.parametrize("count", [1, 3, 4, 20])
def test_coplanar_points_raise(count: int) -> None:
    points = np.random.default_rng(0).uniform(size=(count, 3)) * (1.0, 1.0, 0.0)
    with pytest.raises(InputError, match="span no volume"):
        compute_hull(points)


@pytest.mark.parametrize("vertices", [16, 40])
def test_outer_hulls_contain_their_points(vertices: int) -> None:
    tube = trimesh.creation.cylinder(0.05, height=0.4, sections=100)
    points = np.asarray(
        tube.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])).vertices
    )
    hull = compute_outer_hull(points, vertices=vertices)
    assert len(hull.vertices) <= vertices
    assert compute_excess(points, hull).max() < 1e-9
    assert 1.0 < hull.volume / tube.volume < (1.2 if vertices == 40 else 1.35)


def test_outer_hulls_of_dense_meshes_need_little_memory() -> None:
    """A matrix of all 81 920 facets by all 40 962 vertices would need 27 GB."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    tracemalloc.start()
    hull = compute_outer_hull(ball.vertices)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300e6
    assert len(hull.vertices) <= 40
    assert compute_excess(ball.vertices, hull).max() < 1e-9
    assert 1.0 < hull.volume / ball.volume < 1.2
