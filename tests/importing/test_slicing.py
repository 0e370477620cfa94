from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from vkc_pin.importing.slicing import THICKNESS, is_flat, slice_mesh, thicken


def test_an_open_angle_becomes_its_arms() -> None:
    """Two plates without ends, at a right angle: cut near where they meet."""
    plates = [trimesh.creation.box((1.0, 0.02, 0.5)), trimesh.creation.box((0.02, 1.0, 0.5))]
    mesh = trimesh.util.concatenate(
        [plates[0].apply_translation((0.5, 0, 0)), plates[1].apply_translation((0, 0.5, 0))]
    )
    mesh.update_faces(np.abs(mesh.face_normals[:, 2]) < 0.5)
    parts = slice_mesh(mesh, 4)
    assert 2 <= len(parts) <= 4
    assert sum(ConvexHull(part).volume for part in parts) < 0.3 * ConvexHull(mesh.vertices).volume
    for corner in mesh.vertices:
        assert any(np.abs(part - corner).max(axis=1).min() < 1e-12 for part in parts)


def test_a_box_is_not_cut() -> None:
    assert len(slice_mesh(trimesh.creation.box((0.3, 0.2, 0.1)), 8)) == 1


def test_flat_points_become_a_plate() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    assert is_flat(square)
    assert not is_flat(np.vstack([square, [[0.5, 0.5, 0.1]]]))
    assert ConvexHull(thicken(square)).volume == pytest.approx(THICKNESS, rel=0.01)
    assert ConvexHull(thicken(square[:2])).volume == pytest.approx(THICKNESS**2, rel=0.5)
    tetrahedron = np.vstack([square[:3], [[0, 0, 1]]])
    assert thicken(tetrahedron) is tetrahedron
