from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.partnet import SDF, write_partnet_object

import vkc_pin as vkc
from vkc_pin.importing.objects.object_reading import read_object
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes


@pytest.fixture(scope="module")
def cabinet(tmp_path_factory: pytest.TempPathFactory) -> vkc.importing.ImportedObject:
    folder = tmp_path_factory.mktemp("partnet")
    return vkc.importing.import_object(
        write_partnet_object(folder / "45427"), folder / "out", height=0.8
    )


def test_import_finds_handles_and_reports_changes(cabinet: vkc.importing.ImportedObject) -> None:
    drawer, door = (cabinet.proposals.opening(joint)[0] for joint in ("joint_0", "joint_1"))
    assert (drawer.named, door.named) == (True, False)
    assert (drawer.kind, door.kind) == ("bar", "bar")
    assert drawer.thickness == pytest.approx(0.8 * 0.02, rel=0.01)
    names = [proposal.attachment.name for proposal in cabinet.proposals.found]
    assert list(cabinet.object.attachments) == names
    report = cabinet.summary()
    changes = ("joint_1' states no limits", "joint_3", "decoration-6")
    for text in (*changes, "2 joints", "0.80 m", "husky_ur5e"):
        assert text in report, text
    assert cabinet.picture.read_bytes().startswith(b"\x89PNG")


def test_object_rests_on_the_floor_and_has_the_requested_height(
    cabinet: vkc.importing.ImportedObject,
) -> None:
    assert cabinet.file.name == "object_45427.yaml"
    assert cabinet.size[2] == pytest.approx(0.8)
    item = cabinet.object
    at_zero = vkc.PlacedObject("it", item, pin.SE3.Identity(), np.zeros(2))
    boxes = [
        compute_world_box(each.geometry, each.placement) for each in make_world_shapes(at_zero)
    ]
    low, high = np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))
    assert [low[2], high[2]] == pytest.approx([0.0, 0.8], abs=1e-3)
    assert np.allclose((low + high)[:2], 0.0, atol=2e-3)
    assert item.upper[item.coordinates.index("joint_0")] == pytest.approx(0.8 * 0.36)


def test_imported_object_can_be_opened(cabinet: vkc.importing.ImportedObject) -> None:
    assert cabinet.scene is not None
    scene = vkc.load_scene(cabinet.scene)
    (name,) = scene.objects
    plan = vkc.plan(scene, [vkc.Actuate(name, {"joint_0": 0.2})])
    assert plan.success, plan.summary()
    assert plan.trajectory.column(f"{name}.joint_0")[-1] == pytest.approx(0.2, abs=1e-3)


def test_single_link_is_imported_under_its_name(tmp_path: Path) -> None:
    link, name = "+", "object"
    file = write_partnet_object(tmp_path / "in")
    file.write_text(file.read_text().replace('"link_2"', f'"{link}"'))
    imported = vkc.importing.import_object(file, tmp_path / "out", link=link, up="y", most=1)
    assert imported.file.name == f"{name}.yaml"
    assert (imported.file.parent / f"{name}.urdf").is_file()
    assert imported.object.base_link == link
    assert f"# Name of the link: {link}\n" in imported.file.read_text()
    assert set(imported.object.coordinates.names) == {"joint_0", "joint_1"}
    assert imported.size[2] == pytest.approx(1.0)


def test_failed_import_leaves_no_files(tmp_path: Path) -> None:
    (tmp_path / "box.sdf").write_text(SDF)
    out = tmp_path / "made" / "box"
    without_hand = dataclasses.replace(vkc.load_robot("husky_ur5e"), touch_links=())
    with pytest.raises(vkc.InputError, match="touch_links"):
        vkc.importing.import_object(tmp_path / "box.sdf", out, robot=without_hand)
    assert list((tmp_path / "made").iterdir()) == []
    imported = vkc.importing.import_object(tmp_path / "box.sdf", out, most=1)
    assert imported.proposals.opening("hinge")[0].kind == "bar"
    assert imported.size == pytest.approx([0.54, 0.6, 0.8], abs=0.01)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"height": 0.0}, "height"),
        ({"height": 1.0, "scale": 2.0}, "scale"),
        ({"up": "x"}, "up"),
        ({"up": ["z"]}, "up"),
        ({"link": "link_9"}, "link_2"),
        ({"link": 3}, "link"),
        ({"arguments": 3}, "arguments"),
        ({"packages": {"p": 3}}, "packages"),
        ({"folder": "in"}, "already exists"),
        ({"folder": "in", "force": True}, "already exists"),
        ({"most": 0}, "most"),
    ],
)
def test_invalid_arguments_are_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, argument: dict[str, Any], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    file = write_partnet_object(tmp_path / "in")
    with pytest.raises(vkc.InputError, match=message):
        vkc.importing.import_object(file, **{"folder": "out", **argument})
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_other_xml_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "page.xml").write_text("<html/>")
    with pytest.raises(vkc.InputError, match=r"page\.xml.*<html>"):
        read_object(tmp_path / "page.xml")


def test_packages_and_arguments_of_xacro_are_used(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    (tmp_path / "parts").mkdir()
    trimesh.creation.box((0.4, 0.6, 0.8)).export(tmp_path / "parts" / "case.stl")
    file = tmp_path / "box.urdf.xacro"
    file.write_text(
        """<robot name="box" xmlns:xacro="http://www.ros.org/wiki/xacro">
        <xacro:arg name="depth" default="0.3"/><link name="case"><collision><geometry>
          <mesh filename="package://furniture/case.stl"/></geometry></collision></link>
        <link name="front"/><joint name="slide" type="prismatic"><parent link="case"/>
          <child link="front"/><limit lower="0" upper="$(arg depth)"/></joint></robot>"""
    )
    packages = {"furniture": tmp_path / "parts"}
    found = read_object(file, packages=packages, arguments={"depth": "0.25"})
    assert found.joints["front"].limits == (0.0, 0.25)
    assert found.links["case"].collision[0].file == tmp_path / "parts" / "case.stl"


FORMATS = {
    "urdf": """<robot name="door"><link name="frame">{box}</link><link name="leaf">{box}</link>
<joint name="hinge" type="revolute"><parent link="frame"/><child link="leaf"/>
<origin xyz="1 0 0"/><axis xyz="0 0 1"/>
<limit lower="0" upper="1" velocity="1e6"/><dynamics damping="{damping}" friction="{friction}"/>
</joint></robot>""",
    "xml": """<mujoco><worldbody><body name="frame"><geom type="box" size=".2 .3 .4"/>
<body name="leaf" pos="1 0 0"><joint name="hinge" axis="0 0 1" range="0 57" damping="{damping}"
frictionloss="{friction}"/><geom type="box" size=".2 .3 .4"/></body></body></worldbody></mujoco>""",
    "sdf": """<sdf version="1.9"><model name="door"><link name="frame">{sdf_box}</link>
<link name="leaf"><pose>1 0 0 0 0 0</pose>{sdf_box}</link><joint name="hinge" type="revolute">
<parent>frame</parent><child>leaf</child><axis><xyz>0 0 1</xyz><limit><lower>0</lower>
<upper>1</upper></limit><dynamics><damping>{damping}</damping><friction>{friction}</friction>
</dynamics></axis></joint></model></sdf>""",
}
BOX = '<collision><geometry><box size="0.4 0.6 0.8"/></geometry></collision>'
SDF_BOX = """<collision name="c"><geometry><box><size>0.4 0.6 0.8</size></box></geometry>
</collision>"""


def write_door(folder: Path, kind: str, **values: object) -> Path:
    """Write a frame and a leaf beside it as "urdf", "xml" (MJCF) or "sdf"."""
    file = folder / f"door.{kind}"
    given = {"damping": 0, "friction": 0, "box": BOX, "sdf_box": SDF_BOX, **values}
    file.write_text(FORMATS[kind].format(**given))
    return file


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize(("damping", "friction"), [(3e4, 0.5), (2.0, 1e7), (1e12, 1e12)])
def test_resistances_that_hold_a_joint_are_clipped_with_a_note(
    tmp_path: Path, kind: str, damping: float, friction: float
) -> None:
    file = write_door(tmp_path, kind, damping=damping, friction=friction)
    found = vkc.importing.import_object(file, tmp_path / "out")
    resistance = found.object.resistance["hinge"]
    expected = (min(damping, 1e4), min(friction, 1e4))
    assert (resistance.damping, resistance.friction) == pytest.approx(expected)
    notes = [note for note in found.notes if "10000 is used" in note]
    assert len(notes) == (damping > 1e4) + (friction > 1e4)
    assert all("joint 'hinge' states a " in note for note in notes)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", ["damping", "friction"])
@pytest.mark.parametrize(
    ("text", "used", "stated"),
    [("inf", 1e4, "inf"), ("+INF", 1e4, "inf"), ("-inf", 0.0, "-inf"), ("-3", 0.0, "-3")],
)
def test_infinite_and_negative_resistances_are_clipped_with_a_note(
    tmp_path: Path, kind: str, name: str, text: str, used: float, stated: str
) -> None:
    found = vkc.importing.import_object(write_door(tmp_path, kind, **{name: text}), tmp_path / "o")
    resistance = found.object.resistance["hinge"]
    other = "friction" if name == "damping" else "damping"
    assert (getattr(resistance, name), getattr(resistance, other)) == (used, 0.0)
    note = f"joint 'hinge' states a {name} of {stated}: {used:g} is used"
    assert [one for one in found.notes if "is used" in one] == [note]


@pytest.mark.parametrize("kind", FORMATS)
def test_resistances_that_are_no_numbers_are_refused(tmp_path: Path, kind: str) -> None:
    file = write_door(tmp_path, kind, damping="nan")
    with pytest.raises(vkc.InputError, match=r"hinge: dynamics damping: .*got nan") as found:
        vkc.importing.import_object(file, tmp_path / "out")
    assert found.value.file == file


def test_infinite_numbers_other_than_resistances_and_limits_are_none(tmp_path: Path) -> None:
    file = write_door(tmp_path, "sdf")
    dense = '<link name="leaf"><inertial auto="true"><density>inf</density></inertial>'
    file.write_text(file.read_text().replace('<link name="leaf">', dense))
    found = vkc.importing.import_object(file, tmp_path / "out")
    assert found.object.mass == 0.0
    assert any("density: wrong numbers" in note and "got inf" in note for note in found.notes)


@pytest.mark.parametrize("kind", FORMATS)
def test_errors_about_generated_files_name_the_given_file(tmp_path: Path, kind: str) -> None:
    """The generated files are gone when the error is read."""
    near = {"urdf": 'xyz="1 0 0"', "xml": 'pos="1 0 0"', "sdf": "<pose>1 0 0"}[kind]
    file = write_door(tmp_path, kind)
    file.write_text(file.read_text().replace(near, near.replace("1", "3", 1)))
    # The hinge is then 13.5 km from the middle of the object.
    with pytest.raises(vkc.InputError, match=r"at most 10000, got 13500") as caught:
        vkc.importing.import_object(file, tmp_path / "out", scale=9000.0)
    assert (caught.value.file, caught.value.line) == (file, None)
    assert str(tmp_path / "out") not in str(caught.value)
