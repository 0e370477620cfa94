from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh

import vkc_pin as vkc
from vkc_pin.importing.homes.splitting import Home, HomeObject
from vkc_pin.importing.homes.writing import ImportProgress, write_object, write_obstacles
from vkc_pin.importing.objects.description import Description, Link, Part
from vkc_pin.world.scene.scene import Scene

SETTINGS = {"stem": "can", "most": 2, "dist_safe": 0.02, "grasp_clearance": 0.005}


def _make_can(radius: float) -> HomeObject:
    part = Part(
        name="",
        placement=pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.06])),
        kind="cylinder",
        size=(radius, 0.12),
    )
    return HomeObject(
        "can",
        Description(Path("home.urdf"), {"can": Link("can", (part,), (part,))}, {}),
        (1.0, 2.0, 0.7),
        free=True,
    )


def test_free_object_has_no_joint(tmp_path: Path) -> None:
    written = write_object(_make_can(0.03), vkc.load_robot("husky_ur5e"), tmp_path, {}, **SETTINGS)
    item = vkc.load_object(tmp_path / "objects" / "can" / "can.yaml")
    assert item.free
    assert item.coordinates.size == 0
    assert item.base_link == "can"
    assert (
        list(item.attachments)
        == [proposal.attachment.name for proposal in written.proposals.found]
        != []
    )
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
    written = write_object(_make_can(0.3), vkc.load_robot("husky_ur5e"), tmp_path, {}, **SETTINGS)
    assert not vkc.load_object(tmp_path / "objects" / "can" / "can.yaml").attachments
    assert "carried by no hand: nothing of it fits" in written.summary()


def make_part(name: str, kind: str, size: tuple[float, ...], at: pin.SE3, **more: object) -> Part:
    return Part(name=name, placement=at, kind=kind, size=size, **more)  # type: ignore[arg-type]


def test_primitive_shapes_are_kept_and_meshes_become_urdf(tmp_path: Path) -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.1), np.array([1.0, 2.0, 0.7]))
    red = (1.0, 0.0, 0.0, 1.0)
    visual = make_part("looks", "box", (2.0, 0.1, 2.0), placement, colour=red)
    wedge = trimesh.convex.convex_hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    building = Link(
        "walls",
        (visual,),
        (
            make_part("a wall", "box", (2.0, 0.1, 2.0), placement),
            make_part("", "capsule", (0.1, 1.0), placement),
        ),
    )
    mesh = Link("wedge", (), (make_part("", "mesh", (1.0, 1.0, 1.0), placement, triangles=wedge),))
    ball = Link("a wall", (), (make_part("", "sphere", (0.2,), placement),))
    home = Home((building,), (mesh, ball), (), (), 4, ())
    taken = {"ball", "wedge"}
    entries, notes = write_obstacles(
        home, tmp_path / "home.urdf", tmp_path, taken, {}, ImportProgress(home)
    )
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
        )  # triangulated spheres are smaller
        if part.kind != "mesh":
            assert shape.placement.isApprox(part.placement, 1e-5)


def test_progress_is_logged_every_few_seconds(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    links = tuple(
        Link(f"chair {k}", (), (make_part("", "sphere", (0.2,), pin.SE3.Identity()),))
        for k in range(6)
    )
    now = 0.0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    with caplog.at_level("INFO", "vkc_pin.importing"):
        progress = ImportProgress(Home((), links, (), (), 6, ()))
        for number, _ in enumerate(progress.follow(links)):
            now += (0.5, 2.0, 0.5, 3.0, 1.0, 1.0)[number]
    assert [record.getMessage() for record in caplog.records] == [
        "chair 2: part 3 of 6, about 5 s left",
        "chair 4: part 5 of 6, about 3 s left",
    ]
