"""Tests random starts, and limits of the start."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.scene_schema import RegionSchema


@pytest.mark.parametrize("yaw", [None, (0.5, 0.7)])
def test_samples_fill_the_region(yaw: tuple[float, float] | None) -> None:
    low, high = np.array([-1.0, 2.0, -np.pi]), np.array([3.0, 2.5, np.pi])
    if yaw is not None:
        low[2], high[2] = yaw
    rng = np.random.default_rng(0)
    drawn = np.array(
        list(
            itertools.islice(
                RegionSchema(x=(-1.0, 3.0), y=(2.0, 2.5), yaw=yaw).sample_poses(rng), 2000
            )
        )
    )
    assert ((drawn >= low) & (drawn <= high)).all()
    shares = (drawn - low) / (high - low)
    counts = np.array([np.histogram(column, 4, (0.0, 1.0))[0] for column in shares.T])
    assert (np.abs(counts - 500) < 100).all(), "evenly: five standard deviations are 97"
    assert (np.abs(np.corrcoef(shares.T) - np.eye(3)) < 0.1).all()


def test_samples_are_reproducible() -> None:
    region = RegionSchema(x=(0.0, 1.0), y=(0.0, 1.0))
    one, other = (next(region.sample_poses(np.random.default_rng(5))) for _ in range(2))
    np.testing.assert_array_equal(one, other)


def test_limits_of_a_start_are_the_robots_unless_its_base_cannot_move() -> None:
    robot, fixed = load_robot("husky_ur5e"), load_robot("husky_ur5e", base="fixed")
    for mine, its in zip(robot.start_limits, (robot.lower, robot.upper), strict=True):
        np.testing.assert_array_equal(mine, its)
        assert mine is not its
    lower, upper = fixed.start_limits
    assert np.isneginf(lower[:3]).all()
    assert np.isposinf(upper[:3]).all()
    np.testing.assert_array_equal(lower[3:], fixed.lower[3:])
    np.testing.assert_array_equal(fixed.lower[:3], fixed.upper[:3])  # which stays as it was
