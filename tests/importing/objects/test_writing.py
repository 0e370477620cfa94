from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml
from helpers.descriptions import make_description, make_joint, make_mesh_part, make_part

from vkc_pin.importing.description import Link, Part
from vkc_pin.importing.objects.object_reading import read_object
from vkc_pin.importing.objects.writing import write_description, write_urdf
from vkc_pin.world.files.urdf import read_urdf


def compute_bounds(parts: tuple[Part, ...]) -> np.ndarray:
    return trimesh.util.concatenate([part.make_mesh() for part in parts]).bounds


def test_written_object_is_read_back(tmp_path: Path) -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.4, 1.2), np.array([0.1, 0.2, 0.3]))
    red, cone = (1.0, 0.0, 0.0, 1.0), trimesh.creation.cone(0.3, 0.5)
    parts = (
        make_part("cylinder", (0.01, 0.3), placement, "handle & bar", colour=red),
        make_part("capsule", (0.02, 0.3), placement),
        make_part("mesh", (0.5, 0.5, 0.5), placement, triangles=cone, colour=red),
    )
    spring = {"stiffness": 4.0, "springref": -1.1}
    values = {"limits": (-0.2, 1.1), "velocity": 0.7, "damping": 0.5, "friction": 0.25}
    axis = np.array([0.6, 0.0, 0.8])
    joint = make_joint("a", "b", at=placement, axis=axis, **values, **spring)  # type: ignore[arg-type]
    inertia = placement.act(pin.Inertia(2.5, np.zeros(3), np.diag([0.1, 0.2, 0.25])))
    links = [Link("a", parts[:1], parts[:1]), Link("b", parts, parts, inertia)]
    urdf, yaml_file = tmp_path / "thing.urdf", tmp_path / "thing.yaml"
    write_urdf(make_description(links, [joint]), urdf)
    found = read_object(urdf)
    assert found.links["b"].inertia.isApprox(inertia, 1e-6)
    assert [part.name for part in found.links["a"].collision] == ["handle & bar"]
    for link in links:
        for kind in ("visual", "collision"):
            bounds = [
                compute_bounds(getattr(each, kind)) for each in (link, found.links[link.name])
            ]
            assert np.allclose(*bounds, atol=1e-3)
    # The capsule becomes a cylinder and two spheres.
    kinds = [part.kind for part in found.links["b"].collision]
    assert kinds == ["cylinder", "cylinder", "sphere", "sphere", "mesh"]
    assert [part.colour for part in found.links["b"].visual].count(red) == 2
    read = found.joints["b"]
    assert np.allclose(read.placement.homogeneous, placement.homogeneous, atol=1e-8)
    assert np.allclose(read.axis, axis)
    assert {name: getattr(read, name) for name in values} == values
    write_description(yaml_file, urdf.name, (), about=["One.", "Two."], joints=[joint])
    assert yaml_file.read_text().startswith("# One.\n# Two.\nurdf: thing.urdf\n")
    document = {"urdf": urdf.name, "joints": {joint.name: spring}, "attachments": []}
    assert yaml.safe_load(yaml_file.read_text()) == document


def test_links_with_similar_names_keep_their_own_meshes(tmp_path: Path) -> None:
    names = ("é", "ü", "a_b", "a b", "Leaf", "leaf", "x" * 300, "x" * 301)
    sizes = {name: 0.1 + 0.01 * k for k, name in enumerate(names)}
    parts = {
        name: (make_mesh_part(trimesh.creation.box((size,) * 3)),) for name, size in sizes.items()
    }
    links = [Link("case"), *(Link(name, own, own) for name, own in parts.items())]
    joints = [make_joint("case", name, "prismatic") for name in parts]
    write_urdf(make_description(links, joints), tmp_path / "thing.urdf")
    for kind in ("collision", "visual"):
        shapes = read_urdf(tmp_path / "thing.urdf").read_shapes(kind)
        volumes = {shape.link: shape.make_mesh().volume for shape in shapes}
        assert volumes == pytest.approx({name: size**3 for name, size in sizes.items()}), kind
        files = {shape.file.name for shape in shapes if shape.file is not None}
        assert len(files) == len(names)
        assert max(map(len, files)) < 80
