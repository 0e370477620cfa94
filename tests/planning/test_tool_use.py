"""A stick is grasped and used as a tool."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.initialization import TARGET
from vkc_pin.planning.initialization.initial_guess import make_initial_guess
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.sequential import plan_each_step
from vkc_pin.planning.solve_task import TaskResult, solve_task
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.trajectory.world_model import World, compute_final_scene


@cache
def sample_start(seed: int = 5) -> vkc.Scene:
    return vkc.load_scene("init_1").sample_start(np.random.default_rng(seed))


@cache
def plan_touch() -> vkc.Plan:
    return vkc.plan(
        sample_start(),
        [vkc.Grasp("stick", "grip"), vkc.Touch("stick.tip", TARGET)],
        initialization="astar",
    )


def compute_tip(scene: vkc.Scene, row: np.ndarray, trajectory: vkc.Trajectory) -> np.ndarray:
    """Return the tip's position from the tool, the grasp's definition and the stick's URDF."""
    robot = scene.robot
    data = robot.model.createData()
    pin.framesForwardKinematics(
        robot.model, data, robot.coordinates.q(row[: trajectory.robot_size])
    )
    tool = data.oMf[robot.model.getFrameId(robot.tool_frame)]
    stick = scene.objects["stick"].object
    grasp = stick.attachment(trajectory.phases[-1].held["stick"])
    values = [row[trajectory.names.index(f"stick.{name}")] for name in grasp.coordinates]
    root = (
        tool
        * (stick.link_placement(grasp.link, []) * grasp.placement * grasp.motion(values)).inverse()
    )
    return np.asarray((root * stick.link_placement("tip", [])).translation)


def test_tip_reaches_its_target() -> None:
    found = plan_touch()
    assert found.success, found.summary()
    assert (
        np.linalg.norm(
            compute_tip(sample_start(), found.trajectory.positions[-1], found.trajectory) - TARGET
        )
        < 1e-3
    )
    assert [dict(phase.held) for phase in found.trajectory.phases] == [{}, {"stick": "grip"}]


def compute_objective(problem: vkc.TrajectoryProblem, z: np.ndarray) -> float:
    return problem.objective(z, problem.timing_for(z).dt)


def solve(
    scene: vkc.Scene, steps: list[vkc.Step], request: PlanningRequest, guess: Any = None
) -> TaskResult:
    return solve_task(scene, compile_task(scene, steps, request.options), request, guess=guess)


@pytest.mark.long
def test_simultaneous_planning_costs_less_than_sequential() -> None:
    request = PlanningRequest("astar", vkc.Options())
    steps = [vkc.Grasp("stick"), vkc.Touch("stick.tip", TARGET)]
    parts = plan_each_step(
        sample_start(), compile_task(sample_start(), steps, request.options), request
    )
    assert [part.result.plan.success for part in parts] == [True, True]
    pieces = [part.result.phase_waypoints() for part in parts]
    simultaneous = solve(
        sample_start(), steps, request, lambda problem: make_initial_guess(problem, pieces)
    )
    assert simultaneous.plan.success, simultaneous.plan.summary()
    before = compute_objective(
        simultaneous.problem, make_initial_guess(simultaneous.problem, pieces).z
    )
    assert compute_objective(simultaneous.problem, simultaneous.z) < before
    assert (
        np.abs(simultaneous.z[39, :3] - parts[0].result.z[39, :3]).max() > 1e-3
    )  # the grasp moves in favour of the touch


def test_each_step_begins_at_the_end_of_the_previous() -> None:
    request = PlanningRequest("astar", vkc.Options())
    steps = [vkc.Grasp("stick"), vkc.Grasp("stick"), vkc.Touch("stick.tip", TARGET)]
    parts = plan_each_step(
        sample_start(), compile_task(sample_start(), steps, request.options), request
    )
    assert len(parts) == 2  # the second grasp is already satisfied
    first, second = (part.result for part in parts)
    end = first.plan.trajectory
    after = compute_final_scene(sample_start(), end, first.task.after)
    np.testing.assert_allclose(after.start, end.positions[-1, : end.robot_size], atol=1e-9)
    assert dict(after.held) == {"stick": "grip"}
    np.testing.assert_allclose(second.scene.start, after.start, atol=1e-12)
    # The stick does not move while the hand closes.
    initial, final = sample_start().objects["stick"].placement, after.objects["stick"].placement
    assert np.linalg.norm(initial.actInv(final).translation) < 1e-4
    world = World(sample_start())
    np.testing.assert_allclose(
        world.get_placement("stick", world.compute_positions(end)[-1]).homogeneous,
        initial.homogeneous,
        atol=1e-9,
    )


@pytest.mark.parametrize("bad", [-0.1, np.inf, "much"])
def test_invalid_perturbation(bad: object) -> None:
    with pytest.raises(vkc.InputError, match="perturbation"):
        vkc.plan(sample_start(), [vkc.GoTo(0.0, 0.0)], perturbation=bad)  # type: ignore[arg-type]
