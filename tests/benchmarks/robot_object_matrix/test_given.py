"""Tests requested robots and objects: parsing of requests, and import of files."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.arm_urdf import write_arms

import vkc_pin as vkc
from vkc_pin.benchmarks.robot_object_matrix.pairs import (
    Request,
    load_description,
    make_hall,
    parse_requests,
    prepare_object,
    prepare_robot,
)
from vkc_pin.world.models.robot_file import find_robot

# A box with a drawer that is pulled towards +y, and a lamp beside it.
DESK = """<robot name="desk">
  <link name="room"/>
  <link name="case">
    <collision><origin xyz="0 0 0.4"/><geometry><box size="0.5 0.5 0.8"/></geometry></collision>
  </link>
  <link name="tray"><collision><geometry><box size="0.3 0.02 0.1"/></geometry></collision>
    <collision name="handle">
      <origin xyz="0 0.08 0"/><geometry><box size="0.3 0.02 0.02"/></geometry>
    </collision></link>
  <link name="lamp">
    <collision><origin xyz="1 0 0.5"/><geometry><box size="0.2 0.2 1.0"/></geometry></collision>
  </link>
  <joint name="stands" type="fixed"><parent link="room"/><child link="case"/></joint>
  <joint name="beside" type="fixed"><parent link="room"/><child link="lamp"/></joint>
  <joint name="slide" type="prismatic">
    <parent link="case"/><child link="tray"/><origin xyz="0 0.28 0.6"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
</robot>"""


def test_requests_are_parsed() -> None:
    texts = [
        "default",
        "my_oven=kitchens/kitchen.xml#oven",
        "kitchens/kitchen.xml#sink top",
        "home/desk.yaml",
        "drawer",
    ]
    assert parse_requests(texts, "objects", ("oven_0", "door")) == [
        Request("oven_0", "oven_0"),
        Request("door", "door"),
        Request("my_oven", "kitchens/kitchen.xml", "oven"),
        Request("sink top", "kitchens/kitchen.xml", "sink top"),
        Request("desk", "home/desk.yaml"),
        Request("drawer", "drawer"),
    ]
    assert [
        request.is_imported
        for request in parse_requests(["a.URDF", "b.sdf", "c.yaml", "urdf"], "objects", ())
    ] == [True, True, False, False]


@pytest.mark.parametrize(
    "texts",
    [[], ["oven_0", "oven_0"], ["default", "oven_0"], ["a=oven_0", "a=oven_1"], [""], ["#link"]],
)
def test_malformed_requests_are_refused(texts: list[str]) -> None:
    with pytest.raises(vkc.InputError, match="objects: not a choice"):
        parse_requests(texts, "objects", ("oven_0",))


def test_object_file_is_imported_once_and_faces_the_robot(tmp_path: Path) -> None:
    (tmp_path / "flat.urdf").write_text(DESK, encoding="utf-8")
    (request,) = parse_requests([f"desk={tmp_path / 'flat.urdf'}#case"], "objects", ())
    file_name = prepare_object(request, tmp_path / "objects")
    item = vkc.load_object(load_description(file_name))
    assert sorted(item.links) == ["case", "front", "tray"], "not the lamp"
    attachment = item.attachment()
    approach = (item.link_placement(attachment.link, [0.0]) * attachment.placement).rotation[:, 2]
    np.testing.assert_allclose(approach, [1.0, 0.0, 0.0], atol=1e-9)
    closed, opened = (item.link_placement("tray", [value]).translation for value in (0.0, 0.3))
    np.testing.assert_allclose(opened - closed, [-0.3, 0.0, 0.0], atol=1e-9)
    written = {
        file: file.read_bytes() for file in Path(file_name).parent.rglob("*") if file.is_file()
    }
    assert prepare_object(request, tmp_path / "objects") == file_name
    assert {
        file: file.read_bytes() for file in Path(file_name).parent.rglob("*") if file.is_file()
    } == written
    assert not list((tmp_path / "objects").glob(".*")), "no temporary files remain"


@pytest.mark.parametrize("link", ["../../evil", "..", "a/b", "/evil", ".hidden"])
def test_link_name_must_be_a_file_name(tmp_path: Path, link: str) -> None:
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil" / "letter.txt").write_text("mine")
    desk = DESK.replace("case", link)
    (tmp_path / "flat.urdf").write_text(desk, encoding="utf-8")
    (request,) = parse_requests([f"{tmp_path / 'flat.urdf'}#{link}"], "objects", ())
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(vkc.InputError, match="objects: not a plain file name"):
        prepare_object(request, tmp_path / "a" / "objects")
    with pytest.raises(vkc.InputError, match="robots: not a plain file name"):
        prepare_robot(Request(link, "husky_ur5e"), tmp_path / "a" / "robots")
    assert sorted(tmp_path.rglob("*")) == before
    (request,) = parse_requests([f"desk={tmp_path / 'flat.urdf'}#{link}"], "objects", ())
    assert prepare_object(request, tmp_path / "objects") == str(tmp_path / "objects/desk/desk.yaml")


def test_bundled_robot_is_used_and_robot_file_is_imported_once(tmp_path: Path) -> None:
    assert prepare_robot(Request("husky", "husky_ur5e"), tmp_path) == "husky_ur5e"
    assert not list(tmp_path.iterdir())
    file = write_arms(tmp_path / "given")
    folder = Path(prepare_robot(Request("two_arms", str(file)), tmp_path / "robots"))
    assert folder == tmp_path / "robots" / "two_arms"
    assert vkc.load_robot(folder).touch_links
    changed = (folder / "robot.yaml").stat().st_mtime_ns
    prepare_robot(Request("two_arms", str(file)), tmp_path / "robots")
    assert (folder / "robot.yaml").stat().st_mtime_ns == changed


@pytest.mark.parametrize("text", ["rover/robot.yaml", "rover"])
def test_relative_path_of_a_robot_is_relative_to_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(find_robot("husky_ur5e").parent, "rover")
    found = prepare_robot(Request("rover", f"./{text}"), Path("robots"))
    scene = make_hall(found, "drawer", load_description("drawer"))
    assert scene.robot.urdf == tmp_path / "rover/husky_ur5e.urdf"
