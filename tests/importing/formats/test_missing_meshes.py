from __future__ import annotations

from pathlib import Path

import pytest
import trimesh
from helpers.texts import format_box, format_fixed_link

from vkc_pin.errors import InputError
from vkc_pin.importing import import_home, import_object
from vkc_pin.importing.formats.missing_meshes import replace_missing_meshes
from vkc_pin.importing.objects.object_reading import read_object
from vkc_pin.importing.robots.sources import Source, read_source
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


def read_written(folder: Path, *shapes: str) -> Source:
    """Write a URDF and read it as a robot."""
    write_robot(folder, *shapes)
    return read_source(folder / "r.urdf", folder / "scratch", packages={}, arguments={})


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
    notes, missing = replace_missing_meshes(file)
    assert not missing
    assert note in "; ".join(notes)
    assert [shape.kind for shape in file.read_shapes("collision")] == kinds
    file.read_shapes("visual")
    description = read_object(tmp_path / "r.urdf")
    assert note in "; ".join(description.notes)
    assert [part.kind for part in description.links["l0"].solid] == kinds


def test_all_missing_meshes_are_listed(tmp_path: Path) -> None:
    shapes = [COLLISION.format(name) for name in ("a.stl", "there.stl", "package://p/b.dae")]
    with pytest.raises(InputError, match=r"2 meshes do not exist: a\.stl, package://p/b\.dae"):
        read_written(tmp_path, *shapes)
    with pytest.raises(InputError, match=r"a\.stl: there is no such mesh"):
        read_written(tmp_path, *shapes[:2])


@pytest.mark.parametrize("address", ["{}.stl", "package://{}/a.stl", "model://p/{}"])
def test_meshes_with_impossible_file_names_are_missing(tmp_path: Path, address: str) -> None:
    for name in ("é" * 300, "a/" * 3000, "%00"):
        with pytest.raises(InputError, match="there is no such mesh") as caught:
            read_written(tmp_path, COLLISION.format(address.format(name)))
        assert caught.value.file == tmp_path / "r.urdf"


CHEST = f"""<robot name="flat">
<link name="room">{VISUAL.format("gone.dae")}</link>
<link name="chest">{format_box("0.4 0.6 0.8", at="0 0 0.4")}</link>
<link name="front">{{front}}</link>
<link name="lamp">{{lamp}}</link>
<joint name="stands" type="fixed"><parent link="room"/><child link="chest"/></joint>
<joint name="hangs" type="fixed"><parent link="room"/><child link="lamp"/></joint>
<joint name="slide" type="prismatic"><parent link="chest"/><child link="front"/>
<origin xyz="-0.22 0 0.5"/><axis xyz="-1 0 0"/>
<limit lower="0" upper="0.3" effort="9" velocity="1"/></joint></robot>"""
FRONT = format_box("0.02 0.56 0.3") + format_box("0.02 0.2 0.02", at="-0.07 0 0")
LAMP = format_box("0.1 0.1 0.1", at="0 2 2")


def write_chest(folder: Path, *, front: str = FRONT, lamp: str = LAMP) -> Path:
    """Write a room whose picture mesh is missing, with a chest and a lamp."""
    file = folder / "flat.urdf"
    file.write_text(CHEST.format(front=front, lamp=lamp))
    return file


@pytest.mark.parametrize("lamp", [LAMP, COLLISION.format("gone.stl"), VISUAL.format("gone.stl")])
def test_meshes_that_are_missing_elsewhere_do_not_stop_the_import_of_a_link(
    tmp_path: Path, lamp: str
) -> None:
    file = write_chest(tmp_path, lamp=lamp)
    chest = import_object(file, tmp_path / "chest", link="chest")
    assert chest.object.coordinates.names == ("slide",)
    with pytest.raises(InputError, match=r"there is no such mesh|meshes do not exist"):
        import_object(file, tmp_path / "flat")


def test_missing_pictures_of_what_does_not_move_are_noted_in_homes(tmp_path: Path) -> None:
    home = import_home(write_chest(tmp_path), tmp_path / "home")
    (note,) = [note for note in home.notes if "gone.dae" in note]
    assert "link 'room': there is no visual mesh gone.dae: left out" in note
    assert "nothing collides in its place" in note
    assert [item.name for item in home.objects] == ["chest"]
    # What moves, and what was to collide, is needed.
    for shapes in (
        {"front": VISUAL.format("front.dae")},
        {"lamp": COLLISION.format("lamp.stl")},
    ):
        with pytest.raises(InputError, match=r"(front\.dae|lamp\.stl): there is no such mesh"):
            import_home(write_chest(tmp_path, **shapes), tmp_path / "other")


def test_all_missing_meshes_of_a_link_are_listed(tmp_path: Path) -> None:
    gone = COLLISION.format("a.stl") + COLLISION.format("b.stl")
    with pytest.raises(InputError, match=r"2 meshes do not exist: a\.stl, b\.stl"):
        import_object(write_chest(tmp_path, front=gone), tmp_path / "chest", link="chest")


def test_meshes_that_are_missing_elsewhere_in_sdf_files_do_not_stop_an_import(
    tmp_path: Path,
) -> None:
    box = "<geometry><box><size>0.4 0.6 0.8</size></box></geometry>"
    mesh = "<geometry><mesh><uri>gone.dae</uri></mesh></geometry>"
    file = tmp_path / "flat.sdf"
    file.write_text(f"""<sdf version="1.9"><model name="flat">
<link name="room"><visual name="v">{mesh}</visual></link>
<link name="chest"><collision name="c">{box}</collision></link>
<link name="front"><pose>-0.22 0 0 0 0 0</pose><collision name="c"><geometry><box>
<size>0.02 0.56 0.3</size></box></geometry></collision></link>
<joint name="stands" type="fixed"><parent>room</parent><child>chest</child></joint>
<joint name="slide" type="prismatic"><parent>chest</parent><child>front</child>
<axis><xyz>-1 0 0</xyz><limit><lower>0</lower><upper>0.3</upper></limit></axis></joint>
</model></sdf>""")
    chest = import_object(file, tmp_path / "chest", link="chest")
    assert chest.object.coordinates.names == ("slide",)
    with pytest.raises(InputError, match=r"gone\.dae: there is no such mesh"):
        import_object(file, tmp_path / "flat")


def test_missing_visual_meshes_that_collide_are_errors(tmp_path: Path) -> None:
    """Visual shapes collide per link in objects, but in robots only without collision shapes."""
    cosmetic = (BOX, VISUAL.format("gone.stl"))
    (warning,) = read_written(tmp_path, *cosmetic).warnings
    assert warning == "l1: there is no visual mesh gone.stl: left out"
    with pytest.raises(InputError, match=r"gone\.stl"):
        read_written(tmp_path, *cosmetic[1:])
    write_robot(tmp_path, *cosmetic)
    with pytest.raises(InputError, match=r"gone\.stl"):
        read_object(tmp_path / "r.urdf").check_meshes()
