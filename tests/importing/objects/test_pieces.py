from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import trimesh
from helpers.descriptions import make_description, make_joint, make_mesh_part, make_part

from vkc_pin.importing.description import Link
from vkc_pin.importing.objects.clean_up import load_surfaces
from vkc_pin.importing.objects.pieces import PieceCache, decompose_links


def test_enclosed_pieces_are_removed() -> None:
    large, small = trimesh.creation.box((0.3, 0.3, 0.3)), trimesh.creation.box((0.1, 0.1, 0.1))
    beside = small.copy().apply_translation((0.15, 0.0, 0.0))
    parts = tuple(map(make_mesh_part, (small, large, beside)))
    description = make_description([Link("a"), Link("b", parts, parts)], [make_joint("a", "b")])
    found = decompose_links(description, load_surfaces(description)).links["b"].collision
    assert sorted(round(part.make_mesh().volume, 6) for part in found) == [0.001, 0.027]


def test_visual_boxes_replace_missing_collision_geometry() -> None:
    box = make_part()
    description = make_description([Link("a", (box,))])
    found = decompose_links(description, load_surfaces(description))
    assert found.links["a"].collision == (box,)
    assert any("visual geometry is used" in note for note in found.notes)


def test_repeated_mesh_is_decomposed_once(tmp_path: Path) -> None:
    bodies = [trimesh.creation.box((0.3, 0.3, 0.3)).apply_translation((k, 0, 0)) for k in (0, 1)]
    trimesh.util.concatenate(bodies).export(tmp_path / "twins.stl")
    places = [
        pin.SE3(pin.rpy.rpyToMatrix(0.2, 0.3, k), np.array([float(k), 0.0, 0.5])) for k in range(2)
    ]
    cache: PieceCache = {}
    found = []
    for at in places:
        part = make_mesh_part(None, at, file=tmp_path / "twins.stl")
        description = make_description([Link("twins", (), (part,))])
        decomposed = decompose_links(description, load_surfaces(description), cache)
        found.append(decomposed.links["twins"].collision)
    assert len(cache) == 1
    (cut,) = (pieces.meshes for pieces in cache.values())
    assert len(found[0]) == len(found[1]) == len(cut) > 1
    for at, pieces in zip(places, found, strict=True):
        for part, piece in zip(pieces, cut, strict=True):
            moved = piece.copy().apply_transform(at.homogeneous)
            assert np.allclose(part.make_mesh().vertices, moved.vertices)
