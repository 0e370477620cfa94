"""Decomposes meshes into convex pieces that contain them.

Planning would drive through parts of a surface that no piece contains. The surface is therefore cut
by planes until the hulls of its parts hardly protrude over it; then parts whose common hull
protrudes little are merged. Every point of the surface stays in a part, whether the mesh is closed
or open, manifold or not.
"""

from __future__ import annotations

import hashlib
import heapq
import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import coal
import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import (
    check_coordinate,
    check_finite_array,
    check_integer,
    check_number,
)
from vkc_pin.utils.arrays import Floats, Ints, find_unique_rows
from vkc_pin.utils.disk_cache import load_or_build
from vkc_pin.world.files.hulls import SHEET_THICKNESS, compute_hull, compute_outer_hull, thicken
from vkc_pin.world.files.meshes import MeshPart, load_mesh, make_bvh
from vkc_pin.world.files.resources import check_path

if TYPE_CHECKING:
    import trimesh


ERROR = 0.02
"""Largest protrusion of pieces over the surface [m], about the clearance margin of motions."""
PIECES = 12
"""Number of pieces of one mesh, unless cavities need more: planning time grows with it."""
_VERSION = 5  # of the disk cache: increase it whenever the same mesh would be cut differently
_CORNERS = 40  # largest number of vertices of a piece, as in the packaged collision geometry
# Pieces are simplified only above this multiple of the vertex limit: simplifying takes a second.
_CORNER_TOLERANCE = 1.5
# Multiples of the vertex limit that are tried in turn while pieces protrude too far
_CORNER_FACTORS = (1, 2, 4)
_CONVEX = 1e-4  # [m] protrusion of the hull of a mesh that counts as convex
# Of the error: part of a piece's protrusion that comes of few vertices and is not worth more
_CORNER_SHARE = 0.2
_FLATNESS = 1e-4  # [m] thickness up to which parts become plates
_SAMPLES_PER_CELL = 16  # surface samples that detect the grid cells of a mesh's skin
_MAX_SAMPLES = 4_000_000
_SAMPLES = 1000  # samples on a surface in addition to its vertices
_BOUNDING_SAMPLES = 20_000  # samples on a mesh that bound distances from it
_BATCH = 256  # samples that are looked for in other pieces at once
_OUTWARD = 1e-5  # [m] offset of samples that tells outer faces from faces between pieces
_POINT_RADIUS = 1e-6  # [m] radius of the sphere that stands for a point in distance queries
_CELLS = 96  # grid cells along the longest edge, for volumes of open meshes
_MAX_CELLS = 1_000_000  # of the grid that tells outer from inner space while a mesh is cut
_CUT_SHARE = 0.4  # of the error: parts that protrude by less are not cut
_FREE_SHARE = 0.5  # of the error: pieces are merged up to this even if there are few
_MERGE_SHARE = 0.8  # of the error: leaves room for what samples miss and for fewer vertices
_EXTRA = 4  # multiple of `PIECES` up to which the error matters more than the number
_MAX_PARTS = 64  # of a mesh before merging
# Triangles for which the cuts of one mesh are sought, about a minute: there are up to `_MAX_PARTS`
# cuts, of all that is left each
_MAX_CUT_TRIANGLES = 20_000_000
_MAX_HULL_POINTS = 1000  # of a part: if it has more, its hull is that of its extreme ones
_MAX_TRIANGLES = 600  # of a part while its best cut is sought
_MAX_COARSE_TRIANGLES = 150  # of a part while the most promising cuts are sought
_PROMISING_PLANES = 8  # number of these cuts
# Candidate cuts
_FACET_PLANES = 10  # through facets
_AXIS_PLANES = 7  # across each axis
# Costs of a merged hull besides its protrusion
_VOLUME_COST = 2.0  # of its mean thickness over the two
_SIZE_COST = 0.02  # of its size
_MIN_FACET = 0.02  # smallest area of a facet that is a candidate, relative to the part
# Reduction of volume, relative to the hull, that outweighs a facet of the whole part's area
_FACET_BONUS = 0.3
_SNAP = 3e-5  # [m] distance from a plane that counts as zero


@dataclass(frozen=True, eq=False)
class Pieces:
    """Convex pieces that together contain a mesh.

    Attributes:
        meshes: The pieces, closed, in the frame of the mesh [m].
        error: Largest protrusion of the pieces over the mesh's surface [m], measured at samples.
        mesh: The mesh.
    """

    meshes: tuple[trimesh.Trimesh, ...]
    error: float
    mesh: trimesh.Trimesh

    @cached_property
    def hull_volume(self) -> float:
        """Volume of the convex hull of the mesh [m³]."""
        return float(_make_hull(self.mesh.vertices).volume)

    @cached_property
    def solid(self) -> float:
        """Volume of the mesh [m³], including cavities that are not reachable from outside."""
        # The volume of an open mesh is only measured, and hull and pieces contain the mesh.
        return min(compute_solid_volume(self.mesh), self.hull_volume, self.volume)

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
    most_pieces: int | None = None,
    error: float = ERROR,
    overhead: float = 0.0,
    corners: int = _CORNERS,
) -> Pieces:
    """Decompose a mesh into convex pieces that contain it.

    The result is the convex hull if it is close to the mesh, else the hulls of parts into which
    planes cut the surface. Parts thinner than 0.1 mm become plates of 1 mm. The same mesh gives the
    same pieces; those of meshes that had to be cut are cached on disk.

    Args:
        mesh: A mesh file in [m], or a mesh. It may be open, non-manifold or flat.
        most_pieces: Largest number of pieces. Defaults to `PIECES`, and to four times as many where
            fewer would protrude by more than `error`, as those of a cabinet with many shelves.
        error: Largest protrusion of the pieces over the mesh's surface [m], unless it takes more
            pieces: see `Pieces.error`.
        overhead: A hull whose excess volume, relative to the mesh, is no larger than this is kept
            whole, wherever it protrudes.
        corners: Largest number of vertices. A piece with half as many again is replaced by an
            enclosing polytope; where the pieces would then protrude by more than `error`, by one
            with up to four times as many, or not at all. A mesh that is convex keeps its hull of up
            to six times as many.

    Raises:
        InputError: The mesh cannot be read or is empty, or an argument is invalid.
    """
    import trimesh

    if most_pieces is not None:
        check_integer(most_pieces, "most_pieces", low=1)
    check_integer(corners, "corners", low=8)
    error = check_coordinate(error, "error")
    overhead = check_number(overhead, "overhead", low=0.0)
    if error <= 0.0:
        raise InputError(
            "`error` must be positive", field="error", expected="a number above 0 [m]", got=error
        )
    if isinstance(mesh, trimesh.Trimesh):
        loaded = mesh
        check_finite_array(loaded.vertices, "mesh.vertices")
        if not len(loaded.faces):
            raise InputError("the mesh is empty", field="mesh", expected="at least one triangle")
    else:
        loaded = load_mesh(check_path(mesh, "mesh", "a mesh or a mesh file"))

    def is_sufficient(hull: Pieces) -> bool:
        if most_pieces == 1 or hull.error <= error:
            return True
        return overhead > 0.0 and not is_flat(loaded) and hull.overhead <= overhead

    hull = _measure_pieces([_make_hull(loaded.vertices)], loaded)
    if is_sufficient(hull):
        return _simplify(hull, corners, error, is_sufficient)

    def cut_pieces() -> list[list[list[float]]]:
        """Return the vertices of each piece."""
        parts = _cut_mesh(loaded, most_pieces, error)
        exact = _measure_pieces([_make_hull(part) for part in parts], loaded)
        pieces = _simplify(exact, corners, error, lambda simplified: True)
        return [piece.vertices.tolist() for piece in pieces.meshes]

    key = _make_cache_key(loaded, most_pieces, error, corners)
    pieces = [compute_hull(np.array(piece)) for piece in load_or_build(key, cut_pieces)]
    return _measure_pieces(pieces, loaded)


def compute_concavity(mesh: trimesh.Trimesh) -> float:
    """Return the largest protrusion of a mesh's convex hull over its surface [m], sampled."""
    return _measure_protrusion([_make_hull(mesh.vertices)], mesh)


def compute_solid_volume(mesh: trimesh.Trimesh) -> float:
    """Return the volume of a mesh [m³].

    For a mesh that is not closed, this is the volume of grid cells that cannot be reached from
    outside; cells of the surface itself count half. Holes narrower than a hundredth of the mesh
    count as closed.
    """
    if mesh.is_volume and mesh.body_count == 1:
        return float(mesh.volume)
    grid = _Grid(mesh, max(float(mesh.extents.max()), SHEET_THICKNESS) / _CELLS)
    inside = (~grid.is_outside).sum() - 0.5 * grid.is_skin.sum()
    return float(inside * grid.pitch**3)


def is_flat(mesh: trimesh.Trimesh) -> bool:
    """Return whether a mesh lies almost in one plane, so that it becomes a plate."""
    _, was_flat = thicken(mesh.vertices, _FLATNESS)
    return was_flat


def measure_outside(piece: trimesh.Trimesh, points: Floats) -> Floats:
    """Return the signed distances of points, shape (n, 3), from a convex piece, shape (n,) [m].

    They are those from the plane of the face that a point is furthest beyond: exact inside, and
    at most the distance outside.
    """
    normals = np.asarray(piece.face_normals)
    offsets = np.einsum("ij,ij->i", normals, np.asarray(piece.triangles)[:, 0])
    distances = points @ normals.T - offsets
    return np.asarray(distances.max(axis=1))


def _make_cache_key(mesh: trimesh.Trimesh, *settings: float | None) -> bytes:
    """Return a key of everything that the pieces of a mesh depend on."""
    vertices = np.asarray(mesh.vertices, float).tobytes()
    faces = np.asarray(mesh.faces, np.int64).tobytes()
    surface = hashlib.sha256(vertices + faces)
    return json.dumps(("pieces", _VERSION, settings, surface.hexdigest())).encode()


def _make_hull(points: Floats) -> trimesh.Trimesh:
    """Return the convex hull of points, or a plate around flat ones."""
    thickened, _ = thicken(points, _FLATNESS)
    return compute_hull(thickened)


def _measure_pieces(pieces: Sequence[trimesh.Trimesh], mesh: trimesh.Trimesh) -> Pieces:
    return Pieces(tuple(pieces), _measure_protrusion(pieces, mesh), mesh)


def _simplify(
    exact: Pieces, corners: int, error: float, is_sufficient: Callable[[Pieces], bool]
) -> Pieces:
    """Return polytopes with few vertices around pieces.

    Those that protrude far over their piece get more vertices, up to all, while the pieces miss
    `error` [m] or are not sufficient: protrusions block motions, vertices cost little time.
    """
    most = _CORNER_TOLERANCE * _CORNER_FACTORS[-1] * corners
    if exact.error <= _CONVEX and all(len(piece.vertices) <= most for piece in exact.meshes):
        return exact
    slack = _CORNER_SHARE * error
    aim = error if exact.error <= error else exact.error + slack
    pieces = list(exact.meshes)
    for factor in _CORNER_FACTORS:
        for k, piece in enumerate(exact.meshes):
            if len(piece.vertices) <= _CORNER_TOLERANCE * factor * corners:
                pieces[k] = piece
            elif factor == 1 or measure_outside(piece, pieces[k].vertices).max() > slack:
                pieces[k] = compute_outer_hull(piece.vertices, vertices=factor * corners)
        simplified = _measure_pieces(pieces, exact.mesh)
        if simplified.error <= aim and is_sufficient(simplified):
            return simplified
    return exact


def _measure_protrusion(pieces: Sequence[trimesh.Trimesh], mesh: trimesh.Trimesh) -> float:
    """Return the largest distance of the pieces' outer surface from a mesh [m], sampled."""
    import trimesh
    from scipy.spatial import KDTree

    # coal 3.0.3 takes points for inside if any triangle has no area.
    has_area = mesh.area_faces > 0.0
    if not has_area.any():
        return 0.0
    vertices = np.asarray(mesh.vertices)
    faces = np.asarray(mesh.faces)[has_area]
    triangles = make_bvh(MeshPart(vertices, faces))
    triangles.computeLocalAABB()
    origin = coal.Transform3s()
    request = coal.DistanceRequest()
    result = coal.DistanceResult()
    point = coal.Sphere(_POINT_RADIUS)
    # Of each piece: the middles of its largest triangles, and samples
    points = list[Floats]()
    normals = list[Floats]()
    for piece in pieces:
        samples, sampled = trimesh.sample.sample_surface(piece, _SAMPLES, seed=0)
        largest = np.argsort(-piece.area_faces, kind="stable")[:_SAMPLES]
        points += [piece.triangles_center[largest], samples]
        normals += [piece.face_normals[largest], piece.face_normals[sampled]]
    places = np.vstack(points)
    owners = np.repeat(np.arange(len(points)) // 2, [len(group) for group in points])
    outward = places + _OUTWARD * np.vstack(normals)
    # No point is further from the surface than from the nearest point of it: few are measured.
    known, _ = trimesh.sample.sample_surface(mesh, _BOUNDING_SAMPLES, seed=0)
    bounds, _ = KDTree(np.vstack([vertices[np.unique(faces)], known])).query(places)
    order = np.argsort(-bounds)
    furthest = 0.0
    for batch in np.split(order, range(_BATCH, len(order), _BATCH)):
        is_covered = np.zeros(len(batch), bool)
        for number, piece in enumerate(pieces):
            others = owners[batch] != number
            is_covered[others] |= measure_outside(piece, outward[batch[others]]) < 0.0
        for k in batch[~is_covered]:
            if bounds[k] <= furthest:
                return furthest
            result.clear()
            place = coal.Transform3s(np.eye(3), places[k])
            distance = coal.distance(point, place, triangles, origin, request, result)
            furthest = max(furthest, distance)
    return furthest


class _Grid:
    """Cells around a mesh.

    Attributes:
        low: Corner of the first cell, shape (3,) [m].
        pitch: Edge of a cell [m].
        points: Vertices and samples of the surface, shape (n, 3) [m].
        is_skin: Whether cells hold points of the surface, shape (i, j, k).
        is_outside: Whether cells can be reached from outside, shape (i, j, k).
    """

    def __init__(self, mesh: trimesh.Trimesh, pitch: float) -> None:
        import trimesh
        from scipy import ndimage

        self.pitch = pitch
        self.low = mesh.bounds[0] - 1.5 * pitch
        size = np.ceil((mesh.bounds[1] - self.low) / pitch).astype(int) + 2
        self.is_skin = np.zeros(size, bool)
        count = int(min(_SAMPLES_PER_CELL * mesh.area / pitch**2, _MAX_SAMPLES)) + 1
        samples, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
        self.points = np.vstack([mesh.vertices, samples])
        self.is_skin[self.find_cells(self.points)] = True
        regions, _ = ndimage.label(~self.is_skin)
        self.is_outside = regions == regions[0, 0, 0]

    def find_cells(self, points: Floats) -> tuple[Ints, ...]:
        """Return the indices of the cells of points, or of the nearest cells."""
        cells = np.floor((points - self.low) / self.pitch).astype(int)
        return tuple(np.clip(cells, 0, np.array(self.is_skin.shape) - 1).T)


class _Surface:
    """Estimates protrusions over a mesh, faster than `_measure_protrusion`."""

    def __init__(self, mesh: trimesh.Trimesh, error: float) -> None:
        from scipy import ndimage

        volume = float(np.prod(mesh.extents + 0.1 * mesh.extents.max()))
        smallest_pitch = (volume / _MAX_CELLS) ** (1.0 / 3.0)
        self._grid = _Grid(mesh, max(error / 3.0, smallest_pitch))
        is_skin = self._grid.is_skin
        points = self._grid.points
        # Each cell of the skin has a number, and the centre of the points in it.
        numbers = np.cumsum(is_skin.ravel()) - 1
        cells = numbers[np.ravel_multi_index(self._grid.find_cells(points), is_skin.shape)]
        sums = [np.bincount(cells, weights=coordinates) for coordinates in points.T]
        self._centres = np.column_stack(sums) / np.bincount(cells)[:, None]
        nearest = ndimage.distance_transform_edt(
            ~is_skin, return_distances=False, return_indices=True
        )
        self._nearest = numbers.reshape(is_skin.shape)[tuple(nearest)]

    def measure_protrusion(self, points: Floats) -> float:
        """Return the largest distance of points from the solid mesh [m]; 0 within its skin."""
        cells = self._grid.find_cells(points)
        squares = ((points - self._centres[self._nearest[cells]]) ** 2).sum(axis=1)
        # The surface comes nearer than the centre of its points in a cell.
        squares = np.maximum(squares - 0.75 * self._grid.pitch**2, 0.0)
        return float(np.sqrt(np.where(self._grid.is_outside[cells], squares, 0.0).max()))


# Points of a unit cube that choose samples on triangles
_RANDOM = np.random.default_rng(0).random((400, 3))


# Directions spread over the sphere, in which the outlines of smooth parts are taken
_DIRECTIONS = np.random.default_rng(1).normal(size=(3, 128)).T


def _choose_extremes(points: Floats) -> Floats:
    """Return the points that are extreme in some direction, at most one for each."""
    if len(points) <= len(_DIRECTIONS):
        return points
    return points[np.unique((_DIRECTIONS @ points.T).argmax(axis=1))]


# Choice of points on two outlines whose midpoints bound the protrusion of the common hull
_MIDPOINTS = np.random.default_rng(2).integers(2**31, size=(2, 64))


class _Hull:
    """Convex hull of parts of a mesh's surface.

    Attributes:
        parts: Vertices of each part, shape (k, 3) [m].
        outline: Corners from which its measures are computed, shape (l, 3) [m].
        bounds: Corners of the box around it, shape (2, 3) [m].
        protrusion: Protrusion over the whole mesh [m].
    """

    def __init__(self, points: Floats, surface: _Surface, parts: Sequence[Floats] = ()) -> None:
        from scipy.spatial import ConvexHull, QhullError

        self.parts = parts or (points,)
        points, _ = thicken(points, _FLATNESS)
        if len(points) > _MAX_HULL_POINTS:
            points = _choose_extremes(points)
        try:
            hull = ConvexHull(points)
        except QhullError:
            hull = ConvexHull(points, qhull_options="QJ Pp")
        found = points[hull.vertices]
        self.outline = _choose_extremes(found)
        self.volume = float(hull.volume)
        self.area = float(hull.area)
        self.bounds = np.array([found.min(axis=0), found.max(axis=0)])
        triangles = points[hull.simplices]
        samples = _sample_triangles(triangles)
        self.protrusion = surface.measure_protrusion(samples)


def _sample_triangles(triangles: Floats) -> Floats:
    """Return samples on triangles, shape (m, 3, 3), and the middles of the largest, shape (n, 3).

    A sample takes its triangle by area, at even steps with a random offset each. In the triangle
    a b c, with u² and v uniform in [0, 1], a + u (b - a) + u v (c - b) is uniform.
    """
    a, b, c = triangles.transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1).cumsum()
    steps = (np.arange(len(_RANDOM)) + _RANDOM[:, 2]) / len(_RANDOM) * areas[-1]
    a, b, c = triangles[np.searchsorted(areas, steps)].transpose(1, 0, 2)
    u = np.sqrt(_RANDOM[:, :1])
    v = _RANDOM[:, 1:2]
    samples = a + u * (b - a) + u * v * (c - b)
    largest = np.argsort(-np.diff(areas, prepend=0.0))[: len(_RANDOM)]
    return np.vstack([samples, triangles[largest].mean(axis=1)])


def _cut_mesh(mesh: trimesh.Trimesh, most_pieces: int | None, error: float) -> list[Floats]:
    """Return points whose hulls contain a mesh, for each piece."""
    merged = mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    merged.update_faces(merged.area_faces > 0.0)
    surface = _Surface(merged, error)
    hulls = _cut_surface(merged, surface, _CUT_SHARE * error)

    @cache
    def unite(one: _Hull, other: _Hull) -> _Hull:
        outline = np.vstack([one.outline, other.outline])
        return _Hull(outline, surface, [*one.parts, *other.parts])

    @cache
    def estimate(one: _Hull, other: _Hull) -> float:
        first, second = _MIDPOINTS
        starts = one.outline[first % len(one.outline)]
        ends = other.outline[second % len(other.outline)]
        return surface.measure_protrusion((starts + ends) / 2.0)

    few = PIECES if most_pieces is None else most_pieces
    most = _EXTRA * PIECES if most_pieces is None else most_pieces
    # Ever larger protrusions are allowed, down to ever larger numbers of pieces.
    hulls = _merge_hulls(hulls, unite, estimate, _FREE_SHARE * error, 1)
    hulls = _merge_hulls(hulls, unite, estimate, _MERGE_SHARE * error, few)
    hulls = _merge_hulls(hulls, unite, estimate, error, few)
    hulls = _merge_hulls(hulls, unite, estimate, np.inf, most)
    return [np.vstack(hull.parts) for hull in hulls]


def _cut_surface(mesh: trimesh.Trimesh, surface: _Surface, limit: float) -> list[_Hull]:
    """Cut a mesh into parts that protrude by at most `limit` [m], or into `_MAX_PARTS`."""
    import trimesh

    vertices = np.asarray(mesh.vertices, float)
    faces = np.asarray(mesh.faces)
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(faces))
    body_count = labels.max() + 1
    groups = [faces]
    if body_count <= _MAX_PARTS // 2:
        groups = [faces[labels == k] for k in range(body_count)]
    finished = list[_Hull]()
    # The part that protrudes most comes first; of equal ones, the first that was added.
    numbers = itertools.count()
    queue = list[tuple[float, int, _Hull, Floats, Ints]]()

    def add_part(vertices: Floats, faces: Ints) -> None:
        used, renumbered = np.unique(faces, return_inverse=True)
        own_vertices = vertices[used]
        own_faces = renumbered.reshape(-1, 3)
        hull = _Hull(own_vertices, surface)
        heapq.heappush(queue, (-hull.protrusion, next(numbers), hull, own_vertices, own_faces))

    for group in groups:
        add_part(vertices, group)
    work = 0  # triangles for which cuts were sought
    # Each step finishes a part, or divides it into more parts: there are at most `_MAX_PARTS`.
    while queue and len(queue) + len(finished) < _MAX_PARTS and work < _MAX_CUT_TRIANGLES:
        *_, hull, vertices, faces = heapq.heappop(queue)
        work += len(faces)
        parts = _divide(vertices, faces) if hull.protrusion > limit else []
        if not parts:
            finished.append(hull)
        for part in parts:
            add_part(*part)
    return finished + [hull for *_, hull, _, _ in queue]


def _divide(vertices: Floats, faces: Ints) -> list[tuple[Floats, Ints]]:
    """Return the parts into which the best cut that divides a part cuts it; none if no cut does.

    Cuts are rated on a coarser surface: all of the part may lie on one side of the best.
    """
    for normal, offset in _rank_cuts(vertices, faces):
        parts = _clip(vertices, faces, normal, offset)
        if len(parts) > 1:
            return parts
    return []


def _clip(
    vertices: Floats, faces: Ints, normal: Floats, offset: float
) -> list[tuple[Floats, Ints]]:
    """Return the triangles in a plane, below and above it, where there are any.

    Triangles across the plane are divided.
    """
    import trimesh

    heights = _measure_heights(vertices, normal, offset)
    in_plane = (heights[faces] == 0.0).all(axis=1)
    parts = [(vertices, faces[in_plane])]
    others = faces[~in_plane]
    for sign in (-1.0, 1.0):
        part_vertices, part_faces, *_ = trimesh.intersections.slice_faces_plane(
            vertices, others, sign * normal, offset * normal, cached_dots=sign * heights
        )
        parts.append((part_vertices, part_faces))
    return [part for part in parts if len(part[1])]


def _measure_heights(vertices: Floats, normal: Floats, offset: float) -> Floats:
    """Return the heights of vertices above a plane, shape (n,) [m]; small ones become 0."""
    heights = vertices @ normal - offset
    return np.where(np.abs(heights) < _SNAP, 0.0, heights)


def _rank_cuts(vertices: Floats, faces: Ints) -> Iterator[tuple[Floats, float]]:
    """Yield normals and offsets of planes that divide a part, the best first.

    The best reduces the volume of the hulls most. Several cuts may be needed before the volume
    falls, since the hull of half a ring is half a disc: planes of large facets, and to a lesser
    degree those through the middle, are preferred.
    """
    vertices, faces = _coarsen(vertices, faces, _MAX_TRIANGLES)
    planes = list(_list_planes(vertices, faces))
    if len(faces) > _MAX_COARSE_TRIANGLES:
        values = _rate_planes(*_coarsen(vertices, faces, _MAX_COARSE_TRIANGLES), planes)
        best = np.argsort(-values, kind="stable")[:_PROMISING_PLANES]
        planes = [planes[k] for k in np.sort(best)]
    values = _rate_planes(vertices, faces, planes)
    for k in np.argsort(-values, kind="stable"):
        if np.isfinite(values[k]):
            normal, offset, _ = planes[k]
            yield normal, offset


def _rate_planes(
    vertices: Floats, faces: Ints, planes: Sequence[tuple[Floats, float, float]]
) -> Floats:
    """Return the relative reduction of the hulls' volume by planes plus bonuses, shape (k,).

    It is -inf for planes that leave the part whole.
    """
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    first, _ = find_unique_rows(edges)
    edges = edges[first]
    _, is_flat_part = thicken(vertices, _FLATNESS)
    flatness = _FLATNESS if is_flat_part else 0.0
    whole = _compute_hull_volume(vertices, flatness)
    values = np.full(len(planes), -np.inf)
    for number, (normal, offset, bonus) in enumerate(planes):
        heights = _measure_heights(vertices, normal, offset)
        ends = heights[edges]
        is_across = (ends.min(axis=1) < 0.0) & (ends.max(axis=1) > 0.0)
        # An edge from p to p' crosses the plane at p + h / (h - h') (p' - p), with the heights h
        # and h' of its ends.
        start_height, end_height = ends[is_across].T
        fraction = (start_height / (start_height - end_height))[:, None]
        start, end = vertices[edges[is_across]].transpose(1, 0, 2)
        crossings = start + fraction * (end - start)
        has_faces_in_plane = bool((heights[faces] == 0.0).all(axis=1).any())
        sides = int(has_faces_in_plane)
        volumes = 0.0
        for above in (-heights, heights):
            used = np.zeros(len(vertices), bool)
            used[faces[(above[faces] > 0.0).any(axis=1)]] = True
            used &= above >= 0.0
            sides += bool(used.any())
            volumes += _compute_hull_volume(np.vstack([vertices[used], crossings]), flatness)
        if sides > 1:
            values[number] = (whole - volumes) / whole + bonus
    return values


def _list_planes(vertices: Floats, faces: Ints) -> Iterator[tuple[Floats, float, float]]:
    """Yield normals, offsets and bonuses of planes through large facets and across the axes."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    has_area = areas > 0.0
    corners = corners[has_area]
    areas = areas[has_area]
    normals = normals[has_area] / areas[:, None]
    # Opposite normals mean the same plane.
    largest = np.abs(normals).argmax(axis=1)
    normals *= np.sign(normals[np.arange(len(normals)), largest])[:, None]
    offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
    extent = float(np.ptp(vertices, axis=0).max())
    planes = np.column_stack([normals, offsets])
    _, group = find_unique_rows((planes / (1, 1, 1, extent)).round(3))
    facets = np.bincount(group, areas)
    sums = [np.bincount(group, areas * column) for column in planes.T]
    means = np.asarray(np.column_stack(sums), float)
    means = means / np.linalg.norm(means[:, :3], axis=1, keepdims=True)
    total_area = areas.sum()
    for k in np.argsort(-facets, kind="stable")[:_FACET_PLANES]:
        if facets[k] > _MIN_FACET * total_area:
            yield means[k, :3], float(means[k, 3]), _FACET_BONUS * float(facets[k] / total_area)
    _, principal_axes = np.linalg.eigh(np.cov(vertices.T))
    for axis in np.vstack([np.eye(3), principal_axes.T]):
        along = vertices @ axis
        low = along.min()
        high = along.max()
        for place in np.linspace(low, high, _AXIS_PLANES + 2)[1:-1]:
            rank = (high - low) / extent - 3.0 * abs(place - (low + high) / 2.0) / extent
            yield axis, float(place), 0.01 * float(rank)


def _coarsen(vertices: Floats, faces: Ints, most: int) -> tuple[Floats, Ints]:
    """Return at most `most` triangles between vertices of a mesh.

    In each cell of a grid, the vertex at the sharpest corner stands for all, so that facets stay in
    their planes.
    """
    import trimesh

    if len(faces) <= most:
        return vertices, faces
    normals = np.zeros((len(faces), 3))
    found, has_area = trimesh.triangles.normals(vertices[faces])
    normals[has_area] = found
    corners = faces.ravel()
    counts = np.bincount(corners, minlength=len(vertices))
    corner_normals = np.repeat(normals, 3, axis=0)
    sums = [np.bincount(corners, column, minlength=len(vertices)) for column in corner_normals.T]
    # The mean of unit normals around a vertex is the shorter, the sharper the corner is.
    means = np.linalg.norm(np.column_stack(sums), axis=1) / np.maximum(counts, 1)
    order = np.argsort(means, kind="stable")
    cell = float(np.ptp(vertices, axis=0).max()) / 64.0
    kept = faces
    while len(kept) > most:
        cells = np.floor(vertices[order] / cell).astype(np.int64)
        first, group = find_unique_rows(cells)
        representative = np.empty(len(vertices), int)
        representative[order] = order[first][group]
        kept = np.sort(representative[faces], axis=1)
        low, middle, high = kept.T
        is_triangle = (low < middle) & (middle < high)
        is_in_triangle = np.zeros(len(vertices), bool)
        is_in_triangle[kept[is_triangle]] = True
        # A strip narrower than a cell becomes a line.
        is_line = (low < high) & ~is_in_triangle[kept].all(axis=1)
        kept = kept[is_triangle | is_line]
        distinct, _ = find_unique_rows(kept)
        kept = kept[distinct]
        cell *= 1.4
    used, kept = np.unique(kept, return_inverse=True)
    return vertices[used], kept.reshape(-1, 3)


def _compute_hull_volume(points: Floats, flatness: float = 0.0) -> float:
    """Return the volume of the convex hull of points [m³]; 0 if they are flat.

    With a `flatness` [m], see `thicken`, it is the volume of the plate around them.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(points) and flatness:
        points, _ = thicken(points, flatness)
    if len(points) <= 3:
        return 0.0
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return 0.0


def _merge_hulls(
    hulls: Sequence[_Hull],
    unite: Callable[[_Hull, _Hull], _Hull],
    estimate: Callable[[_Hull, _Hull], float],
    limit: float,
    least: int,
) -> list[_Hull]:
    """Merge pairs whose common hull protrudes least, until `least` are left.

    No result protrudes by more than `limit` [m]. `unite` returns the common hull of two, `estimate`
    a lower bound of its protrusion [m].
    """
    if len(hulls) <= least:
        return list(hulls)
    left = dict(enumerate(hulls))
    numbers = itertools.count(len(left))
    slack = _CUT_SHARE * limit if np.isfinite(limit) else 0.0
    queue = list[tuple[float, int, int, _Hull | None]]()

    def add_pair(i: int, j: int, union: _Hull | None = None) -> None:
        bounds = np.stack([left[i].bounds, left[j].bounds])
        low, high = bounds.transpose(1, 0, 2)
        # Between parts that are further apart, the hull would protrude more.
        if (low.max(axis=0) - high.min(axis=0)).max() > 2.0 * limit:
            return
        protrusion = union.protrusion if union else estimate(left[i], left[j])
        if protrusion > limit:
            return
        # Among those that protrude little, small ones come first.
        size = float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
        cost = max(protrusion - slack, 0.0) + _SIZE_COST * size
        if union:
            added = max(union.volume - left[i].volume - left[j].volume, 0.0) / union.area
            cost += _VOLUME_COST * added
        heapq.heappush(queue, (cost, i, j, union))

    for i, j in itertools.combinations(left, 2):
        add_pair(i, j)
    while queue and len(left) > least:
        _, i, j, union = heapq.heappop(queue)
        if i not in left or j not in left:
            continue
        if union is None:
            add_pair(i, j, unite(left[i], left[j]))
            continue
        del left[i], left[j]
        number = next(numbers)
        others = list(left)
        left[number] = union
        for other in others:
            add_pair(other, number)
    return list(left.values())
