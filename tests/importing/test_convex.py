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
box, torus, concatenate = trimesh.creation.box, trimesh.creation.torus, trimesh.util.concatenate
CAVITY = (0.24, 0.3, 0.4)  # in the middle of a cabinet


def make_block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Triangles:
    size = np.subtract(high, low)
    return box(size).apply_translation(np.add(low, size / 2.0))


def weld(*bodies: Triangles) -> Triangles:
    """Merge bodies into one mesh with shared vertices."""
    mesh = concatenate(list(bodies))
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def remove_sides(mesh: Triangles, *sides: tuple[int, float]) -> Triangles:
    """Remove the triangles in planes, each given by an axis and a coordinate."""
    mesh = mesh.copy()
    for axis, coordinate in sides:
        mesh.update_faces((np.abs(mesh.triangles[:, :, axis] - coordinate) > 1e-6).any(axis=1))
    return mesh


def make_sheet_cabinet() -> Triangles:
    return remove_sides(make_block((0, 0, 0), (0.5, 0.6, 0.8)), (0, 0.0))


def make_board_cabinet(*shelves: float) -> Triangles:
    """Make a cabinet of solid boards, 20 mm thick, with shelves at the given heights."""
    t, (x, y, z) = 0.02, (0.5, 0.6, 0.8)
    return weld(
        make_block((0, 0, 0), (x, y, t)),
        make_block((0, 0, z - t), (x, y, z)),
        make_block((0, 0, t), (x, t, z - t)),
        make_block((0, y - t, t), (x, y, z - t)),
        make_block((x - t, t, t), (x, y - t, z - t)),
        *(make_block((0, t, height), (x - t, y - t, height + t)) for height in shelves),
    )


def mirror(mesh: Triangles) -> Triangles:
    """Mirror a mesh in y, so that its triangles face inward."""
    return Triangles(mesh.vertices * (1, -1, 1), mesh.faces)


def turn(mesh: Triangles) -> Triangles:
    return mesh.copy().apply_transform(trimesh.transformations.euler_matrix(0.3, 0.4, 0.5))


def make_two_blocks(shift: float = 0.0) -> Triangles:
    """Make an L, or a T if the upright block is shifted, in one mesh."""
    return weld(
        make_block((0, 0, 0), (0.3, 0.04, 0.03)),
        make_block((shift, 0.04 if shift else 0.0, 0), (shift + 0.04, 0.2, 0.03)),
    )


def make_cup(wall: float) -> Triangles:
    profile = [[0, 0], [0.1, 0], [0.1, 0.2], [0.1 - wall, 0.2], [0.1 - wall, wall], [0, wall]]
    return trimesh.creation.revolve(np.array(profile), sections=32)


def make_bowl() -> Triangles:
    ball = trimesh.creation.icosphere(3, 0.15)
    ball.update_faces((ball.triangles[:, :, 2] < 1e-6).all(axis=1))
    return ball


def make_flat_frame() -> Triangles:
    outer = np.array([[-0.3, -0.2, 0.5], [0.3, -0.2, 0.5], [0.3, 0.2, 0.5], [-0.3, 0.2, 0.5]])
    faces = [[k, (k + 1) % 4, 4 + k] for k in range(4)]
    faces += [[(k + 1) % 4, 4 + (k + 1) % 4, 4 + k] for k in range(4)]
    return Triangles(np.vstack([outer, outer * (0.7, 0.7, 1.0)]), faces)


def make_corrugated_sheet() -> Triangles:
    n = 40
    x, y = np.meshgrid(np.linspace(0.0, 0.6, n), np.linspace(0.0, 0.4, n))
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    vertices = np.column_stack([x.ravel(), y.ravel(), 0.05 * np.sin(x.ravel() / 0.05)])
    return Triangles(vertices, np.hstack([(a, b, c), (a, c, d)]).T)


def make_chain_link() -> Triangles:
    return torus(0.1, 0.02, major_sections=16, minor_sections=8)


Point = tuple[float, float, float]
SHAPES: dict[str, tuple[Callable[[], Triangles], list[Point], int]] = {
    # Mesh, points that stay free, largest number of pieces
    "sheets": (make_sheet_cabinet, [CAVITY], 5),
    "turned sheets": (lambda: turn(make_sheet_cabinet()), [], 5),
    "boards": (make_board_cabinet, [CAVITY], 5),
    "inverted boards": (lambda: mirror(make_board_cabinet()), [(0.24, -0.3, 0.4)], 5),
    "shelves": (lambda: make_board_cabinet(0.2, 0.5), [(0.24, 0.3, 0.35), (0.24, 0.3, 0.65)], 7),
    "L": (make_two_blocks, [(0.1, 0.1, 0.015)], 3),
    "T": (lambda: make_two_blocks(0.13), [(0.05, 0.1, 0.015), (0.25, 0.1, 0.015)], 2),
    "turned L": (lambda: turn(make_two_blocks()), [], 3),
    "dense L": (lambda: make_two_blocks().subdivide_to_size(0.01), [(0.1, 0.1, 0.015)], 3),
    "cup": (lambda: make_cup(0.01), [(0, 0, 0.1)], 12),
    "tube": (
        lambda: remove_sides(trimesh.creation.cylinder(0.1, 0.2, sections=24), (2, 0.1), (2, -0.1)),
        [(0, 0, 0)],
        12,
    ),
    "bowl": (make_bowl, [(0, 0, -0.05)], 24),
    "ring": (lambda: torus(0.2, 0.04, major_sections=24, minor_sections=12), [(0, 0, 0)], 12),
    "links of a chain": (
        lambda: concatenate([make_chain_link(), turn(make_chain_link())]),
        [(0, 0, 0)],
        16,
    ),
    "flat frame": (make_flat_frame, [(0, 0, 0.5)], 6),
    "wave": (make_corrugated_sheet, [], 12),
    # The sides of flat boxes are triangles without area.
    "crossing sheets": (
        lambda: concatenate([box((0.6, 0, 0.4)), box((0, 0.6, 0.4))]),
        [(0.15, 0.15, 0)],
        4,
    ),
}


def measure_uncovered(pieces: tuple[Triangles, ...], points: np.ndarray) -> np.ndarray:
    """Return signed distances of points from the union of pieces [m], by their face planes."""
    distances = []
    for piece in pieces:
        offsets = np.einsum("ij,ij->i", piece.face_normals, piece.triangles[:, 0])
        distances.append((points @ piece.face_normals.T - offsets).max(axis=1))
    return np.min(distances, axis=0)


def sample_points(mesh: Triangles, count: int) -> np.ndarray:
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
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    sphere, identity = coal.Sphere(1e-9), coal.Transform3s()
    places = [coal.Transform3s(np.eye(3), point) for point in points]
    return np.array(
        [coal.distance(sphere, at, triangles, identity, request, result) for at in places]
    )


def check_pieces(mesh: Triangles, pieces: Pieces) -> None:
    """Check that pieces contain the mesh and exceed it by no more than their stated error."""
    assert all(piece.is_volume for piece in pieces.meshes)
    assert measure_uncovered(pieces.meshes, sample_points(mesh, 3000)).max() < 1e-4
    for piece in pieces.meshes:
        points = trimesh.sample.sample_surface(piece, 100, seed=7)[0]
        outward = points + 1e-4 * (points - piece.center_mass)
        others = tuple(other for other in pieces.meshes if other is not piece)
        if others:
            points = points[measure_uncovered(others, outward) > 0.0]
        assert measure_distances(mesh, points).max(initial=0.0) < pieces.error + 2e-3


SLOW_SHAPES = ("bowl", "cup", "dense L", "links of a chain", "tube", "turned L", "wave")


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.long) if kind in SLOW_SHAPES else kind
        for kind in SHAPES
    ],
)
def test_pieces_contain_the_mesh_and_leave_cavities_free(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, "off")
    make, free, most = SHAPES[kind]
    mesh = make()
    pieces = decompose(mesh)
    check_pieces(mesh, pieces)
    assert pieces.error <= 0.02
    assert len(pieces.meshes) <= most
    for point in free:
        distance = float(measure_distances(mesh, np.array([point]))[0])
        assert measure_uncovered(pieces.meshes, np.array([point])) > distance - 0.02 - 1e-4


@pytest.mark.long
def test_long_narrow_strips_are_cut() -> None:
    """The grid that coarsens a ribbon of 1 m must be finer than the ribbon's width."""
    x, k = np.linspace(0.0, 1.0, 400), np.arange(399)
    z = 0.004 + 0.003 * np.sin(10.0 * x)
    edges = [np.column_stack([x, np.full(400, y), z]) for y in (0.001, 0.004)]
    triangles = [(k, k + 1, k + 400), (k + 1, k + 401, k + 400)]
    ribbon = Triangles(np.vstack(edges), np.hstack(triangles).T)
    pieces = decompose(ribbon, error=0.004)
    check_pieces(ribbon, pieces)
    assert pieces.error < 0.004 < compute_concavity(ribbon)


def test_convex_bodies_are_not_cut() -> None:
    corner = box((0.1, 0.1, 1)).apply_translation((0.4, 0, 0.6))
    pieces = decompose(trimesh.util.concatenate([box((1, 0.1, 0.1)), corner]))
    assert sorted(len(piece.vertices) for piece in pieces.meshes) == [8, 8]
    assert pieces.volume == pytest.approx(0.02, rel=1e-6)
    assert pieces.error < 1e-5
    single = decompose(box((0.3, 0.2, 0.1)))
    assert (single.solid, single.overhead) == pytest.approx((0.006, 0.0), abs=1e-9)


def test_cached_pieces_equal_computed_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    mesh = make_cup(0.02)
    assert compute_concavity(mesh) > 0.06
    pieces = decompose(mesh)
    assert pieces.solid == pytest.approx(mesh.volume)
    assert pieces.overhead < 0.3
    assert decompose(mesh, most_pieces=1).overhead > 0.8
    cached = decompose(mesh)
    assert (cached.solid, cached.error) == (pieces.solid, pieces.error)
    for one, other in zip(pieces.meshes, cached.meshes, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.faces, other.faces)
    assert len(decompose(mesh, most_pieces=6).meshes) <= 6


def test_open_boxes_are_thin_shells() -> None:
    whole = box((0.4, 0.3, 0.2)).subdivide_to_size(0.02)
    assert compute_solid_volume(whole) == pytest.approx(0.024)
    for kept in (np.arange(len(whole.faces)) != 7, whole.triangles_center[:, 2] < 0.0999):
        open_ = whole.copy()
        open_.update_faces(kept)
        assert compute_solid_volume(open_) < 0.3 * 0.024


def break_vertex() -> Triangles:
    broken = box((1, 1, 1))
    broken.vertices[3, 1] = np.nan
    return broken


@pytest.mark.parametrize(
    ("mesh", "argument", "field"),
    [
        *(
            (box((1, 1, 1)), argument, next(iter(argument)))
            for argument in (
                {"most_pieces": 0},
                {"error": 0.0},
                {"error": float("nan")},
                {"corners": 3},
            )
        ),
        (break_vertex(), {}, "mesh.vertices[3, 1]"),
        (Triangles(), {}, "mesh"),
    ],
)
def test_errors_name_the_invalid_argument(
    mesh: Triangles, argument: dict[str, float], field: str
) -> None:
    with pytest.raises(vkc.InputError) as caught:
        decompose(mesh, **argument)  # type: ignore[arg-type]
    assert caught.value.field == field


def make_bodies(rng: np.random.Generator, count: int, kind: str) -> Triangles:
    """Make a mesh of many bodies: cones whose tips are in one plane, boards on a grid, or rods."""
    bodies = []
    for _ in range(count):
        if kind == "cones":
            body = trimesh.creation.cone(0.01, 0.02, sections=8)
            body.apply_translation((*rng.uniform(-1.0, 1.0, 2), 0.0))
        elif kind == "boards":
            body = box((rng.choice([0.1, 0.2]), 0.018, rng.choice([0.018, 0.1])))
            body.apply_translation(0.1 * rng.integers(0, 5, 3))
        else:
            body = trimesh.creation.cylinder(0.01, rng.uniform(0.05, 0.5), sections=6)
            body.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
            body.apply_translation(rng.uniform(-0.4, 0.4, 3))
        bodies.append(body)
    return concatenate(bodies)


@pytest.mark.parametrize(
    ("kind", "count", "seed"),
    [
        ("cones", 719, 2),
        ("cones", 40, 3),
        ("boards", 40, 5),
        ("boards", 3, 5),
        ("rods", 60, 6),
    ],
)
def test_every_cut_of_meshes_of_many_bodies_divides_a_part(
    kind: str, count: int, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best cut of the coarse surface may leave all of the part on one side."""
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, "off")
    slice_faces, slices = trimesh.intersections.slice_faces_plane, list[int]()

    def count_slices(*args: object, **options: object) -> object:
        slices.append(1)
        assert len(slices) <= 2 * 64 * 2, "parts are cut without end"
        return slice_faces(*args, **options)

    monkeypatch.setattr(trimesh.intersections, "slice_faces_plane", count_slices)
    rng = np.random.default_rng(seed)
    mesh = make_bodies(rng, count, kind).apply_scale(rng.choice([1.0, 1.15, 1.25], 3))
    pieces = decompose(mesh, error=0.01)
    assert len(pieces.meshes) > 1
    assert measure_uncovered(pieces.meshes, sample_points(mesh, 1000)).max() < 1e-4


def make_drum(corners: int) -> Triangles:
    """Make a convex body like the base of a robot: a drum of 0.56 m with a slanted top."""
    angles = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    x, y = 0.28 * np.cos(angles), 0.28 * np.sin(angles)
    rims = [np.column_stack([x, y, height]) for height in (np.zeros(corners), 0.3 + 0.2 * x)]
    return trimesh.convex.convex_hull(np.vstack(rims))


@pytest.mark.parametrize(
    ("mesh", "error", "overhead", "most_vertices"),
    [
        (make_drum(90), 0.03, 0.0, 180),
        (make_drum(90), 0.003, 0.0, 180),
        (make_drum(90), 0.003, 0.15, 180),
        (make_drum(300), 0.001, 0.0, 600),
        (trimesh.creation.icosphere(3, 0.4), 0.004, 0.0, 642),
        (trimesh.creation.cylinder(1.0, 0.02, sections=128), 0.005, 0.2, 160),
    ],
)
def test_convex_meshes_keep_vertices_where_few_would_protrude(
    mesh: Triangles,
    error: float,
    overhead: float,
    most_vertices: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Excess volume that is acceptable for concave meshes excuses no protrusion."""
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, "off")
    pieces = decompose(mesh, error=error, overhead=overhead)
    (piece,) = pieces.meshes
    assert pieces.error <= error
    assert len(piece.vertices) <= most_vertices
    check_pieces(mesh, pieces)
