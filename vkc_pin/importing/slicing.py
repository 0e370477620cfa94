"""Cuts meshes that are open or large by planes into parts with small convex hulls.

CoACD remeshes open meshes as skins of some ten thousand triangles, which takes minutes. Convex
hulls of parts need neither a closed mesh nor many cuts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints

if TYPE_CHECKING:
    import trimesh

__all__ = ["THICKNESS", "is_flat", "slice_mesh", "thicken"]

THICKNESS = 1e-3
"""Thickness that flat parts are given [m]."""
_FLAT_RATIO = 1e-4  # thickness relative to the extent up to which points are flat
_FLAT_THICKNESS = 1e-5  # [m] thickness up to which points are flat
_PLANES = 12  # number of cutting planes along each axis
_MIN_GAIN = 0.01  # smallest reduction of volume of a cut, relative to the whole hull


def slice_mesh(mesh: trimesh.Trimesh, max_parts: int) -> list[Floats]:
    """Cut a mesh by planes into parts whose convex hulls have a small total volume.

    Greedily, the part whose best cut reduces the volume most is cut in two. Planes are normal to
    the axes of the mesh and to its principal axes. Points on a cut belong to both sides, so that
    the hulls contain the mesh.

    Args:
        mesh: Any triangles; they need not be closed.
        max_parts: Largest number of parts.

    Returns:
        The points of each part, shape (n, 3).
    """
    vertices, edges = np.asarray(mesh.vertices, float), np.asarray(mesh.edges_unique)
    axes = np.vstack([np.eye(3), np.linalg.eigh(np.cov(vertices.T))[1].T])
    least = _MIN_GAIN * _compute_hull_volume(vertices)
    parts = [(vertices, edges)]
    cuts = [_find_best_cut(vertices, edges, axes)]
    while len(parts) < max_parts:
        k = int(np.argmax([gain for gain, _ in cuts]))
        gain, halves = cuts[k]
        if gain <= least:
            break
        parts[k : k + 1] = halves
        cuts[k : k + 1] = [_find_best_cut(*half, axes) for half in halves]
    return [points for points, _ in parts]


def is_flat(points: Floats) -> bool:
    """Return whether points, shape (n, 3) [m], lie almost in one plane."""
    if len(points) < 4:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return bool(spread[-1] <= max(_FLAT_THICKNESS, _FLAT_RATIO * spread[0]))


def thicken(points: Floats) -> Floats:
    """Return points that span a volume: flat ones become layers `THICKNESS` apart."""
    if not is_flat(points):
        return points
    axes = np.linalg.svd(points - points.mean(axis=0))[2]
    # Along all axes, since the points may lie on a line.
    layers = [points + 0.5 * side * THICKNESS * axis for axis in axes for side in (-1.0, 1.0)]
    return np.vstack(layers)


def _find_best_cut(
    points: Floats, edges: Ints, axes: Floats
) -> tuple[float, list[tuple[Floats, Ints]]]:
    """Return the largest reduction of the hulls' volume by one cut [m³], and the two sides."""
    whole = _compute_hull_volume(points)
    best: tuple[float, list[tuple[Floats, Ints]]] = (0.0, [])
    if whole == 0.0:
        return best
    for axis in axes:
        along = points @ axis
        for place in np.linspace(along.min(), along.max(), _PLANES + 2)[1:-1]:
            sides = [_clip(points, edges, sign * along, sign * place) for sign in (1.0, -1.0)]
            if min(len(side) for side, _ in sides) < 3:
                continue
            gain = whole - sum(_compute_hull_volume(side) for side, _ in sides)
            if gain > best[0]:
                best = (gain, sides)
    return best


def _clip(points: Floats, edges: Ints, along: Floats, place: float) -> tuple[Floats, Ints]:
    """Return the points with `along` up to `place`, those on cut edges, and the edges between."""
    is_inside = along <= place
    index = np.cumsum(is_inside) - 1
    inside = edges[is_inside[edges].all(axis=1)]
    crossing = edges[is_inside[edges[:, 0]] != is_inside[edges[:, 1]]]
    start, end = crossing[:, 0], crossing[:, 1]
    fraction = ((place - along[start]) / (along[end] - along[start]))[:, None]
    cut = points[start] * (1.0 - fraction) + points[end] * fraction
    cut_edges = np.column_stack(
        [index[np.where(is_inside[start], start, end)], is_inside.sum() + np.arange(len(cut))]
    )
    return np.vstack([points[is_inside], cut]), np.vstack([index[inside], cut_edges])


def _compute_hull_volume(points: Floats) -> float:
    """Return the volume of the convex hull of points [m³]; 0 if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(points).volume) if len(points) > 3 else 0.0
    except (QhullError, ValueError):
        return 0.0
