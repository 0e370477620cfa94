"""Convex polytopes of few corners around given points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vkc_pin.arrays import Floats

if TYPE_CHECKING:
    import trimesh

__all__ = ["outer_hull"]

_GAP = 5e-4  # [m]: no cut takes away less
_DIRECTIONS = 400  # of cuts, spread over the sphere


def outer_hull(points: ArrayLike, *, vertices: int = 40) -> trimesh.Trimesh:
    """Return a convex polytope of few vertices that contains `points`.

    It starts as the box along the principal axes of the hull and is cut, again and again, by the plane that touches
    the hull and lies deepest below one of the polytope's corners.

    Args:
        points: Shape (n, 3), [m].
        vertices: The largest number of its vertices.

    Returns:
        The polytope; every point lies in it (up to rounding, 1e-9 m).
    """
    import trimesh

    hull = trimesh.convex.convex_hull(np.asarray(points, float))
    corners = np.asarray(hull.vertices)
    normals = _directions(hull)
    offsets = (corners @ normals.T).max(axis=0)
    axes = np.linalg.eigh(np.cov(corners.T))[1].T
    found = []
    for frame in (np.eye(3), axes):
        box = np.vstack([frame, -frame])
        chosen_normals, chosen_offsets = box, (corners @ box.T).max(axis=0)
        polytope = _intersect(chosen_normals, chosen_offsets, corners)
        for _ in range(4 * vertices):
            depth = (np.asarray(polytope.vertices) @ normals.T).max(axis=0) - offsets
            order = np.argsort(-depth)[:12]
            trials = []
            for k in order[depth[order] > _GAP]:
                planes = np.vstack([chosen_normals, normals[k]]), np.append(chosen_offsets, offsets[k])
                trial = _intersect(*planes, corners)
                if len(trial.vertices) <= vertices:
                    trials.append((trial, planes))
            if not trials:
                break
            polytope, (chosen_normals, chosen_offsets) = min(trials, key=lambda trial: trial[0].volume)
        found.append(polytope)
    return min(found, key=lambda polytope: polytope.volume)


def _directions(hull: trimesh.Trimesh) -> Floats:
    """Return the normals worth trying: those of the hull's faces, and some spread evenly over the sphere."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / _DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
    spread = np.stack([np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z], axis=1)
    _, first = np.unique(np.asarray(hull.face_normals).round(2), axis=0, return_index=True)
    return np.vstack([np.asarray(hull.face_normals)[np.sort(first)], spread])


def _intersect(normals: NDArray[Any], offsets: NDArray[Any], inner: NDArray[Any]) -> trimesh.Trimesh:
    """Return the polytope {x: normals·x ≤ offsets}; `inner` are points in it."""
    import trimesh
    from scipy.spatial import HalfspaceIntersection

    centre = inner.mean(axis=0)
    corners = HalfspaceIntersection(np.column_stack([normals, -offsets]), centre).intersections
    corners = corners[np.isfinite(corners).all(axis=1)]
    _, first = np.unique(corners.round(7), axis=0, return_index=True)
    return trimesh.convex.convex_hull(corners[np.sort(first)])
