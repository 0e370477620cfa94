from __future__ import annotations

from pathlib import Path

import pytest
import trimesh
from helpers.texts import format_box, format_fixed_link

from vkc_pin.errors import InputError
from vkc_pin.importing.missing_meshes import replace_missing_meshes
from vkc_pin.importing.objects.urdf import read_object_urdf
from vkc_pin.world.files.urdf import UrdfFile, read_urdf

BOX, VISUAL_BOX = format_box("1 1 1"), format_box("1 1 1", kind="visual")
MESH = '<{kind}><geometry><mesh filename="{{}}"/></geometry></{kind}>'
COLLISION, VISUAL = MESH.format(kind="collision"), MESH.format(kind="visual")


def write_robot(folder: Path, *shapes: str) -> UrdfFile:
    """Write a URDF with one link per argument, and meshes there.stl and again.STL beside it."""
    trimesh.creation.box((1, 1, 1)).export(folder / "there.stl")
    (folder / "again.STL").write_bytes((folder / "there.stl").read_bytes())
    links = f'<link name="l0">{shapes[0]}</link>'
    for k, text in enumerate(shapes[1:], 1):
        links += format_fixed_link(f"l{k}", "l0", shapes=text)
    (folder / "r.urdf").write_text(f'<robot name="r">{links}</robot>')
    return read_urdf(folder / "r.urdf")


@pytest.mark.parametrize(
    ("shapes", "note", "kinds"),
    [
        (COLLISION.format("there.std"), "there.std: there.stl beside it is used", ["mesh"]),
        (COLLISION.format("there"), "there.stl beside it", ["mesh"]),
        (COLLISION.format("again.stl"), "again.STL beside it", ["mesh"]),
        (COLLISION.format("file://./there.dae"), "there.stl beside it", ["mesh"]),
        (
            VISUAL.format("there.stl") + COLLISION.format("gone.stl"),
            "visual shapes collide",
            ["mesh"],
        ),
        (
            VISUAL_BOX + COLLISION.format("a.stl") + COLLISION.format("b.stl"),
            "no collision mesh b.stl: the link's visual shapes collide",
            ["box"],
        ),
        (
            VISUAL.format("gone.dae") + BOX,
            "no visual mesh gone.dae: left out",
            ["box"],
        ),
    ],
)
def test_missing_meshes_are_replaced(
    tmp_path: Path, shapes: str, note: str, kinds: list[str]
) -> None:
    file = write_robot(tmp_path, shapes)
    notes = replace_missing_meshes(file, every_link=True)
    assert note in "; ".join(notes)
    assert [shape.kind for shape in file.read_shapes("collision")] == kinds
    file.read_shapes("visual")
    description = read_object_urdf(tmp_path / "r.urdf")
    assert note in "; ".join(description.notes)
    assert [part.kind for part in description.links["l0"].solid] == kinds


def test_all_missing_meshes_are_listed(tmp_path: Path) -> None:
    shapes = [COLLISION.format(name) for name in ("a.stl", "there.stl", "package://p/b.dae")]
    with pytest.raises(InputError, match=r"2 meshes do not exist: a\.stl, package://p/b\.dae"):
        replace_missing_meshes(write_robot(tmp_path, *shapes), every_link=True)
    with pytest.raises(InputError, match=r"a\.stl: there is no such mesh"):
        replace_missing_meshes(write_robot(tmp_path, *shapes[:2]), every_link=True)


@pytest.mark.parametrize("address", ["{}.stl", "package://{}/a.stl", "model://p/{}"])
def test_meshes_with_impossible_file_names_are_missing(tmp_path: Path, address: str) -> None:
    for name in ("é" * 300, "a/" * 3000, "%00"):
        file = write_robot(tmp_path, COLLISION.format(address.format(name)))
        with pytest.raises(InputError, match="there is no such mesh") as caught:
            replace_missing_meshes(file, every_link=True)
        assert caught.value.file == tmp_path / "r.urdf"


def test_missing_visual_meshes_that_collide_are_errors(tmp_path: Path) -> None:
    """Visual shapes collide per link in objects, but in robots only without collision shapes."""
    cosmetic = (BOX, VISUAL.format("gone.stl"))
    assert len(replace_missing_meshes(write_robot(tmp_path, *cosmetic), every_link=False)) == 1
    for shapes, every_link in ((cosmetic, True), (cosmetic[1:], False)):
        with pytest.raises(InputError, match=r"gone\.stl"):
            replace_missing_meshes(write_robot(tmp_path, *shapes), every_link=every_link)
