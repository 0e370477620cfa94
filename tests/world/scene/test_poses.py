"""Tests the conversion of poses and points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vkc_pin.world.scene.poses import as_placement, as_target

TURN = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([1.0, 2.0, 3.0]))


def corrupt(row: int, column: int, value: float) -> np.ndarray:
    matrix = TURN.homogeneous.copy()
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("pose", "problem"),
    [
        ("here", "not a pose"),
        (np.zeros((3, 1)), "not a pose"),
        (["0", "0", "0", "0", "0", "0"], "not a pose"),
        (range(0), "not a pose"),
        ([1.0, 2.0, 3.0, 0.0, 0.0, np.nan], "not finite"),
        (corrupt(0, 3, np.inf), "not finite"),
        (pin.SE3(np.eye(3), np.array([np.nan, 0.0, 0.0])), "not finite"),
        ([2e4, 0, 0, 0, 0, 0], "out of range"),
        ([0, 0, 0, 0, 1e300, 0], "out of range"),
        (TURN.homogeneous + 1e5, "out of range"),
        (corrupt(0, 0, 0.5), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rotation"),
        (corrupt(3, 3, 0.0), "last row"),
        ([0, 0, 0, 0, 0, 0, 0], r"not a rotation .*unit quaternion \(x, y, z, w\)"),
        ([0, 0, 0, 0, 0, 0, 0.99], "not a rotation"),
    ],
)
def test_invalid_poses_are_rejected(pose: Any, problem: str) -> None:
    for convert in (as_placement, as_target):
        with expect_error(problem, field="where"):
            convert(pose, name="where")


@pytest.mark.parametrize(
    ("point", "problem"), [((0.0, -2e4, 0.0), "out of range"), ((0.0, np.nan, 0.0), "not finite")]
)
def test_invalid_points_are_rejected(point: tuple[float, ...], problem: str) -> None:
    with expect_error(problem, field="where"):
        as_target(point, name="where")


@pytest.mark.parametrize("pose", [TURN, TURN.homogeneous, (1.0, 2.0, 3.0, 0.1, -0.2, 0.3)])
def test_three_numbers_are_a_point_and_other_inputs_a_pose(pose: Any) -> None:
    for found in (as_placement(pose), as_target(pose, name="where")):
        np.testing.assert_allclose(found, TURN, atol=1e-15)
    assert as_target(np.array([1, 2, 3]), name="where") == (1.0, 2.0, 3.0)
    with expect_error("not a pose"):
        as_placement([1.0, 2.0, 3.0])


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)
)
def test_seven_numbers_are_a_pose_with_a_quaternion_scalar_last(quaternion: list[float]) -> None:
    x, y, z, w = np.round(np.array(quaternion) / np.linalg.norm(quaternion), 4)  # as in files
    found = as_target((1.0, 2.0, 3.0, x, y, z, w), name="where")
    np.testing.assert_allclose(found.translation, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.rotation, Rotation([x, y, z, w]).as_matrix(), atol=1e-12)
