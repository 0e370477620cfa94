from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.grippers import write_gripper
from helpers.texts import format_box
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.procedural.furniture.catalogue import KINDS
from vkc_pin.procedural.rooms.fixtures import OPENABLE, make_fixture
from vkc_pin.procedural.rooms.random_room import Layout, sample_layout
from vkc_pin.world.models.shapes import (
    compute_clearance,
    list_placed_shapes,
)
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE


@pytest.mark.parametrize(
    ("changes", "field", "expected"),
    [
        ({"clutter": 1.1}, "clutter", "a number from 0 to 1"),
        ({"clutter": "much"}, "clutter", "a number from 0 to 1"),
        ({"width": 5.0}, "width", "two lengths"),
        ({"width": (3.0, 5.0)}, "width", "a number from 4 to 20"),
        ({"width": (6.0, 5.0)}, "width", "the lower one first"),
        ({"tables": 1.5}, "tables", "a whole number from 0 to 10"),
        ({"height": 1.0}, "height", "a number from 2.1"),
        ({"front": 0.2}, "front", "a number from 1.5"),
        ({"gap": 0.0}, "gap", "a number from 0.02"),
        ({"objects": "door"}, "objects", "a list of types"),
        ({"objects": (3,)}, "objects", "the name of a"),
        ({"carried": ("cup",) * 5}, "carried", "at most 4"),
        ({"carried": ("cup",), "tables": 0}, "carried", "at least 1"),
    ],
)
def test_invalid_settings_are_rejected(changes: dict[str, Any], field: str, expected: str) -> None:
    with pytest.raises(vkc.InputError) as caught:
        vkc.procedural.RoomSettings(**changes)
    assert caught.value.field == field
    assert expected in str(caught.value.expected)
    assert caught.value.got is not None


@pytest.mark.parametrize(
    ("changes", "field", "nearest"),
    [
        ({"objects": ("dor",)}, "objects", "door"),
        ({"objects": ("random_ovn",)}, "objects", "random_oven"),
        ({"carried": ("cub",)}, "carried", "cup"),
        ({"cluter": 0.5}, "cluter", "clutter"),
    ],
)
def test_unknown_types_and_settings_are_rejected(
    changes: dict[str, Any], field: str, nearest: str
) -> None:
    with pytest.raises(vkc.UnknownNameError) as caught:
        vkc.procedural.random_room(0, **changes)
    assert (caught.value.field, caught.value.nearest) == (field, nearest)


NUMBERS = st.integers(0, 10_000)
KNOWN = sorted([*OPENABLE, *(f"random_{kind}" for kind in KINDS)])
OBJECTS = st.one_of(st.none(), st.lists(st.sampled_from(KNOWN), max_size=2).map(tuple))


def group_shapes(layout: Layout, scene: vkc.Scene) -> dict[str, list]:
    """Return the collision shapes of every part and of the walls."""
    names = {
        entry["name"]: "counters" if part.objects else part.name
        for part in layout.parts
        for entry in part.obstacles
    }
    found: dict[str, list] = {part.name: [] for part in layout.parts}
    for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True):
        if label != FLOOR:
            found.setdefault(names.get(label, "walls"), []).append(shape)
    for name, placed in scene.objects.items():
        found[name] = make_world_shapes(placed)
    return found


@settings(max_examples=4, deadline=None, phases=[Phase.generate])
@given(NUMBERS, st.floats(0.0, 1.0), OBJECTS, st.booleans())
def test_rooms_have_no_overlaps_and_reachable_standing_places(
    number: int, clutter: float, objects: tuple[str, ...] | None, cup: bool
) -> None:
    carried = ("cup",) if cup else ()
    layout = sample_layout(number, clutter=clutter, objects=objects, carried=carried)
    scene = layout.make_scene()
    assert all(4.0 <= size <= 7.0 for size in (layout.floor.width, layout.floor.depth))

    shapes = group_shapes(layout, scene)
    for one, other in itertools.combinations(shapes, 2):
        pair = {one, other}
        placed = [list_placed_shapes(shapes[name]) for name in (one, other)]
        distance = compute_clearance(*placed, reach=0.05)
        on_top = "cup" in pair or ("counters" in pair and "walls" not in pair)
        door = "walls" in pair and any("door" in name for name in pair)
        least = -2e-3 if door else 5e-4 if on_top else 0.0 if "walls" in pair else 0.05
        assert distance >= least - 1e-9, (one, other, distance)

    def check_start(x: float, y: float, *yaws: float) -> None:
        """Check that the robot can turn at a place."""
        for yaw in yaws:
            moved = scene.with_start(base=[x, y, yaw])
            assert moved.start_clearance(reach=START_CLEARANCE) >= START_CLEARANCE, (x, y)

    assert scene.start_clearance() >= START_CLEARANCE
    check_start(*layout.start[:2], *np.linspace(-np.pi, np.pi, 7))
    for part in layout.parts:
        if part.clear_floor is None:
            continue
        assert layout.floor.contains(part.clear_floor)
        assert all(
            part.clear_floor.compute_gap(other.footprint) > 0.0
            for other in layout.parts
            if other.footprint != part.footprint
        )
        assert part.standing_place is not None
        check_start(*part.standing_place, 0.0, 1.5, 3.0)
    spots = [part.standing_place for part in layout.parts if part.standing_place is not None]
    footprints = [part.footprint for part in layout.parts]
    assert layout.floor.is_connected(footprints, layout.radius, [layout.start[:2], *spots])


def test_random_rooms_are_reproducible() -> None:
    one, other = (vkc.procedural.random_room(number, clutter=0.3).document for number in (5, 6))
    assert one != other
    assert vkc.procedural.random_room(5, vkc.procedural.RoomSettings(clutter=0.3)).document == one


def test_room_zero_is_the_same_on_all_machines() -> None:
    """Recorded results refer to these rooms."""
    layout = sample_layout(0)
    assert (layout.floor.width, layout.floor.depth) == (5.54, 6.85)
    assert [part.name for part in layout.parts][:2] == ["narrow_door", "table_1"]


def test_requested_parts_are_present() -> None:
    room = vkc.procedural.random_room(
        3, objects=("drawer", "drawer", "door"), tables=2, carried=("cup", "ball"), clutter=0.0
    )
    assert list(room.objects) == ["drawer_1", "drawer_2", "door", "cup", "ball"]
    assert sum(name.endswith("_top") for name in room.obstacle_names) == 2
    few, many = (vkc.procedural.random_room(3, objects=(), clutter=k) for k in (0.1, 1.0))
    assert len(few.obstacle_names) < len(many.obstacle_names)


def test_unknown_parts_and_negative_seeds_are_rejected() -> None:
    with pytest.raises(vkc.InputError, match="a whole number of at least 0"):
        vkc.procedural.random_room(-1)
    with pytest.raises(vkc.UnknownNameError, match="table_9"):
        sample_layout(0).find_part("table_9")


def test_error_if_parts_do_not_fit() -> None:
    with pytest.raises(vkc.InputError) as caught:
        vkc.procedural.random_room(0, width=(4.0, 4.0), objects=("cabinet",) * 6)
    assert caught.value.field == "clutter"
    assert "fewer objects" in str(caught.value.expected)


def test_imported_objects_and_robots_are_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The front face of an imported object may lie at negative x of its frame."""
    body, door = format_box("0.64 0.5 0.4", "0.03 0 0.2"), format_box("0.02 0.5 0.4", "-0.3 0 0.2")
    urdf = f"""<robot name="oven"><link name="body">{body}</link><link name="door">{door}</link>
        <joint name="hinge" type="revolute"><parent link="body"/><child link="door"/>
        <axis xyz="0 0 1"/><limit lower="0" upper="1"/></joint></robot>"""
    fixture = make_fixture({"urdf": urdf, "attachments": []})
    assert fixture.face == pytest.approx(-0.29)
    assert make_fixture("dishwasher").face == pytest.approx(0.0, abs=0.03)
    write_gripper(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    room = vkc.procedural.random_room(
        7, objects=[{"urdf": urdf, "attachments": []}], robot="mine/robot.yaml", clutter=0.0
    )
    assert room.robot.name == "mine"
    assert list(room.objects) == ["oven"]
