from __future__ import annotations

from pathlib import Path

import pytest
from helpers.arm_urdf import write_arms
from helpers.texts import replace_in_file

import vkc_pin as vkc
from vkc_pin.importing.formats.xacro import expand_xacro
from vkc_pin.importing.robots.sources import Source, read_source
from vkc_pin.world.files import resources
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.files.xml import parse_xml


def read_robot(file: Path, scratch: Path) -> Source:
    return read_source(file, scratch, packages={}, arguments={})


def test_foreign_elements_are_removed_and_missing_limits_noted(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    foreign = "</robot>", "<gazebo/><transmission name='t'/></robot>"
    replace_in_file(path, (' effort="10"', ""), foreign, count=1)
    source = read_robot(path, tmp_path)
    assert source.kind == "URDF"
    assert "left out elements that a URDF does not have: <gazebo>, <transmission>" in source.notes
    assert any("state no effort or velocity limit: arm_1_joint" in note for note in source.notes)
    assert source.file.root.find("gazebo") is None


def test_srdf_of_another_robot_is_ignored(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    other = "<robot name='x'><disable_collisions link1='elsewhere' link2='sun'/></robot>"
    (tmp_path / "robot.srdf").write_text(other, encoding="utf-8")
    source = read_robot(path, tmp_path)
    assert any("ignored robot.srdf" in note and "elsewhere, sun" in note for note in source.notes)
    assert not source.srdf.allowed
    with pytest.raises(vkc.InputError, match="names no link of this robot"):
        read_source(path, tmp_path, packages={}, arguments={}, srdf=tmp_path / "robot.srdf")


def test_srdf_with_some_stale_names_is_read(tmp_path: Path) -> None:
    path = write_arms(tmp_path)
    pairs = "".join(
        f"<disable_collisions link1='body' link2='{other}'/>" for other in ("arm_1", "arm_1_sc")
    )
    group = "<group name='manip'><chain base_link='body' tip_link='hand'/></group>"
    (tmp_path / "robot.srdf").write_text(f"<robot name='x'>{pairs}{group}</robot>")
    source = read_robot(path, tmp_path)
    assert source.srdf.allowed.keys() == {("arm_1", "body")}
    assert source.srdf.groups["manip"].tip == "hand"
    assert any("robot.srdf: skipped links" in note and "arm_1_sc" in note for note in source.notes)


def test_srdf_of_a_published_robot_is_read(tmp_path: Path) -> None:
    folder = resources.find_example_robot_data()
    assert folder is not None
    panda = read_robot(folder / "robots" / "panda_description" / "urdf" / "panda.urdf", tmp_path)
    assert panda.srdf.groups
    assert panda.srdf.states
    assert panda.srdf.allowed


TEXT = """<?xml version="1.0"?>
<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:include filename="$(find my_parts)/links.xacro"/>
  <xacro:arg name="length" default="0.3"/>
  <xacro:stick name="upper" length="$(arg length)"/>
</robot>
"""
PART = """<?xml version="1.0"?>
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="stick" params="name length">
    <link name="${name}"><collision><geometry>
      <box size="${2*length} 0.1 0.1"/></geometry></collision></link>
  </xacro:macro>
</robot>
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "work" / "my_robot" / "urdf" / "two.xacro"
    part = tmp_path / "work" / "my_parts" / "links.xacro"
    for target, text in ((path, TEXT), (part, PART)):
        target.parent.mkdir(parents=True)
        target.write_text(text, encoding="utf-8")
    return path


def expand_box_size(
    file: Path, packages: dict[str, Path] | None = None, **arguments: str
) -> str | None:
    """Expand a xacro file and return the size of its box."""
    box = parse_xml(expand_xacro(file, packages or {}, arguments), file).find(".//box")
    return None if box is None else box.get("size")


def test_given_packages_and_those_around_the_file_are_found(file: Path, tmp_path: Path) -> None:
    assert expand_box_size(file) == "0.6 0.1 0.1"
    assert expand_box_size(file, length="0.5") == "1.0 0.1 0.1"
    (tmp_path / "links.xacro").write_text(PART.replace("2*length", "4*length"), encoding="utf-8")
    assert expand_box_size(file, {"my_parts": tmp_path}) == "1.2 0.1 0.1"


@pytest.mark.parametrize(
    ("folder", "names"),
    [
        ("work/checkout-of-parts", "my_parts"),  # beside the robot's package
        ("work/my_robot/checkout", "my_parts"),  # within it
        ("work", "my_parts"),  # around it
        ("work/z", " my_parts\n "),
    ],
)
def test_package_xml_names_a_package(file: Path, tmp_path: Path, folder: str, names: str) -> None:
    (tmp_path / "work" / "my_parts").rename(tmp_path / "elsewhere")
    with pytest.raises(vkc.InputError, match="packages were not found: my_parts"):
        expand_xacro(file, {}, {})
    package = tmp_path / folder
    package.mkdir(exist_ok=True)
    (tmp_path / "elsewhere" / "links.xacro").rename(package / "links.xacro")
    text = f'<?xml version="1.0"?><package format="2"><name>{names}</name></package>'
    (package / "package.xml").write_text(text)
    assert expand_box_size(file) == "0.6 0.1 0.1"
    plain = package / "r.urdf"
    plain.write_text('<robot name="r"><link name="a"/></robot>')
    assert read_urdf(plain).resolve("package://my_parts/links.xacro") == package / "links.xacro"


def test_all_missing_packages_are_listed(file: Path) -> None:
    include = '<xacro:include filename="$(find {})/x.xacro"/>'
    more = "".join(map(include.format, ("first_gone", "second_gone", "é" * 300)))
    part = file.parents[2] / "my_parts" / "links.xacro"
    replace_in_file(part, ("</robot>", f"{include.format('third')}</robot>"))
    replace_in_file(file, ("</robot>", f"{more}</robot>"))
    with pytest.raises(vkc.InputError) as caught:
        expand_xacro(file, {}, {})
    message = str(caught.value)
    assert "packages were not found: first_gone, second_gone, é" in message
    assert "é, third " in message
    assert "--package NAME=FOLDER" in message
    assert message.count("first_gone") == 1
    assert "class" not in message


def test_errors_name_the_cause(file: Path) -> None:
    replace_in_file(file, ("$(arg length)", "${1/0}"))
    with pytest.raises(vkc.InputError, match="xacro cannot process the file") as caught:
        expand_xacro(file, {}, {})
    assert caught.value.file == file
