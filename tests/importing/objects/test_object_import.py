from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from helpers.partnet import SDF, write_partnet_object

import vkc_pin as vkc
from vkc_pin.importing.objects.object_import import read_description


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
    item, data = cabinet.object, cabinet.object.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(np.zeros(2)))
    corners = [
        (data.oMi[shape.parentJoint] * shape.placement).act(np.asarray(point))
        for shape in item.collision.geometryObjects
        for point in np.asarray(shape.geometry.points())
    ]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    assert low[2] == pytest.approx(0.0, abs=1e-3)
    assert high[2] == pytest.approx(0.8, abs=1e-3)
    assert np.allclose((low + high)[:2], 0.0, atol=2e-3)
    assert item.upper[item.coordinates.index("joint_0")] == pytest.approx(0.8 * 0.36)


def test_imported_object_can_be_opened(
    cabinet: vkc.importing.ImportedObject, tmp_path: Path
) -> None:
    best = cabinet.proposals.opening("joint_0")[0].attachment
    tool = cabinet.object.link_placement(best.link, np.zeros(2)) * best.placement
    back = -tool.rotation[:2, 2]
    start = [*(tool.translation[:2] + 1.5 * back).tolist(), float(np.arctan2(-back[1], -back[0]))]
    scene = {
        "name": "alone",
        "robot": {"name": "husky_ur5e", "base": "omni"},
        "start": {"base": start, "arm": "home"},
        "arena": {"x": [-4, 4], "y": [-4, 4]},
        "floor": True,
        "objects": [{"name": "it", "type": str(cabinet.file), "position": [0, 0, 0]}],
    }
    (tmp_path / "alone.yaml").write_text(yaml.safe_dump(scene))
    plan = vkc.plan(
        vkc.load_scene(tmp_path / "alone.yaml"), [vkc.Actuate("it", {"joint_0": 0.2}, best.name)]
    )
    assert plan.success, plan.summary()
    assert plan.trajectory.column("it.joint_0")[-1] == pytest.approx(0.2, abs=1e-3)


@pytest.mark.parametrize(("link", "name"), [("+", "object")])
def test_single_link_is_imported_under_its_name(link: str, name: str, tmp_path: Path) -> None:
    file = write_partnet_object(tmp_path / "in")
    file.write_text(file.read_text().replace('"link_2"', f'"{link}"'))
    imported = vkc.importing.import_object(file, tmp_path / "out", link=link, up="y", most=1)
    assert imported.file.name == f"{name}.yaml"
    assert (imported.file.parent / f"{name}.urdf").is_file()
    assert imported.object.base_link == link
    assert (f"# Name of the link: {link}\n" in imported.file.read_text()) == (link != name)
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


def test_invalid_objects_and_arguments_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "page.xml").write_text("<html/>")
    with pytest.raises(vkc.InputError, match=r"page\.xml.*<html>"):
        read_description(tmp_path / "page.xml")
    file = write_partnet_object(tmp_path / "in")
    for argument, message in (
        ({"height": 0.0}, "height"),
        ({"height": 1.0, "scale": 2.0}, "scale"),
        ({"up": "x"}, "up"),
        ({"up": ["z"]}, "up"),
        ({"link": "link_9"}, "link_2"),
        ({"link": ""}, "link_2"),
        ({"link": 3}, "link"),
        ({"link": ["link_2"]}, "link"),
        ({"arguments": 3}, "arguments"),
        ({"packages": {"p": 3}}, "packages"),
        ({"folder": tmp_path / "in"}, "already exists"),
        ({"folder": tmp_path / "in", "force": True}, "already exists"),
        ({"most": 0}, "most"),
    ):
        with pytest.raises(vkc.InputError, match=message):
            vkc.importing.import_object(file, **{"folder": tmp_path / "out", **argument})  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
