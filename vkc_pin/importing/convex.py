"""Decomposes concave meshes into convex pieces with CoACD (Wei et al., SIGGRAPH 2022).

Pieces contain the surface that they are made from, since planning would drive through whatever they
leave uncovered. CoACD takes closed meshes of few triangles; it would remesh others for minutes, so
these are cut by planes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import coal
import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.importing.parsers import cut_mesh
from vkc_pin.utils.arguments import check_coordinate, check_integer, check_number
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.disk_cache import load_or_build
from vkc_pin.world.files.hulls import compute_hull, compute_outer_hull
from vkc_pin.world.files.meshes import MeshPart, load_mesh, make_bvh, simplify_mesh
from vkc_pin.world.files.resources import check_path

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "ERROR",
    "PIECES",
    "THICKNESS",
    "Pieces",
    "compute_concavity",
    "compute_solid_volume",
    "decompose",
    "is_flat",
    "measure_outside",
    "slice_mesh",
    "thicken",
]

ERROR = 0.02
"""Largest protrusion of pieces over the surface [m], about the clearance margin of motions."""
PIECES = 12
"""Largest number of pieces of one mesh: planning time grows with their number."""
_VERSION = 1  # of the disk cache: increase it whenever the same mesh would be cut differently
_MAX_TRIANGLES = 2000  # of a mesh for CoACD, which takes minutes for larger ones
_CORNERS = 40  # largest number of vertices of a piece, as in the packaged collision geometry
# Pieces are simplified only above this multiple of the vertex limit: simplifying takes a second.
_CORNER_TOLERANCE = 1.5
_SAMPLES_PER_CELL = 16  # surface samples that detect the grid cells of a mesh's skin
_MAX_SAMPLES = 4_000_000
_SAMPLES = 1000  # samples on a surface in addition to its vertices
_POINT_RADIUS = 1e-6  # [m] radius of the sphere that stands for a point in distance queries
_CELLS = 96  # grid cells along the longest edge, for volumes of open meshes
_SEARCH = {
    "resolution": 1000
}  # samples with which CoACD rates cuts: half its default, half the time


@dataclass(frozen=True, eq=False)
class Pieces:
    """Convex pieces that together contain a mesh.

    Attributes:
        meshes: The pieces, closed, in the frame of the mesh [m].
        solid: Volume of the mesh itself [m³], including cavities that are not reachable from
            outside.
        error: Largest protrusion of the pieces over the mesh's surface [m], measured at samples.
    """

    meshes: tuple[trimesh.Trimesh, ...]
    solid: float
    error: float

    @property
    def volume(self) -> float:
        """Total volume of the pieces [m³]; overlaps count twice."""
        return float(sum(piece.volume for piece in self.meshes))

    @property
    def overhead(self) -> float:
        """Volume of the pieces in excess of the mesh, relative to it: 0.25 for a quarter more."""
        return self.volume / self.solid - 1.0


def decompose(
    mesh: str | Path | trimesh.Trimesh,
    *,
    most_pieces: int = PIECES,
    error: float = ERROR,
    overhead: float = 0.0,
    corners: int = _CORNERS,
    seed: int = 0,
) -> Pieces:
    """Decompose a mesh into convex pieces that contain it.

    The result is the convex hull if it is close to the mesh, else the hulls of its connected
    bodies, else those of the parts into which CoACD cuts it. The same mesh gives the same pieces;
    the parts of meshes that had to be cut are cached on disk.

    Args:
        mesh: A mesh file in [m], or a mesh; it need not be closed.
        most_pieces: Largest number of pieces.
        error: Largest protrusion of the pieces over the mesh's surface [m], unless it takes more
            pieces.
        overhead: A hull whose excess volume, relative to the mesh, is no larger than this is kept
            whole, wherever it protrudes.
        corners: Largest number of vertices. A piece with half as many again is replaced by an
            enclosing polytope.
        seed: Random seed.

    Raises:
        InputError: The mesh cannot be read, is empty or flat, or has to be cut and CoACD is not
            installed.
    """
    import trimesh

    check_integer(most_pieces, "most_pieces", low=1)
    check_integer(corners, "corners", low=8)
    error, overhead = check_coordinate(error, "error"), check_number(overhead, "overhead", low=0.0)
    if error <= 0.0:
        raise InputError(
            "`error` must be positive", field="error", expected="a number above 0 [m]", got=error
        )
    if isinstance(mesh, trimesh.Trimesh):
        file, loaded = None, mesh
    else:
        file = check_path(mesh, "mesh", "a mesh or a mesh file")
        loaded = load_mesh(file)
    hull = _make_hull(loaded.vertices, file)
    hulls, solid = [hull], min(compute_solid_volume(loaded), float(hull.volume))
    if (
        most_pieces > 1
        and hull.volume > (1.0 + overhead) * solid
        and _measure_protrusion(hulls, loaded) > error
    ):
        hulls = _make_body_hulls(loaded, most_pieces)
        if not hulls or _measure_protrusion(hulls, loaded) > error:

            def cut_pieces() -> list[list[list[float]]]:
                """Return the vertices of each piece."""
                parts = _cut_mesh(loaded, most_pieces, error, seed, file)
                parts = parts or [np.asarray(hull.vertices)]
                pieces = _simplify(_enclose_surface(parts, _sample_surface(loaded)), corners)
                return [piece.vertices.tolist() for piece in pieces]

            parts = load_or_build(
                _make_cache_key(loaded, most_pieces, error, corners, seed), cut_pieces
            )
            hulls = [compute_hull(np.array(part)) for part in parts]
    pieces = tuple(_simplify(hulls, corners))
    # The volume of an open mesh is only measured, and the pieces contain the mesh.
    solid = min(solid, float(sum(piece.volume for piece in pieces)))
    return Pieces(pieces, solid, _measure_protrusion(pieces, loaded))


def compute_concavity(mesh: trimesh.Trimesh) -> float:
    """Return the largest protrusion of a mesh's convex hull over its surface [m], sampled."""
    return _measure_protrusion([_make_hull(mesh.vertices, None)], mesh)


def compute_solid_volume(mesh: trimesh.Trimesh) -> float:
    """Return the volume of a mesh [m³].

    For a mesh that is not closed, this is the volume of grid cells that cannot be reached from
    outside; cells of the surface itself count half. Holes narrower than a hundredth of the mesh
    count as closed.
    """
    import trimesh
    from scipy import ndimage

    if mesh.is_volume and mesh.body_count == 1:
        return float(mesh.volume)
    pitch = float(mesh.extents.max()) / _CELLS
    low = mesh.bounds[0] - 1.5 * pitch
    size = np.ceil((mesh.bounds[1] - low) / pitch).astype(int) + 2
    skin = np.zeros(size, bool)
    count = int(min(_SAMPLES_PER_CELL * mesh.area / pitch**2, _MAX_SAMPLES)) + 1
    points = np.vstack([mesh.vertices, trimesh.sample.sample_surface(mesh, count, seed=0)[0]])
    skin[tuple(np.floor((points - low) / pitch).astype(int).T)] = True
    regions, _ = ndimage.label(~skin)
    inside = ~skin & (regions != regions[0, 0, 0])
    return float((inside.sum() + 0.5 * skin.sum()) * pitch**3)


def _make_cache_key(mesh: trimesh.Trimesh, *settings: float) -> bytes:
    """Return a key of everything that the pieces of a mesh depend on."""
    surface = hashlib.sha256(
        np.asarray(mesh.vertices, float).tobytes() + np.asarray(mesh.faces, np.int64).tobytes()
    )
    return json.dumps(("pieces", _VERSION, settings, surface.hexdigest())).encode()


def _simplify(pieces: Sequence[trimesh.Trimesh], corners: int) -> list[trimesh.Trimesh]:
    """Replace pieces with many vertices by enclosing polytopes with few."""
    return [
        compute_outer_hull(one.vertices, vertices=corners)
        if len(one.vertices) > _CORNER_TOLERANCE * corners
        else one
        for one in pieces
    ]


def _make_body_hulls(mesh: trimesh.Trimesh, max_parts: int) -> list[trimesh.Trimesh]:
    """Return the hulls of a mesh's connected bodies."""
    merged = _merge_vertices(mesh)
    if not 1 < merged.body_count <= max_parts:
        return []
    bodies = [
        np.asarray(body.vertices) for body in merged.split(only_watertight=False, repair=False)
    ]
    return [] if any(map(is_flat, bodies)) else [_make_hull(body, None) for body in bodies]


def _cut_mesh(
    mesh: trimesh.Trimesh, max_parts: int, error: float, seed: int, file: Path | None
) -> list[Floats]:
    """Return the vertices of parts of a mesh."""
    import trimesh

    merged = _merge_vertices(mesh)
    if not merged.is_volume or len(merged.faces) > _MAX_TRIANGLES:
        coarse = simplify_mesh(
            MeshPart(np.asarray(merged.vertices), np.asarray(merged.faces)),
            merged.extents.max() / _CELLS,
        )
        return [
            thicken(part)
            for part in slice_mesh(trimesh.Trimesh(coarse.vertices, coarse.faces), max_parts)
        ]
    parts = cut_mesh(
        np.asarray(merged.vertices),
        np.asarray(merged.faces),
        file,
        threshold=error,
        real_metric=True,
        max_convex_hull=max_parts,
        seed=seed,
        preprocess_mode="off",
        **_SEARCH,
    )
    return [corners for part in parts if not is_flat(corners := np.asarray(part))]


def _merge_vertices(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a copy of a mesh in which coincident vertices are merged."""
    merged = mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    return merged


def _make_hull(points: Any, file: Path | None) -> trimesh.Trimesh:
    """Return the convex hull of points, which must not be flat."""
    points = np.asarray(points, float)
    if is_flat(points):
        raise InputError(
            "the mesh is flat",
            file=file,
            expected="triangles that enclose a volume",
            got="triangles in one plane",
        )
    return compute_hull(points)


def _sample_surface(mesh: trimesh.Trimesh) -> Floats:
    """Return points on a mesh, shape (n, 3): its vertices, and samples uniform by area."""
    import trimesh

    samples, _ = trimesh.sample.sample_surface(mesh, 4 * _SAMPLES, seed=0)
    return np.vstack([np.asarray(mesh.vertices), np.asarray(samples)])


def _measure_protrusion(pieces: Sequence[trimesh.Trimesh], mesh: trimesh.Trimesh) -> float:
    """Return the largest distance of the pieces' outer surface from a mesh [m], sampled."""
    import trimesh

    triangles, here, request, result = (
        make_bvh(mesh),
        coal.Transform3s(),
        coal.DistanceRequest(),
        coal.DistanceResult(),
    )
    triangles.computeLocalAABB()
    point_shape, furthest = coal.Sphere(_POINT_RADIUS), 0.0
    for piece in pieces:
        points = np.vstack(
            [piece.triangles_center, trimesh.sample.sample_surface(piece, _SAMPLES, seed=0)[0]]
        )
        is_covered = np.zeros(len(points), bool)
        for other in pieces:
            if other is not piece:
                is_covered |= measure_outside(other, points) < -_POINT_RADIUS
        for point in points[~is_covered]:
            result.clear()
            place = coal.Transform3s(np.eye(3), point)
            distance = coal.distance(point_shape, place, triangles, here, request, result)
            furthest = max(furthest, distance)
    return furthest


def measure_outside(piece: trimesh.Trimesh, points: Floats) -> Floats:
    """Return the signed distances of points, shape (n, 3), from a convex piece, shape (n,) [m]."""
    normals = np.asarray(piece.face_normals)
    return np.asarray(
        (
            points @ normals.T - np.einsum("ij,ij->i", normals, np.asarray(piece.triangles)[:, 0])
        ).max(axis=1)
    )


def _enclose_surface(parts: list[Floats], surface: Floats) -> list[trimesh.Trimesh]:
    """Return the hulls of parts, extended to contain a surface."""
    hulls = [compute_hull(part) for part in parts]
    beyond = np.array([measure_outside(hull, surface) for hull in hulls])
    nearest, is_outside = beyond.argmin(axis=0), beyond.min(axis=0) > 1e-9
    return [
        compute_hull(np.vstack([np.asarray(hull.vertices), surface[is_outside & (nearest == k)]]))
        for k, hull in enumerate(hulls)
    ]


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
