"""Builds triangle meshes with normals from coal shapes, boxes and tubes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.meshes import MeshPart, simplify_mesh
from vkc_pin.world.models.shapes import triangulate

__all__ = ["Solid", "make_box", "make_tube", "merge_solids", "shade", "simplify", "to_solid"]

_CREASE = np.radians(35.0)  # faces that meet at a larger angle keep an edge between them
_SIDES = 8  # of a tube
_GRAIN = 2.0**-14  # rounding of vertices, for better compression [m]
_MAX_CACHED_SOLIDS = 512  # that a process keeps: robots are drawn again and again


@dataclass(frozen=True, eq=False)
class Solid:
    """A triangle mesh with a normal at every vertex.

    Attributes:
        vertices: Shape (n, 3), float32 [m].
        faces: Shape (m, 3), uint32, indices of vertices, counter-clockwise seen from outside.
        normals: Unit vectors, shape (n, 3), float32.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    normals: NDArray[np.float32]

    def transform(self, placement: pin.SE3) -> Solid:
        """Return the mesh transformed by `placement`."""
        rotation = np.asarray(placement.rotation)
        vertices = self.vertices @ rotation.T + np.asarray(placement.translation)
        return Solid(
            vertices.astype(np.float32), self.faces, (self.normals @ rotation.T).astype(np.float32)
        )


def to_solid(shape: coal.CollisionGeometry) -> Solid:
    """Convert a coal shape to a mesh with smooth surfaces and sharp edges."""
    return shade(*triangulate(shape))


def shade(vertices: Floats, faces: NDArray[np.int64]) -> Solid:
    """Add normals to triangles; vertices on sharp edges are duplicated."""
    return _shade(np.asarray(vertices, float).tobytes(), np.asarray(faces, np.int64).tobytes())


@lru_cache(maxsize=_MAX_CACHED_SOLIDS)
def _shade(vertices: bytes, faces: bytes) -> Solid:
    import trimesh

    triangles = trimesh.Trimesh(
        np.frombuffer(vertices).reshape(-1, 3),
        np.frombuffer(faces, np.int64).reshape(-1, 3),
        process=False,
    )
    mesh = trimesh.graph.smooth_shade(triangles, angle=_CREASE)
    points = (np.round(np.asarray(mesh.vertices) / _GRAIN) * _GRAIN).astype(np.float32)
    normals = (np.round(np.asarray(mesh.vertex_normals) * 64.0) / 64.0).astype(np.float32)
    arrays = (points, np.asarray(mesh.faces, np.uint32), normals)
    for array in arrays:
        array.flags.writeable = False
    return Solid(*arrays)


def simplify(solid: Solid, width: float) -> Solid:
    """Simplify a mesh by merging the vertices in each cell of a grid of `width` [m]."""
    part = simplify_mesh(
        MeshPart(solid.vertices.astype(float), solid.faces.astype(np.int64)), width
    )
    return shade(part.vertices, part.faces)


def merge_solids(solids: list[Solid]) -> Solid:
    """Merge meshes into one."""
    offsets = np.cumsum([0, *(len(s.vertices) for s in solids)])
    faces = [s.faces + np.uint32(offset) for s, offset in zip(solids, offsets[:-1], strict=True)]
    return Solid(
        np.concatenate([s.vertices for s in solids]),
        np.concatenate(faces),
        np.concatenate([s.normals for s in solids]),
    )


def make_box(lower: Floats, upper: Floats, sides: tuple[int, ...] = (0, 1, 2, 3, 4, 5)) -> Solid:
    """Build sides of the box between two corners: 0, 1: −x, +x; 2, 3: −y, +y; 4, 5: −z, +z."""
    vertices: list[Floats] = []
    faces: list[NDArray[np.int64]] = []
    normals: list[Floats] = []
    for k, side in enumerate(sides):
        axis, positive = divmod(side, 2)
        u, v = (axis + 1) % 3, (axis + 2) % 3
        corner = np.tile(lower, (4, 1)).astype(float)
        corner[:, axis] = (lower, upper)[positive][axis]
        corner[1:3, u], corner[2:4, v] = upper[u], upper[v]
        order = [[0, 1, 2], [0, 2, 3]] if positive else [[0, 2, 1], [0, 3, 2]]
        vertices.append(corner)
        faces.append(np.array(order) + 4 * k)
        normals.append(np.tile((2.0 * positive - 1.0) * np.eye(3)[axis], (4, 1)))
    return _solid(np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals))


def make_tube(points: Floats, radius: float) -> Solid | None:
    """Build a tube of `radius` [m] along `points`, shape (n, 3) [m]; browsers draw lines too thin.

    Returns:
        The tube, or None if the points lie within a radius of each other.
    """
    kept = [0]
    for i in range(1, len(points)):
        if np.linalg.norm(points[i] - points[kept[-1]]) > radius / 2.0:
            kept.append(i)
    line = np.asarray(points, float)[kept]
    if len(line) < 2:
        return None
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    across = np.empty_like(line)
    side = np.eye(3)[int(np.argmin(np.abs(along[0])))]
    for i, direction in enumerate(along):  # carried along without twist
        side = side - direction * (side @ direction)
        side /= max(float(np.linalg.norm(side)), 1e-9)
        across[i] = side
    other = np.cross(along, across)
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    normals = (
        np.cos(angle)[None, :, None] * across[:, None]
        + np.sin(angle)[None, :, None] * other[:, None]
    )
    vertices = line[:, None] + radius * normals
    ring, k = np.meshgrid(np.arange(len(line) - 1) * _SIDES, np.arange(_SIDES), indexing="ij")
    a, b = ring + k, ring + (k + 1) % _SIDES
    faces = np.concatenate(
        [np.stack([a, b, b + _SIDES], axis=-1), np.stack([a, b + _SIDES, a + _SIDES], axis=-1)]
    )
    return _solid(vertices.reshape(-1, 3), faces.reshape(-1, 3), normals.reshape(-1, 3))


def _solid(vertices: NDArray[Any], faces: NDArray[Any], normals: NDArray[Any]) -> Solid:
    return Solid(vertices.astype(np.float32), faces.astype(np.uint32), normals.astype(np.float32))
