"""Tests the inverse kinematics of the arm alone against Pinocchio."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.drawers import (
    SHORT,
    compute_handle_pose,
    compute_pose_error,
    load_drawer_scene,
    make_grasping_scene,
)
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.experiments.baselines.following import ArmKinematics, refine_configuration
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE

SLIDE = {"slide": 0.3}
EXACT = np.sqrt(3.0) * TOLERANCE  # [m] and [rad]: the tolerance is per coordinate


def make_problem(attachment: str = "handle") -> tuple[vkc.TrajectoryProblem, ArmKinematics]:
    problem = make_program(
        make_grasping_scene(attachment=attachment), [vkc.Actuate("drawer", SLIDE)], options=SHORT
    )
    return problem, ArmKinematics(problem, KeyframeSampler(problem, np.random.default_rng(0)))


@cache
def make_shared_problem() -> tuple[vkc.TrajectoryProblem, ArmKinematics]:
    return make_problem()


@pytest.mark.parametrize("waypoint", [1, 4, 8])
@pytest.mark.parametrize("seed", range(3))
def test_arm_closes_the_chain(waypoint: int, seed: int) -> None:
    problem, arm = make_shared_problem()
    rng = np.random.default_rng(seed)
    guess = arm.sampler.object_motion[waypoint - 1].copy()
    guess[:3] += rng.uniform(-0.05, 0.05, 3)
    guess[3:9] += rng.normal(0.0, 0.3, 6)
    before = guess.copy()
    z, closed = arm.solve(guess, waypoint)
    np.testing.assert_array_equal(guess, before)
    assert closed
    assert compute_pose_error(problem.scene, z, compute_handle_pose(z[-1])) <= EXACT
    np.testing.assert_array_equal(z[[0, 1, 2, 9]], before[[0, 1, 2, 9]])
    assert np.all((z >= problem.chain.lower) & (z <= problem.chain.upper))
    assert np.abs(z - before).max() > 0.05
    np.testing.assert_array_equal(arm.solve(z, waypoint)[0], z)


def test_grasp_freedoms_are_solved_for() -> None:
    problem, arm = make_problem("handle_free")
    tilt, slide = (problem.chain.index(f"drawer.{name}") for name in ("handle_free", "slide"))
    assert arm.columns.tolist() == [3, 4, 5, 6, 7, 8, tilt]
    tilts = []
    for waypoint in (2, 5, 8):
        z, closed = arm.solve(arm.sampler.object_motion[waypoint - 1], waypoint)
        assert closed
        handle = compute_handle_pose(z[slide], tilt=z[tilt])
        assert compute_pose_error(problem.scene, z, handle) <= EXACT
        tilts.append(z[tilt])
    assert np.ptp(tilts) > 0.02
    assert np.abs(tilts).max() <= 0.6


def test_waypoints_without_closure_are_unchanged() -> None:
    problem = make_program(load_drawer_scene(), [vkc.Grasp("drawer")])
    sampler, start = KeyframeSampler(problem, np.random.default_rng(0)), problem.start
    arm = ArmKinematics(problem, sampler)
    for z, closed in (
        arm.solve(start, 1),
        refine_configuration(
            problem, sampler, start, wanted=start, waypoint=1, columns=arm.columns
        ),
    ):
        assert closed
        np.testing.assert_array_equal(z, start)
    assert not arm.solve(start, problem.segments)[1], "the handle is two metres away"


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_solution_satisfies_joint_limits(side: float) -> None:
    """The limits of the shoulder exclude the solution, and slightly wider ones admit it."""
    problem, arm = make_problem()
    chain, pan = problem.chain, 3
    free, closed = arm.solve(problem.start, 4)
    assert closed
    for nearest, is_admitted in ((-0.1, False), (1e-4, True)):
        limits = np.sort([free[pan] + side * nearest, free[pan] - side * 0.6])
        chain.lower[pan], chain.upper[pan] = limits
        start = problem.start.copy()
        start[pan] = free[pan] - side * 0.35
        z, closed = arm.solve(start, 4)
        assert closed == is_admitted
        assert np.all((z >= chain.lower) & (z <= chain.upper))
        error = compute_pose_error(problem.scene, z, compute_handle_pose(z[-1]))
        assert error <= EXACT if is_admitted else error > 1e-3
    np.testing.assert_allclose(z[3:9], free[3:9], atol=1e-4)


def test_start_may_exceed_limits_by_rounding() -> None:
    problem, arm = make_problem()
    z, _ = arm.solve(problem.start, 4)
    problem.chain.upper[5] = z[5] - 1e-8
    assert arm.solve(z, 4)[1]
