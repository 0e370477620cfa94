"""Tests that base poses satisfy the constraints, are collision-free and sorted by distance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from helpers.drawers import (
    SHORT,
    add_boxes,
    compute_handle_pose,
    compute_pose_error,
    compute_spare_clearance,
    load_drawer_scene,
    make_grasping_scene,
    replace_scene_fields,
)
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.experiments.baselines import postures
from vkc_pin.experiments.baselines.postures import find_base_poses


def make_reach(scene: vkc.Scene, attachment: str = "handle") -> vkc.TrajectoryProblem:
    return make_program(scene, [vkc.Grasp("drawer", attachment)], options=SHORT)


def find_poses(
    problem: vkc.TrajectoryProblem, *, seed: int = 0, near: np.ndarray | None = None
) -> np.ndarray:
    near = problem.start if near is None else near
    return find_base_poses(problem, problem.segments, near, np.random.default_rng(seed))


def check_poses(
    problem: vkc.TrajectoryProblem, rows: np.ndarray, *, slide: float = 0.0, held: bool = False
) -> None:
    """Check that the hand is at the handle, without collisions, in every row."""
    handle, scene = compute_handle_pose(slide), problem.scene
    assert len(rows) > 10
    for row in rows:
        assert compute_pose_error(scene, row, handle) < 1e-4 * np.sqrt(3)
        assert compute_spare_clearance(scene, row, slide=slide, held=held) >= -1e-6
    assert np.all(rows[:, -1] == slide)


@pytest.mark.parametrize("seed", range(2))
def test_arm_reaches_the_handle_from_all_poses(seed: int) -> None:
    problem = make_reach(load_drawer_scene())
    rows = find_poses(problem, seed=seed)
    assert rows.shape == (postures.ENOUGH, problem.chain.size)
    check_poses(problem, rows)
    assert np.all((rows >= problem.lower[-1]) & (rows <= problem.upper[-1]))
    assert np.ptp(rows[:, :2], axis=0).min() > 0.3, "the poses are spread"


def test_arm_reaches_the_moved_handle_from_all_poses() -> None:
    pull = vkc.Actuate("drawer", {"slide": 0.3})
    problem = make_program(make_grasping_scene(), [pull], options=SHORT)
    check_poses(problem, find_poses(problem), slide=0.3, held=True)


def test_poses_are_sorted_by_distance() -> None:
    problem = make_reach(load_drawer_scene(), "handle_free")
    near = problem.start.copy()
    near[:3] = [0.8, -0.6, 0.3]
    weights = np.ones(problem.chain.size)
    weights[:2] /= 0.3249  # [m/rad], the lever of this arm
    for reference in (problem.start, near):
        distances = np.abs(find_poses(problem, near=reference) - reference) @ weights
        assert np.all(np.diff(distances) >= 0.0)
        assert distances[-1] > distances[0] + 1.0
    assert not np.array_equal(find_poses(problem)[0], find_poses(problem, near=near)[0])


def raise_drawer() -> vkc.Scene:
    scene = load_drawer_scene()
    return replace_scene_fields(
        scene, objects=[{**scene.document["objects"][0], "position": [1.93, 0.0, 2.0]}]
    )


def add_board() -> vkc.Scene:
    return add_boxes(load_drawer_scene(), board=([0.02, 1.0, 1.2], [1.7, 0.0, 0.6]))


@pytest.mark.parametrize("make_scene", [raise_drawer, add_board])
def test_unreachable_handle_has_no_pose(
    make_scene: Callable[[], vkc.Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postures, "TRIES", 1000)
    problem = make_reach(make_scene())
    assert find_poses(problem).shape == (0, problem.chain.size)
