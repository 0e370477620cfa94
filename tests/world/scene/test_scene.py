"""Tests scenes: their contents, changed copies, and random starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.rooms import TINY, load

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.models.shapes import compute_clearance, list_placed_shapes
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene


@pytest.fixture(scope="module")
def door() -> Scene:
    return load_scene("door")


def test_the_door_is_in_an_ordinary_room(door: Scene) -> None:
    assert door.name == "door"
    assert door.robot.name == "husky_ur5e"
    assert len(door.obstacle_names) >= 10
    assert door.objects["door"].object.name == "door"
    assert dict(door.held) == {}
    np.testing.assert_array_equal(door.objects["door"].state, [0.0, 0.0])
    np.testing.assert_array_equal(door.start[3:], door.robot.home)
    region, hinge = door.start_region, door.objects["door"].placement.translation
    assert region is not None
    assert region.yaw is None
    assert 2.0 <= hinge[0] - region.x[1] <= hinge[0] - region.x[0] <= 4.0
    assert door.obstacle_labels[-1] == FLOOR
    assert len(door.obstacle_labels) == len(door.obstacles)
    assert set(door.obstacle_labels) == {*door.obstacle_names, FLOOR}


@pytest.mark.parametrize("name", ["door", "drawer"])
def test_the_robot_starts_clear_of_everything(name: str) -> None:
    scene = load_scene(name)
    assert scene.start_clearance() > START_CLEARANCE


@pytest.mark.parametrize(("name", "joint"), [("door", "hinge"), ("drawer", "slide")])
def test_moving_parts_keep_clear_of_the_room_over_the_whole_range(name: str, joint: str) -> None:
    scene = load_scene(name)
    placed = scene.objects[name]
    index = placed.object.coordinates.index(joint)
    room = list_placed_shapes(
        s for s, label in zip(scene.obstacles, scene.obstacle_labels, strict=True) if label != FLOOR
    )
    nearest = np.inf
    for value in np.linspace(placed.object.lower[index], placed.object.upper[index], 80):
        moved = make_world_shapes(placed.with_state({joint: value}))
        moving = [
            s
            for s, original in zip(moved, placed.object.collision.geometryObjects, strict=True)
            if original.parentJoint
        ]
        nearest = min(nearest, compute_clearance(list_placed_shapes(moving), room))
    assert nearest >= 0.03


def test_the_frame_fills_the_opening_without_a_gap_wider_than_a_finger(door: Scene) -> None:
    walls = [s for s in door.obstacles if s.name.startswith("wall_")]
    frame = [s for s in make_world_shapes(door.objects["door"]) if s.name.startswith("frame_")]
    assert len(frame) == 3
    for part in frame:
        assert abs(compute_clearance(list_placed_shapes([part]), list_placed_shapes(walls))) < 1e-3


def test_with_methods_reject_invalid_values(door: Scene) -> None:
    with pytest.raises(InputError, match="base: wrong number of values"):
        door.with_start(base=[0.0, 1.0])
    with pytest.raises(InputError, match="arm: wrong number of values"):
        door.with_start(arm=[0.0])
    with pytest.raises(InputError, match=r"base\.base_x: not a finite number"):
        door.with_start(base=[np.nan, 0.0, 0.0])
    with pytest.raises(InputError, match="outside the joint's limits"):
        door.with_start(arm=[100.0, *door.robot.home[1:]])
    with pytest.raises(UnknownNameError) as caught:
        door.with_state("dor", {"hinge": 0.0})
    assert caught.value.nearest == "door"
    with pytest.raises(UnknownNameError) as caught:
        door.with_state("door", {"hing": 0.0})
    assert caught.value.nearest == "hinge"
    with pytest.raises(
        InputError,
        match=r"door\.hinge: outside the joint's limits \(expected -1\.57 to 1\.57, got 2\)",
    ):
        door.with_state("door", {"hinge": 2.0})


def test_a_value_outside_its_limits_by_rounding_only_is_moved_to_the_limit(door: Scene) -> None:
    assert door.with_state("door", {"hinge": 1.57 + 1e-8}).objects["door"].state[0] == 1.57
    arm = door.robot.upper[3:] + 1e-8
    np.testing.assert_array_equal(door.with_start(arm=arm).start[3:], door.robot.upper[3:])


def test_random_starts_are_free_in_the_region_at_any_heading_and_repeatable(door: Scene) -> None:
    first, second = (
        np.array([door.sample_start(rng).start for _ in range(40)])
        for rng in (np.random.default_rng(7), np.random.default_rng(7))
    )
    np.testing.assert_array_equal(first, second)
    region = door.start_region
    assert region is not None
    assert (first[:, 0] >= region.x[0]).all()
    assert (first[:, 0] <= region.x[1]).all()
    assert (first[:, 1] >= region.y[0]).all()
    assert (first[:, 1] <= region.y[1]).all()
    assert np.ptp(first[:, 0]) > 0.7 * (region.x[1] - region.x[0])
    assert np.unique(np.floor(first[:, 2] / (np.pi / 2))).size == 4, "all four quarters of headings"
    for start in first:
        assert door.with_start(base=start[:3]).start_clearance() >= START_CLEARANCE
        hinge = door.objects["door"].placement.translation
        assert 2.0 <= hinge[0] - start[0] <= 4.0


def test_a_fixed_base_may_stand_anywhere_in_the_arena(tmp_path: Path) -> None:
    scene = load(
        tmp_path,
        TINY.replace("husky_ur5e", "{name: husky_ur5e, base: fixed}").replace(
            "0.0, 0.0, 0.5", "0.5, 0.2, 0.5"
        ),
    )
    np.testing.assert_array_equal(scene.start[:3], [0.5, 0.2, 0.5])
    np.testing.assert_array_equal(scene.with_start(base=[0.1, 0.2, 0.3]).start[:3], [0.1, 0.2, 0.3])


def test_start_clearance_includes_obstacles_and_objects(door: Scene) -> None:
    into_the_sofa = door.with_start(base=[-1.5, -1.5, 0.0])
    assert into_the_sofa.start_clearance() < -0.1
    into_the_door = door.with_start(base=[2.2, 0.0, 0.0])
    assert into_the_door.start_clearance() < -0.1


def test_sampling_needs_a_free_start_region(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    none = load(tmp_path, TINY.replace("start_region: {x: [-1, 1], y: [-1, 1], yaw: any}\n", ""))
    with pytest.raises(InputError, match="no start region"):
        none.sample_start(rng)
    full = load(tmp_path, TINY.replace("x: [-1, 1], y: [-1, 1]", "x: [2, 2.1], y: [2, 2.1]"))
    with pytest.raises(InputError, match="no collision-free start"):
        full.sample_start(rng)


STICK = (
    '<robot name="stick"><link name="stick"><visual><geometry><box size="0.5 0.03 0.03"/></geometry></visual>'
    '<collision><geometry><box size="0.5 0.03 0.03"/></geometry></collision></link></robot>'
)


def test_held_free_object_is_in_the_hand(tmp_path: Path) -> None:
    (tmp_path / "stick.urdf").write_text(STICK)
    attachment = "attachments: [{name: end, link: stick, position: [-0.2, 0, 0], approach: [1, 0, 0], closing: [0, 0, 1]}]"
    (tmp_path / "stick.yaml").write_text(f"urdf: stick.urdf\nfree: true\n{attachment}\n")
    text = TINY.replace("  arm: home\n", "  arm: home\n  held: {pole: end}\n")
    text = text.replace(
        "objects:\n", "objects:\n  - {name: pole, type: stick.yaml, position: [0, 0, 0]}\n"
    )
    scene = load(tmp_path, text)
    assert dict(scene.held) == {"pole": "end"}
    for moved in (scene, scene.with_start(base=[0.4, 0.2, 2.0])):
        grasp = (
            moved.objects["pole"].placement
            * scene.objects["pole"].object.attachment("end").placement
        )
        np.testing.assert_allclose(
            grasp.homogeneous, moved.tool_placement().homogeneous, atol=1e-12
        )
    tip = moved.objects["pole"].placement.act(np.array([0.25, 0.0, 0.0]))
    crate = {"name": "crate2", "type": "sphere", "radius": 0.05, "position": tip.tolist()}
    document = {**moved.document, "obstacles": [*moved.document["obstacles"], crate]}
    assert Scene.from_document(document, tmp_path).start_clearance() < 0.0, (
        "what is held collides, too"
    )
    moved.sample_start(np.random.default_rng(0))

    holds_the_door = TINY.replace("  arm: home\n", "  arm: home\n  held: {front: handle}\n")
    with pytest.raises(InputError, match=r"start\.held\.front"):
        load(tmp_path, holds_the_door).sample_start(np.random.default_rng(0))
