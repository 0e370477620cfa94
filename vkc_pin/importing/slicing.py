"""Cuts triangles that enclose no volume, or are many, by planes into parts with small hulls.

CoACD rebuilds open meshes as skins of some ten thousand triangles and then takes minutes. Hulls of
parts need neither a closed mesh nor many cuts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints

if TYPE_CHECKING:
    import trimesh

__all__ = ["THICKNESS", "is_flat", "slice_mesh", "thicken"]

THICKNESS = 1e-3
"""Of what is flat, as a part [m]."""
_FLAT = 1e-4  # of its extent, and
_THIN = 1e-5  # [m]: what is thinner has no volume to speak of
_PLACES = 12  # of planes along each axis
_GAIN = 0.01  # of the whole hull's volume: a cut that takes away less is not worth a part


def slice_mesh(mesh: trimesh.Trimesh, most: int) -> list[Floats]:
    """Return the points of parts of a mesh, shape (n, 3) each, cut at planes so that the volume of their hulls is small.

    One after the other, that part is cut into two where its best cut takes away most. Planes are
    across the axes of the mesh and its principal ones. The points of a cut belong to both sides, so
    that the hulls contain the mesh.

    Args:
        mesh: Any triangles; they need not be closed.
        most: The largest number of parts.
    """
    vertices, edges = np.asarray(mesh.vertices, float), np.asarray(mesh.edges_unique)
    axes = np.vstack([np.eye(3), np.linalg.eigh(np.cov(vertices.T))[1].T])
    least = _GAIN * _volume(vertices)
    parts = [(vertices, edges)]
    cuts = [_best_cut(vertices, edges, axes)]
    while len(parts) < most:
        k = int(np.argmax([gain for gain, _ in cuts]))
        gain, halves = cuts[k]
        if gain <= least:
            break
        parts[k : k + 1] = halves
        cuts[k : k + 1] = [_best_cut(*half, axes) for half in halves]
    return [points for points, _ in parts]


def is_flat(points: Floats) -> bool:
    """Return whether points, shape (n, 3) [m], lie in one plane, or so close to it that they span no volume to speak of."""
    if len(points) < 4:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return bool(spread[-1] <= max(_THIN, _FLAT * spread[0]))


def thicken(points: Floats) -> Floats:
    """Return points that span a volume: these, or two layers of them `THICKNESS` apart if they are flat."""
    if not is_flat(points):
        return points
    axes = np.linalg.svd(points - points.mean(axis=0))[2]
    layers = [
        points + 0.5 * side * THICKNESS * axis for axis in axes for side in (-1.0, 1.0)
    ]  # also what is but a line
    return np.vstack(layers)


def _best_cut(points: Floats, edges: Ints, axes: Floats) -> tuple[float, list[tuple[Floats, Ints]]]:
    """Return by how much the best cut lessens the volume of the hulls [m³], and the two sides."""
    whole = _volume(points)
    best: tuple[float, list[tuple[Floats, Ints]]] = (0.0, [])
    if whole == 0.0:
        return best
    for axis in axes:
        along = points @ axis
        for place in np.linspace(along.min(), along.max(), _PLACES + 2)[1:-1]:
            sides = [_side(points, edges, sign * along, sign * place) for sign in (1.0, -1.0)]
            if min(len(side) for side, _ in sides) < 3:
                continue
            gain = whole - sum(_volume(side) for side, _ in sides)
            if gain > best[0]:
                best = (gain, sides)
    return best


def _side(points: Floats, edges: Ints, along: Floats, place: float) -> tuple[Floats, Ints]:
    """Return the points with `along` up to `place`, with those where edges cross it, and the edges among them."""
    kept = along <= place
    index = np.cumsum(kept) - 1
    inside = edges[kept[edges].all(axis=1)]
    crossing = edges[kept[edges[:, 0]] != kept[edges[:, 1]]]
    start, end = crossing[:, 0], crossing[:, 1]
    share = ((place - along[start]) / (along[end] - along[start]))[:, None]
    cut = points[start] * (1.0 - share) + points[end] * share
    stumps = np.column_stack(
        [index[np.where(kept[start], start, end)], kept.sum() + np.arange(len(cut))]
    )
    return np.vstack([points[kept], cut]), np.vstack([index[inside], stumps])


def _volume(points: Floats) -> float:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(points).volume) if len(points) > 3 else 0.0
    except (QhullError, ValueError):
        return 0.0
