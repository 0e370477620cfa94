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
from vkc_pin.world.scene.scene import Scene


def make_part(name: str, kind: str, size: tuple[float, ...], at: pin.SE3, **more: object) -> Part:
    return Part(name=name, placement=at, kind=kind, size=size, **more)  # type: ignore[arg-type]


def test_primitive_shapes_stay_and_others_become_urdf(tmp_path: Path) -> None:
    turned = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.1), np.array([1.0, 2.0, 0.7]))
    red = (1.0, 0.0, 0.0, 1.0)
    seen = make_part("looks", "box", (2.0, 0.1, 2.0), turned, colour=red)
    wedge = trimesh.convex.convex_hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    building = Link(
        "walls",
        (seen,),
        (
            make_part("a wall", "box", (2.0, 0.1, 2.0), turned),
            make_part("", "capsule", (0.1, 1.0), turned),
        ),
    )
    mesh = Link("wedge", (), (make_part("", "mesh", (1.0, 1.0, 1.0), turned, triangles=wedge),))
    ball = Link("a wall", (), (make_part("", "sphere", (0.2,), turned),))
    home = Home((building,), (mesh, ball), (), (), 4, ())
    taken = {"ball", "wedge"}
    entries, notes = write_obstacles(home, tmp_path / "home.urdf", tmp_path, taken, {})
    assert [entry["name"] for entry in entries] == ["a_wall", "walls_1", "wedge_2", "a_wall_2"]
    assert [entry["type"] for entry in entries] == ["box", "capsule", "urdf", "sphere"]
    assert entries[0]["colour"] == list(red)
    assert taken == {"ball", "wedge", "a_wall", "walls_1", "wedge_2", "a_wall_2"}
    assert not notes
    scene = Scene.from_document(
        {
            "robot": "husky_ur5e",
            "start": {"base": [-3, -3, 0]},
            "obstacles": entries,
            "floor": False,
        },
        tmp_path,
    )
    parts = [*building.collision, *mesh.collision, *ball.collision]
    assert scene.obstacle_labels == tuple(entry["name"] for entry in entries)
    for part, shape in zip(parts, scene.obstacles, strict=True):
        shape.geometry.computeLocalAABB()
        box, own = (
            shape.geometry.aabb_local,
            dataclasses.replace(part, placement=shape.placement.inverse() * part.placement),
        )
        assert np.vstack([box.min_, box.max_]) == pytest.approx(
            own.make_mesh().bounds, abs=2e-3
        )  # balls of triangles are smaller
        if part.kind != "mesh":
            assert shape.placement.isApprox(part.placement, 1e-5)


@pytest.mark.parametrize(
    ("first", "second", "files"),
    [
        ("wardrobe", "stool", ("wardrobe", "stool")),
        ("шкаф", "стул", ("part", "part_2")),
        ("衣柜", "凳子", ("part", "part_2")),
        ("a+b", "a b", ("a_b_2", "a_b")),
        ("Chair", "chair", ("Chair", "chair_2")),
        ("con", "x" * 300, ("con_", "x" * 64)),
    ],
)
def test_links_with_similar_names_keep_their_own_shapes(
    first: str, second: str, files: tuple[str, str], tmp_path: Path
) -> None:
    def pair(name: str, size: tuple[float, float, float], x: float) -> Link:
        boxes = (
            make_part("", "box", size, pin.SE3(np.eye(3), np.array([x, y, 1.0])))
            for y in (0.0, 0.1)
        )
        return Link(name, (), tuple(boxes))

    links = [pair(first, (0.4, 3.4, 1.9), -1.0), pair(second, (0.2, 0.2, 0.3), 3.0)]
    home = Home((), tuple(links), (), (), 4, ())
    entries, _ = write_obstacles(home, tmp_path / "home.urdf", tmp_path, set(), {})
    assert [entry["name"] for entry in entries] == [first, second.replace(" ", "_")]
    assert [entry["file"] for entry in entries] == [
        f"obstacles/{name}/{name}.urdf" for name in files
    ]
    document = {
        "robot": "husky_ur5e",
        "start": {"base": [-3, -3, 0]},
        "obstacles": entries,
        "floor": False,
    }
    scene = Scene.from_document(document, tmp_path)
    for shape, part in zip(
        scene.obstacles, [part for link in links for part in link.collision], strict=True
    ):
        assert 2.0 * shape.geometry.halfSide == pytest.approx(part.size)
        assert shape.placement.isApprox(part.placement, 1e-5)
