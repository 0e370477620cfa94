"""Tests scenes: their contents, changed copies, and random starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.rooms import TINY, load_scene_text

from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.scene import Scene, load_scene


@pytest.fixture(scope="module")
def door() -> Scene:
    return load_scene("door")


def test_with_methods_reject_invalid_values(door: Scene) -> None:
    with expect_error("base: wrong number of values"):
        door.with_start(base=[0.0, 1.0])
    with expect_error("arm: wrong number of values"):
        door.with_start(arm=[0.0])
    with expect_error(r"base\.base_x: not a finite number"):
        door.with_start(base=[np.nan, 0.0, 0.0])
    with expect_error("outside the joint's limits"):
        door.with_start(arm=[100.0, *door.robot.home[1:]])
    with expect_error(nearest="door"):
        door.with_state("dor", {"hinge": 0.0})
    with expect_error(nearest="hinge"):
        door.with_state("door", {"hing": 0.0})
    with expect_error(
        r"door\.hinge: outside the joint's limits \(expected -1\.57 to 1\.57, got 2\)"
    ):
        door.with_state("door", {"hinge": 2.0})


def test_values_are_clamped_to_limits_within_rounding(door: Scene) -> None:
    assert door.with_state("door", {"hinge": 1.57 + 1e-8}).objects["door"].state[0] == 1.57
    arm = door.robot.upper[3:] + 1e-8
    np.testing.assert_array_equal(door.with_start(arm=arm).start[3:], door.robot.upper[3:])


def test_fixed_base_starts_anywhere_in_the_arena(tmp_path: Path) -> None:
    scene = load_scene_text(
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
    none = load_scene_text(
        tmp_path, TINY.replace("start_region: {x: [-1, 1], y: [-1, 1], yaw: any}\n", "")
    )
    with expect_error("no start region"):
        none.sample_start(rng)
    text = TINY.replace("x: [-1, 1], y: [-1, 1]", "x: [2, 2.1], y: [2, 2.1]")
    full = load_scene_text(
        tmp_path,
        text[: text.index("objects:")]
        + text[text.index("obstacles:") : text.index("  - name: post")],
    )
    with expect_error("no collision-free start"):
        full.sample_start(rng)


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


def test_start_limits_are_infinite_for_a_fixed_base() -> None:
    robot, fixed = load_robot("husky_ur5e"), load_robot("husky_ur5e", base="fixed")
    for found, expected in zip(robot.start_limits, (robot.lower, robot.upper), strict=True):
        np.testing.assert_array_equal(found, expected)
        assert found is not expected
    lower, upper = fixed.start_limits
    assert np.isneginf(lower[:3]).all()
    assert np.isposinf(upper[:3]).all()
    np.testing.assert_array_equal(lower[3:], fixed.lower[3:])


def test_random_starts_are_reproducible(door: Scene) -> None:
    one, same, other = (door.sample_start(np.random.default_rng(k)).start for k in (7, 7, 8))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
