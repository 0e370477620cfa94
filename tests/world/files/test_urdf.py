"""Tests URDFs against formulas and Pinocchio's parser."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.expected_errors import expect_error

from vkc_pin.world.files.urdf import load_urdf, read_urdf

WEDGE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def write_urdf(folder: Path, shapes: str, *, name: str = "thing.urdf") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(f'<robot name="r"><link name="a">{shapes}</link></robot>')
    return folder / name


def format_collision(shape: str, origin: str = "") -> str:
    return f"<collision>{origin}<geometry>{shape}</geometry></collision>"


@pytest.mark.parametrize("kind", ["visual", "collision"])
def test_too_many_shapes_raise(tmp_path: Path, kind: str) -> None:
    """Pinocchio needs minutes for thousands of shapes."""
    shape = format_collision('<sphere radius="0.2"/>')
    many = shape.replace("collision", kind) * 7000
    with expect_error(f"too many <{kind}> elements.*expected at most 1000.*got 7000"):
        load_urdf(write_urdf(tmp_path, shape + many if kind == "visual" else many))
    enough = shape.replace("collision", kind) * 1000
    _, collision, visual = load_urdf(
        write_urdf(tmp_path, shape + enough if kind == "visual" else enough)
    )
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
    (tmp_path / "wedge.obj").write_text(WEDGE)
    (found,) = read_urdf(
        write_urdf(tmp_path, format_collision(shape, '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>'))
    ).read_shapes("collision")
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
    (found,) = read_urdf(
        write_urdf(tmp_path, format_collision('<mesh filename="ring.stl"/>'))
    ).read_shapes("collision")
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
    for folder in ("elsewhere", "robots/pack/meshes", "robots/pack/urdf"):
        (tmp_path / folder).mkdir(parents=True)
    packaged, above, beside = (
        tmp_path / "elsewhere" / "a.stl",
        tmp_path / "robots" / "pack" / "meshes" / "b.stl",
        tmp_path / "robots" / "pack" / "urdf" / "c.stl",
    )
    for file in (packaged, above, beside):
        file.write_text("")
    path = write_urdf(
        tmp_path / "robots" / "pack" / "urdf", format_collision('<sphere radius="1"/>')
    )
    robot = read_urdf(path, {"other": tmp_path / "elsewhere"})
    assert robot.resolve("package://other/a.stl") == packaged
    assert robot.resolve("package://pack/meshes/b.stl") == above
    assert (
        robot.resolve("c.stl")
        == robot.resolve(f"file://{beside}")
        == robot.resolve(str(beside))
        == beside
    )
    for name in ("a b.stl", "50%25.stl", "ü#1.stl", "m:n.stl", "%41.stl"):
        file = path.parent / name
        file.write_text("")
        for address in (
            name,
            quote(name),
            f"file://{quote(str(file))}",
            f"file://localhost{quote(str(file))}",
            f"file:{quote(str(file))}",
            f"FILE:///{quote(str(file))}",
            f"file://{quote(name)}",
            f"package://pack/urdf/{quote(name)}",
            f"package://pack//urdf/{name}",
            f"package:///pack/urdf/{name}",
            f"model://pack/urdf/{quote(name)}",
            f" {name} ",
        ):
            assert robot.resolve(address).samefile(file), address
    for folder in ("models/bin", "gazebo/tap"):
        (tmp_path / "robots" / folder).mkdir(parents=True)
        (tmp_path / "robots" / folder / "d.stl").write_text("")
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", f"/nowhere:{tmp_path}/robots/gazebo")
    for name in ("bin", "tap"):
        assert robot.resolve(f"model://{name}/d.stl").parent.name == name
    with expect_error(r"not supported.*got https"):
        robot.resolve("https://fuel.gazebosim.org/1.0/a.stl")
    with expect_error(r"such as c\.stl"):
        robot.resolve("c.std")
    for address in ("package://other/b.stl", "package://nowhere/a.stl", "a.stl"):
        with expect_error("no such mesh", file=path, field=address):
            robot.resolve(address)


def test_trees_equal_those_of_pinocchio(tmp_path: Path) -> None:
    text = """<robot name="r"><link name="a"/><link name="b"><collision>
    <origin xyz="0.1 0 0" rpy="0 0 1"/><geometry><box size="1 2 3"/></geometry></collision></link>
    <link name="c"><collision><geometry><sphere radius="0.5"/></geometry></collision></link>
    <joint name="turn" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="1 2 3" rpy="1 0.5 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" velocity="2" effort="1"/></joint>
    <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/>
    <origin xyz="0 0 1"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" velocity="1" effort="1"/></joint></robot>"""
    (tmp_path / "t.urdf").write_text(text)
    (own, collision, _), model = load_urdf(tmp_path / "t.urdf"), pin.buildModelFromXML(text)
    assert own == model
    theirs = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    for ours, other in zip(collision.geometryObjects, theirs.geometryObjects, strict=True):
        assert (ours.name, ours.parentJoint, ours.parentFrame) == (
            other.name,
            other.parentJoint,
            other.parentFrame,
        )
        assert ours.placement.isApprox(other.placement, 1e-14)
        assert ours.geometry == other.geometry
    assert read_urdf(tmp_path / "t.urdf").links == ("a", "b", "c")
