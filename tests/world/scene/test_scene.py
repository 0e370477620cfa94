"""Tests scenes: their contents, changed copies, and random starts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import make_hall
from helpers.expected_errors import expect_error
from helpers.rooms import TINY, load_scene_text

from vkc_pin import Scene, load_scene
from vkc_pin.world.models.shapes import LIMIT_SLACK
from vkc_pin.world.scene.placed_object import make_world_shapes


@pytest.fixture(scope="module")
def door() -> Scene:
    return load_scene("door")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.with_start(base=[0.0, 1.0]), "base: wrong number of values"),
        (lambda s: s.with_start(arm=[0.0]), "arm: wrong number of values"),
        (lambda s: s.with_start(base=[np.nan, 0, 0]), r"base\.base_x: not a finite number"),
        (lambda s: s.with_start(arm=[100.0, *s.robot.home[1:]]), "outside the joint's limits"),
        (lambda s: s.with_state("dor", {"hinge": 0.0}), "did you mean 'door'"),
        (lambda s: s.with_state("door", {"hing": 0.0}), r"door\.hing: .*did you mean 'hinge'"),
        (
            lambda s: s.with_state("door", {"hinge": 2.0}),
            r"door\.hinge: outside the joint's limits \(expected -1\.57 to 1\.57, got 2\)",
        ),
        (lambda s: s.with_state("door", {"hinge": np.nan}), r"door\.hinge: "),
        (lambda s: s.with_state("door", {"hinge": 1.57 + 3 * LIMIT_SLACK}), "outside"),
    ],
)
def test_invalid_changes_are_rejected(
    door: Scene, change: Callable[[Scene], Scene], message: str
) -> None:
    with expect_error(message):
        change(door)


def test_values_are_clamped_to_limits_within_rounding(door: Scene) -> None:
    assert door.with_state("door", {"hinge": 1.57 + 1e-8}).objects["door"].state[0] == 1.57
    for limits, sign in ((door.robot.lower, -1.0), (door.robot.upper, 1.0)):
        arm = door.with_start(arm=limits[3:] + sign * 1e-8).start[3:]
        np.testing.assert_array_equal(arm, limits[3:])


def test_world_shapes_follow_the_joints(tmp_path: Path) -> None:
    scene = load_scene_text(tmp_path, TINY)
    placed = scene.with_state("front", {"knob": 0.5}).objects["front"]
    assert placed.state.tolist() == [0.3, 0.5]
    assert scene.objects["front"].state.tolist() == [0.3, 0.0]
    turn = pin.utils.rotate("z", 0.3)
    shapes = {s.name: s for s in make_world_shapes(placed)}
    middle = np.array([3.0, 0.0, 0.0]) + turn @ [0.0, -0.45, 1.01]
    np.testing.assert_allclose(shapes["panel_0"].placement.translation, middle, atol=1e-12)
    assert {s.parentJoint for s in shapes.values()} == {0}
    assert len(make_world_shapes(placed, visual=True)) == len(placed.object.visual.geometryObjects)


def test_fixed_base_starts_anywhere_in_the_arena(tmp_path: Path) -> None:
    scene = load_scene_text(
        tmp_path,
        TINY.replace("husky_ur5e", "{name: husky_ur5e, base: fixed}").replace(
            "0.0, 0.0, 0.5", "0.5, 0.2, 0.5"
        ),
    )
    np.testing.assert_array_equal(scene.start[:3], [0.5, 0.2, 0.5])
    np.testing.assert_array_equal(scene.with_start(base=[0.1, 0.2, 0.3]).start[:3], [0.1, 0.2, 0.3])


@pytest.mark.parametrize("base", [(-1.5, -1.5), (2.2, 0.0)], ids=["sofa", "door"])
def test_start_clearance_includes_obstacles_and_objects(
    door: Scene, base: tuple[float, float]
) -> None:
    assert door.with_start(base=[*base, 0.0]).start_clearance() < -0.1


@pytest.mark.long
def test_sampling_needs_a_free_start_region(tmp_path: Path) -> None:
    region = "start_region: {x: [-1, 1], y: [-1, 1], yaw: any}\n"
    for other, message in (
        ("", "no start region"),
        ("start_region: {x: [2, 2.1], y: [2, 2.1]}\n", "no collision-free start"),
    ):
        scene = load_scene_text(tmp_path, TINY.replace(region, other))
        with expect_error(message):
            scene.sample_start(np.random.default_rng(0))


@pytest.mark.parametrize("interval", [(-4.0, 4.0), (1.0, 1.0)])
def test_start_region_may_fill_the_arena_or_be_a_point(
    tmp_path: Path, interval: tuple[float, float]
) -> None:
    low, high = interval
    scene = load_scene_text(tmp_path, TINY.replace("{x: [-1, 1]", f"{{x: [{low}, {high}]"))
    assert scene.start_region is not None
    assert tuple(scene.start_region.x) == interval


def test_start_is_sampled_with_free_held_objects_only(tmp_path: Path) -> None:
    stick = "  - {name: pole, type: stick, position: [0, 0, 0.05]}\n"
    for held, is_valid in (("{pole: end}", True), ("{front: handle}", False)):
        text = TINY.replace("arm: home\n", f"arm: home\n  held: {held}\n")
        scene = load_scene_text(tmp_path, text.replace("objects:\n", f"objects:\n{stick}"))
        if is_valid:
            assert scene.sample_start(np.random.default_rng(0)).held == {"pole": "end"}
        else:
            with expect_error(r"start\.held\.front"):
                scene.sample_start(np.random.default_rng(0))


def test_scene_is_described_by_what_it_has() -> None:
    assert repr(load_scene("door")).startswith("<Scene door: husky_ur5e, objects door, ")
    assert repr(make_hall()).endswith("objects none, 0 obstacles>")
