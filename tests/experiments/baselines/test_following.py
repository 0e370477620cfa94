"""Tests that the arm follows base and object: closed, collision-free and continuous."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from helpers.drawers import (
    SHORT,
    add_boxes,
    compute_handle_pose,
    compute_pose_error,
    compute_spare_clearance,
    make_grasping_scene,
)
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.experiments.baselines.following import CLEAR, FollowResult, follow
from vkc_pin.planning.initialization.keyframes import sample_smoothstep
from vkc_pin.planning.nlp.merit import TOLERANCE

ROUNDING = 1e-6  # [m]
CLOSED = np.sqrt(3.0) * TOLERANCE  # [m]: the tolerance is per coordinate
GOAL = 0.3  # [m]


def make_problem(lamp: float | None = None, attachment: str = "handle") -> vkc.TrajectoryProblem:
    """Return the problem of pulling the drawer under a lamp at height `lamp` [m]."""
    scene = make_grasping_scene(attachment=attachment)
    if lamp is not None:
        scene = add_boxes(scene, lamp=([0.3, 0.3, 0.1], [1.44, 0.0, lamp + 0.05]))
    return make_program(scene, [vkc.Actuate("drawer", {"slide": GOAL})], options=SHORT)


def make_base_path(problem: vkc.TrajectoryProblem, *change: float) -> np.ndarray:
    """Return a straight base path with given changes of x, y and yaw."""
    share = np.arange(1, problem.segments + 1)[:, None] / problem.segments
    return np.asarray(problem.start[:3] + share * np.array(change or (0.0, 0.0, 0.0)))


def follow_path(
    problem: vkc.TrajectoryProblem, base_path: np.ndarray, *, refine: bool = False, seed: int = 0
) -> FollowResult:
    return follow(problem, base_path, np.random.default_rng(seed), refine=refine)


def check_closed_and_free(problem: vkc.TrajectoryProblem, rows: np.ndarray) -> None:
    slide = problem.chain.index("drawer.slide")
    for row in rows:
        handle = compute_handle_pose(row[slide], tilt=row[slide - 1] if len(row) == 11 else 0.0)
        assert compute_pose_error(problem.scene, row, handle) < CLOSED
        clearance = compute_spare_clearance(problem.scene, row, slide=row[slide], held=True)
        assert clearance >= -CLEAR - ROUNDING
        assert np.all((row >= problem.lower.min(axis=0)) & (row <= problem.upper.max(axis=0)))


@pytest.mark.parametrize("refine", [False, True], ids=["B1", "B2"])
@pytest.mark.parametrize("change", [(-0.25, 0.0, 0.0), (0.0, -0.3, 0.2)], ids=["back", "aside"])
def test_arm_follows_the_whole_base_path(change: Sequence[float], refine: bool) -> None:
    problem = make_problem()
    base_path = make_base_path(problem, *change)
    result = follow_path(problem, base_path, refine=refine)
    assert (result.cause, result.share) == ("", 1.0)
    check_closed_and_free(problem, result.z)
    np.testing.assert_array_equal(result.z[:, :3], base_path)
    np.testing.assert_array_equal(result.z[:, -1], GOAL * sample_smoothstep(8))
    assert np.abs(np.diff(problem.waypoints(result.z)[:, 3:9], axis=0)).max() < 0.6, (
        "the arm moves continuously"
    )


def test_following_ends_where_the_base_is_out_of_reach() -> None:
    problem = make_problem()
    base_path = make_base_path(problem, -0.6, 0.0, 0.0)
    result = follow_path(problem, base_path)
    assert result.cause == "no inverse kinematics"
    count = round(8 * result.share)
    assert result.share == count / 8
    assert 0 < count < 8
    assert result.z.shape == (8, problem.chain.size)
    check_closed_and_free(problem, result.z[:count])
    np.testing.assert_array_equal(result.z[:count, :3], base_path[:count])
    # The other waypoints repeat the first configuration that misses the handle.
    np.testing.assert_array_equal(result.z[count:], np.tile(result.z[count], (8 - count, 1)))
    assert (
        compute_pose_error(problem.scene, result.z[count], compute_handle_pose(result.z[count, -1]))
        > 1e-3
    )


@pytest.mark.parametrize("refine", [False, True], ids=["B1", "B2"])
def test_following_ends_at_an_unavoidable_collision(refine: bool) -> None:
    """At the end the drawer itself would touch the lamp."""
    problem = make_problem(0.9)
    result = follow_path(problem, make_base_path(problem), refine=refine)
    assert result.cause == "collision"
    count = round(8 * result.share)
    assert 0.5 <= result.share < 1.0
    check_closed_and_free(problem, result.z[:count])
    colliding = result.z[count]
    assert (
        compute_pose_error(problem.scene, colliding, compute_handle_pose(colliding[-1])) < CLOSED
    ), "the chain is still closed"
    assert compute_spare_clearance(problem.scene, colliding, slide=colliding[-1], held=True) < -1e-3
    np.testing.assert_array_equal(result.z[count:], np.tile(colliding, (8 - count, 1)))


def test_random_arm_configurations_are_tried_after_a_collision() -> None:
    problem = make_problem(0.92)
    one, same, other = (
        follow_path(problem, make_base_path(problem), seed=seed) for seed in (0, 0, 1)
    )
    assert (one.cause, one.share) == ("", 1.0)
    check_closed_and_free(problem, one.z)
    steps = np.abs(np.diff(problem.waypoints(one.z)[:, 3:9], axis=0))
    assert steps.max() > 0.6, "no random arm configuration was needed"
    np.testing.assert_array_equal(one.z, same.z)
    assert not np.array_equal(one.z, other.z)


def test_only_b2_moves_the_object_off_its_time_law() -> None:
    problem = make_problem(0.94, "handle_free")
    law = GOAL * sample_smoothstep(8)
    plain, refined = (
        follow_path(problem, make_base_path(problem), refine=refine) for refine in (False, True)
    )
    assert (plain.cause, refined.cause) == ("", "")
    check_closed_and_free(problem, plain.z)
    check_closed_and_free(problem, refined.z)
    np.testing.assert_array_equal(plain.z[:, -1], law)
    assert np.abs(refined.z[:, -1] - law).max() > 0.005
    assert refined.z[-1, -1] == GOAL
    np.testing.assert_array_equal(refined.z[:, :3], make_base_path(problem))
