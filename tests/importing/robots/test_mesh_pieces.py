from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import trimesh
from helpers.texts import format_fixed_link

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.importing.robots.mesh_pieces import copy_meshes, write_meshes
from vkc_pin.world.files.meshes import load_parts
from vkc_pin.world.files.urdf import read_urdf

TEXT = """<robot name="r">
  <link name="a">
    <visual><geometry><mesh filename="seen.obj" scale="2 2 2"/></geometry></visual>
    <visual><geometry><mesh filename="gone.obj"/></geometry></visual>
    <collision><geometry><box size="1 1 1"/></geometry></collision>
    <collision><origin xyz="0 0 3"/><geometry>
      <mesh filename="angle.stl" scale="0.5 0.5 0.5"/></geometry></collision>
    <collision><geometry><mesh filename="sheet.stl"/></geometry></collision>
  </link></robot>"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    arms = [trimesh.creation.box(size) for size in ((2, 0.2, 1), (0.2, 2, 1))]
    arms[0].apply_translation((1.2, 0, 0))
    arms[1].apply_translation((0, 1.2, 0))
    trimesh.util.concatenate(arms).export(tmp_path / "angle.stl")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "sheet.stl")
    (tmp_path / "seen.obj").write_text(
        "mtllib paint.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    )
    (tmp_path / "paint.mtl").write_text("newmtl red\nKd 1 0 0\n")
    path = tmp_path / "r.urdf"
    path.write_text(TEXT, encoding="utf-8")
    return path


def test_pieces_replace_meshes_and_visuals_are_copied(file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "own"
    root, pieces, notes = write_meshes(read_urdf(file), folder, most_pieces=4)
    (folder / "r.urdf").write_bytes(ElementTree.tostring(root))
    shapes = read_urdf(folder / "r.urdf").read_shapes("collision")
    assert [shape.kind for shape in shapes] == ["box", "mesh", "mesh", "mesh"]
    before = read_urdf(file).read_shapes("collision")[1].make_mesh()
    after = trimesh.util.concatenate([shape.make_mesh() for shape in shapes[1:3]])
    assert after.bounds == pytest.approx(before.bounds)
    assert after.volume == pytest.approx(before.volume, rel=1e-5)
    piece, plate = pieces
    assert (plate.mesh, plate.count) == ("sheet.stl", 1)
    assert (piece.link, piece.count) == ("a", 2)
    assert piece.hull > 1.0 > 0.05 > abs(piece.overhead)
    assert any("sheet.stl is flat" in note for note in notes)
    assert any("left out unreadable visual meshes of a" in note for note in notes)
    assert {path.name for path in (folder / "visual").iterdir()} == {"seen.obj", "paint.mtl"}
    (mesh,) = root.findall("link/visual/geometry/mesh")
    assert mesh.attrib == {"filename": "visual/seen.obj", "scale": "2 2 2"}
    (tmp_path / "angle.stl").unlink()
    with pytest.raises(vkc.InputError, match="there is no such mesh"):
        write_meshes(read_urdf(file), folder, most_pieces=4)


def write_obj(file: Path, size: float, colour: str) -> None:
    """Write a cube as an OBJ file with a colour in paint.mtl."""
    file.parent.mkdir()
    cube = trimesh.creation.box((size,) * 3).export(
        file_type="obj", include_normals=False, include_texture=False
    )
    file.write_text(f"mtllib paint.mtl\nusemtl own\n{cube}", encoding="utf-8")
    (file.parent / "paint.mtl").write_text(f"newmtl own\nKd {colour}\n", encoding="utf-8")


def test_meshes_of_equal_names_keep_their_shapes_and_colours(tmp_path: Path) -> None:
    colours = {"a": (1.0, 0.0, 0.0, 1.0), "b": (0.0, 1.0, 0.0, 1.0), "c": (0.0, 0.0, 1.0, 1.0)}
    sizes, links = {"a": 0.1, "b": 0.2, "c": 0.3}, ""
    for name, size in sizes.items():
        file = tmp_path / name / ("x_2.obj" if name == "a" else "x.obj")
        write_obj(file, size, "{:g} {:g} {:g}".format(*colours[name]))
        relative = file.relative_to(tmp_path)
        shapes = f'<visual><geometry><mesh filename="{relative}"/></geometry></visual>'
        shapes += f'<collision><geometry><mesh filename="{file}"/></geometry></collision>'
        links += format_fixed_link(name, "root", shapes=shapes)
    urdf, own = tmp_path / "r.urdf", tmp_path / "own"
    urdf.write_text(f'<robot name="r"><link name="root"/>{links}</robot>')
    root, _, _ = write_meshes(read_urdf(urdf), own, most_pieces=1)
    (own / "r.urdf").write_bytes(ElementTree.tostring(root))
    visuals = {shape.link: shape for shape in read_urdf(own / "r.urdf").read_shapes("visual")}
    for name, size in sizes.items():
        assert visuals[name].make_mesh().volume == pytest.approx(size**3)
        (part,) = load_parts(visuals[name].file)
        assert part.colour == pytest.approx(colours[name], abs=0.01)
    assert {path.name for path in (own / "visual").iterdir()} == {
        *("x.obj", "x_2.obj", "x_3.obj"),
        *("paint.mtl", "paint_2.mtl", "paint_3.mtl"),
    }
    # No reference in it is to be renamed.
    assert (own / "visual" / "x_2.obj").read_bytes() == (tmp_path / "a" / "x_2.obj").read_bytes()


def test_meshes_are_copied_unchanged(file: Path, tmp_path: Path) -> None:
    original, folder = read_urdf(file), tmp_path / "copy"
    root = copy_meshes(original, folder)
    unchanged = ElementTree.fromstring(TEXT)
    assert ElementTree.tostring(original.root) == ElementTree.tostring(unchanged)
    (folder / "r.urdf").write_bytes(ElementTree.tostring(root))
    copied = read_urdf(folder / "r.urdf")
    for kind, count in (("visual", 1), ("collision", 3)):  # one visual mesh is missing
        shapes = copied.read_shapes(kind)
        assert len(shapes) == count
        for shape in shapes:
            if shape.file is not None:
                assert shape.file.parent == folder / "meshes"
                source = file.parent / shape.file.name
                assert shape.file.read_bytes() == source.read_bytes()
    sizes = [[shape.size for shape in urdf.read_shapes("collision")] for urdf in (original, copied)]
    assert sizes[0] == sizes[1]
    assert (folder / "meshes/paint.mtl").is_file()


def test_missing_collision_meshes_are_refused(file: Path, tmp_path: Path) -> None:
    (file.parent / "angle.stl").unlink()
    with pytest.raises(InputError, match=r"angle\.stl"):
        copy_meshes(read_urdf(file), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
