"""Tests that programs begin and end with given velocities, which are parameters."""

from __future__ import annotations

import copy
from functools import cache

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.held_sticks import make_scene_with_held_stick
from helpers.program_points import make_random_point
from helpers.small_problems import load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.nlp.timing import compute_end_steps
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.trajectory.world_model import compute_final_scene

STEPS = [vkc.Actuate("door", {"hinge": 1.2})]
VELOCITY = {"base_x": 0.2, "elbow_joint": 0.1}


def make_moving_problem(end: float = 0.0) -> TrajectoryProblem:
    """Return the program of a door that begins with `VELOCITY` and ends with one everywhere."""
    problem = copy.copy(make_program(load_door_scene().with_start(velocity=VELOCITY), STEPS))
    velocities = problem.end_velocities.copy()
    velocities[1] = end
    problem.end_velocities = velocities
    return problem


@cache
def open_drawer() -> Scene:
    """Return the scene after a drawer was opened a little, with the handle in the hand."""
    scene = load_scene("drawer")
    plan = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.15})])
    return compute_final_scene(scene, plan.trajectory, plan.trajectory.phases[-1].holds)


def test_rows_and_cost_have_the_velocities_at_the_ends() -> None:
    problem = make_moving_problem(end=0.3)
    point, t = make_random_point(problem), problem.transcription
    point.rate_excess[:] = 0.0
    velocity = np.zeros((2, t.n))
    velocity[0, [0, 5]] = 0.2, 0.1
    velocity[1] = 0.3
    steps = np.diff(point.path, axis=0)
    changes = [steps[0] - velocity[0] * point.dt[0]]
    for k in range(1, t.segments):
        if k in t.structure.stops:
            changes += [-steps[k - 1], steps[k]]
        else:
            changes.append(steps[k] - steps[k - 1])
    changes.append(velocity[1] * point.dt[-1] - steps[-1])
    rates = np.concatenate([steps.ravel(), np.ravel(changes)])
    np.testing.assert_allclose(point.rows()[t.rows :], rates, atol=1e-12)
    found = np.concatenate([part.ravel() for part in problem.rates(point.z, point.dt)])
    np.testing.assert_allclose(found, rates, atol=1e-12)
    squares = np.sum(point.weights[0] * steps**2) + np.sum(point.weights[1] * np.square(changes))
    assert point.cost() == pytest.approx(point.penalties + squares, rel=1e-10)


def test_derivatives_equal_differences() -> None:
    make_random_point(make_moving_problem(end=-0.2), seed=2).check_derivatives()


def test_program_is_shared_with_a_start_at_rest() -> None:
    at_rest = make_program(load_door_scene(), STEPS)
    assert make_moving_problem().transcription is at_rest.transcription
    dt = np.full(at_rest.segments, 0.25)
    assert not compute_end_steps(at_rest.end_velocities, dt).any()


def test_held_drawer_moves_with_the_hand() -> None:
    scene = open_drawer().with_start(velocity={"base_x": -0.1, "base_yaw": 0.0})
    problem = make_program(scene, [vkc.Actuate("drawer", {"slide": 0.3})])
    velocity = problem.end_velocities[0]
    assert velocity[problem.chain.index("drawer.slide")] == pytest.approx(0.1, abs=1e-3)
    (closure,) = (k for k, goal in enumerate(problem.pose_goals) if goal.kind == "closure")
    ahead = problem.start + 1e-3 * velocity
    residual, _ = problem.pose_solvers[closure].evaluate(
        np.array([problem.start, ahead]), problem.targets[closure]
    )
    np.testing.assert_allclose(residual[1], residual[0], atol=1e-6)


def test_held_drawer_does_not_move_sideways() -> None:
    scene = open_drawer().with_start(velocity={"base_y": 0.1})
    with expect_error("start.velocity: the grasped object cannot follow the hand"):
        make_program(scene, [vkc.Actuate("drawer", {"slide": 0.3})])


def test_robot_does_not_move_where_its_hand_opens() -> None:
    scene = make_scene_with_held_stick().with_start(velocity={"base_x": 0.1})
    with expect_error("start.velocity: the robot cannot move where its hand opens"):
        make_program(scene, [vkc.Release("stick", unsupported=True)])
