from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import trimesh

import vkc_pin as vkc
from vkc_pin.files.urdf import read_urdf
from vkc_pin.importing.robots.pieces import own_meshes

TEXT = """<robot name="r">
  <link name="a">
    <visual><geometry><mesh filename="seen.obj" scale="2 2 2"/></geometry></visual>
    <visual><geometry><mesh filename="gone.obj"/></geometry></visual>
    <collision><geometry><box size="1 1 1"/></geometry></collision>
    <collision><origin xyz="0 0 3"/><geometry><mesh filename="angle.stl" scale="0.5 0.5 0.5"/></geometry></collision>
    <collision><geometry><mesh filename="sheet.stl"/></geometry></collision>
  </link></robot>"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    box = trimesh.creation.box
    arms = [box((2, 0.2, 1)).apply_translation((1.2, 0, 0)), box((0.2, 2, 1)).apply_translation((0, 1.2, 0))]
    angle = trimesh.util.concatenate(arms)
    angle.export(tmp_path / "angle.stl")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "sheet.stl")
    (tmp_path / "seen.obj").write_text("mtllib paint.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    (tmp_path / "paint.mtl").write_text("newmtl red\nKd 1 0 0\n")
    path = tmp_path / "r.urdf"
    path.write_text(TEXT, encoding="utf-8")
    return path


def test_pieces_stand_where_the_mesh_stood(file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "own"
    root, pieces, notes = own_meshes(read_urdf(file), folder, most_pieces=4)
    (folder / "r.urdf").write_bytes(ElementTree.tostring(root))
    shapes = read_urdf(folder / "r.urdf").shapes("collision")
    assert [shape.kind for shape in shapes] == ["box", "mesh", "mesh"]
    before = next(shape for shape in read_urdf(file).shapes("collision") if shape.file and shape.file.name == "angle.stl").mesh()
    after = trimesh.util.concatenate([shape.mesh() for shape in shapes[1:]])
    assert after.bounds == pytest.approx(before.bounds)
    assert after.volume == pytest.approx(before.volume, rel=1e-5)
    (piece,) = pieces
    assert (piece.link, piece.count) == ("a", 2)
    assert piece.hull > 1.0 > 0.05 > abs(piece.overhead)
    assert any("sheet.stl is flat" in note for note in notes)
    assert any("what is seen of a is left out" in note for note in notes)


def test_what_is_seen_is_copied_with_its_colours(file: Path, tmp_path: Path) -> None:
    root, _, _ = own_meshes(read_urdf(file), tmp_path / "own", most_pieces=1)
    assert {path.name for path in (tmp_path / "own" / "visual").iterdir()} == {"seen.obj", "paint.mtl"}
    (mesh,) = root.findall("link/visual/geometry/mesh")
    assert mesh.attrib == {"filename": "visual/seen.obj", "scale": "2 2 2"}


def test_a_mesh_that_collides_must_be_there(file: Path, tmp_path: Path) -> None:
    (tmp_path / "angle.stl").unlink()
    with pytest.raises(vkc.InputError, match="there is no such mesh"):
        own_meshes(read_urdf(file), tmp_path / "own", most_pieces=4)
