from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.importing.convex import compute_concavity, compute_solid_volume, decompose
from vkc_pin.utils import disk_cache

box = trimesh.creation.box


def inside(pieces: tuple[trimesh.Trimesh, ...], points: np.ndarray) -> np.ndarray:
    """Return how far points lie outside of all pieces [m], by the planes of their faces."""
    out = []
    for piece in pieces:
        offsets = np.einsum("ij,ij->i", piece.face_normals, piece.triangles[:, 0])
        out.append((points @ piece.face_normals.T - offsets).max(axis=1))
    return np.min(out, axis=0)


def tray() -> trimesh.Trimesh:
    """Return a closed open-topped bin, 0.4 x 0.3 x 0.2, of walls 20 mm thick, as one body."""
    outer = trimesh.Trimesh(box((0.4, 0.3, 0.2)).vertices, box((0.4, 0.3, 0.2)).faces)
    corners = outer.vertices
    inner = corners * (0.36 / 0.4, 0.26 / 0.3, 1.0)
    inner[:, 2] = np.where(corners[:, 2] > 0, 0.1, -0.08)
    faces = [face for face in outer.faces.tolist() if not (corners[face][:, 2] > 0).all()]
    hole = [[a + 8, c + 8, b + 8] for a, b, c in faces]
    rim = []
    ring = [k for k in np.argsort(np.arctan2(corners[:, 1], corners[:, 0])) if corners[k, 2] > 0]
    for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
        rim += [[a, b, b + 8], [a, b + 8, a + 8]]
    mesh = trimesh.Trimesh(np.vstack([corners, inner]), [*faces, *hole, *rim])
    assert mesh.is_volume
    return mesh


def test_convex_bodies_stay_as_they_are() -> None:
    corner = box((0.1, 0.1, 1)).apply_translation((0.4, 0, 0.6))
    pieces = decompose(trimesh.util.concatenate([box((1, 0.1, 0.1)), corner]))
    assert sorted(len(piece.vertices) for piece in pieces.meshes) == [8, 8]
    assert pieces.volume == pytest.approx(0.02, rel=1e-6)
    assert pieces.error < 1e-5
    single = decompose(box((0.3, 0.2, 0.1)))
    assert (single.solid, single.overhead) == pytest.approx((0.006, 0.0), abs=1e-9)


@pytest.mark.long
def test_bin_becomes_hollow_the_same_way_every_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pieces from the cache equal those of the first call bit for bit."""
    mesh = tray()
    assert compute_concavity(mesh) > 0.08
    pieces = decompose(mesh)
    assert 5 <= len(pieces.meshes) <= 12
    assert pieces.solid == pytest.approx(mesh.volume)
    assert pieces.overhead < 0.3
    assert inside(pieces.meshes, np.array([[0.0, 0.0, 0.05]])) > 0.05  # where things are put
    assert inside(pieces.meshes, trimesh.sample.sample_surface(mesh, 3000, seed=5)[0]).max() < 2e-3
    assert inside(pieces.meshes, mesh.vertices).max() < 1e-7
    assert decompose(mesh, most_pieces=1).overhead > 1.5
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    for again in (decompose(mesh), decompose(mesh)):
        assert (again.solid, again.error) == (pieces.solid, pieces.error)
        for one, other in zip(pieces.meshes, again.meshes, strict=True):
            np.testing.assert_array_equal(one.vertices, other.vertices)
            np.testing.assert_array_equal(one.faces, other.faces)
    assert len(decompose(mesh, most_pieces=6).meshes) <= 6


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 2**31))
def test_pieces_contain_the_corners_of_the_mesh(seed: int) -> None:
    """An angle of random arms; every second one has a triangle missing, and is cut by planes."""
    rng = np.random.default_rng(seed)
    a, b, c = rng.uniform(0.2, 0.6, 3)
    profile = np.array([[0, 0], [a, 0], [a, 0.05], [0.05, 0.05], [0.05, b], [0, b]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    mesh = trimesh.creation.extrude_triangulation(profile, triangles, c)
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
    if seed % 2:
        mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    pieces = decompose(mesh, most_pieces=6)
    assert 1 < len(pieces.meshes) <= 6
    assert inside(pieces.meshes, mesh.vertices).max() < 1e-7
    assert pieces.error < 0.7 * compute_concavity(mesh)
    assert pieces.volume < 0.8 * decompose(mesh, most_pieces=1).volume


def test_volume_of_an_open_surface() -> None:
    """A box without a corner of its lid holds what it held; one without the lid is a thin shell."""
    whole = box((0.4, 0.3, 0.2)).subdivide_to_size(0.02)
    pierced, open_ = whole.copy(), whole.copy()
    pierced.update_faces(np.arange(len(whole.faces)) != 7)
    open_.update_faces(whole.triangles_center[:, 2] < 0.0999)
    assert compute_solid_volume(whole) == pytest.approx(0.024)
    assert compute_solid_volume(open_) < 0.3 * 0.024
    assert not pierced.is_watertight


def test_invalid_meshes_and_arguments_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flat = tmp_path / "flat.stl"
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]).export(
        flat
    )
    with pytest.raises(vkc.InputError, match="the mesh is flat") as caught:
        decompose(flat)
    assert caught.value.file == flat
    for wrong in ({"most_pieces": 0}, {"error": 0.0}, {"error": float("nan")}, {"corners": 3}):
        with pytest.raises(vkc.InputError) as caught:
            decompose(flat, **wrong)  # type: ignore[arg-type]
        assert caught.value.field == next(iter(wrong))
    monkeypatch.setitem(sys.modules, "coacd", None)
    assert len(decompose(box((1, 1, 1))).meshes) == 1  # nothing to cut
    with pytest.raises(vkc.InputError, match=r"vkc-pin\[import\]"):
        decompose(tray())
