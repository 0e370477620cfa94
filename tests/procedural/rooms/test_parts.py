"""Tests each kind of room part as a scene, with coal."""

from __future__ import annotations

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
    obstacles = [
        *(parts.make_walls(FLOOR, 2.4, room_parts) if walls else []),
        *(o for part in room_parts for o in part.obstacles),
    ]
    objects = [entry for part in room_parts for entry in part.objects]
    arena = {"x": [-6.0, 6.0], "y": [-6.0, 6.0]}
    document = {"robot": "husky_ur5e", "start": {"base": [0, 0, 0]}, "arena": arena, "floor": False}
    return vkc.Scene.from_document({**document, "obstacles": obstacles, "objects": objects})


def compute_extent(scene: vkc.Scene) -> np.ndarray:
    boxes = np.array(
        [compute_world_box(shape.geometry, shape.placement) for shape in scene.obstacles]
    )
    return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


@pytest.mark.parametrize("side", range(4))
def test_table_covers_its_footprint_and_has_a_free_side(side: int) -> None:
    wall = FLOOR.make_wall_frame(side, 0.4)
    table = parts.make_table(
        "table", Frame(*wall.transform_point(-0.5, 0.0), wall.yaw), (0.8, 1.4, 0.74)
    )
    low, high = compute_extent(make_scene(table))
    assert [*low[:2], *high[:2]] == pytest.approx(
        [*table.footprint.corners.min(axis=0), *table.footprint.corners.max(axis=0)]
    )
    assert (low[2], high[2]) == pytest.approx((0.0, 0.74), abs=1e-3)
    assert len(table.obstacles) == 5
    assert table.clear_floor is not None
    assert table.clear_floor.compute_gap(table.footprint) == pytest.approx(0.0, abs=1e-3)
    assert table.standing_place is not None
    assert np.linalg.norm(table.standing_place) < np.hypot(
        wall.x, wall.y
    )  # on the side towards the room


def test_shelf_is_placed_against_its_wall() -> None:
    shelf = parts.make_shelf("shelf", FLOOR.make_wall_frame(0, 0.3), (0.3, 1.0, 1.8), 4)
    low, high = compute_extent(make_scene(shelf))
    assert np.array([low, high]) == pytest.approx(
        np.array([[2.68, -0.2, 0.0], [2.98, 0.8, 1.8]]), abs=1e-3
    )
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
    assert (
        compute_clearance(list_placed_shapes(make_world_shapes(placed)), walls) > -2e-3
    )  # door frames touch their wall
    joint = placed.object.coordinates.names[0]
    for fraction in np.linspace(0.0, 1.0, 6):  # moving links keep the planner's clearance
        upper = min(placed.object.upper[0], 1.57)
        moved = placed.with_state({joint: fraction * upper})
        parents = [shape.parentJoint for shape in placed.object.collision.geometryObjects]
        moving = [
            shape for shape, parent in zip(make_world_shapes(moved), parents, strict=True) if parent
        ]
        assert compute_clearance(list_placed_shapes(moving), walls) > 0.02
    tool = (
        placed.link_placement(placed.object.attachment().link)
        * placed.object.attachment().placement
    )
    assert part.clear_floor is not None
    assert part.clear_floor.compute_distances([tool.translation[:2]])[0] == pytest.approx(
        0.0, abs=1e-6
    )  # the handle is above the clear floor
    assert FLOOR.compute_half_length(side + 1) - abs(np.array(part.standing_place)[side % 2]) > 0.8


@pytest.mark.parametrize(
    ("kind", "seed"), [("random_microwave", 0), ("random_faucet", 1), ("random_faucet", 2)]
)
def test_small_objects_rest_on_a_counter(kind: str, seed: int) -> None:
    part = parts.make_openable("it", make_fixture(kind, seed), FLOOR, 2, 0.3, 1.8)
    low, high = compute_extent(make_scene(part))
    room = make_scene(part)
    boxes = np.array(
        [
            compute_world_box(shape.geometry, shape.placement)
            for shape in make_world_shapes(room.objects["it"])
        ]
    )
    assert boxes[:, 0].min(axis=0)[2] == pytest.approx(high[2] + 0.001, abs=1e-4)
    assert (boxes[:, 0].min(axis=0)[:2] >= low[:2]).all()
    assert (boxes[:, 1].max(axis=0)[:2] <= high[:2]).all()
    assert [*low[:2], *high[:2]] == pytest.approx(
        [*part.footprint.corners.min(axis=0), *part.footprint.corners.max(axis=0)], abs=2e-3
    )
    assert 0.7 < high[2] < 0.92
    assert part.clear_floor is not None
    assert part.clear_floor.compute_gap(part.footprint) == pytest.approx(0.0, abs=2e-3)


def test_walls_enclose_the_room_except_at_doors() -> None:
    door = parts.make_openable("door", make_fixture("door"), FLOOR, 1, -1.0, 1.8)
    closed, open_ = (parts.make_walls(FLOOR, 2.4, room_parts) for room_parts in ((), (door,)))
    assert [item["name"] for item in closed] == [
        "wall_east",
        "wall_north",
        "wall_west",
        "wall_south",
    ]
    assert [item["name"] for item in open_ if "north" in item["name"]] == [
        "wall_north_1",
        "wall_north_above_door",
        "wall_north_2",
    ]
    lengths = [item["size"][1] for item in open_ if "north" in item["name"]]
    assert sum(lengths) == pytest.approx(6.2)
    assert lengths[1] == pytest.approx(1.07)


@pytest.mark.parametrize("kind", parts.CARRIED)
def test_free_object_rests_on_its_table(kind: str) -> None:
    table = parts.make_table("table", Frame(1.0, -0.5, np.pi), (0.8, 1.4, 0.74))
    room = make_scene(table, parts.make_carried_object(kind, kind, table, -0.2, 0.3))
    placed = room.objects[kind]
    gap = compute_clearance(
        list_placed_shapes(make_world_shapes(placed)), list_placed_shapes(room.obstacles)
    )
    assert gap == pytest.approx(1e-3, abs=1e-4)
    assert placed.placement.translation[:2] == pytest.approx([1.2, -0.8])
