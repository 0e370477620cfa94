"""Tests starts from messages of ROS and MoveIt."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error

import vkc_pin as vkc


@pytest.fixture(scope="module")
def scene() -> vkc.Scene:
    return vkc.load_scene("drawer")


def make_transform(x: float, y: float, yaw: float, z: float = 0.0) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": turn}


def test_names_may_have_any_order(scene: vkc.Scene) -> None:
    names = scene.robot.coordinates.names[3:]
    values = scene.start[3:] + 0.05
    order = [4, 1, 0, 5, 2, 3]
    message = {
        "header": {"frame_id": ""},
        "name": [names[k] for k in order],
        "position": [float(values[k]) for k in order],
        "velocity": [],
        "effort": [],
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        moved = scene.with_joint_state(message)
    np.testing.assert_array_equal(moved.start[3:], values)
    np.testing.assert_array_equal(moved.start[:3], scene.start[:3])


def test_missing_joints_keep_their_start_and_others_are_named(scene: vkc.Scene) -> None:
    names = scene.robot.coordinates.names[3:]
    message = {"name": ["wheel", names[2], "finger"], "position": [3.0, -0.7, 0.01]}
    text = "joints that are not planned are left out: wheel, finger"
    with pytest.warns(UserWarning, match=text):
        moved = scene.with_joint_state(message)
    expected = scene.start.copy()
    expected[5] = -0.7
    np.testing.assert_array_equal(moved.start, expected)


def test_robot_state_of_moveit_places_the_base(scene: vkc.Scene) -> None:
    names = scene.robot.coordinates.names[3:]
    message = {
        "joint_state": {"name": [names[0]], "position": [0.3]},
        "multi_dof_joint_state": {
            "joint_names": ["world_joint"],
            "transforms": [make_transform(-0.5, 0.25, -2.0)],
        },
        "attached_collision_objects": [],
        "is_diff": False,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        moved = scene.with_joint_state(message)
    np.testing.assert_allclose(moved.start[:4], [-0.5, 0.25, -2.0, 0.3], atol=1e-12)
    message["multi_dof_joint_state"]["transforms"] = [make_transform(-0.5, 0.25, 0.0, 0.4)]
    message["attached_collision_objects"] = [{"link_name": "tool0"}]
    with (
        pytest.warns(UserWarning, match="the height of world_joint is left out"),
        pytest.warns(UserWarning, match="attached_collision_objects are left out"),
    ):
        scene.with_joint_state(message)


def make_base(**fields: Any) -> dict[str, Any]:
    base = {"joint_names": ["world_joint"], "transforms": [make_transform(0.0, 0.0, 0.0)]}
    return {"multi_dof_joint_state": {**base, **fields}}


TILTED = {"translation": {"x": 0, "y": 0}, "rotation": {"x": 0.6, "y": 0, "z": 0, "w": 0.8}}
LONG = {"translation": {"x": 0, "y": 0}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 2}}


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (3, "message: "),
        ({}, "the message has no joints"),
        ({"names": []}, "the message has no joints"),
        ({"name": ["a"], "position": []}, "wrong number .*expected 1 positions"),
        ({"name": ["a", "a"], "position": [0, 0]}, "a joint is named twice"),
        ({"name": ["a"], "position": ["x"]}, r"^position\[0\]: wrong value"),
        ({"name": ["a"], "position": [math.nan]}, r"position\[0\]: wrong value .*finite"),
        ({"name": ["elbow_joint"], "position": [9.0]}, r"arm\.elbow_joint: outside"),
        (make_base(joint_names=["a", "b"]), "wrong number .*expected 2 transforms"),
        (
            make_base(joint_names=["a", "b"], transforms=[TILTED, TILTED]),
            "several joints of many degrees of freedom",
        ),
        (make_base(transforms=[TILTED]), "rotation: the base is tilted .*got 1.29 rad"),
        (make_base(transforms=[LONG]), "rotation: not a rotation"),
        (make_base(transforms=[{"rotation": LONG["rotation"]}]), "translation: missing"),
    ],
)
def test_wrong_messages_are_named(scene: vkc.Scene, message: Any, error: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with expect_error(error):
            scene.with_joint_state(message)
