"""Convex pieces of concave meshes, by CoACD (Wei et al., SIGGRAPH 2022), and how much more than the mesh they fill.

What a piece does not cover would be driven through, so the pieces contain the surface that they are
made from. CoACD takes closed meshes of few triangles; others are cut by planes, see `slicing`.
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
from vkc_pin.importing.slicing import is_flat, slice_mesh, thicken
from vkc_pin.utils.arguments import number, quantity, whole
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.disk_cache import record
from vkc_pin.utils.optional_imports import optional_package
from vkc_pin.world.files.hulls import compute_hull, outer_hull
from vkc_pin.world.files.meshes import MeshPart, coarser, load_mesh, to_bvh
from vkc_pin.world.files.resources import file_path

if TYPE_CHECKING:
    import trimesh

__all__ = ["ERROR", "PIECES", "Pieces", "compute_concavity", "compute_solid_volume", "decompose"]

ERROR = 0.02
"""How far pieces may stand out over the surface before more of them are made, [m]: about the margin that motions keep anyway."""
PIECES = 12
"""The most pieces of one mesh: the time of a plan grows with their number."""
_VERSION = 1  # of what is kept on disk: another one whenever the same mesh would be cut otherwise
_MOST_TRIANGLES = 2000  # that CoACD is given: with more it takes minutes
_CORNERS = 40  # of a piece, at most; as in the collision geometry that comes with the package
_SPARE = 1.5  # times as many corners as asked for are left alone: making them fewer takes a second
_PER_CELL, _MOST_SAMPLES = (
    16,
    4_000_000,
)  # points by which cells of that grid are found that the skin passes
_SAMPLES = 1000  # points on a surface, beside its corners
_SPECK = 1e-6  # [m] radius of what distances are measured to
_CELLS = 96  # of the longest edge, in which volumes of open meshes are counted
_SEARCH = {
    "resolution": 1000
}  # points by which CoACD judges a cut: half its default takes half the time


@dataclass(frozen=True, eq=False)
class Pieces:
    """Convex pieces that together contain a mesh.

    Attributes:
        meshes: The pieces, closed, in the frame of the mesh, [m].
        solid: Volume of the mesh itself [m³], of which everything is part that cannot be reached
            from outside.
        error: How far the pieces stand out over the mesh's surface at most [m], measured at points.
    """

    meshes: tuple[trimesh.Trimesh, ...]
    solid: float
    error: float

    @property
    def volume(self) -> float:
        """Volume of the pieces [m³]; where they overlap, it counts twice."""
        return float(sum(piece.volume for piece in self.meshes))

    @property
    def overhead(self) -> float:
        """How much more than the mesh the pieces fill, relative to it: 0.25 for a quarter more."""
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
    """Return convex pieces that contain a mesh.

    That is its hull where this is close to it, else the hulls of the bodies that it consists of,
    else the parts that CoACD cuts it into. The same mesh gives the same pieces; the parts of one
    that had to be cut are kept on disk.

    Args:
        mesh: A mesh file in [m], or a mesh; it need not be closed.
        most_pieces: The largest number of pieces.
        error: How far the pieces may stand out over the mesh's surface [m]; unless that takes more
            pieces.
        overhead: A hull that fills no more than this share more than the mesh is left whole,
            wherever it stands out.
        corners: A piece with half as many again, or more, becomes a polytope around it that has no
            more than these.
        seed: Of the random numbers.

    Raises:
        InputError: The mesh cannot be read, is empty or flat, or CoACD is not installed and would
            be needed.
    """
    import trimesh

    whole(most_pieces, "most_pieces", low=1)
    whole(corners, "corners", low=8)
    error, overhead = quantity(error, "error"), number(overhead, "overhead", low=0.0)
    if error <= 0.0:
        raise InputError(
            "not a distance", field="error", expected="a number above 0 [m]", got=error
        )
    if isinstance(mesh, trimesh.Trimesh):
        file, given = None, mesh
    else:
        file = file_path(mesh, "mesh", "a mesh or a mesh file")
        given = load_mesh(file)
    hull = _hull(given.vertices, file)
    found, solid = [hull], min(compute_solid_volume(given), float(hull.volume))
    if (
        most_pieces > 1
        and hull.volume > (1.0 + overhead) * solid
        and _standing_out(found, given) > error
    ):
        found = _bodies(given, most_pieces)
        if not found or _standing_out(found, given) > error:

            def cut() -> list[list[list[float]]]:
                parts = _cut(given, most_pieces, error, seed, file) or [np.asarray(hull.vertices)]
                return [
                    piece.vertices.tolist()
                    for piece in _simple(_containing(parts, _surface(given)), corners)
                ]

            parts = record(_key(given, most_pieces, error, corners, seed), cut)
            found = [compute_hull(np.array(part)) for part in parts]
    pieces = tuple(_simple(found, corners))
    solid = min(
        solid, float(sum(piece.volume for piece in pieces))
    )  # which contain it: of open meshes, it is but measured
    return Pieces(pieces, solid, _standing_out(pieces, given))


def compute_concavity(mesh: trimesh.Trimesh) -> float:
    """Return how far the convex hull of a mesh stands out over its surface at most [m], measured at points.

    Raises:
        InputError: The mesh is flat.
    """
    return _standing_out([_hull(mesh.vertices, None)], mesh)


def compute_solid_volume(mesh: trimesh.Trimesh) -> float:
    """Return the volume of a mesh [m³]; of one that is not closed, that of the cells of a grid that nothing reaches from outside.

    Cells that the skin itself passes count half. Holes narrower than a hundredth of the mesh count
    as closed.
    """
    import trimesh
    from scipy import ndimage

    if mesh.is_volume and mesh.body_count == 1:
        return float(mesh.volume)
    pitch = float(mesh.extents.max()) / _CELLS
    low = mesh.bounds[0] - 1.5 * pitch
    size = np.ceil((mesh.bounds[1] - low) / pitch).astype(int) + 2
    skin = np.zeros(size, bool)
    count = int(min(_PER_CELL * mesh.area / pitch**2, _MOST_SAMPLES)) + 1
    points = np.vstack([mesh.vertices, trimesh.sample.sample_surface(mesh, count, seed=0)[0]])
    skin[tuple(np.floor((points - low) / pitch).astype(int).T)] = True
    regions, _ = ndimage.label(~skin)
    inside = ~skin & (regions != regions[0, 0, 0])
    return float((inside.sum() + 0.5 * skin.sum()) * pitch**3)


def _key(mesh: trimesh.Trimesh, *settings: float) -> bytes:
    """Return all that the pieces of a mesh depend on."""
    surface = hashlib.sha256(
        np.asarray(mesh.vertices, float).tobytes() + np.asarray(mesh.faces, np.int64).tobytes()
    )
    return json.dumps(("pieces", _VERSION, settings, surface.hexdigest())).encode()


def _simple(pieces: Sequence[trimesh.Trimesh], corners: int) -> list[trimesh.Trimesh]:
    """Return pieces with few corners: polytopes around those that have many."""
    return [
        outer_hull(one.vertices, vertices=corners) if len(one.vertices) > _SPARE * corners else one
        for one in pieces
    ]


def _bodies(mesh: trimesh.Trimesh, most: int) -> list[trimesh.Trimesh]:
    """Return the hulls of the connected bodies of a mesh; none if it is one body, or more than `most`, or one is flat."""
    merged = _merged(mesh)
    if not 1 < merged.body_count <= most:
        return []
    bodies = [
        np.asarray(body.vertices) for body in merged.split(only_watertight=False, repair=False)
    ]
    return [] if any(map(is_flat, bodies)) else [_hull(body, None) for body in bodies]


def _cut(
    mesh: trimesh.Trimesh, most: int, error: float, seed: int, file: Path | None
) -> list[Floats]:
    """Return the corners of parts of a mesh: those that CoACD cuts it into, or slices if it is open or has many triangles."""
    import trimesh

    merged = _merged(mesh)
    if not merged.is_volume or len(merged.faces) > _MOST_TRIANGLES:
        coarse = coarser(
            MeshPart(np.asarray(merged.vertices), np.asarray(merged.faces)),
            merged.extents.max() / _CELLS,
        )
        return [
            thicken(part)
            for part in slice_mesh(trimesh.Trimesh(coarse.vertices, coarse.faces), most)
        ]
    coacd = optional_package(
        "coacd", "import", what="cutting a concave mesh into convex pieces", file=file
    )
    coacd.set_log_level("off")
    given = coacd.Mesh(merged.vertices, merged.faces)
    parts = coacd.run_coacd(
        given,
        threshold=error,
        real_metric=True,
        max_convex_hull=most,
        seed=seed,
        preprocess_mode="off",
        **_SEARCH,
    )
    return [corners for vertices, _ in parts if not is_flat(corners := np.asarray(vertices))]


def _merged(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh whose triangles share corners that are at one place."""
    merged = mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    return merged


def _hull(points: Any, file: Path | None) -> trimesh.Trimesh:
    points = np.asarray(points, float)
    if is_flat(points):
        raise InputError(
            "the mesh is flat",
            file=file,
            expected="triangles around a volume",
            got="triangles in one plane",
        )
    return compute_hull(points)


def _surface(mesh: trimesh.Trimesh) -> Floats:
    """Return points on a mesh, shape (n, 3): its corners, and some spread evenly by area."""
    import trimesh

    samples, _ = trimesh.sample.sample_surface(mesh, 4 * _SAMPLES, seed=0)
    return np.vstack([np.asarray(mesh.vertices), np.asarray(samples)])


def _standing_out(pieces: Sequence[trimesh.Trimesh], mesh: trimesh.Trimesh) -> float:
    """Return how far the outer surface of pieces lies from a mesh at most [m], measured at points."""
    import trimesh

    triangles, here, request, result = (
        to_bvh(mesh),
        coal.Transform3s(),
        coal.DistanceRequest(),
        coal.DistanceResult(),
    )
    triangles.computeLocalAABB()
    speck, furthest = coal.Sphere(_SPECK), 0.0
    for piece in pieces:
        points = np.vstack(
            [piece.triangles_center, trimesh.sample.sample_surface(piece, _SAMPLES, seed=0)[0]]
        )
        hidden = np.zeros(len(points), bool)
        for other in pieces:
            if other is not piece:
                hidden |= _outside(other, points) < -_SPECK
        for point in points[~hidden]:
            result.clear()
            furthest = max(
                furthest,
                coal.distance(
                    speck, coal.Transform3s(np.eye(3), point), triangles, here, request, result
                ),
            )
    return furthest


def _outside(piece: trimesh.Trimesh, points: Floats) -> Floats:
    """Return how far points, shape (n, 3), lie beyond the faces of a convex piece, shape (n,) [m]; negative inside."""
    normals = np.asarray(piece.face_normals)
    return np.asarray(
        (
            points @ normals.T - np.einsum("ij,ij->i", normals, np.asarray(piece.triangles)[:, 0])
        ).max(axis=1)
    )


def _containing(parts: list[Floats], surface: Floats) -> list[trimesh.Trimesh]:
    """Return the hulls of parts, each widened by the points of a surface that lie in none and are nearest to it."""
    hulls = [compute_hull(part) for part in parts]
    beyond = np.array([_outside(hull, surface) for hull in hulls])
    nearest, missing = beyond.argmin(axis=0), beyond.min(axis=0) > 1e-9
    return [
        compute_hull(np.vstack([np.asarray(hull.vertices), surface[missing & (nearest == k)]]))
        for k, hull in enumerate(hulls)
    ]
