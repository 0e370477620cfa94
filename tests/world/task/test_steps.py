"""Tests the arguments of steps, their conversion to data, and their errors."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error

from vkc_pin.world.task.steps import (
    Actuate,
    Configure,
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


def test_poses_and_points_are_copied() -> None:
    point, own = np.array([1, -2, 3]), pin.SE3(TURN)
    place, reach = Place("stick", point), Reach(own)
    point[:], own.translation[:] = 0, 0.0
    assert place.pose == (1.0, -2.0, 3.0)
    assert {type(value) for value in place.pose} == {float}
    assert reach.pose == TURN


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
    ("joints", "tolerance", "field"),
    [
        ({}, 0.0, "Configure.joints"),
        ([1.0, 2.0], 0.0, "Configure.joints"),
        ({"elbow": np.nan}, 0.0, "Configure.joints['elbow']"),
        ({"elbow": 1.0}, -0.1, "Configure.tolerance"),
        ({"elbow": 1.0}, np.inf, "Configure.tolerance"),
        ({"elbow": 1.0}, {"elbow": -0.1}, "Configure.tolerance['elbow']"),
        ({"elbow": 1.0}, {"elbo": 0.1}, "Configure.tolerance"),
    ],
)
def test_invalid_joint_goals_are_rejected(joints: Any, tolerance: Any, field: str) -> None:
    with expect_error(field=field):
        Configure(joints, tolerance)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (Reach, "Reach.pose"),
        (lambda pose: Touch("stick.tip", pose), "Touch.target"),
        (lambda pose: Place("stick", pose), "Place.pose"),
    ],
)
def test_invalid_poses_are_rejected(make: Callable[[Any], Step], field: str) -> None:
    for pose, problem in (("here", "not a pose"), ([0.0] * 5 + [np.nan], "not finite")):
        with expect_error(problem, field=field):
            make(pose)


@pytest.mark.parametrize("field", ["x", "y", "yaw"])
@pytest.mark.parametrize("value", ["there", np.nan, [1.0, 2.0]])
def test_invalid_base_goals_are_rejected(field: str, value: Any) -> None:
    with expect_error(field=f"GoTo.{field}"):
        GoTo(**{"x": 0.0, "y": 0.0, "yaw": 0.0, field: value})


def test_numbers_are_converted_to_floats() -> None:
    step = GoTo(np.float32(1.0), np.int64(2), np.float64(3.0))  # type: ignore[arg-type]
    numbers = [*vars(step).values(), *Actuate("door", {"hinge": np.float32(1.0)}).joints.values()]
    assert {type(value) for value in numbers} == {float}


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
        Configure({"elbow_joint": 1.2, "base_x": 0.5}, 0.1),
        Configure({"elbow_joint": 1.2}, {"elbow_joint": 0.1}),
    ],
)
def test_steps_survive_a_round_trip_through_data(step: Step) -> None:
    again = step_from_dict(json.loads(json.dumps(step_to_dict(step))))
    assert again == step


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"step": "Actuat", "object": "door"}, "^step: .*did you mean 'Actuate'"),
        ({"object": "door"}, "^step: "),
        ({"step": "Grasp", "objects": "door"}, r"^Grasp\.objects: .*did you mean 'object'"),
        ({"step": "GoTo", "x": 0.0, "y": 0.0, "jaw": 0.0}, r"^GoTo\.jaw: .*did you mean 'yaw'"),
        ({"step": "GoTo", "x": 1.0}, r"^GoTo\.y: "),
        ({"step": "Place", "pose": [0.0, 0.0, 0.0]}, r"^Place\.object: "),
    ],
)
def test_invalid_data_is_rejected(data: dict[str, Any], message: str) -> None:
    with expect_error(message):
        step_from_dict(data)
