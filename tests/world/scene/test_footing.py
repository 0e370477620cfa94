"""Tests how objects stand where they are released."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.blocks import ABOVE, TABLE, TOP, describe_block, make_block_scene
from helpers.carrying import describe_box

from vkc_pin import Scene
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.footing import Footing, find_footing
from vkc_pin.world.scene.placed_object import make_world_shapes


def measure(scene: Scene, name: str = "block", load: Sequence[str] = ()) -> Footing:
    """Return the footing of an object, where it is in a scene."""
    others = [
        (f"{other}.{get_link_name(shape.name)}", shape)
        for other, placed in scene.objects.items()
        if other not in (name, *load)
        for shape in make_world_shapes(placed)
    ]
    others += zip(scene.obstacle_labels, scene.obstacles, strict=True)
    return find_footing(scene.objects[name], others, [scene.objects[one] for one in load])


def put(at: Sequence[float], **block: Any) -> Footing:
    return measure(make_block_scene(describe_block(at=at, **block)))


@pytest.mark.parametrize(
    ("height", "fall", "below"),
    [
        (TOP + 0.003, 0.003, "table"),
        (TOP + 0.2, 0.2, "table"),
        (0.05, 0.05, "floor"),
    ],
)
def test_free_fall_is_measured(height: float, fall: float, below: str) -> None:
    footing = put([1.0, 0.0, height])
    assert footing.supports == ()
    assert footing.height == pytest.approx(fall, abs=1e-6)
    assert footing.below == below
    assert not footing.is_stable()


def test_nothing_may_be_below() -> None:
    scene = make_block_scene(describe_block(at=[0.0, 1.0, 0.5]), floor=False)
    footing = measure(scene)
    assert footing.height == np.inf
    assert str(footing) == "it is in mid-air, with nothing below"


@pytest.mark.parametrize("gap", [0.0, 1e-3, 2.4e-3])
def test_block_rests_within_the_contact_tolerance(gap: float) -> None:
    footing = put([1.0, 0.0, TOP + gap])
    assert footing == Footing(("table",), overhang=pytest.approx(0.0, abs=1e-6))
    assert footing.is_stable()


@pytest.mark.parametrize(
    ("y", "overhang"), [(0.2, 0.0), (0.298, 0.0), (0.305, 0.005), (0.32, 0.02), (-0.31, 0.01)]
)
def test_block_tips_over_an_edge(y: float, overhang: float) -> None:
    """Its side is 60 mm long, and the edge of the table is at 0.3 m."""
    footing = put([1.0, y, TOP + ABOVE])
    assert footing.supports == ("table",)
    assert footing.overhang == pytest.approx(overhang, abs=1e-6)
    assert footing.is_stable() == (overhang == 0.0)


@pytest.mark.parametrize(("shift", "overhang"), [(-0.02, 0.0), (0.0, 0.01), (0.02, 0.03)])
def test_centre_of_mass_decides(shift: float, overhang: float) -> None:
    """It need not be the middle of the shapes."""
    footing = put([1.0, 0.31, TOP + ABOVE], centre=(0.0, shift, 0.0))
    assert footing.overhang == pytest.approx(overhang, abs=1e-6)


def test_middle_of_the_shapes_counts_without_a_mass() -> None:
    assert put([1.0, 0.32, TOP + ABOVE], mass=None).overhang == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize("gap", [0.04, 0.1, 0.19])
def test_two_supports_bridge_a_gap(gap: float) -> None:
    """A plank of 0.2 m lies on two tables, and its middle on neither."""
    tables = [
        describe_box(name, [0.4, 0.4, 0.02], [1.0, side * (0.2 + gap / 2), TOP - 0.01])
        for name, side in (("left", 1), ("right", -1))
    ]
    block = describe_block(size=(0.1, 0.2, 0.02))
    footing = measure(make_block_scene(block, obstacles=tables))
    assert footing.supports == ("left", "right")
    assert footing.is_stable()


def test_three_posts_support_only_what_is_between_them() -> None:
    """Their hull is a triangle, whose corner towards −x, −y is missing."""
    posts = [
        describe_box(f"post_{k}", [0.02, 0.02, TOP], [1.0 + x, y, TOP / 2])
        for k, (x, y) in enumerate([(0.1, 0.1), (0.1, -0.1), (-0.1, 0.1)])
    ]
    board = {"size": (0.4, 0.4, 0.02)}
    inside, outside = (
        measure(make_block_scene(describe_block(**board, centre=(c, c, 0.0)), obstacles=posts))
        for c in (0.03, -0.06)
    )
    assert len(inside.supports) == len(outside.supports) == 3
    assert inside.is_stable()
    assert not outside.is_stable()


def test_load_counts() -> None:
    """A board of 1 kg reaches 0.14 m beyond the edge, with a block of 1 kg at its end."""
    board = describe_block("board", size=(0.1, 0.4, 0.02), mass=1.0, at=[1.0, 0.24, TOP + ABOVE])
    weight = describe_block(mass=1.0, at=[1.0, 0.41, TOP + 0.02 + 2 * ABOVE])
    scene = make_block_scene(board, weight)
    assert measure(scene, "board").is_stable()
    loaded = measure(scene, "board", ["block"])
    assert loaded.overhang == pytest.approx((0.24 + 0.41) / 2 - 0.3, abs=1e-6)


def test_block_rests_on_objects() -> None:
    lower = describe_block("lower", size=(0.2, 0.2, 0.05))
    scene = make_block_scene(lower, describe_block(at=[1.0, 0.0, TOP + 0.05 + 2 * ABOVE]))
    assert measure(scene).supports == ("lower.body",)
    assert measure(scene, "lower").supports == ("table",)


def test_block_that_lies_on_its_side_rests() -> None:
    scene = make_block_scene()
    placed = scene.objects["block"]
    turn = pin.exp3(np.array([np.pi / 2, 0.0, 0.0]))
    flat = pin.SE3(turn, np.array([1.0, 0.0, TOP + 0.03 + ABOVE]))
    others = zip(scene.obstacle_labels, scene.obstacles, strict=True)
    footing = find_footing(dataclasses.replace(placed, placement=flat), others)
    assert footing.is_stable()


@pytest.mark.parametrize(
    ("kind", "height"),
    [("ball", 0.035), ("cup", 0.0), ("bowl", 0.0), ("stick", 0.05), ("broom", 0.0)],
)
def test_included_objects_stand(kind: str, height: float) -> None:
    entry = {"name": "block", "type": kind, "position": [1.0, 0.0, TOP + height + ABOVE]}
    table = describe_box("table", [1.0, 1.0, 0.02], [1.0, 0.0, TOP - 0.01])
    assert measure(make_block_scene(entry, obstacles=[table])).is_stable()
    assert not measure(make_block_scene({**entry, "position": [1.0, 0.0, 2.0]})).supports


def test_wall_beside_it_supports_nothing() -> None:
    wall = describe_box("wall", [0.02, 0.6, 0.6], [1.0 + 0.03 + 0.01, 0.0, 1.2])
    footing = measure(make_block_scene(describe_block(at=[1.0, 0.0, 1.1]), obstacles=[TABLE, wall]))
    assert footing.supports == ()
    assert footing.below == "table"
