"""Cuts a link's mesh into few parts with small hulls, and measures the volume that hulls add."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

__all__ = ["cut", "solid_volume"]


def cut(
    mesh: trimesh.Trimesh, pieces: int, *, axis: ArrayLike, steps: int = 24
) -> list[NDArray[np.float64]]:
    """Cut `mesh` by `pieces` − 1 planes across `axis` that minimize the volume of the hulls.

    Args:
        mesh: Any triangles; they need not be closed.
        pieces: At least 1.
        axis: Normal of the planes, shape (3,).
        steps: Number of places along the mesh where a plane may lie.

    Returns:
        For each piece its points, shape (n, 3), the corners of the cut included: the pieces' hulls
        contain the mesh.
    """
    direction = np.asarray(axis, float) / np.linalg.norm(np.asarray(axis, float))
    if pieces == 1:
        return [np.asarray(mesh.vertices)]
    along = np.asarray(mesh.vertices) @ direction
    places = np.linspace(along.min(), along.max(), steps + 1)
    points: dict[tuple[int, int], NDArray[np.float64]] = {}
    volumes: dict[tuple[int, int], float] = {}
    for low, high in itertools.combinations(range(steps + 1), 2):
        slab = _slab(mesh, direction, places[low], places[high])
        points[low, high], volumes[low, high] = slab, _hull_volume(slab)
    bounds = [(0, *inner, steps) for inner in itertools.combinations(range(1, steps), pieces - 1)]
    best = min(bounds, key=lambda cuts: sum(volumes[pair] for pair in itertools.pairwise(cuts)))
    return [points[pair] for pair in itertools.pairwise(best)]


def solid_volume(meshes: Sequence[trimesh.Trimesh], *, pitch: float = 0.001) -> float:
    """Return the volume [m³] of the solid whose skin `meshes` are.

    A maker's mesh is an open skin with loose screws: it has no volume of its own. So cells of width
    `pitch` are counted that have skin on both sides along at least two of the three axes, and half
    of those that the skin itself fills.
    """
    low = np.min([mesh.bounds[0] for mesh in meshes], axis=0) - 2.0 * pitch
    size = (
        np.ceil((np.max([mesh.bounds[1] for mesh in meshes], axis=0) - low) / pitch).astype(int) + 3
    )
    skin = np.zeros(size, bool)
    for mesh in meshes:
        points = mesh.subdivide_to_size(0.7 * pitch, max_iter=20).vertices
        skin[tuple(np.floor((points - low) / pitch).astype(int).T)] = True
    enclosed = np.zeros(size, int)
    for axis in range(3):
        before = np.logical_or.accumulate(skin, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(skin, axis), axis=axis), axis)
        enclosed += before & after
    inside = (enclosed >= 2) & ~skin
    return float((inside.sum() + 0.5 * skin.sum()) * pitch**3)


def _slab(
    mesh: trimesh.Trimesh, direction: NDArray[Any], low: float, high: float
) -> NDArray[np.float64]:
    """Return the points of `mesh` between two planes, with those where its edges cross them."""
    vertices, edges = np.asarray(mesh.vertices), np.asarray(mesh.edges_unique)
    along = vertices @ direction
    parts = [vertices[(along >= low - 1e-12) & (along <= high + 1e-12)]]
    start, end = along[edges[:, 0]], along[edges[:, 1]]
    for place in (low, high):
        crossing = (start - place) * (end - place) < 0.0
        share = ((place - start[crossing]) / (end[crossing] - start[crossing]))[:, None]
        parts.append(
            vertices[edges[crossing, 0]] * (1.0 - share) + vertices[edges[crossing, 1]] * share
        )
    return np.vstack(parts)


def _hull_volume(points: NDArray[Any]) -> float:
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        return 0.0
