from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from vkc_pin.visualization.threejs import (
    Solid,
    make_box,
    make_tube,
    merge_solids,
    shade,
    simplify,
    to_solid,
)


def make_mesh(solid: Solid) -> trimesh.Trimesh:
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    mesh.merge_vertices(merge_norm=True)
    return mesh


def check_winding(solid: Solid) -> None:
    """Check that the faces are wound outwards, as the normals of their corners point."""
    faces = trimesh.Trimesh(solid.vertices, solid.faces, process=False).face_normals
    normals = solid.normals[solid.faces[:, 0]]
    assert (np.einsum("ij,ij->i", faces, normals) > 0).all()


def make_ball(radius: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces)


def test_boxes_are_shaded_flat_and_balls_smooth() -> None:
    box = to_solid(coal.Box(1.0, 1.0, 1.0))
    assert np.allclose(np.sort(np.abs(box.normals), axis=1), [0, 0, 1], atol=0.02), (
        "each side has its own normal"
    )
    sphere = to_solid(coal.Sphere(1.0))
    assert np.einsum("ij,ij->i", sphere.normals, sphere.vertices).min() > 0.97, "normals are radial"


def test_sides_of_a_box_face_outwards() -> None:
    lower, upper = np.array([-1.0, 0.0, 2.0]), np.array([1.0, 3.0, 4.0])
    whole = make_box(lower, upper)
    assert make_mesh(whole).volume == pytest.approx(12.0)
    for side in range(6):
        solid = make_box(lower, upper, (side,))
        axis, positive = divmod(side, 2)
        assert np.allclose(solid.vertices[:, axis], (lower, upper)[positive][axis])
        assert np.allclose(solid.normals, (2 * positive - 1) * np.eye(3)[axis])
        check_winding(solid)


def test_coarse_copy_has_fewer_faces_and_the_same_volume() -> None:
    fine = shade(*make_ball())
    coarse = simplify(fine, 0.1)
    assert len(coarse.faces) < 0.8 * len(fine.faces)
    assert make_mesh(coarse).volume == pytest.approx(make_mesh(fine).volume, rel=0.1)


def test_solids_are_moved_and_merged() -> None:
    solid = make_box(np.zeros(3), np.ones(3))
    moved = solid.transform(
        pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, np.pi / 2), np.array([5.0, 0.0, 0.0]))
    )
    assert np.allclose(moved.vertices.min(axis=0), [4.0, 0.0, 0.0], atol=1e-6)
    both = merge_solids([solid, moved])
    assert len(both.vertices) == 2 * len(solid.vertices)
    assert make_mesh(both).volume == pytest.approx(2.0, rel=1e-5)


def test_tube_follows_its_line() -> None:
    angle = np.linspace(0.0, 3.0, 60)
    line = np.column_stack([np.cos(angle), np.sin(angle), 0.2 * angle])
    solid = make_tube(line, 0.01)
    assert solid is not None
    distances = np.linalg.norm(solid.vertices[:, None] - line[None], axis=2).min(axis=1)
    assert np.allclose(distances, 0.01, atol=1e-3)
    check_winding(solid)
    assert make_tube(np.zeros((5, 3)), 0.01) is None, "a line of length zero has no tube"
