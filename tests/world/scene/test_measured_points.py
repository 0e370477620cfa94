"""Tests of measured points as obstacles of scenes."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.world.scene.placed_object import make_world_shapes

POINTS = np.array([[1.0, 1.0, 0.5], [1.0, 1.2, 0.5], [2.0, 1.0, 0.75]])


@pytest.fixture(scope="module")
def scene() -> vkc.Scene:
    return vkc.load_scene("init_1")


def collect_points(scene: vkc.Scene, name: str = "points") -> np.ndarray:
    """Return all points of an obstacle in the world frame, sorted."""
    found = []
    for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True):
        if label == name:
            found.append(shape.geometry.points @ shape.placement.rotation.T)
            found[-1] = found[-1] + shape.placement.translation
    points = np.concatenate(found)
    return np.asarray(points[np.lexsort(points.T)])


def sort_points(points: np.ndarray) -> np.ndarray:
    return np.asarray(points[np.lexsort(points.T)])


def test_points_are_an_obstacle(scene: vkc.Scene) -> None:
    changed = scene.with_points(POINTS, 0.02)
    assert changed.obstacle_names == (*scene.obstacle_names, "points")
    assert changed.point_counts == {"points": vkc.PointCounts(kept=3)}
    np.testing.assert_allclose(collect_points(changed), sort_points(POINTS), atol=1e-6)
    assert "points" not in scene.obstacle_names


def test_points_of_the_same_name_are_replaced(scene: vkc.Scene) -> None:
    first = scene.with_points(POINTS)
    second = first.with_points(POINTS[:1]).with_points(POINTS[1:], name="camera 2")
    assert second.obstacle_names == (*scene.obstacle_names, "points", "camera 2")
    np.testing.assert_allclose(collect_points(second), POINTS[:1], atol=1e-6)


def test_points_in_a_frame_of_the_robot(scene: vkc.Scene) -> None:
    placement = scene.tool_placement()
    local = np.array([[0.3, 0.1, 0.4], [0.3, 0.1, 0.5]])
    changed = scene.with_points(local, frame=scene.robot.tool_frame)
    expected = local @ placement.rotation.T + placement.translation
    np.testing.assert_allclose(collect_points(changed), sort_points(expected), atol=1e-6)


def test_points_of_robot_and_floor_are_removed_and_counted(scene: vkc.Scene) -> None:
    data = scene.robot.model.createData()
    q = scene.robot.coordinates.q(scene.start)
    pin.framesForwardKinematics(scene.robot.model, data, q)
    hand = data.oMf[scene.robot.model.getFrameId("wrist_3_link")].translation
    floor = [[2.0, 2.0, 0.049], [2.0, 2.0, -0.3]]
    changed = scene.with_points([*POINTS, hand, *floor])
    assert changed.point_counts == {"points": vkc.PointCounts(kept=3, robot=1, floor=2)}
    without_floor = vkc.Scene.from_document({**scene.document, "floor": False}, scene.folder)
    kept = without_floor.with_points([*POINTS, *floor])
    assert kept.point_counts["points"].kept == 5


def test_points_of_held_objects_are_removed() -> None:
    scene = vkc.load_scene("household")
    held = scene.with_held({"cup": "side"})
    at_cup = make_world_shapes(held.objects["cup"])[0].placement.translation
    assert held.with_points([*POINTS, at_cup]).point_counts["points"].robot == 1


def test_points_of_objects_are_removed_where_these_are() -> None:
    scene = vkc.load_scene("drawer")
    opened = scene.with_state("drawer", {"slide": 0.3})
    counts = []
    for known in (scene, opened):
        shapes = {shape.name: shape for shape in make_world_shapes(known.objects["drawer"])}
        center = shapes["tray_0"].placement.translation
        counts.append(opened.with_points([*POINTS, center]).point_counts["points"])
    assert [one.objects for one in counts] == [0, 1]
    assert [one.kept for one in counts] == [4, 3]


def test_document_restores_the_same_points(scene: vkc.Scene) -> None:
    changed = scene.with_points(POINTS, 0.02)
    restored = vkc.Scene.from_document(changed.document, changed.folder)
    assert restored.point_counts == changed.point_counts
    assert restored.obstacle_labels == changed.obstacle_labels
    np.testing.assert_array_equal(collect_points(restored), collect_points(changed))
    copy = pickle.loads(pickle.dumps(changed))
    np.testing.assert_array_equal(collect_points(copy), collect_points(changed))


def test_points_move_like_other_obstacles(scene: vkc.Scene) -> None:
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, np.pi / 2), np.array([0.5, 0.0, 0.0]))
    moved = scene.with_points(POINTS).with_obstacle("points", pose)
    expected = POINTS @ pose.rotation.T + pose.translation
    np.testing.assert_allclose(collect_points(moved), sort_points(expected), atol=1e-6)
    restored = vkc.Scene.from_document(moved.document, moved.folder)
    np.testing.assert_allclose(collect_points(restored), collect_points(moved), atol=1e-9)


def test_scene_file_names_a_file_of_points(scene: vkc.Scene, tmp_path: Path) -> None:
    rows = "\n".join(" ".join(map(str, point)) for point in [*POINTS, [1.0, np.nan, 1.0]])
    header = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    (tmp_path / "room.ply").write_text(f"{header}end_header\n{rows}\n")
    cloud = {"type": "points", "name": "room", "file": "room.ply", "position": [0.0, 0.5, 0.0]}
    document = {**scene.document, "obstacles": [cloud]}
    loaded = vkc.Scene.from_document(document, tmp_path)
    assert loaded.point_counts == {"room": vkc.PointCounts(kept=3, not_finite=1)}
    np.testing.assert_allclose(
        collect_points(loaded, "room"), sort_points(POINTS + np.array([0.0, 0.5, 0.0])), atol=1e-6
    )
    # The document has the points themselves: removal does not depend on later starts.
    assert "file" not in loaded.document["obstacles"][0]


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "points: no points"),
        (np.zeros((4, 2)), r"points: not an array of points \(expected the shape \(n, 3\)"),
        ([1.0, 2.0, 3.0], "not an array of points"),
        ("cloud.ply", r"expected an array of shape \(n, 3\)"),
        ([[0, 0, 1], [0, np.nan, 1], [np.inf, 0, 1]], r"points\[1\]: 2 of 3 points are not finite"),
        ([[0, 0, 1], [0, 2e4, 1]], r"points\[1\]: a point is too far away"),
        (np.zeros((2_000_001, 3)), "too many points .*2000000.*got 2000001"),
        ([[3.0, 3.0, 0.0]], "no points are left: 0 are within 0.03 m .* 1 below 0.05 m"),
    ],
)
def test_invalid_points_are_refused(scene: vkc.Scene, points: object, message: str) -> None:
    with pytest.raises(vkc.InputError, match=message):
        scene.with_points(points)  # type: ignore[arg-type]


@pytest.mark.parametrize("radius", [0.0, -1.0, np.nan, np.inf, "1 cm", True])
def test_invalid_radius_is_refused(scene: vkc.Scene, radius: object) -> None:
    with pytest.raises(vkc.InputError, match="radius: invalid radius"):
        scene.with_points(POINTS, radius)  # type: ignore[arg-type]


def test_unknown_frame_is_refused_with_the_nearest(scene: vkc.Scene) -> None:
    with pytest.raises(vkc.UnknownNameError, match="tool0"):
        scene.with_points(POINTS, frame="tool_0")


def test_names_of_others_are_refused(scene: vkc.Scene) -> None:
    for name in ("floor", next(iter(scene.objects)), "a.b", " a", ""):
        with pytest.raises(vkc.InputError, match="name: this name cannot be used"):
            scene.with_points(POINTS, name=name)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({}, "neither a file nor data"),
        ({"file": "none.ply"}, "no such file"),
        ({"data": "AAAA", "radius": 0.01}, "no points"),
        ({"data": "AAAAAAAAAAAAAAAA"}, "data without a radius"),
        ({"data": "AADAfwAAAAAAAAAA", "radius": 0.01}, "no points"),
    ],
)
def test_invalid_entries_of_files_are_refused(
    scene: vkc.Scene, entry: dict[str, object], message: str
) -> None:
    document = {**scene.document, "obstacles": [{"type": "points", "name": "cloud", **entry}]}
    with pytest.raises(vkc.InputError, match=message):
        vkc.Scene.from_document(document, scene.folder)


def test_points_have_their_colour(scene: vkc.Scene) -> None:
    """Viewers take it from the shape, not from a material."""
    seen = scene.with_points(POINTS, radius=0.02)
    own = [shape for shape in seen.obstacle_visual if shape.name.startswith("points")]
    assert own
    for shape in own:
        assert shape.overrideMaterial
        assert shape.meshColor.shape == (4,)
