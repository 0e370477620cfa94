from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.arm_urdf import write_arms

import vkc_pin as vkc
from vkc_pin.benchmarks.robot_object_matrix import reach
from vkc_pin.benchmarks.robot_object_matrix.reach import random_poses


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> vkc.Robot:
    folder = tmp_path_factory.mktemp("robot")
    return vkc.load_robot(write_arms(folder), tool_frame="hand", height=0.35)


def test_poses_are_above_the_floor_and_the_seed_and_the_name_make_them(robot: vkc.Robot) -> None:
    poses = random_poses(robot, "one", 8)
    assert all(pose.translation[2] > vkc.Options().dist_safe for pose in poses)
    again, other, later = (
        random_poses(robot, *given, seed=seed)
        for *given, seed in (("one", 8, 0), ("two", 8, 0), ("one", 8, 1))
    )
    assert all(a.isApprox(b, 0.0) for a, b in zip(poses, again, strict=True))
    for others in (other, later):
        assert not any(a.isApprox(b, 1e-3) for a in poses for b in others)
    assert all(
        a.isApprox(b, 0.0) for a, b in zip(poses, random_poses(robot, "one", 3), strict=False)
    ), "more of them begin alike"


def test_configurations_that_are_not_free_are_none(robot: vkc.Robot) -> None:
    """As coal has it through Pinocchio: margins between links, and the arm off the floor."""
    free, rng = reach._Free(robot), np.random.default_rng(3)
    data, geometry, found = robot.model.createData(), robot.collision.createData(), []
    margins = robot.own_margins(vkc.Options().self_distance)
    low, high = robot.lower.copy(), robot.upper.copy()
    low[2], high[2] = -np.pi, np.pi
    for _ in range(60):
        z = rng.uniform(low, high)
        pin.computeDistances(robot.model, data, robot.collision, geometry, robot.coordinates.q(z))
        pairs = robot.collision.collisionPairs
        apart = all(
            result.min_distance >= margins[pair.first, pair.second] - 1e-9
            for pair, result in zip(pairs, geometry.distanceResults, strict=True)
        )
        lowest = min(
            float(np.asarray(geometry.oMg[k].act(corner))[2])
            for k, shape in enumerate(robot.collision.geometryObjects)
            if shape.parentJoint > 1
            for corner in _corners(shape)
        )
        found.append(free(z))
        assert found[-1] == (apart and lowest >= vkc.Options().dist_safe)
    assert 0 < sum(found) < len(found)


def test_a_robot_that_is_never_free_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reach, "_TRIES", 20)
    buried = vkc.load_robot(write_arms(tmp_path), tool_frame="hand", height=-3.0)
    with pytest.raises(vkc.VkcError, match="buried: only 0 of 40 random configurations"):
        random_poses(buried, "buried", 2)


def _corners(shape: pin.GeometryObject) -> list[np.ndarray]:
    half = np.asarray(shape.geometry.halfSide)
    return [
        half * np.array(signs)
        for signs in np.ndindex(2, 2, 2)
        for signs in [[2 * s - 1 for s in signs]]
    ]
