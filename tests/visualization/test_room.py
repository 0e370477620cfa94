from __future__ import annotations

import numpy as np
import pytest

from vkc_pin import Scene, load_scene
from vkc_pin.visualization.room import Room


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("door")


@pytest.fixture(scope="module")
def room(scene: Scene) -> Room:
    return Room(scene)


def test_obstacles_are_drawn_as_walls_or_furniture(room: Room, scene: Scene) -> None:
    names = {name for part in room.make_parts() for name in part.name.split("/")}
    assert {*scene.obstacle_names, "floor"} <= names
    walls = {
        part.name.split("/")[1] for part in room.make_parts() if part.name.startswith("walls/")
    }
    beside_the_door = {"wall_left_of_door", "wall_right_of_door", "wall_above_door"}
    assert walls == beside_the_door | {"wall_west", "wall_north", "wall_south", "hall_wall"}


def test_walls_are_visible_from_inside_only(room: Room) -> None:
    inside = {part.name: part for part in room.make_parts() if part.name.endswith("/inside")}
    normals = {
        "wall_west": [1, 0, 0],
        "wall_south": [0, 1, 0],
        "wall_north": [0, -1, 0],
        "hall_wall": [-1, 0, 0],
    }
    for name, normal in normals.items():
        part = inside[f"walls/{name}/inside"]
        assert np.allclose(part.solid.normals, normal)
        assert part.one_sided
        assert not part.shadow
    assert "walls/wall_above_door/inside" not in inside, "it separates room and hall"


def test_walls_obstruct_the_view_less_than_furniture(room: Room, scene: Scene) -> None:
    boxes = room.find_obstructions()
    assert len(boxes) == len(scene.obstacle_visual)
    sofa = [o for low, high, o in boxes if np.allclose(low, [-2.4, -1.775, 0.0], atol=1e-6)]
    assert sofa == [1.0]
    assert sum(opacity < 1.0 for _, _, opacity in boxes) == 7
    assert all((low <= high).all() for low, high, _ in boxes)
