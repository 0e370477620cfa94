"""Tests the search for supports and supported objects."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_box
from helpers.supports import TOP, describe_cup, make_plate_scene, make_scene, write_objects

from vkc_pin import Scene
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.support import (
    compute_tilt,
    find_supported_objects,
    find_supports,
)


def find_supports_of(scene: Scene, name: str = "cup") -> set[str]:
    shapes = [
        (f"{other}.{get_link_name(shape.name)}", shape)
        for other, placed in scene.objects.items()
        if other != name
        for shape in make_world_shapes(placed)
    ]
    shapes += zip(scene.obstacle_labels, scene.obstacles, strict=True)
    return find_supports(scene.objects[name], shapes)


@pytest.mark.parametrize(
    ("gap", "is_supported"),
    [(-2e-3, True), (0.0, True), (1e-3, True), (2.4e-3, True), (2.6e-3, False), (0.1, False)],
)
def test_cup_is_supported_within_the_contact_tolerance(gap: float, is_supported: bool) -> None:
    assert find_supports_of(make_plate_scene(gap=gap)) == (
        {"plate.plate"} if is_supported else set()
    )


@pytest.mark.parametrize("apart", [-1e-3, 0.0, 1e-3])
def test_adjacent_shape_is_no_support(apart: float) -> None:
    assert find_supports_of(make_plate_scene(cups=1, wall=apart)) == {"plate.plate"}


def test_floor_and_several_tables_can_be_supports() -> None:
    tables = [describe_box(f"table_{k}", [0.2, 0.5, 0.5], [0.2 * k, 0.0, 0.25]) for k in range(3)]
    assert find_supports_of(make_scene([describe_cup(at=(0.1, 0.0, 0.5))], tables)) == {
        "table_0",
        "table_1",
    }
    assert find_supports_of(make_scene([describe_cup(at=(0.1, 0.0, 0.0))])) == {"floor"}


def test_stacked_objects_are_supported() -> None:
    scene = make_plate_scene(cups=1)
    upper = describe_cup("upper", at=(0.8, 0.06, TOP + 0.1))
    stacked = Scene.from_document(
        {**scene.document, "objects": [*scene.document["objects"], upper]}, write_objects()
    )
    assert find_supports_of(stacked, "upper") == {"cup.cup"}
    assert find_supported_objects(stacked.objects, {"plate": {"plate"}}, ["cup", "upper"]) == {
        "cup": "plate.plate",
        "upper": "plate.plate",
    }
    assert find_supported_objects(stacked.objects, {"cup": {"cup"}}, ["cup", "upper"]) == {
        "upper": "cup.cup"
    }
    assert find_supported_objects(stacked.objects, {"plate": {"post"}}, ["cup", "upper"]) == {}
    # The object between them is grasped.
    assert find_supported_objects(stacked.objects, {"plate": {"plate"}}, ["upper"]) == {}


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.1, 1.5, 3.0])
def test_tilt_ignores_the_heading(angle: float) -> None:
    rng = np.random.default_rng(3)
    pin.seed(0)
    before = pin.SE3.Random()
    first, last = (pin.utils.rotate("z", rng.uniform()) for _ in range(2))
    leaning = pin.SE3(first @ pin.utils.rotate("x", angle) @ last, rng.normal(size=3))
    assert compute_tilt(before, leaning * before) == pytest.approx(angle, abs=1e-9)
