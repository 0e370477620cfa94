"""Tests the import of rooms that are one mesh."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin.importing.homes.mesh_rooms import read_mesh_room
from vkc_pin.world.models.shapes import FixedShapes

WIDTH, DEPTH, HEIGHT = 5.0, 4.0, 2.2
CHEST = ((3.0, 0.5), (3.8, 1.1), 0.8)  # corners and height


def make_grid(origin: tuple[float, ...], *edges: tuple[float, ...]) -> trimesh.Trimesh:
    """Return a parallelogram of triangles of up to 0.3 m."""
    first, second = map(np.array, edges)
    counts = [int(np.ceil(np.linalg.norm(edge) / 0.3)) + 1 for edge in (first, second)]
    s, t = np.meshgrid(*(np.linspace(0.0, 1.0, count) for count in counts), indexing="ij")
    points = np.array(origin) + s[..., None] * first + t[..., None] * second
    index = np.arange(s.size).reshape(s.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(k, axis=-1).reshape(-1, 3) for k in ((a, b, c), (a, c, d))])
    return trimesh.Trimesh(points.reshape(-1, 3), faces, process=False)


def make_room(noise: float = 0.0, floor: float = 0.0) -> trimesh.Trimesh:
    """Return a scan-like room, open above and at the south: walls, and a chest without a bottom."""
    (x, y), (x_end, y_end), z = CHEST
    length, width = x_end - x, y_end - y
    surfaces = [
        make_grid((0, 0, 0), (WIDTH, 0, 0), (0, DEPTH, 0)),
        make_grid((0, DEPTH, 0), (WIDTH, 0, 0), (0, 0, HEIGHT)),
        make_grid((0, 0, 0), (0, DEPTH, 0), (0, 0, HEIGHT)),
        make_grid((WIDTH, 0, 0), (0, DEPTH, 0), (0, 0, HEIGHT)),
        make_grid((x, y, 0), (length, 0, 0), (0, 0, z)),
        make_grid((x, y_end, 0), (length, 0, 0), (0, 0, z)),
        make_grid((x, y, 0), (0, width, 0), (0, 0, z)),
        make_grid((x_end, y, 0), (0, width, 0), (0, 0, z)),
        make_grid((x, y, z), (length, 0, 0), (0, width, 0)),
    ]
    room = trimesh.util.concatenate(surfaces)
    room.merge_vertices()
    room.vertices += np.random.default_rng(0).normal(0.0, noise, room.vertices.shape)
    room.vertices += (0.0, 0.0, floor)
    return room


def export(room: trimesh.Trimesh, file: Path) -> Path:
    if file.suffix == ".glb":
        y_up = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
        room = room.copy().apply_transform(np.vstack([y_up, [0.0, 0.0, 0.0, 1.0]]))
    room.export(file)
    return file


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".stl", ".obj"])
def test_room_falls_into_floor_walls_and_furniture(tmp_path: Path, suffix: str) -> None:
    file = export(make_room(noise=0.003, floor=-0.7), tmp_path / f"flat{suffix}")
    description, floor = read_mesh_room(file)
    assert floor == pytest.approx(-0.7, abs=0.002)
    (walls,) = [part for part in description.links["room"].collision if part.name != "floor"]
    np.testing.assert_allclose(walls.make_mesh().extents, (WIDTH, DEPTH, HEIGHT), atol=0.03)
    (name,) = description.joints
    low, high = description.links[name].collision[0].make_mesh().bounds
    np.testing.assert_allclose(low[:2], CHEST[0], atol=0.02)
    np.testing.assert_allclose(high, (*CHEST[1], CHEST[2] - 0.7), atol=0.02)
    faces = sum(len(part.make_mesh().faces) for part in description.links["room"].collision)
    faces += len(description.links[name].collision[0].make_mesh().faces)
    assert faces == len(make_room().faces)


def test_robot_drives_round_what_stands_in_a_scanned_room(tmp_path: Path) -> None:
    room = make_room(noise=0.003)
    file = export(room, tmp_path / "flat.ply")
    home = vkc.importing.import_home(file, tmp_path / "home")
    assert home.scene.obstacle_names == ("walls_0", "furniture_1")
    assert home.shapes == {"file": 3, "obstacles": 2, "objects": 0, "floor": 1}
    solids = [(one.geometry, one.placement) for one in home.scene.obstacles]
    check_coverage(room, FixedShapes(solids))
    plan = vkc.plan(home.scene.with_start(base=[2.2, 0.8, 0.0]), [vkc.GoTo(4.3, 2.2, 0.0)])
    assert plan.success, plan.summary()


def check_coverage(room: trimesh.Trimesh, shapes: FixedShapes) -> None:
    """Check that obstacles contain the surface above the floor, and nothing else by much."""

    def is_near(place: np.ndarray, radius: float) -> bool:
        at = pin.SE3(np.eye(3), np.asarray(place, float))
        return shapes.compute_clearance([(coal.Sphere(radius), at)], reach=1.0) <= 1e-6

    is_above = room.triangles[:, :, 2].max(axis=1) > 0.05
    for center in room.triangles_center[is_above][::7]:
        assert is_near(center, 1e-6)
    rng = np.random.default_rng(1)
    places = rng.uniform((0.2, 0.2, 0.2), (WIDTH - 0.2, DEPTH - 0.2, 1.5), (200, 3))
    distances = np.abs(trimesh.proximity.closest_point_naive(room, places)[1])
    inside = np.all((places[:, :2] > CHEST[0]) & (places[:, :2] < CHEST[1]), axis=1)
    far = places[(distances > 0.15) & ~(inside & (places[:, 2] < CHEST[2]))]
    assert len(far) > 50
    assert not any(is_near(place, 1e-3) for place in far)


def test_floor_is_not_a_larger_ceiling(tmp_path: Path) -> None:
    room = make_room(noise=0.003)
    ceiling = make_grid((-1, -1, HEIGHT), (WIDTH + 2, 0, 0), (0, DEPTH + 2, 0))
    file = export(trimesh.util.concatenate([room, ceiling]), tmp_path / "flat.ply")
    _, floor = read_mesh_room(file)
    assert floor == pytest.approx(0.0, abs=0.002)


def test_stated_height_of_the_floor_counts(tmp_path: Path) -> None:
    file = export(make_room(), tmp_path / "flat.ply")
    description, floor = read_mesh_room(file, 0.4)
    assert floor == 0.4
    assert not description.notes


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (make_grid((0, 0, 0), (4, 0, 0), (0, 0, 2)), "horizontal faces"),
        (make_grid((0, 0, 0), (4, 0, 0), (0, 4, 0)), "surfaces above"),
    ],
)
def test_meshes_that_are_no_rooms_are_errors(
    tmp_path: Path, mesh: trimesh.Trimesh, expected: str
) -> None:
    file = export(mesh, tmp_path / "flat.ply")
    with expect_error(expected, file=file, field="floor"):
        vkc.importing.import_home(file, tmp_path / "home")
    assert not (tmp_path / "home").exists()


def test_cloud_is_no_mesh(tmp_path: Path) -> None:
    file = tmp_path / "cloud.ply"
    trimesh.PointCloud(np.eye(3)).export(file)
    with expect_error("empty", file=file):
        vkc.importing.import_home(file, tmp_path / "home")
