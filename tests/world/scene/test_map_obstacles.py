"""Tests scenes on maps of ROS: obstacles, arena and files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
import yaml
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

import vkc_pin as vkc
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.scene.map_obstacles import MAP, merge_cells

CELL = 0.5
ORIGIN = (-2.0, -1.5, 0.3)


def write_map(folder: Path, grey: Any, origin: tuple[float, ...] = ORIGIN) -> Path:
    """Write a map whose rows are listed from the top, as in the image."""
    Image.fromarray(np.array(grey, np.uint8)).save(folder / "map.pgm")
    fields = {
        **{"image": "map.pgm", "resolution": CELL, "origin": list(origin), "negate": 0},
        **{"occupied_thresh": 0.65, "free_thresh": 0.196},
    }
    file = folder / "map.yaml"
    file.write_text(yaml.safe_dump(fields))
    return file


def make_document(**fields: Any) -> dict[str, Any]:
    return {"robot": "husky_ur5e", "start": {"base": [0.0, 0.0, 0.0]}, **fields}


def find_boxes(scene: vkc.Scene) -> list[pin.GeometryObject]:
    found = []
    for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True):
        if label == MAP:
            found.append(shape)
    return found


def is_inside(point: Floats, shape: pin.GeometryObject) -> bool:
    return bool(np.all(np.abs(shape.placement.actInv(point)) < shape.geometry.halfSide))


ROOM = np.full((8, 8), 254)
ROOM[0] = ROOM[-1] = 0
ROOM[:, 0] = ROOM[:, -1] = 0


@settings(max_examples=80, deadline=None)
@given(cells=arrays.arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_rectangles_cover_exactly_the_cells(cells: Bools) -> None:
    found = merge_cells(cells, 100)
    assert found is not None
    covered = np.zeros_like(cells)
    for first_column, last_column, first_row, last_row in found:
        assert first_column < last_column
        assert first_row < last_row
        covered[first_row:last_row, first_column:last_column] = True
    assert np.array_equal(covered, cells)
    # Each has a cell of its own.
    assert len(found) <= cells.sum()


def test_walls_are_few_rectangles() -> None:
    cells = np.zeros((200, 300), bool)
    cells[:3] = cells[-3:] = True
    cells[:, :3] = cells[:, -3:] = True
    cells[90:110, 40:50] = True
    found = merge_cells(cells, 10)
    assert found is not None
    assert len(found) == 5
    assert merge_cells(cells, 4) is None


@settings(max_examples=12, deadline=None)
@given(
    grey=arrays.arrays(
        np.uint8, (6, 7), elements=st.sampled_from([0, 205, 254]), fill=st.just(254)
    ),
    yaw=st.floats(-math.pi, math.pi),
    unknown=st.sampled_from(["blocked", "free"]),
)
def test_points_are_inside_obstacles_if_their_cells_are(
    tmp_path_factory: pytest.TempPathFactory, grey: Any, yaw: float, unknown: str
) -> None:
    folder = tmp_path_factory.mktemp("map")
    write_map(folder, grey, (-1.75, -1.5, yaw))
    entry = {"file": "map.yaml", "height": 1.2, "unknown": unknown}
    start = {"base": [-1.75, -1.5, 0.0]}
    scene = vkc.Scene.from_document({**make_document(map=entry), "start": start}, folder)
    boxes = find_boxes(scene)
    assert all(isinstance(shape.geometry, coal.Box) for shape in boxes)
    x_min, x_max, y_min, y_max = scene.arena
    rng = np.random.default_rng(0)
    for x, y in rng.uniform((x_min, y_min), (x_max, y_max), (80, 2)):
        # From the lower left corner, along the turned axes.
        column = math.floor((math.cos(yaw) * (x + 1.75) + math.sin(yaw) * (y + 1.5)) / CELL)
        row = math.floor((math.cos(yaw) * (y + 1.5) - math.sin(yaw) * (x + 1.75)) / CELL)
        value = 205
        if 0 <= column < 7 and 0 <= row < 6:
            value = int(grey[5 - row, column])
        is_blocked = value == 0 or (value == 205 and unknown == "blocked")
        assert any(is_inside(np.array([x, y, 0.6]), shape) for shape in boxes) == is_blocked
        assert not any(is_inside(np.array([x, y, 1.3]), shape) for shape in boxes)


def test_arena_is_the_bounding_box_of_the_turned_map(tmp_path: Path) -> None:
    write_map(tmp_path, ROOM)
    scene = vkc.Scene.from_document(make_document(map="map.yaml"), tmp_path)
    c = 4.0 * math.cos(0.3)
    s = 4.0 * math.sin(0.3)
    np.testing.assert_allclose(scene.arena, [-2 - s, -2 + c, -1.5, -1.5 + s + c])
    # Four walls, and the parts of the arena beyond the four sides of the turned image.
    assert scene.obstacle_labels.count(MAP) == 8
    free = make_document(map={"file": "map.yaml", "unknown": "free"})
    assert vkc.Scene.from_document(free, tmp_path).obstacle_labels.count(MAP) == 4
    stated = make_document(map="map.yaml", arena={"x": [-1, 1], "y": [-1, 1.5]})
    small = vkc.Scene.from_document(stated, tmp_path)
    assert small.arena == (-1.0, 1.0, -1.0, 1.5)


def test_straight_maps_have_no_borders(tmp_path: Path) -> None:
    write_map(tmp_path, ROOM, (-1.7, -1.6, 0.0))
    scene = vkc.Scene.from_document(make_document(map="map.yaml"), tmp_path)
    np.testing.assert_allclose(scene.arena, [-1.7, 2.3, -1.6, 2.4])
    assert scene.obstacle_labels.count(MAP) == 4


def test_scenes_on_maps_are_read_again(tmp_path: Path) -> None:
    write_map(tmp_path, ROOM)
    document = make_document(map={"file": "map.yaml", "height": 1.5}, allow=[["base_link", MAP]])
    scene = vkc.Scene.from_document(document, tmp_path)
    saved = json.loads(json.dumps(scene.document))
    assert saved["map"] == {"file": "map.yaml", "height": 1.5, "unknown": "blocked"}
    again = vkc.Scene.from_document(saved, tmp_path)
    assert again.document == scene.document
    assert again.obstacle_labels == scene.obstacle_labels
    for one, other in zip(scene.obstacles, again.obstacles, strict=True):
        np.testing.assert_array_equal(one.placement, other.placement)
        assert one.geometry == other.geometry
    assert scene.obstacle_names == ()
    assert scene.with_robot("husky_ur5e", base="differential").document["map"] == saved["map"]


def test_with_map_replaces_the_map(tmp_path: Path) -> None:
    file = write_map(tmp_path, ROOM)
    empty = vkc.Scene.from_document(make_document(), tmp_path)
    scene = empty.with_map(file, height=2.5, unknown="free")
    assert scene.obstacle_labels.count(MAP) == 4
    assert {2.0 * shape.geometry.halfSide[2] for shape in find_boxes(scene)} == {2.5}
    assert scene.with_map(file).obstacle_labels.count(MAP) == 8
    stated = make_document(arena={"x": [-1, 1], "y": [-1, 1.5]})
    small = vkc.Scene.from_document(stated, tmp_path).with_map(file)
    assert small.arena == (-1.0, 1.0, -1.0, 1.5)
    large = make_document(arena={"x": [-9, 1], "y": [-1, 1.5]})
    assert vkc.Scene.from_document(large, tmp_path).with_map(file).arena == scene.arena


def test_saved_plans_find_their_map(tmp_path: Path) -> None:
    room = np.full((12, 12), 254)
    room[:, 0] = 0
    write_map(tmp_path, room, (-3.0, -3.0, 0.0))
    scene = vkc.Scene.from_document(make_document(map="map.yaml"), tmp_path)
    plan = vkc.plan(scene, [vkc.GoTo(x=0.5, y=0.0, yaw=0.0)])
    assert plan.status == "success"
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert loaded.scene.document == scene.document


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"map": "rooms.yaml"}, r"map: there is no such file .*perhaps map\.yaml"),
        ({"map": {"file": "map.yaml", "height": 0}}, r"map\.height: out of range"),
        ({"map": {"file": "map.yaml", "unknown": "walls"}}, r"map\.unknown: there is no unknown"),
        ({"map": {"height": 2.0}}, r"map\.file: missing"),
        ({"map": {"file": "map.yaml", "hight": 2.0}}, "map.*did you mean 'height'"),
        ({"map": 3}, "map: wrong value"),
        (
            {
                "map": "map.yaml",
                "obstacles": [{"name": MAP, "type": "sphere", "radius": 1, "position": [9, 9, 9]}],
            },
            "this name is already used .*as the map",
        ),
        ({"map": "map.yaml", "start": {"base": [9.0, 0.0, 0.0]}}, r"start\.base\[0\]: outside"),
    ],
)
def test_wrong_maps_are_named(tmp_path: Path, fields: dict[str, Any], message: str) -> None:
    write_map(tmp_path, ROOM)
    with expect_error(message):
        vkc.Scene.from_document({**make_document(), **fields}, tmp_path)


def test_wrong_arguments_are_named(tmp_path: Path) -> None:
    scene = vkc.Scene.from_document(make_document(), tmp_path)
    file = write_map(tmp_path, ROOM)
    with expect_error("map.height: out of range"):
        scene.with_map(file, height=-1.0)
    with expect_error("map.unknown: there is no unknown 'block'; did you mean 'blocked'"):
        scene.with_map(file, unknown="block")  # type: ignore[arg-type]
    with expect_error("file: not a path"):
        scene.with_map(3)  # type: ignore[arg-type]
    with expect_error("there is no such file"):
        scene.with_map(tmp_path / "other.yaml")
    file.write_text("image: map.pgm\n")
    with expect_error(r"map\.yaml:1: resolution: missing"):
        scene.with_map(file)


def test_too_many_boxes_are_refused(tmp_path: Path) -> None:
    board = np.indices((201, 201)).sum(axis=0) % 2 * 254
    write_map(tmp_path, board)
    with expect_error(r"map\.yaml: image: the map has too many separate cells .*20000 boxes"):
        vkc.Scene.from_document(make_document(map="map.yaml"), tmp_path)
