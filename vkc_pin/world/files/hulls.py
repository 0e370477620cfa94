"""Computes convex hulls of points, and convex polytopes of few vertices around them."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats, find_unique_rows

if TYPE_CHECKING:
    import trimesh
    from scipy.spatial import ConvexHull


SHEET_THICKNESS = 1e-3
"""Thickness of flat parts, such as pictures and rugs [m]."""
# Of the largest extent: thinner than 10 µm in a metre is drawn as a sheet, not as a solid.
_FLATNESS_RATIO = 1e-5
_MIN_CUT_DEPTH = 5e-4  # [m]: no cut takes away less
_NUM_DIRECTIONS = 400  # of cuts, spread over the sphere
_NUM_CUTS = 12  # deepest planes of which one is chosen
# Twice the area of facets that count as none, relative to the square of the hull's size, as in
# trimesh for a size of 1 m
_NO_AREA = float(np.finfo(np.float64).resolution * 100.0)
_MAX_FACETS = 1000  # of a hull whose normals are all candidate cuts
# Options of Qhull, tried in this order: scaled to the unit cube, unscaled, and joggled.
_QHULL_OPTIONS = ("QbB Pp Qt", "Pp Qt", "Pp QJ")


def thicken(points: ArrayLike, flatness: float = 0.0) -> tuple[Floats, bool]:
    """Return points that span a volume, and whether the given ones, shape (n, 3) [m], do not.

    A plane set becomes a plate around it, a line a square bar, a point a cube, all with thickness
    `SHEET_THICKNESS`. So do sets thinner than `flatness` [m].
    """
    given = np.asarray(points, float)
    centered = given - given.mean(axis=0)
    # The principal axes of the points, as rows.
    _, eigenvectors = np.linalg.eigh(centered.T @ centered)
    axes = eigenvectors.T
    extents = np.ptp(centered @ axes.T, axis=0)
    (flat,) = np.nonzero(extents <= max(_FLATNESS_RATIO * extents.max(), flatness))
    found = given
    for axis in axes[flat]:
        half_thickness = SHEET_THICKNESS / 2.0 * axis
        found = np.concatenate([found - half_thickness, found + half_thickness])
    return found, bool(len(flat))


def compute_hull(points: ArrayLike) -> trimesh.Trimesh:
    """Return the convex hull of points, shape (n, 3) [m], as a mesh whose faces point outward.

    It equals `trimesh.convex.convex_hull` bit for bit, except for some thin bodies, for which Qhull
    returns overlapping triangles after scaling to the unit cube; trimesh then needs networkx and
    returns an inverted triangle. Here Qhull runs again without scaling.
    """
    from scipy.spatial import ConvexHull, QhullError

    given = np.asarray(points, float)
    for options in _QHULL_OPTIONS:
        with contextlib.suppress(QhullError):
            mesh = _orient_faces(ConvexHull(given, qhull_options=options))
            if mesh.is_winding_consistent:
                return mesh
    expected = "at least four points that are not in one plane"
    raise InputError("the points span no volume", expected=expected)


def _orient_faces(hull: ConvexHull) -> trimesh.Trimesh:
    """Return the triangles of a hull with normals that point away from its centroid."""
    import trimesh

    corners = np.sort(hull.vertices)
    vertices = hull.points[corners]
    faces = np.searchsorted(corners, hull.simplices)
    # Facets of small hulls have small areas: those without count relative to a size below 1 m.
    size = min(float(np.ptp(vertices, axis=0).max()), 1.0)
    crosses = trimesh.triangles.cross(vertices[faces])
    normals, has_area = trimesh.util.unitize(
        crosses, check_valid=True, threshold=_NO_AREA * size**2
    )
    faces = faces[has_area]
    centres = vertices[faces].mean(axis=1)
    areas = trimesh.triangles.area(vertices[faces])
    outward = centres - np.average(centres, weights=areas, axis=0)
    inverted = np.einsum("ij,ij->i", normals, outward) < 0.0
    faces[inverted] = faces[inverted][:, ::-1]
    normals[inverted] *= -1.0
    return trimesh.Trimesh(vertices, faces, face_normals=normals)


def compute_outer_hull(points: ArrayLike, *, vertices: int = 40) -> trimesh.Trimesh:
    """Return a convex polytope with few vertices that contains all points, up to 1e-9 m.

    The box along the principal axes of the hull is cut repeatedly by a tangent plane of the hull:
    of those deepest below a corner of the polytope, by the one that cuts off most volume. Flat sets
    are thickened first.

    Args:
        points: Shape (n, 3) [m].
        vertices: Maximum number of vertices.
    """
    thick_points, _ = thicken(points)
    hull = compute_hull(thick_points)
    corners = np.asarray(hull.vertices)
    normals = _sample_directions(hull)
    offsets = _compute_tangent_offsets(corners, normals)
    # The principal axes of the hull, as rows.
    _, eigenvectors = np.linalg.eigh(np.cov(corners.T))
    smallest = None
    for axes in (np.eye(3), eigenvectors.T):
        polytope = _cut_box(axes, corners, normals, offsets, vertices)
        if smallest is None or polytope.volume < smallest.volume:
            smallest = polytope
    assert smallest is not None
    return compute_hull(smallest.points)


def _compute_tangent_offsets(corners: Floats, normals: Floats) -> Floats:
    """Return the offsets d of the tangent planes normal·x = d of a hull, shape (k,) [m].

    The products are computed in parts: together, those of a fine mesh would take much memory.
    """
    parts = np.array_split(normals, 1 + len(normals) // 64)
    return np.concatenate([(corners @ part.T).max(axis=0) for part in parts])


def _cut_box(
    axes: Floats, corners: Floats, normals: Floats, offsets: Floats, vertices: int
) -> ConvexHull:
    """Return the box of a hull along `axes` after cuts; see `compute_outer_hull`.

    Args:
        axes: Axes of the box, as rows, shape (3, 3).
        corners: Corners of the hull, shape (n, 3) [m].
        normals: Normals of the candidate cuts, shape (k, 3).
        offsets: Their offsets, shape (k,) [m]; see `_compute_tangent_offsets`.
        vertices: Maximum number of vertices.
    """
    chosen_normals = np.vstack([axes, -axes])
    chosen_offsets = (corners @ chosen_normals.T).max(axis=0)
    polytope = _intersect_half_spaces(chosen_normals, chosen_offsets, corners)
    for _ in range(4 * vertices):
        depth = (polytope.points @ normals.T).max(axis=0) - offsets
        deepest = np.argsort(-depth)[:_NUM_CUTS]
        deepest = deepest[depth[deepest] > _MIN_CUT_DEPTH]
        volumes = _compute_cut_volumes(polytope, normals[deepest], offsets[deepest])
        largest_first = deepest[np.argsort(-volumes, kind="stable")]
        for k in largest_first:
            trial_normals = np.vstack([chosen_normals, normals[k]])
            trial_offsets = np.append(chosen_offsets, offsets[k])
            trial = _intersect_half_spaces(trial_normals, trial_offsets, corners)
            if len(trial.vertices) <= vertices:
                polytope = trial
                chosen_normals = trial_normals
                chosen_offsets = trial_offsets
                break
        else:
            # No cut is left that keeps to the number of vertices.
            break
    return polytope


def _sample_directions(hull: trimesh.Trimesh) -> Floats:
    """Return normals of candidate cuts: those of the hull, and some spread over the sphere.

    Of the many facets of a finely meshed hull, only the largest of each direction counts.
    """
    # A Fibonacci lattice: equal steps along z, and turns by the golden ratio.
    k = np.arange(_NUM_DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * k / _NUM_DIRECTIONS
    turn = np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z**2)
    spread = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
    normals = np.asarray(hull.face_normals)
    first, _ = find_unique_rows(normals.round(2))
    if len(first) > _MAX_FACETS:
        normals = normals[np.argsort(-hull.area_faces, kind="stable")]
        first, _ = find_unique_rows(normals.round(1))
    return np.vstack([normals[np.sort(first)], spread])


def _compute_cut_volumes(polytope: ConvexHull, normals: Floats, offsets: Floats) -> Floats:
    """Return the volumes of a polytope above planes, shape (k,) [m³].

    They are sums of cones over the surface above a plane, with the apex in that plane: a facet of
    the area A, whose plane is the distance h from the apex, contributes h A / 3 times the fraction
    of A above the cut. Facets are triangles with heights low ≤ middle ≤ high above the cut. If one
    corner is above it, a similar triangle is cut off, whose sides from that corner have the
    fractions high / (high − low) and high / (high − middle).
    """
    corners = polytope.points[polytope.simplices]
    first_edges = corners[:, 1] - corners[:, 0]
    second_edges = corners[:, 2] - corners[:, 0]
    double_areas = np.linalg.norm(np.cross(first_edges, second_edges), axis=1)
    facet_normals = polytope.equations[:, :3]
    facet_offsets = polytope.equations[:, 3]
    apexes = offsets[:, None] * normals
    cones = -(apexes @ facet_normals.T + facet_offsets) * double_areas / 6.0
    heights = np.einsum("ijk,lk->lij", corners, normals) - offsets[:, None, None]
    low, middle, high = np.moveaxis(np.sort(heights, axis=2), 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        one_corner_above = high**2 / ((high - low) * (high - middle))
        one_corner_below = 1.0 - low**2 / ((low - middle) * (low - high))
    fraction = np.where(
        middle <= 0.0,
        np.where(high > 0.0, one_corner_above, 0.0),
        np.where(low < 0.0, one_corner_below, 1.0),
    )
    return np.asarray((fraction * cones).sum(axis=1))


def _intersect_half_spaces(
    normals: NDArray[Any], offsets: NDArray[Any], inner: NDArray[Any]
) -> ConvexHull:
    """Return the polytope {x: normals·x ≤ offsets}, which contains the points `inner`."""
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    center = inner.mean(axis=0)
    half_spaces = np.column_stack([normals, -offsets])
    corners = HalfspaceIntersection(half_spaces, center).intersections
    corners = corners[np.isfinite(corners).all(axis=1)]
    first, _ = find_unique_rows(corners.round(7))
    return ConvexHull(corners[np.sort(first)])
