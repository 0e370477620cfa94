"""Reads meshes with assimp, which shares no code with the package's readers."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import assimp_py
import numpy as np

__all__ = ["Measures", "measure", "read_triangles"]

# assimp applies the unit of COLLADA files, and turns them such that y points up; the package keeps
# their axes.
_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
Measures = tuple[np.ndarray, float, float]  # bounds, shape (2, 3) [m], area [m²], volume [m³]


def read_triangles(file: Path) -> np.ndarray:
    """Return the triangles of all nodes of a mesh file, shape (n, 3, 3) [m].

    glTF files are turned such that z points up, COLLADA files keep their axes.
    """
    kind = file.suffix.lower()
    if kind == ".dae":
        return _read_collada(file)
    found = _import_file(file)
    return found @ _Y_UP_TO_Z_UP.T if kind in (".gltf", ".glb") else found


def _read_collada(file: Path) -> np.ndarray:
    text = file.read_text(encoding="utf-8", errors="replace")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "mesh.dae")
        # assimp_py refuses files with lines.
        copy.write_text(
            re.sub(r"<(lines|linestrips)\b.*?</\1>", "", text, flags=re.DOTALL), "utf-8"
        )
        found = _import_file(copy)
    if re.search(r"<up_axis>\s*Z_UP", text):
        found = found @ _Y_UP_TO_Z_UP.T
    return found


def _import_file(file: Path) -> np.ndarray:
    scene = assimp_py.import_file(str(file), assimp_py.Process_Triangulate)
    triangles = [np.empty((0, 3, 3))]

    def visit(node: assimp_py.Node, above: np.ndarray) -> None:
        placement = above @ np.array(node.transformation)
        for number in node.mesh_indices:
            mesh = scene.meshes[number]
            points = np.array(mesh.vertices, float).reshape(-1, 3)
            moved = points @ placement[:3, :3].T + placement[:3, 3]
            triangles.append(moved[np.array(mesh.indices).reshape(-1, 3)])
        for child in node.children:
            visit(child, placement)

    visit(scene.root_node, np.eye(4))
    return np.concatenate(triangles)


def measure(triangles: np.ndarray) -> Measures:
    """Return bounds, area and enclosed volume of triangles, shape (n, 3, 3)."""
    around = triangles - triangles.reshape(-1, 3).mean(axis=0)
    a, b, c = around.transpose(1, 0, 2)
    points = triangles.reshape(-1, 3)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    return np.array([points.min(axis=0), points.max(axis=0)]), float(area), float(volume)
