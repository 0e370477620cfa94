"""Divides polygons in space into triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.optional_imports import import_optional

# Cross products of edges, relative to the polygon's area vector, that count as straight: corners
# that lie on a side
_STRAIGHT = 1e-9


def triangulate_polygons(vertices: Floats, corners: Ints) -> Ints:
    """Return the triangles of polygons with the same number of corners, shape (k, 3).

    Convex polygons become fans about their first corner.

    Args:
        vertices: Shape (n, 3).
        corners: Vertices of each polygon in order, shape (m, c).
    """
    count = corners.shape[1]
    if count < 3:
        return np.empty((0, 3), np.int64)
    if count == 3:
        return corners
    is_convex = _are_convex(vertices[corners])
    convex = corners[is_convex]
    starts = np.repeat(convex[:, :1], count - 2, axis=1)
    fans = np.stack([starts, convex[:, 1:-1], convex[:, 2:]], axis=2).reshape(-1, 3)
    others = [triangulate_polygon(vertices, [polygon]) for polygon in corners[~is_convex]]
    return np.concatenate([fans, *others])


def triangulate_polygon(vertices: Floats, rings: Sequence[Ints]) -> Ints:
    """Return the triangles of one polygon, shape (k, 3), whose normals are the polygon's.

    Args:
        vertices: Shape (n, 3).
        rings: Vertices of the outline, and of each hole.
    """
    earcut = import_optional("mapbox_earcut", "import", purpose="a mesh of concave polygons")
    corners = np.concatenate(rings)
    outline = vertices[rings[0]]
    (normal,) = _compute_area_vectors(outline[None])
    # Of the three coordinate planes, that in which the polygon appears largest.
    largest = int(np.abs(normal).argmax())
    plane = [(largest + 1) % 3, (largest + 2) % 3]
    projected = np.ascontiguousarray(vertices[corners][:, plane], float)
    ring_ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    indices = earcut.triangulate_float64(projected, ring_ends)
    triangles = corners[indices.reshape(-1, 3).astype(np.int64)]
    area_vectors = _compute_area_vectors(vertices[triangles])
    is_inverted = area_vectors @ normal < 0.0
    triangles[is_inverted] = triangles[is_inverted][:, ::-1]
    return np.asarray(triangles)


def _are_convex(polygons: Floats) -> np.ndarray:
    """Return whether polygons, shape (m, c, 3), are convex, shape (m,)."""
    normals = _compute_area_vectors(polygons)
    straight = -_STRAIGHT * (normals**2).sum(axis=1)[:, None]
    edges = np.roll(polygons, -1, axis=1) - polygons
    turns = np.cross(edges, np.roll(edges, -1, axis=1))
    # Twice the area of the triangle at each corner, as it appears along the polygon's normal
    turn_areas = np.einsum("mci,mi->mc", turns, normals)
    turns_left = (turn_areas >= straight).all(axis=1)
    # A pentagram turns left everywhere, too, but twice around: its fan about a corner overlaps.
    first = polygons[:, :1]
    fans = np.cross(polygons[:, 1:-1] - first, polygons[:, 2:] - first)
    fan_areas = np.einsum("mci,mi->mc", fans, normals)
    is_star_free = (fan_areas >= straight).all(axis=1)
    return np.asarray(turns_left & is_star_free)


def _compute_area_vectors(polygons: Floats) -> Floats:
    """Return normals of polygons, shape (m, c, 3), as long as their areas times 2, shape (m, 3).

    Newell's method: the sum of v_k × v_(k+1), about the first corner.
    """
    corners = polygons - polygons[:, :1]
    next_corners = np.roll(corners, -1, axis=1)
    return np.asarray(np.cross(corners, next_corners).sum(axis=1))
