from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from vkc_pin.importing.homes.obstacles import write_obstacles
from vkc_pin.importing.homes.splitting import Home
from vkc_pin.importing.objects.description import Link, Part
from vkc_pin.scene.scene import Scene


def _part(name: str, kind: str, size: tuple[float, ...], at: pin.SE3, **more: object) -> Part:
    return Part(name=name, placement=at, kind=kind, size=size, **more)  # type: ignore[arg-type]


def test_simple_shapes_stay_what_they_are_and_others_become_urdf(tmp_path: Path) -> None:
    turned = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.1), np.array([1.0, 2.0, 0.7]))
    red = (1.0, 0.0, 0.0, 1.0)
    seen = _part("looks", "box", (2.0, 0.1, 2.0), turned, colour=red)
    wedge = trimesh.convex.convex_hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    building = Link("walls", (seen,), (_part("a wall", "box", (2.0, 0.1, 2.0), turned), _part("", "capsule", (0.1, 1.0), turned)))
    mesh = Link("wedge", (), (_part("", "mesh", (1.0, 1.0, 1.0), turned, triangles=wedge),))
    ball = Link("a wall", (), (_part("", "sphere", (0.2,), turned),))
    home = Home((building,), (mesh, ball), (), (), 4, ())
    taken = {"ball", "wedge"}
    entries, notes = write_obstacles(home, tmp_path / "home.urdf", tmp_path, taken, {})
    assert [entry["name"] for entry in entries] == ["a_wall", "walls_1", "wedge_2", "a_wall_2"]
    assert [entry["type"] for entry in entries] == ["box", "capsule", "urdf", "sphere"]
    assert entries[0]["colour"] == list(red)
    assert taken == {"ball", "wedge", "a_wall", "walls_1", "wedge_2", "a_wall_2"}
    assert not notes
    scene = Scene.from_document(
        {"robot": "husky_ur5e", "start": {"base": [-3, -3, 0]}, "obstacles": entries, "floor": False}, tmp_path
    )
    parts = [*building.collision, *mesh.collision, *ball.collision]
    assert scene.obstacle_labels == tuple(entry["name"] for entry in entries)
    for part, shape in zip(parts, scene.obstacles, strict=True):
        shape.geometry.computeLocalAABB()
        box, own = shape.geometry.aabb_local, dataclasses.replace(part, placement=shape.placement.inverse() * part.placement)
        assert np.vstack([box.min_, box.max_]) == pytest.approx(own.mesh().bounds, abs=2e-3)  # balls of triangles are smaller
        if part.kind != "mesh":
            assert shape.placement.isApprox(part.placement, 1e-5)
