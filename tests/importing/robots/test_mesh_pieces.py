from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import trimesh

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.importing.robots.mesh_pieces import copy_meshes, write_meshes
from vkc_pin.world.files.meshes import load_parts
from vkc_pin.world.files.urdf import UrdfFile, read_urdf

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
    box = trimesh.creation.box
    arms = [
        box((2, 0.2, 1)).apply_translation((1.2, 0, 0)),
        box((0.2, 2, 1)).apply_translation((0, 1.2, 0)),
    ]
    angle = trimesh.util.concatenate(arms)
    angle.export(tmp_path / "angle.stl")
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
    before = next(
        shape
        for shape in read_urdf(file).read_shapes("collision")
        if shape.file and shape.file.name == "angle.stl"
    ).make_mesh()
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


def write_obj(file: Path, size: float, colour: str) -> Path:
    """Write a cube as an OBJ file with a colour in paint.mtl, and return the file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    cube = trimesh.creation.box((size,) * 3).export(
        file_type="obj", include_normals=False, include_texture=False
    )
    file.write_text(f"mtllib paint.mtl\nusemtl own\n{cube}", encoding="utf-8")
    (file.parent / "paint.mtl").write_text(f"newmtl own\nKd {colour}\n", encoding="utf-8")
    return file


def format_link(name: str, visual: str, collision: str) -> str:
    shapes = f'<visual><geometry><mesh filename="{visual}"/></geometry></visual>'
    shapes += f'<collision><geometry><mesh filename="{collision}"/></geometry></collision>'
    ends = f'<parent link="root"/><child link="{name}"/>'
    joint = f'<joint name="{name}_joint" type="fixed">{ends}</joint>'
    return f'<link name="{name}">{shapes}</link>{joint}'


def write_own_meshes(folder: Path, *links: str) -> UrdfFile:
    """Write a robot with these links below its root, and return its copy with its own meshes."""
    (folder / "r.urdf").write_text(
        f'<robot name="r"><link name="root"/>{"".join(links)}</robot>', encoding="utf-8"
    )
    root, _, _ = write_meshes(read_urdf(folder / "r.urdf"), folder / "own", most_pieces=1)
    (folder / "own" / "r.urdf").write_bytes(ElementTree.tostring(root))
    return read_urdf(folder / "own" / "r.urdf")


def test_meshes_of_equal_names_keep_their_shapes_and_colours(
    tmp_path: Path,
) -> None:
    colours = {"a": (1.0, 0.0, 0.0, 1.0), "b": (0.0, 1.0, 0.0, 1.0), "c": (0.0, 0.0, 1.0, 1.0)}
    files = {
        name: write_obj(
            tmp_path / name / file, size, " ".join(f"{value:g}" for value in colours[name][:3])
        )
        for name, file, size in (("a", "x_2.obj", 0.1), ("b", "x.obj", 0.2), ("c", "x.obj", 0.3))
    }
    robot = write_own_meshes(
        tmp_path,
        *(
            format_link(name, str(file.relative_to(tmp_path)), str(file))
            for name, file in files.items()
        ),
    )
    shapes = {shape.link: shape for shape in robot.read_shapes("visual")}
    assert {name: shape.make_mesh().volume for name, shape in shapes.items()} == pytest.approx(
        {"a": 0.1**3, "b": 0.2**3, "c": 0.3**3}
    )
    for name, shape in shapes.items():
        assert shape.file is not None
        (part,) = load_parts(shape.file)
        assert part.colour == pytest.approx(colours[name], abs=0.01)
    folder = tmp_path / "own" / "visual"
    assert {path.name for path in folder.iterdir()} == {
        *("x.obj", "x_2.obj", "x_3.obj"),
        *("paint.mtl", "paint_2.mtl", "paint_3.mtl"),
    }
    assert (folder / "x_2.obj").read_bytes() == files["a"].read_bytes(), "no reference to rename"


def test_meshes_are_copied_unchanged(file: Path, tmp_path: Path) -> None:
    original, folder = read_urdf(file), tmp_path / "copy"
    root = copy_meshes(original, folder)
    assert (
        ElementTree.tostring(original.root).decode()
        == ElementTree.tostring(ElementTree.fromstring(TEXT)).decode()
    )
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
    assert [shape.size for shape in copied.read_shapes("collision")] == [
        shape.size for shape in original.read_shapes("collision")
    ]
    assert (folder / "meshes/paint.mtl").is_file()


def test_missing_collision_meshes_are_refused(file: Path, tmp_path: Path) -> None:
    (file.parent / "angle.stl").unlink()
    with pytest.raises(InputError, match=r"angle\.stl"):
        copy_meshes(read_urdf(file), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
