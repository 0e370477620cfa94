"""Tests what importers say about files that they do not read, and about arguments of xacro."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import vkc_pin as vkc
from vkc_pin.cli import main
from vkc_pin.importing.homes.mesh_rooms import MESH_SUFFIXES

IMPORTERS: dict[str, Callable[..., Any]] = {
    "import-object": vkc.importing.import_object,
    "import-home": vkc.importing.import_home,
    "import-robot": vkc.importing.import_robot,
}
OTHERS = {
    "a.glb": (b"glTF\x02\x00\x00\x00\xb8", "glTF is not supported"),
    "a.gltf": (b'{"asset": {"version": "2.0"}}', "glTF is not supported"),
    "a.ply": (b"ply\nformat binary_little_endian 1.0\n\xb8", "PLY is not supported"),
    "a.pcd": (b"# .PCD v0.7\nVERSION 0.7\n", "PCD is not supported"),
    "a.bt": (b"# Octomap OcTree binary file\n\xb8", "OctoMap is not supported"),
    "a.stl": (b"solid a\nendsolid a\n", "STL is not supported"),
    "map.yaml": (b"image: m.pgm\nresolution: 0.05\n", "map of nav2.* is not supported"),
    "s.wbt": (b"#VRML_SIM R2023b utf8\n", "Webots is not supported"),
    "readme": (b"\n  A robot.\n", "the file is not XML .*got A"),
}


@pytest.mark.parametrize("command", IMPORTERS)
@pytest.mark.parametrize(("name", "data", "message"), [(n, *o) for n, o in OTHERS.items()])
def test_other_formats_are_named(
    command: str, name: str, data: bytes, message: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(data)
    expected = "URDF, xacro"
    if command == "import-home" and Path(name).suffix in MESH_SUFFIXES:
        message, expected = "the mesh", "STL|triangle"  # read as rooms, and none of these is one
    with pytest.raises(vkc.InputError, match=message) as caught:
        IMPORTERS[command](tmp_path / name, tmp_path / "out")
    assert re.search(expected, str(caught.value.expected))
    assert caught.value.file == tmp_path / name
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("head", ["", "\n ", "\ufeff", "<!-- ply -->"])
def test_xml_is_read_whatever_precedes_its_first_element(head: str, tmp_path: Path) -> None:
    """Whether a file is XML does not depend on its suffix."""
    file = tmp_path / "a.usda"
    shape = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    file.write_text(f'{head}<robot name="r"><link name="a">{shape}</link></robot>', "utf-8")
    assert vkc.importing.import_object(file, tmp_path / "out").object.links == ("a",)


def test_command_ends_with_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.pcd").write_bytes(b"# .PCD v0.7")
    assert main(["import-home", str(tmp_path / "a.pcd")]) == 2
    assert "PCD is not supported" in capsys.readouterr().err


XACRO = """<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">
<!-- <xacro:arg name="old" default="1"/> -->
<xacro:arg name="prefix" default="my_"/>
<xacro:arg default="0.1" name='width'/>
<xacro:include filename="part.xacro"/>
<xacro:if value="false"><link name="$(arg unused)"/></xacro:if>
<link name="$(arg prefix)a"><collision><geometry><box size="$(arg width) 1 1"/></geometry>
</collision></link>
</robot>"""
PART = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="part_name" default="b"/></robot>"""


@pytest.fixture
def xacro_file(tmp_path: Path) -> Path:
    pytest.importorskip("xacro")
    (tmp_path / "part.xacro").write_text(PART)
    (tmp_path / "t.urdf.xacro").write_text(XACRO)
    return tmp_path / "t.urdf.xacro"


@pytest.mark.parametrize("command", IMPORTERS)
@pytest.mark.parametrize(
    ("argument", "nearest"),
    [("prefx", "prefix"), ("Width", "width"), ("part_nam", "part_name"), ("old", None)],
)
def test_misspelled_arguments_of_xacro_are_rejected(
    command: str, argument: str, nearest: str | None, xacro_file: Path, tmp_path: Path
) -> None:
    with pytest.raises(vkc.UnknownNameError, match=f"no xacro argument '{argument}'") as caught:
        IMPORTERS[command](xacro_file, tmp_path / "out", arguments={argument: "1"})
    assert set(caught.value.choices) == {"part_name", "prefix", "unused", "width"}
    assert (f"did you mean '{nearest}'" in str(caught.value)) == (nearest is not None)


def test_misspelled_argument_explains_why_another_is_missing(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    file = tmp_path / "t.xacro"
    text = XACRO.replace('<xacro:arg name="prefix" default="my_"/>', "")
    file.write_text(text.replace("part.xacro", "$(arg prefix).xacro"))
    with pytest.raises(vkc.UnknownNameError, match="'prefx'; did you mean 'prefix'"):
        vkc.importing.import_object(file, tmp_path / "out", arguments={"prefx": "1"})


@pytest.mark.parametrize("argument", ["prefix", "width", "part_name", "unused"])
def test_arguments_that_any_file_declares_or_uses_are_accepted(
    argument: str, xacro_file: Path, tmp_path: Path
) -> None:
    done = vkc.importing.import_object(xacro_file, tmp_path / "out", arguments={argument: "2"})
    assert done.object.links == (("2a",) if argument == "prefix" else ("my_a",))


def test_computed_names_of_arguments_may_be_any(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    file = tmp_path / "t.xacro"
    file.write_text(XACRO.replace('name="prefix"', "name=\"pre${'fix'}\"").replace("part.x", "p.x"))
    (tmp_path / "p.xacro").write_text(PART)
    done = vkc.importing.import_object(file, tmp_path / "out", arguments={"prefix": "2"})
    assert done.object.links == ("2a",)


FILES_WITHOUT_ARGUMENTS = {
    "t.urdf": '<robot name="r"><link name="a"/></robot>',
    "t.sdf": '<sdf version="1.9"><model name="m"><link name="a"/></model></sdf>',
    "t.xml": "<mujoco><worldbody/></mujoco>",
}


@pytest.mark.parametrize("command", IMPORTERS)
@pytest.mark.parametrize(("name", "text"), FILES_WITHOUT_ARGUMENTS.items())
def test_files_other_than_xacro_have_no_arguments(
    command: str, name: str, text: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(vkc.InputError, match=r"only xacro files have arguments .*got prefix"):
        IMPORTERS[command](tmp_path / name, tmp_path / "out", arguments={"prefix": "1"})


EMPTY = {
    "world.sdf": ('<sdf version="1.9"><world name="w"/></sdf>', "w: a world without links"),
    "actor.sdf": (
        '<sdf version="1.9"><world name="w"><actor name="a"/></world></sdf>',
        "a world without links .*got <actor>",
    ),
    "lights.sdf": (
        '<sdf version="1.9"><world name="w"><light name="a" type="point"/><plugin name="p"/>'
        "</world></sdf>",
        "a world without links .*got <light>, <plugin>",
    ),
    "models.sdf": (
        '<sdf version="1.9"><world name="w"><model name="m"/></world></sdf>',
        "a world without links .*got <model>",
    ),
    "frames.sdf": (
        '<sdf version="1.9"><world name="w"><frame name="f"/></world></sdf>',
        "a world without links .*got <frame>",
    ),
    "model.sdf": ('<sdf version="1.9"><model name="m"/></sdf>', "m: a model without links"),
    "nothing.sdf": ('<sdf version="1.9"/>', "does not hold exactly one model"),
    "shapeless.sdf": (
        '<sdf version="1.9"><model name="m"><link name="a"/></model></sdf>',
        "the file has no shapes",
    ),
    "empty.xml": ("<mujoco/>", "the file has no shapes"),
    "light.xml": ("<mujoco><worldbody><light/></worldbody></mujoco>", "the file has no shapes"),
    "plane.xml": (
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>',
        r"no shapes are left .*\(a plane\): left out",
    ),
    "links.urdf": ('<robot name="r"/>', "there are no links"),
    "shapeless.urdf": ('<robot name="r"><link name="a"/></robot>', "the file has no shapes"),
    "empty.urdf": ("", "not valid XML"),
}


@pytest.mark.parametrize("command", ["import-object", "import-home"])
@pytest.mark.parametrize(("name", "text", "message"), [(n, *e) for n, e in EMPTY.items()])
def test_empty_files_are_rejected(
    command: str, name: str, text: str, message: str, tmp_path: Path
) -> None:
    if name.endswith(".xml"):
        pytest.importorskip("mujoco")
    (tmp_path / name).write_text(text)
    with pytest.raises(vkc.InputError, match=message) as caught:
        IMPORTERS[command](tmp_path / name, tmp_path / "out")
    assert caught.value.file == tmp_path / name


@pytest.mark.parametrize("name", ["free.sdf", "free.xml"])
def test_one_free_body_is_the_object_and_several_are_left_out(name: str, tmp_path: Path) -> None:
    shape = '<collision name="c"><geometry><box><size>1 1 1</size></box></geometry></collision>'
    model = f'<model name="{{}}"><link name="a">{shape}</link></model>'
    body = '<body name="{}"><freejoint/><geom type="box" size="0.5 0.5 0.5"/></body>'
    start, each, end = {
        "free.sdf": ('<sdf version="1.9"><world name="w">', model, "</world></sdf>"),
        "free.xml": ("<mujoco><worldbody>", body, "</worldbody></mujoco>"),
    }[name]
    file = tmp_path / name
    file.write_text(start + each.format("can") + end)
    can = vkc.importing.import_object(file, tmp_path / "can")
    assert can.size == pytest.approx([1.0, 1.0, 1.0])
    file.write_text(start + each.format("can") + each.format("cup") + end)
    with pytest.raises(vkc.InputError, match=r"no shapes are left .*'can' is free.*'cup' is free"):
        vkc.importing.import_object(file, tmp_path / "out")
