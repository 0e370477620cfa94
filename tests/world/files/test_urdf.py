"""Tests URDFs against formulas and Pinocchio's parser."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.expected_errors import expect_error
from helpers.meshes import write_wedge

from vkc_pin.world.files.urdf import load_urdf, read_urdf


def write_urdf(folder: Path, shapes: str, *, name: str = "thing.urdf") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(f'<robot name="r"><link name="a">{shapes}</link></robot>')
    return folder / name


def format_collision(shape: str, origin: str = "") -> str:
    return f"<collision>{origin}<geometry>{shape}</geometry></collision>"


@pytest.mark.parametrize("kind", ["visual", "collision"])
def test_too_many_shapes_raise(tmp_path: Path, kind: str) -> None:
    """Pinocchio needs minutes for thousands of shapes."""
    one = f"<{kind}><geometry><sphere radius='0.2'/></geometry></{kind}>"
    solid = format_collision('<sphere radius="0.2"/>') if kind == "visual" else ""
    with expect_error(f"too many <{kind}> elements.*expected at most 1000.*got 7000"):
        load_urdf(write_urdf(tmp_path, solid + one * 7000))
    _, collision, visual = load_urdf(write_urdf(tmp_path, solid + one * 1000))
    assert len((visual if kind == "visual" else collision).geometryObjects) == 1000


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        ('<box size="0.2 0.3 0.4"/>', 0.024),
        ('<sphere radius="0.2"/>', 4 / 3 * np.pi * 0.008),
        ('<cylinder radius="0.2" length="0.5"/>', np.pi * 0.04 * 0.5),
        ('<capsule radius="0.2" length="0.5"/>', np.pi * 0.04 * 0.5 + 4 / 3 * np.pi * 0.008),
        ('<mesh filename="wedge.obj" scale="2 1 3"/>', 1.0),
    ],
)
def test_triangulated_shapes_enclose_the_solid(tmp_path: Path, shape: str, volume: float) -> None:
    write_wedge(tmp_path / "wedge.obj")
    origin = '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>'
    file = write_urdf(tmp_path, format_collision(shape, origin))
    (found,) = read_urdf(file).read_shapes("collision")
    mesh, solid = found.make_mesh(), found.make_solid()
    assert volume * (1 - 1e-3) <= mesh.volume <= 1.02 * volume
    solid.computeLocalAABB()
    box = solid.aabb_local
    local = (mesh.vertices - found.placement.translation) @ found.placement.rotation
    np.testing.assert_allclose(
        [local.min(axis=0), local.max(axis=0)], [box.min_, box.max_], atol=5e-3
    )
    assert (found.link, found.name, found.kind) == ("a", "a_0", shape[1:].partition(" ")[0])


def test_collision_meshes_become_convex_hulls(tmp_path: Path) -> None:
    ring = trimesh.creation.annulus(0.3, 0.5, 1.0)
    ring.export(tmp_path / "ring.stl")
    file = write_urdf(tmp_path, format_collision('<mesh filename="ring.stl"/>'))
    (found,) = read_urdf(file).read_shapes("collision")
    assert found.make_solid().computeVolume() == pytest.approx(ring.convex_hull.volume, rel=1e-3)
    assert found.make_mesh().volume == pytest.approx(ring.volume, rel=1e-3)
    assert ring.volume < 0.9 * ring.convex_hull.volume


def test_colours_are_shared_by_name(tmp_path: Path) -> None:
    ball = '<geometry><sphere radius="1"/></geometry>'
    own = f'<visual>{ball}<material name="red"><color rgba="1 0 0 1"/></material></visual>'
    named, plain = f'<visual>{ball}<material name="red"/></visual>', f"<visual>{ball}</visual>"
    shapes = read_urdf(
        write_urdf(tmp_path, named + own + plain + format_collision('<sphere radius="1"/>'))
    ).read_shapes("visual")
    assert [shape.colour for shape in shapes] == [(1.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 1.0), None]
    assert [shape.name for shape in shapes] == ["a_0", "a_1", "a_2"]


def test_mesh_addresses_are_resolved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Covers given packages, folders above the file, its own folder, and absolute paths."""
    pack = tmp_path / "robots" / "pack"
    packaged = tmp_path / "elsewhere" / "a.stl"
    above = pack / "meshes" / "b.stl"
    beside = pack / "urdf" / "c.stl"
    files = (packaged, above, beside)
    models = [tmp_path / "robots" / folder / "d.stl" for folder in ("models/bin", "gazebo/tap")]
    names = ("a b.stl", "50%25.stl", "ü#1.stl", "m:n.stl", "%41.stl")
    for file in (*files, *models, *(pack / "urdf" / name for name in names)):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    path = write_urdf(pack / "urdf", format_collision('<sphere radius="1"/>'))
    robot = read_urdf(path, {"other": tmp_path / "elsewhere"})
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", f"/nowhere:{tmp_path}/robots/gazebo")
    for address, expected in (
        ("package://other/a.stl", packaged),
        ("package://pack/meshes/b.stl", above),
        ("c.stl", beside),
        (f"file://{beside}", beside),
        (str(beside), beside),
        ("model://bin/d.stl", models[0]),
        ("model://tap/d.stl", models[1]),
    ):
        assert robot.resolve(address) == expected
    for file in (pack / "urdf" / name for name in names):
        name, quoted = file.name, quote(str(file))
        for address in (
            name,
            quote(name),
            f"file://{quoted}",
            f"file://localhost{quoted}",
            f"file:{quoted}",
            f"FILE:///{quoted}",
            f"file://{quote(name)}",
            f"package://pack/urdf/{quote(name)}",
            f"package://pack//urdf/{name}",
            f"package:///pack/urdf/{name}",
            f"model://pack/urdf/{quote(name)}",
            f" {name} ",
        ):
            assert robot.resolve(address).samefile(file), address
    for address, message in (
        ("https://fuel.gazebosim.org/1.0/a.stl", r"not supported.*got https"),
        ("c.std", r"such as c\.stl"),
        ("package://other/b.stl", "no such mesh"),
        ("package://nowhere/a.stl", "no such mesh"),
        ("a.stl", "no such mesh"),
    ):
        with expect_error(message, file=path, field=address):
            robot.resolve(address)


def test_trees_equal_those_of_pinocchio(tmp_path: Path) -> None:
    limit = '<limit lower="-1" upper="1" velocity="2" effort="1"/>'
    text = f"""<robot name="r"><link name="a"/><link name="b"><collision>
    <origin xyz="0.1 0 0" rpy="0 0 1"/><geometry><box size="1 2 3"/></geometry></collision></link>
    <link name="c"><collision><geometry><sphere radius="0.5"/></geometry></collision></link>
    <joint name="turn" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="1 2 3" rpy="1 0.5 0"/><axis xyz="0 1 0"/>{limit}</joint>
    <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/>
    <origin xyz="0 0 1"/><axis xyz="1 0 0"/>{limit}</joint></robot>"""
    (tmp_path / "t.urdf").write_text(text)
    (own, collision, _), model = load_urdf(tmp_path / "t.urdf"), pin.buildModelFromXML(text)
    assert own == model
    theirs = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    for ours, other in zip(collision.geometryObjects, theirs.geometryObjects, strict=True):
        for field in ("name", "parentJoint", "parentFrame", "geometry"):
            assert getattr(ours, field) == getattr(other, field)
        assert ours.placement.isApprox(other.placement, 1e-14)
    assert read_urdf(tmp_path / "t.urdf").links == ("a", "b", "c")
