from __future__ import annotations

import pytest
from helpers.arm_urdf import write_arms

import vkc_pin as vkc
from vkc_pin.benchmarks.robot_object_matrix.robots import sample_reachable_poses


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> vkc.Robot:
    folder = tmp_path_factory.mktemp("robot")
    return vkc.load_robot(write_arms(folder), tool_frame="hand", height=0.35)


def test_poses_are_above_the_floor_and_reproducible(robot: vkc.Robot) -> None:
    poses = sample_reachable_poses(robot, "one", 8)
    assert all(pose.translation[2] > vkc.Options().dist_safe for pose in poses)
    same, other_name, other_seed = (
        sample_reachable_poses(robot, *arguments, seed=seed)
        for *arguments, seed in (("one", 8, 0), ("two", 8, 0), ("one", 8, 1))
    )
    assert all(a.isApprox(b, 0.0) for a, b in zip(poses, same, strict=True))
    for others in (other_name, other_seed):
        assert not any(a.isApprox(b, 1e-3) for a in poses for b in others)
    assert all(
        a.isApprox(b, 0.0)
        for a, b in zip(poses, sample_reachable_poses(robot, "one", 3), strict=False)
    ), "a smaller sample is the beginning of a larger one"
