"""Tests the arguments of steps, their conversion to data, and their errors."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error

from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.task.steps import (
    Actuate,
    GoTo,
    Grasp,
    Place,
    Reach,
    Release,
    Step,
    Touch,
    step_from_dict,
    step_to_dict,
)

TURN = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("pose", [TURN, TURN.homogeneous, [1.0, 2.0, 3.0, 0.1, -0.2, 0.3]])
def test_poses_and_points_are_converted_and_copied(pose: Any) -> None:
    for found in (as_placement(pose), Reach(pose).pose, Touch("stick.tip", pose).target):
        np.testing.assert_allclose(found.homogeneous, TURN.homogeneous, atol=1e-15)
    point, own = np.array([1, -2, 3]), pin.SE3(TURN)
    steps = Place("stick", point), Reach(own)
    point[:], own.translation[:] = 0, 0.0
    assert steps[0].pose == (1.0, -2.0, 3.0)
    assert {type(value) for value in steps[0].pose} == {float}
    assert steps[1].pose == TURN


def corrupt(row: int, column: int, value: float) -> np.ndarray:
    matrix = TURN.homogeneous.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("pose", "problem"),
    [
        ("here", "not a pose"),
        ([1.0, 2.0, 3.0], "not a pose"),
        ([1.0, 2.0, 3.0, 0.0, 0.0, np.nan], "not finite"),
        (corrupt(0, 3, np.inf), "not finite"),
        (pin.SE3(np.eye(3), np.array([np.nan, 0.0, 0.0])), "not finite"),
        (corrupt(0, 0, 0.5), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rotation"),
        (corrupt(3, 3, 0.0), "last row"),
    ],
)
def test_invalid_poses_are_rejected(pose: Any, problem: str) -> None:
    with expect_error(problem, field="Reach.pose"):
        Reach(pose)
    with expect_error(field="target"):
        as_placement(pose, name="target")


@pytest.mark.parametrize(
    ("joints", "field"),
    [
        ({}, "Actuate.joints"),
        ([("hinge", 1.2)], "Actuate.joints"),
        ({"hinge": "wide"}, "Actuate.joints['hinge']"),
        ({"knob": 0.1, "hinge": np.nan}, "Actuate.joints['hinge']"),
    ],
)
def test_invalid_joints_are_rejected(joints: Any, field: str) -> None:
    with expect_error(field=field):
        Actuate("door", joints)


@pytest.mark.parametrize(
    ("target", "problem"),
    [
        ("here", "not a pose"),
        ([1.0, 2.0], "not a pose"),
        (np.zeros((3, 1)), "not a pose"),
        ([0.0, np.nan, 0.0], "not finite"),
        (corrupt(0, 0, 0.5), "not a rotation"),
    ],
)
def test_invalid_targets_are_rejected(target: Any, problem: str) -> None:
    for make, field in (
        (lambda: Touch("stick.tip", target), "Touch.target"),
        (lambda: Place("stick", target), "Place.pose"),
    ):
        with expect_error(problem, field=field):
            make()


@pytest.mark.parametrize("field", ["x", "y", "yaw"])
@pytest.mark.parametrize("value", ["there", np.nan, [1.0, 2.0]])
def test_invalid_base_goals_are_rejected(field: str, value: Any) -> None:
    with expect_error(field=f"GoTo.{field}"):
        GoTo(**{"x": 0.0, "y": 0.0, "yaw": 0.0, field: value})


def test_numbers_are_converted_to_floats() -> None:
    step = GoTo(np.float32(1.0), np.int64(2), np.float64(3.0))  # type: ignore[arg-type]
    assert [type(value) for value in vars(step).values()] == [float] * 3
    assert {
        type(value) for value in Actuate("door", {"hinge": np.float32(1.0)}).joints.values()
    } == {float}
    json.dumps([step_to_dict(step)])


@pytest.mark.parametrize(
    "step",
    [
        Reach(TURN, "wrist_3_link"),
        Grasp("door"),
        Grasp("ball", "pull", "stick.tip"),
        Touch("stick.tip", (1.0, 2.0, -3.0)),
        Touch("tool", TURN),
        Place("stick", [1.0, 2.0, 3.0]),
        Place("stick", TURN, "end"),
        Release(),
        Actuate("door", {"hinge": 1.2, "knob": 0.1}, "handle"),
        GoTo(1.0, -2.0),
    ],
)
def test_steps_survive_a_round_trip_through_data(step: Step) -> None:
    again = step_from_dict(json.loads(json.dumps(step_to_dict(step))))
    assert type(again) is type(step)
    assert step_to_dict(again) == step_to_dict(step)
    assert again == step


@pytest.mark.parametrize(
    ("data", "field", "nearest"),
    [
        ({"step": "Actuat", "object": "door"}, "step", "Actuate"),
        ({"object": "door"}, "step", None),
        ({"step": "Grasp", "objects": "door"}, "Grasp.objects", "object"),
        ({"step": "GoTo", "x": 0.0, "y": 0.0, "jaw": 0.0}, "GoTo.jaw", "yaw"),
    ],
)
def test_unknown_names_in_data_are_rejected(
    data: dict[str, Any], field: str, nearest: str | None
) -> None:
    with expect_error(field=field, nearest=nearest):
        step_from_dict(data)


@pytest.mark.parametrize(
    ("data", "field"),
    [
        ({"step": "GoTo", "x": 1.0}, "GoTo.y"),
        ({"step": "Place", "pose": [0.0, 0.0, 0.0]}, "Place.object"),
    ],
)
def test_incomplete_data_is_rejected(data: dict[str, Any], field: str) -> None:
    with expect_error(field=field):
        step_from_dict(data)
