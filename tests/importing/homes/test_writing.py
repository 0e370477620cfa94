from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.descriptions import make_description, make_mesh_part, make_part

import vkc_pin as vkc
from vkc_pin.importing.description import Link
from vkc_pin.importing.homes.splitting import Home, HomeObject
from vkc_pin.importing.homes.writing import (
    ImportedHomeObject,
    measure_parts,
    write_object,
    write_obstacles,
)
from vkc_pin.importing.progress import ImportProgress
from vkc_pin.world.models.articulated_object import ArticulatedObject

SETTINGS = {"stem": "can", "most": 2, "dist_safe": 0.02, "grasp_clearance": 0.005}


def write_can(folder: Path, radius: float) -> tuple[ImportedHomeObject, ArticulatedObject]:
    """Write a free cylinder; return it, and the object read from the file."""
    part = make_part("cylinder", (radius, 0.12), (0.0, 0.0, 0.06))
    description = make_description([Link("can", (part,), (part,))])
    can = HomeObject("can", description, (1.0, 2.0, 0.7), free=True)
    written = write_object(can, vkc.load_robot("husky_ur5e"), folder, {}, **SETTINGS)
    return written, vkc.load_object(folder / "objects" / "can" / "can.yaml")


def test_free_object_has_no_joint(tmp_path: Path) -> None:
    written, item = write_can(tmp_path, 0.03)
    assert item.free
    assert item.coordinates.size == 0
    assert item.base_link == "can"
    names = [proposal.attachment.name for proposal in written.proposals.found]
    assert list(item.attachments) == names != []
    for attachment in item.attachments.values():
        assert attachment.placement.translation[2] > 0.0
        assert attachment.firm
    assert written.entry == {
        "name": "can",
        "type": "objects/can/can.yaml",
        "position": [1.0, 2.0, 0.7],
    }
    assert written.summary().startswith("can: carried by can_")


def test_thick_object_is_reported(tmp_path: Path) -> None:
    written, item = write_can(tmp_path, 0.3)
    assert not item.attachments
    assert "carried by no hand: nothing of it fits" in written.summary()


def test_primitive_shapes_are_kept_and_meshes_become_urdf(tmp_path: Path) -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.1), np.array([1.0, 2.0, 0.7]))
    red = (1.0, 0.0, 0.0, 1.0)
    visual = make_part("box", (2.0, 0.1, 2.0), placement, colour=red)
    wedge = trimesh.convex.convex_hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    building = Link(
        "walls",
        (visual,),
        (
            make_part("box", (2.0, 0.1, 2.0), placement, "a wall"),
            make_part("capsule", (0.1, 1.0), placement),
        ),
    )
    mesh = Link("wedge", (), (make_mesh_part(wedge, placement),))
    ball = Link("a wall", (), (make_part("sphere", (0.2,), placement),))
    home = Home((building,), (mesh, ball), (), (), 4, ())
    taken = {"ball", "wedge"}
    entries, links, notes = write_obstacles(
        home, tmp_path / "home.urdf", tmp_path, taken, {}, ImportProgress(measure_parts(home))
    )
    assert [entry["name"] for entry in entries] == ["a_wall", "walls_1", "wedge_2", "a_wall_2"]
    assert [entry["type"] for entry in entries] == ["box", "capsule", "urdf", "sphere"]
    assert entries[0]["colour"] == list(red)
    assert taken == {"ball", "wedge", "a_wall", "walls_1", "wedge_2", "a_wall_2"}
    assert list(links.values()) == ["walls", "walls", "wedge", "a wall"]
    assert list(links) == [entry["name"] for entry in entries]
    assert not notes
    document = {"robot": "husky_ur5e", "start": {"base": [-3, -3, 0]}, "floor": False}
    scene = vkc.Scene.from_document({**document, "obstacles": entries}, tmp_path)
    parts = [*building.collision, *mesh.collision, *ball.collision]
    assert scene.obstacle_labels == tuple(entry["name"] for entry in entries)
    for part, shape in zip(parts, scene.obstacles, strict=True):
        shape.geometry.computeLocalAABB()
        box, place = shape.geometry.aabb_local, shape.placement.inverse() * part.placement
        bounds = dataclasses.replace(part, placement=place).make_mesh().bounds
        # Triangulated spheres are smaller.
        assert np.vstack([box.min_, box.max_]) == pytest.approx(bounds, abs=2e-3)
        if part.kind != "mesh":
            assert shape.placement.isApprox(part.placement, 1e-5)
