"""The arm follows base and object, waypoint by waypoint: closed, free and continuous."""

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
from vkc_pin.baselines.following import FollowResult, follow
from vkc_pin.baselines.refining import CLEAR
from vkc_pin.planning.initialization.keyframes import sample_smoothstep
from vkc_pin.planning.nlp.merit import TOLERANCE

STILL = 0.0
ROUNDING = 1e-6  # [m]
CLOSED = np.sqrt(3.0) * TOLERANCE  # [m]: it holds for each coordinate
GOAL = 0.3  # [m]


def make_problem(lamp: float | None = None, attachment: str = "handle") -> vkc.TrajectoryProblem:
    """Return the problem of pulling the drawer under a lamp at height `lamp` [m]."""
    scene = make_grasping_scene(attachment=attachment)
    if lamp is not None:
        scene = add_boxes(scene, lamp=([0.3, 0.3, 0.1], [1.44, 0.0, lamp + 0.05]))
    return make_program(scene, [vkc.Actuate("drawer", {"slide": GOAL})], options=SHORT)


def make_base_path(problem: vkc.TrajectoryProblem, *change: float) -> np.ndarray:
    """Return a straight path of the base, by its changes of x, y and yaw."""
    share = np.arange(1, problem.segments + 1)[:, None] / problem.segments
    return np.asarray(problem.start[:3] + share * np.array(change or (0.0, 0.0, 0.0)))


def follow_path(
    problem: vkc.TrajectoryProblem, way: np.ndarray, *, refine: bool = False, seed: int = 0
) -> FollowResult:
    return follow(problem, way, np.random.default_rng(seed), refine=refine)


def check_closed_and_free(problem: vkc.TrajectoryProblem, rows: np.ndarray) -> None:
    slide = problem.chain.index("drawer.slide")
    for row in rows:
        tilt = row[slide - 1] if len(row) == 11 else 0.0
        assert (
            compute_pose_error(problem.scene, row, compute_handle_pose(row[slide], tilt=tilt))
            < CLOSED
        )
        assert (
            compute_spare_clearance(problem.scene, row, slide=row[slide], held=True)
            >= -CLEAR - ROUNDING
        )
        assert np.all(
            (row >= problem.lower.min(axis=0) - STILL) & (row <= problem.upper.max(axis=0) + STILL)
        )


@pytest.mark.parametrize("refine", [False, True], ids=["B1", "B2"])
@pytest.mark.parametrize("change", [(-0.25, 0.0, 0.0), (0.0, -0.3, 0.2)], ids=["back", "aside"])
def test_arm_follows_to_the_end(change: Sequence[float], refine: bool) -> None:
    problem = make_problem()
    way = make_base_path(problem, *change)
    found = follow_path(problem, way, refine=refine)
    assert (found.cause, found.share) == ("", 1.0)
    check_closed_and_free(problem, found.z)
    np.testing.assert_allclose(found.z[:, :3], way, rtol=0.0, atol=STILL)
    np.testing.assert_allclose(found.z[:, -1], GOAL * sample_smoothstep(8), rtol=0.0, atol=STILL)
    assert np.abs(np.diff(problem.waypoints(found.z)[:, 3:9], axis=0)).max() < 0.6, (
        "from the waypoint before"
    )


def test_result_depends_on_the_random_seed_only() -> None:
    problem = make_problem(0.92)  # where random arms are needed
    way = make_base_path(problem)
    np.testing.assert_array_equal(follow_path(problem, way).z, follow_path(problem, way).z)
    assert not np.array_equal(follow_path(problem, way).z, follow_path(problem, way, seed=1).z)


def test_base_out_of_reach() -> None:
    problem = make_problem()
    way = make_base_path(problem, -0.6, 0.0, 0.0)
    found = follow_path(problem, way)
    assert found.cause == "no inverse kinematics"
    done = round(8 * found.share)
    assert found.share == done / 8
    assert 0 < done < 8
    assert found.z.shape == (8, problem.chain.size)
    check_closed_and_free(problem, found.z[:done])
    np.testing.assert_allclose(found.z[:done, :3], way[:done], rtol=0.0, atol=STILL)
    # From there on all stands still, in what was not at the handle.
    np.testing.assert_array_equal(found.z[done:], np.tile(found.z[done], (8 - done, 1)))
    assert (
        compute_pose_error(problem.scene, found.z[done], compute_handle_pose(found.z[done, -1]))
        > 1e-3
    )


@pytest.mark.parametrize(("refine", "least"), [(False, 0.5), (True, 0.5)], ids=["B1", "B2"])
def test_unavoidable_collision(refine: bool, least: float) -> None:
    """At the end the drawer itself would touch the lamp."""
    problem = make_problem(0.9)
    found = follow_path(problem, make_base_path(problem), refine=refine)
    assert found.cause == "collision"
    done = round(8 * found.share)
    assert least <= found.share < 1.0
    check_closed_and_free(problem, found.z[:done])
    wrong = found.z[done]
    assert compute_pose_error(problem.scene, wrong, compute_handle_pose(wrong[-1])) < CLOSED, (
        "the chain is closed all the same"
    )
    assert compute_spare_clearance(problem.scene, wrong, slide=wrong[-1], held=True) < -1e-3
    np.testing.assert_array_equal(found.z[done:], np.tile(wrong, (8 - done, 1)))


def test_other_arm_configurations_are_tried_after_a_collision() -> None:
    problem = make_problem(0.92)
    found = follow_path(problem, make_base_path(problem))
    assert (found.cause, found.share) == ("", 1.0)
    check_closed_and_free(problem, found.z)
    steps = np.abs(np.diff(problem.waypoints(found.z)[:, 3:9], axis=0))
    assert steps.max() > 0.6, "no random arm was needed"


def test_only_b2_moves_the_object_off_its_time_law() -> None:
    problem = make_problem(0.94, "handle_free")
    law = GOAL * sample_smoothstep(8)
    plain, refined = (
        follow_path(problem, make_base_path(problem), refine=refine) for refine in (False, True)
    )
    assert (plain.cause, refined.cause) == ("", "")
    check_closed_and_free(problem, plain.z)
    check_closed_and_free(problem, refined.z)
    np.testing.assert_allclose(plain.z[:, -1], law, rtol=0.0, atol=STILL)
    assert np.abs(refined.z[:, -1] - law).max() > 0.005
    assert refined.z[-1, -1] == pytest.approx(GOAL, abs=STILL)
    np.testing.assert_allclose(refined.z[:, :3], make_base_path(problem), rtol=0.0, atol=STILL)
