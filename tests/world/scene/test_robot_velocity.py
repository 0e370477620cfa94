"""Tests the velocity with which the robot of a scene starts, in Python and in scene files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.expected_errors import expect_error
from helpers.small_problems import load_door_scene

import vkc_pin as vkc

VELOCITY = {"base_x": 0.2, "elbow_joint": -0.1}


def test_start_is_at_rest_by_default() -> None:
    scene = load_door_scene()
    np.testing.assert_array_equal(scene.start_velocity, np.zeros(len(scene.start)))
    assert "velocity" not in scene.document["start"]
    assert scene.with_start(velocity={}).document == scene.document


def test_velocities_are_given_by_name_or_for_all_coordinates() -> None:
    scene = load_door_scene()
    named = scene.with_start(velocity=VELOCITY)
    names = scene.robot.coordinates.names
    expected = [VELOCITY.get(name, 0.0) for name in names]
    np.testing.assert_array_equal(named.start_velocity, expected)
    listed = scene.with_start(velocity=expected)
    np.testing.assert_array_equal(listed.start_velocity, expected)
    np.testing.assert_array_equal(named.with_start(base=[0.0, 0.0, 1.0]).start_velocity, expected)
    assert not named.with_robot("husky_ur5e").start_velocity.any()


def test_velocity_is_written_and_read(tmp_path: Path) -> None:
    scene = load_door_scene().with_start(velocity=VELOCITY)
    document = json.loads(json.dumps(scene.document))
    assert document["start"]["velocity"] == VELOCITY
    again = vkc.Scene.from_document(document, scene.folder)
    np.testing.assert_array_equal(again.start_velocity, scene.start_velocity)
    assert again.document == scene.document
    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(document))
    np.testing.assert_array_equal(vkc.load_scene(file).start_velocity, scene.start_velocity)


@pytest.mark.parametrize(
    ("velocity", "message"),
    [
        ({"base_x": float("nan")}, "velocity.base_x"),
        ([0.2, float("inf"), *[0.0] * 7], "velocity.base_y"),
        ({"base_x": 3.0}, "velocity.base_x: faster than the joint's limit"),
        ([0.1, 0.2], "velocity: wrong number of values"),
        ({"elbow": 0.1}, "did you mean 'elbow_joint'"),
        ("fast", "velocity: not numbers"),
        ({"base_x": "fast"}, "velocity.base_x"),
    ],
)
def test_wrong_velocities_are_refused(velocity: Any, message: str) -> None:
    with expect_error(message):
        load_door_scene().with_start(velocity=velocity)


@pytest.mark.parametrize(
    ("base", "velocity", "message"),
    [
        ("fixed", {"base_x": 0.1}, "a fixed base does not move"),
        ("differential", {"base_y": 0.1}, "would slip sideways"),
        ("ackermann", {"base_x": 0.1, "base_yaw": 1.0}, "would turn more tightly"),
    ],
)
def test_bases_do_not_start_as_they_cannot_move(
    base: Any, velocity: dict[str, float], message: str
) -> None:
    radius = 1.0 if base == "ackermann" else None
    scene = load_door_scene().with_robot("husky_ur5e", base=base, turning_radius=radius)
    with expect_error(message):
        scene.with_start(base=[*scene.start[:2], 0.0], velocity=velocity)


def test_wrong_velocities_in_files_name_their_line(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    text = "robot: husky_ur5e\nstart:\n  base: [0, 0, 0]\n  velocity: {base_x: %s}\n"
    for value in ("9.0", ".nan", "fast"):
        file.write_text(text % value)
        with expect_error("scene.yaml.*start.velocity"):
            vkc.load_scene(file)
    file.write_text(text.replace("base_x", "base_z") % 0.1)
    with expect_error("scene.yaml.*did you mean"):
        vkc.load_scene(file)
