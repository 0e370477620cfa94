from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import coal
import numpy as np
import pytest
import trimesh

import vkc_pin as vkc
from vkc_pin.importing.convex import Pieces, compute_concavity, compute_solid_volume, decompose
from vkc_pin.utils import disk_cache

Triangles = trimesh.Trimesh
box, cylinder = trimesh.creation.box, trimesh.creation.cylinder
revolve, torus = trimesh.creation.revolve, trimesh.creation.torus
concatenate = trimesh.util.concatenate
CAVITY = (0.24, 0.3, 0.4)  # in the middle of a cabinet


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Triangles:
    size = np.subtract(high, low)
    return box(size).apply_translation(np.add(low, size / 2.0))


def weld(*bodies: Triangles) -> Triangles:
    """Return one mesh of bodies that share their corners."""
    mesh = concatenate(list(bodies))
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def open_at(mesh: Triangles, *sides: tuple[int, float]) -> Triangles:
    """Return a mesh without its triangles in planes, each an axis and a coordinate."""
    mesh = mesh.copy()
    for axis, place in sides:
        mesh.update_faces((np.abs(mesh.triangles[:, :, axis] - place) > 1e-6).any(axis=1))
    return mesh


def sheet_cabinet() -> Triangles:
    return open_at(block((0, 0, 0), (0.5, 0.6, 0.8)), (0, 0.0))


def boards(*shelves: float) -> Triangles:
    """Return a cabinet of closed boards, 20 mm thick, with shelves at some heights."""
    t, (x, y, z) = 0.02, (0.5, 0.6, 0.8)
    return weld(
        block((0, 0, 0), (x, y, t)),
        block((0, 0, z - t), (x, y, z)),
        block((0, 0, t), (x, t, z - t)),
        block((0, y - t, t), (x, y, z - t)),
        block((x - t, t, t), (x, y - t, z - t)),
        *(block((0, t, height), (x - t, y - t, height + t)) for height in shelves),
    )


def mirror(mesh: Triangles) -> Triangles:
    """Return a mesh mirrored in y with triangles that face inward."""
    return Triangles(mesh.vertices * (1, -1, 1), mesh.faces)


def turn(mesh: Triangles) -> Triangles:
    return mesh.copy().apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))


def touching(*, tee: bool) -> Triangles:
    """Return two blocks in one mesh, as an L or a T."""
    shift = 0.13 if tee else 0.0
    return weld(
        block((0, 0, 0), (0.3, 0.04, 0.03)),
        block((shift, 0.04 if tee else 0.0, 0), (shift + 0.04, 0.2, 0.03)),
    )


def cup(wall: float) -> Triangles:
    profile = [[0, 0], [0.1, 0], [0.1, 0.2], [0.1 - wall, 0.2], [0.1 - wall, wall], [0, wall]]
    return revolve(np.array(profile if wall else profile[:3], float), sections=32)


def bowl() -> Triangles:
    ball = trimesh.creation.icosphere(3, 0.15)
    ball.update_faces((ball.triangles[:, :, 2] < 1e-6).all(axis=1))
    return ball


def plate_with_hole() -> Triangles:
    """Return a flat frame."""
    outer = np.array([[-0.3, -0.2, 0.5], [0.3, -0.2, 0.5], [0.3, 0.2, 0.5], [-0.3, 0.2, 0.5]])
    faces = [[k, (k + 1) % 4, 4 + k] for k in range(4)]
    faces += [[(k + 1) % 4, 4 + (k + 1) % 4, 4 + k] for k in range(4)]
    return Triangles(np.vstack([outer, outer * (0.7, 0.7, 1.0)]), faces)


def wave() -> Triangles:
    """Return a corrugated sheet."""
    n = 40
    x, y = np.meshgrid(np.linspace(0.0, 0.6, n), np.linspace(0.0, 0.4, n))
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    vertices = np.column_stack([x.ravel(), y.ravel(), 0.05 * np.sin(x.ravel() / 0.05)])
    return Triangles(vertices, np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))


def link() -> Triangles:
    return torus(0.1, 0.02, major_sections=16, minor_sections=8)


Point = tuple[float, float, float]
ZOO: dict[str, tuple[Callable[[], Triangles], list[Point], int]] = {
    # Mesh, points that stay free, largest number of pieces
    "sheets": (sheet_cabinet, [CAVITY], 5),
    "dense sheets": (lambda: sheet_cabinet().subdivide_to_size(0.04), [CAVITY], 5),
    "turned sheets": (lambda: turn(sheet_cabinet()), [], 5),
    "basket": (lambda: open_at(box((0.4, 0.3, 0.2)), (2, 0.1)), [(0, 0, 0)], 5),
    "boards": (boards, [CAVITY], 5),
    "inverted boards": (lambda: mirror(boards()), [(0.24, -0.3, 0.4)], 5),
    "shelves": (lambda: boards(0.2, 0.5), [(0.24, 0.3, 0.35), (0.24, 0.3, 0.65)], 7),
    "many shelves": (
        lambda: boards(*np.arange(0.08, 0.75, 0.08)),
        [(0.24, 0.3, 0.13 + 0.08 * k) for k in range(8)],
        14,
    ),
    "L": (lambda: touching(tee=False), [(0.1, 0.1, 0.015)], 3),
    "T": (lambda: touching(tee=True), [(0.05, 0.1, 0.015), (0.25, 0.1, 0.015)], 2),
    "turned L": (lambda: turn(touching(tee=False)), [], 3),
    "dense L": (lambda: touching(tee=False).subdivide_to_size(0.01), [(0.1, 0.1, 0.015)], 3),
    "cup": (lambda: cup(0.01), [(0, 0, 0.1)], 12),
    "cup of sheet": (lambda: cup(0.0), [(0, 0, 0.1)], 12),
    "tube": (
        lambda: open_at(cylinder(0.1, 0.2, sections=24), (2, 0.1), (2, -0.1)),
        [(0, 0, 0)],
        12,
    ),
    "bowl": (bowl, [(0, 0, -0.05)], 24),
    "ring": (lambda: torus(0.2, 0.04, major_sections=24, minor_sections=12), [(0, 0, 0)], 12),
    "links of a chain": (
        lambda: concatenate([link(), turn(link())]),
        [(0, 0, 0)],
        16,
    ),
    "flat frame": (plate_with_hole, [(0, 0, 0.5)], 6),
    "wave": (wave, [], 12),
    # Sides of their boxes are triangles without area.
    "crossing sheets": (
        lambda: concatenate([box((0.6, 0, 0.4)), box((0, 0.6, 0.4))]),
        [(0.15, 0.15, 0)],
        4,
    ),
}


def measure_uncovered(pieces: tuple[Triangles, ...], points: np.ndarray) -> np.ndarray:
    """Return how far points lie outside of all pieces [m], by the planes of their faces."""
    out = []
    for piece in pieces:
        offsets = np.einsum("ij,ij->i", piece.face_normals, piece.triangles[:, 0])
        out.append((points @ piece.face_normals.T - offsets).max(axis=1))
    return np.min(out, axis=0)


def sample(mesh: Triangles, count: int) -> np.ndarray:
    points = trimesh.sample.sample_surface(mesh, count, seed=5)[0]
    return np.vstack([mesh.vertices[np.unique(mesh.faces)], points])


def measure_distances(mesh: Triangles, points: np.ndarray) -> np.ndarray:
    """Return the distances of points from the triangles of a mesh [m]."""
    faces = np.asarray(mesh.faces, np.int32)[mesh.area_faces > 0.0]
    triangles = coal.BVHModelOBBRSS()
    triangles.beginModel(len(faces), len(mesh.vertices))
    triangles.addVertices(np.asarray(mesh.vertices))
    triangles.addTriangles(faces)
    triangles.endModel()
    triangles.computeLocalAABB()
    point, here = coal.Sphere(1e-9), coal.Transform3s()
    return np.array(
        [
            coal.distance(
                point,
                coal.Transform3s(np.eye(3), place),
                triangles,
                here,
                coal.DistanceRequest(),
                coal.DistanceResult(),
            )
            for place in points
        ]
    )


def check_contract(mesh: Triangles, pieces: Pieces) -> None:
    """Check that pieces contain a mesh, and protrude by no more than they state."""
    assert all(piece.is_volume for piece in pieces.meshes)
    assert measure_uncovered(pieces.meshes, sample(mesh, 3000)).max() < 1e-4
    for piece in pieces.meshes:
        points = trimesh.sample.sample_surface(piece, 100, seed=7)[0]
        outward = points + 1e-4 * (points - piece.center_mass)
        others = tuple(other for other in pieces.meshes if other is not piece)
        if others:
            points = points[measure_uncovered(others, outward) > 0.0]
        assert measure_distances(mesh, points).max(initial=0.0) < pieces.error + 2e-3


LONG = (
    "bowl",
    "cup",
    "cup of sheet",
    "dense L",
    "dense sheets",
    "links of a chain",
    "many shelves",
    "tube",
    "turned L",
    "wave",
)


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=pytest.mark.long) if kind in LONG else kind for kind in ZOO],
)
def test_pieces_contain_the_mesh_and_leave_cavities_free(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, "off")
    make, free, most = ZOO[kind]
    mesh = make()
    pieces = decompose(mesh)
    check_contract(mesh, pieces)
    assert pieces.error <= 0.02
    assert len(pieces.meshes) <= most
    for point in free:
        near = float(measure_distances(mesh, np.array([point]))[0])
        assert measure_uncovered(pieces.meshes, np.array([point])) > near - 0.02 - 1e-4


def test_long_narrow_strips_are_cut() -> None:
    """A grid that coarsens a metre of ribbon must not be wider than the ribbon."""
    x = np.linspace(0.0, 1.0, 400)
    z = 0.004 + 0.003 * np.sin(10.0 * x)
    edges = [np.column_stack([x, np.full(400, y), z]) for y in (0.001, 0.004)]
    k = np.arange(399)
    faces = np.vstack(
        [np.column_stack([k, k + 1, k + 400]), np.column_stack([k + 1, k + 401, k + 400])]
    )
    ribbon = Triangles(np.vstack(edges), faces)
    pieces = decompose(ribbon, error=0.004)
    check_contract(ribbon, pieces)
    assert pieces.error < 0.004 < compute_concavity(ribbon)


def test_convex_bodies_stay_as_they_are() -> None:
    corner = box((0.1, 0.1, 1)).apply_translation((0.4, 0, 0.6))
    pieces = decompose(trimesh.util.concatenate([box((1, 0.1, 0.1)), corner]))
    assert sorted(len(piece.vertices) for piece in pieces.meshes) == [8, 8]
    assert pieces.volume == pytest.approx(0.02, rel=1e-6)
    assert pieces.error < 1e-5
    single = decompose(box((0.3, 0.2, 0.1)))
    assert (single.solid, single.overhead) == pytest.approx((0.006, 0.0), abs=1e-9)


def test_cached_pieces_equal_the_first_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pieces from the cache equal those of the first call bit for bit."""
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    mesh = cup(0.02)
    assert compute_concavity(mesh) > 0.06
    pieces = decompose(mesh)
    assert pieces.solid == pytest.approx(mesh.volume)
    assert pieces.overhead < 0.3
    assert decompose(mesh, most_pieces=1).overhead > 0.8
    again = decompose(mesh)
    assert (again.solid, again.error) == (pieces.solid, pieces.error)
    for one, other in zip(pieces.meshes, again.meshes, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.faces, other.faces)
    assert len(decompose(mesh, most_pieces=6).meshes) <= 6


def test_volume_of_an_open_surface() -> None:
    """A box without a corner of its lid holds what it held; one without the lid is a thin shell."""
    whole = box((0.4, 0.3, 0.2)).subdivide_to_size(0.02)
    pierced, open_ = whole.copy(), whole.copy()
    pierced.update_faces(np.arange(len(whole.faces)) != 7)
    open_.update_faces(whole.triangles_center[:, 2] < 0.0999)
    assert compute_solid_volume(whole) == pytest.approx(0.024)
    assert compute_solid_volume(open_) < 0.3 * 0.024
    assert not pierced.is_watertight


@pytest.mark.parametrize(
    "wrong", [{"most_pieces": 0}, {"error": 0.0}, {"error": float("nan")}, {"corners": 3}]
)
def test_invalid_arguments_are_named(wrong: dict[str, float]) -> None:
    with pytest.raises(vkc.InputError) as caught:
        decompose(box((1, 1, 1)), **wrong)  # type: ignore[arg-type]
    assert caught.value.field == next(iter(wrong))


def test_invalid_meshes_are_named() -> None:
    broken = box((1, 1, 1))
    broken.vertices[3, 1] = np.nan
    for mesh, field in ((broken, "mesh.vertices[3, 1]"), (Triangles(), "mesh")):
        with pytest.raises(vkc.InputError) as caught:
            decompose(mesh)
        assert caught.value.field == field
