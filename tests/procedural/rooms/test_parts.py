"""Tests each kind of room part as a scene, with coal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.procedural.rooms import parts
from vkc_pin.procedural.rooms.fixtures import make_fixture
from vkc_pin.procedural.rooms.footprints import Floor, Frame
from vkc_pin.world.models.shapes import compute_clearance, compute_world_box, list_placed_shapes
from vkc_pin.world.scene.placed_object import make_world_shapes

FLOOR = Floor(6.0, 5.0)


def make_scene(*room_parts: parts.Part, walls: bool = False) -> vkc.Scene:
    obstacles = parts.make_walls(FLOOR, 2.4, room_parts) if walls else []
    obstacles = [*obstacles, *(entry for part in room_parts for entry in part.obstacles)]
    objects = [entry for part in room_parts for entry in part.objects]
    arena = {"x": [-6.0, 6.0], "y": [-6.0, 6.0]}
    document = {"robot": "husky_ur5e", "start": {"base": [0, 0, 0]}, "arena": arena, "floor": False}
    return vkc.Scene.from_document({**document, "obstacles": obstacles, "objects": objects})


def compute_extent(shapes: Iterable[Any]) -> np.ndarray:
    """Return the bounding box of shapes in the world, shape (2, 3) [m]."""
    boxes = np.array([compute_world_box(shape.geometry, shape.placement) for shape in shapes])
    return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def compute_footprint(part: parts.Part) -> np.ndarray:
    corners = part.footprint.corners
    return np.array([corners.min(axis=0), corners.max(axis=0)])


@pytest.mark.parametrize("side", range(4))
def test_table_covers_its_footprint_and_has_a_free_side(side: int) -> None:
    wall = FLOOR.make_wall_frame(side, 0.4)
    table = parts.make_table(
        "table", Frame(*wall.transform_point(-0.5, 0.0), wall.yaw), (0.8, 1.4, 0.74)
    )
    extent = compute_extent(make_scene(table).obstacles)
    assert extent[:, :2] == pytest.approx(compute_footprint(table))
    assert extent[:, 2] == pytest.approx([0.0, 0.74], abs=1e-3)
    assert len(table.obstacles) == 5
    assert table.clear_floor is not None
    assert table.clear_floor.compute_gap(table.footprint) == pytest.approx(0.0, abs=1e-3)
    assert table.standing_place is not None
    # on the side towards the room
    assert np.linalg.norm(table.standing_place) < np.hypot(wall.x, wall.y)


def test_shelf_is_placed_against_its_wall() -> None:
    shelf = parts.make_shelf("shelf", FLOOR.make_wall_frame(0, 0.3), (0.3, 1.0, 1.8), 4)
    expected = np.array([[2.68, -0.2, 0.0], [2.98, 0.8, 1.8]])
    assert compute_extent(make_scene(shelf).obstacles) == pytest.approx(expected, abs=1e-3)
    boards = sorted(item["position"][2] for item in shelf.obstacles if "board" in item["name"])
    assert len(boards) == 4
    assert min(np.diff(boards)) > 0.3


@pytest.mark.parametrize(
    ("kind", "side"), [("door", 0), ("drawer", 1), ("random_oven", 2), ("random_door", 3)]
)
def test_openable_object_is_at_its_wall_with_clear_floor(kind: str, side: int) -> None:
    part = parts.make_openable(kind, make_fixture(kind, side), FLOOR, side, 0.5, 1.8)
    room = make_scene(part, walls=True)
    placed = room.objects[kind]
    walls = list_placed_shapes(room.obstacles)
    # Door frames touch their wall.
    assert compute_clearance(list_placed_shapes(make_world_shapes(placed)), walls) > -2e-3
    joint = placed.object.coordinates.names[0]
    parents = [shape.parentJoint for shape in placed.object.collision.geometryObjects]
    # Moving links keep the planner's clearance.
    for value in np.linspace(0.0, min(placed.object.upper[0], 1.57), 6):
        shapes = make_world_shapes(placed.with_state({joint: value}))
        moving = [shape for shape, parent in zip(shapes, parents, strict=True) if parent]
        assert compute_clearance(list_placed_shapes(moving), walls) > 0.02
    attachment = placed.object.attachment()
    tool = placed.link_placement(attachment.link) * attachment.placement
    assert part.clear_floor is not None
    # The handle is above the clear floor.
    (distance,) = part.clear_floor.compute_distances([tool.translation[:2]])
    assert distance == pytest.approx(0.0, abs=1e-6)
    assert FLOOR.compute_half_length(side + 1) - abs(np.array(part.standing_place)[side % 2]) > 0.8


@pytest.mark.parametrize(
    ("kind", "seed"), [("random_microwave", 0), ("random_faucet", 1), ("random_faucet", 2)]
)
def test_small_objects_rest_on_a_counter(kind: str, seed: int) -> None:
    part = parts.make_openable("it", make_fixture(kind, seed), FLOOR, 2, 0.3, 1.8)
    room = make_scene(part)
    low, high = counter = compute_extent(room.obstacles)
    own_low, own_high = compute_extent(make_world_shapes(room.objects["it"]))
    assert own_low[2] == pytest.approx(high[2] + 0.001, abs=1e-4)
    assert (own_low[:2] >= low[:2]).all()
    assert (own_high[:2] <= high[:2]).all()
    assert counter[:, :2] == pytest.approx(compute_footprint(part), abs=2e-3)
    assert 0.7 < high[2] < 0.92
    assert part.clear_floor is not None
    assert part.clear_floor.compute_gap(part.footprint) == pytest.approx(0.0, abs=2e-3)


def test_walls_enclose_the_room_except_at_doors() -> None:
    door = parts.make_openable("door", make_fixture("door"), FLOOR, 1, -1.0, 1.8)
    closed, open_ = (parts.make_walls(FLOOR, 2.4, room_parts) for room_parts in ((), (door,)))
    sides = ("east", "north", "west", "south")
    assert [item["name"] for item in closed] == [f"wall_{side}" for side in sides]
    beside = [item["name"] for item in open_ if "north" in item["name"]]
    assert beside == ["wall_north_1", "wall_north_above_door", "wall_north_2"]
    lengths = [item["size"][1] for item in open_ if "north" in item["name"]]
    assert sum(lengths) == pytest.approx(6.2)
    assert lengths[1] == pytest.approx(1.07)


@pytest.mark.parametrize("kind", parts.CARRIED)
def test_free_object_rests_on_its_table(kind: str) -> None:
    table = parts.make_table("table", Frame(1.0, -0.5, np.pi), (0.8, 1.4, 0.74))
    room = make_scene(table, parts.make_carried_object(kind, kind, table, -0.2, 0.3))
    placed = room.objects[kind]
    shapes = make_world_shapes(placed), room.obstacles
    gap = compute_clearance(*map(list_placed_shapes, shapes))
    assert gap == pytest.approx(1e-3, abs=1e-4)
    assert placed.placement.translation[:2] == pytest.approx([1.2, -0.8])
