"""Writes small meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh


def write_wedge(file: Path) -> None:
    """Write the tetrahedron of the origin and the unit points on the axes as an OBJ file."""
    file.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")


def compute_excess(points: np.ndarray, hull: trimesh.Trimesh) -> np.ndarray:
    """Return how far points are outside of a convex hull, shape (n,); negative inside [m]."""
    planes = np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
    return np.asarray((points @ hull.face_normals.T - planes).max(axis=1))
