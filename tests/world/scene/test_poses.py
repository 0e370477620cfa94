"""Tests the conversion of poses and points; test_steps.py has further invalid ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.errors import InputError
from vkc_pin.world.scene.poses import as_placement, as_target


@pytest.mark.parametrize(
    "pose", [[2e4, 0, 0, 0, 0, 0], [0, 0, 0, 0, 1e300, 0], np.diag([1.0, 1.0, 1.0, 1.0]) + 1e5]
)
def test_distant_poses_are_rejected(pose: Any) -> None:
    for convert in (as_placement, as_target):
        with expect_error("out of range", field="where"):
            convert(pose, name="where")
    with expect_error("out of range"):
        as_target([0.0, -2e4, 0.0], name="where")


@pytest.mark.parametrize(
    "pose",
    [["0", "0", "0", "0", "0", "0"], [1j] * 6, [True] * 6, [10**5000] * 6, b"123456", range(0)],
)
def test_poses_that_are_not_numeric_are_rejected(pose: Any) -> None:
    for convert in (as_placement, as_target):
        with pytest.raises(InputError, match="not a pose") as caught:
            convert(pose, name="where")
        assert len(str(caught.value)) < 600


def test_three_numbers_are_a_point_and_six_a_pose() -> None:
    assert as_target(np.array([1, 2, 3]), name="where") == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(
        as_target((1, 2, 3, 0, 0, 0), name="where").translation, [1.0, 2.0, 3.0]
    )


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)
)
def test_seven_numbers_are_a_pose_with_a_quaternion_scalar_last(quaternion: list[float]) -> None:
    x, y, z, w = np.array(quaternion) / np.linalg.norm(quaternion)
    rounded = np.round([x, y, z, w], 4)  # four decimals, as in files
    found = as_target((1.0, 2.0, 3.0, *rounded), name="where")
    angle, axis = 2.0 * np.arctan2(np.linalg.norm([x, y, z]), w), np.array([x, y, z])
    np.testing.assert_allclose(found.translation, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    if np.linalg.norm(axis) > 1e-3:
        np.testing.assert_allclose(
            found.rotation, pin.AngleAxis(angle, axis / np.linalg.norm(axis)).matrix(), atol=1e-3
        )


@pytest.mark.parametrize(
    "quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.99)]
)
def test_quaternions_of_other_length_than_one_are_rejected(quaternion: tuple[float, ...]) -> None:
    for convert in (as_placement, as_target):
        with expect_error(r"not a rotation .*unit quaternion \(x, y, z, w\)"):
            convert((0.0, 0.0, 0.0, *quaternion), name="where")
