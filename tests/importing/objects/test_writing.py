from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml
from helpers.descriptions import make_description, make_joint, make_mesh_part, make_part

import vkc_pin as vkc
from vkc_pin.importing.objects.description import Link
from vkc_pin.importing.objects.writing import write_description, write_urdf
from vkc_pin.world.files.urdf import read_urdf


def test_written_object_is_read_back(tmp_path: Path) -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.4, 1.2), np.array([0.1, 0.2, 0.3]))
    red = (1.0, 0.0, 0.0, 1.0)
    parts = (
        make_part("cylinder", (0.01, 0.3), placement, "handle & bar", colour=red),
        make_part("capsule", (0.02, 0.3), placement),
        make_part(
            "mesh", (0.5, 0.5, 0.5), placement, triangles=trimesh.creation.icosphere(), colour=red
        ),
    )
    axis = np.array([0.6, 0.0, 0.8])
    resistance = {"damping": 0.5, "friction": 0.25, "stiffness": 4.0, "springref": -1.1}
    joint = make_joint(
        "a", "b", at=placement, axis=axis, limits=(-0.2, 1.1), velocity=0.7, **resistance
    )
    inertia = placement.act(pin.Inertia(2.5, np.zeros(3), np.diag([0.1, 0.2, 0.25])))
    links = [Link("a", parts[:1], parts[:1]), Link("b", parts, parts, inertia)]
    write_urdf(make_description(links, [joint]), tmp_path / "thing.urdf")
    about = ["One.", "Two."]
    write_description(tmp_path / "thing.yaml", "thing.urdf", (), about=about, joints=[joint])
    assert (tmp_path / "thing.yaml").read_text().startswith("# One.\n# Two.\nurdf: thing.urdf\n")
    assert yaml.safe_load((tmp_path / "thing.yaml").read_text()) == {
        "urdf": "thing.urdf",
        "joints": {"to_b": {"stiffness": 4.0, "springref": -1.1}},
        "attachments": [],
    }
    item = vkc.load_object(tmp_path / "thing.yaml")
    assert (item.lower[0], item.upper[0], item.velocity[0]) == (-0.2, 1.1, 0.7)
    assert {name: getattr(item.resistance["to_b"], name) for name in resistance} == resistance
    assert item.model.inertias[1].isApprox(inertia, 1e-6)
    moved = placement * pin.SE3(pin.exp3(axis * 0.5), np.zeros(3))
    assert np.allclose(item.link_placement("b", [0.5]).homogeneous, moved.homogeneous, atol=1e-8)
    assert [shape.name for shape in item.collision.geometryObjects] == [
        "a_0",
        *(f"b_{k}" for k in range(5)),
    ]
    capsule = [shape.geometry for shape in item.collision.geometryObjects[2:5]]
    assert [type(shape).__name__ for shape in capsule] == ["Cylinder", "Sphere", "Sphere"]
    assert capsule[0].halfLength == 0.15
    bar = item.collision.geometryObjects[1]
    assert np.allclose(bar.placement.homogeneous, placement.homogeneous, atol=1e-8)
    assert (bar.geometry.radius, bar.geometry.halfLength) == (0.01, 0.15)
    assert 'name="handle &amp; bar"' in (tmp_path / "thing.urdf").read_text()
    ball = item.collision.geometryObjects[5]
    middle = ball.placement.act(np.asarray(ball.geometry.points()).mean(axis=0))
    assert np.allclose(middle, placement.translation, atol=1e-3)
    assert np.allclose(item.visual.geometryObjects[1].meshColor, red)


@pytest.mark.parametrize(
    ("small", "large"), [("é", "ü"), ("a_b", "a b"), ("Leaf", "leaf"), ("x" * 300, "x" * 301)]
)
def test_links_with_similar_names_keep_their_own_meshes(
    small: str, large: str, tmp_path: Path
) -> None:
    sizes = {small: 0.1, large: 0.2}
    parts = {
        name: (make_mesh_part(trimesh.creation.box((size,) * 3)),) for name, size in sizes.items()
    }
    links = [Link("case"), *(Link(name, own, own) for name, own in parts.items())]
    joints = [make_joint("case", name, "prismatic") for name in parts]
    write_urdf(make_description(links, joints), tmp_path / "thing.urdf")
    for kind in ("collision", "visual"):
        found = read_urdf(tmp_path / "thing.urdf").read_shapes(kind)
        volumes = {shape.link: shape.make_mesh().volume for shape in found}
        assert volumes == pytest.approx({name: size**3 for name, size in sizes.items()}), kind
        names = {shape.file.name for shape in found if shape.file is not None}
        assert len(names) == 2
        assert max(map(len, names)) < 80
