"""A stick is grasped and used as a tool."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.schedules import plan_each_step, solve_task

import vkc_pin as vkc
from vkc_pin.experiments.initialization import TARGET
from vkc_pin.planning.initialization.initial_guess import InitialGuess, make_initial_guess
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.solve_task import TaskResult
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.trajectory.world_model import compute_final_scene

STEPS = [vkc.Grasp("stick"), vkc.Touch("stick.tip", TARGET)]
REQUEST = PlanningRequest("astar", vkc.Options())


@cache
def sample_start() -> vkc.Scene:
    return vkc.load_scene("init_1").sample_start(np.random.default_rng(5))


def plan_parts(*steps: vkc.steps.Step) -> list[TaskResult]:
    task = compile_task(sample_start(), steps, REQUEST.options)
    return [part.result for part in plan_each_step(sample_start(), task, REQUEST)]


@pytest.mark.long
def test_simultaneous_planning_costs_less_than_sequential() -> None:
    parts = plan_parts(*STEPS)
    assert [part.plan.success for part in parts] == [True, True]
    pieces = [part.phase_waypoints() for part in parts]

    def guess(problem: vkc.TrajectoryProblem) -> InitialGuess:
        return make_initial_guess(problem, pieces)

    task = compile_task(sample_start(), STEPS, REQUEST.options)
    found = solve_task(sample_start(), task, REQUEST, guess=guess)
    assert found.plan.success, found.plan.summary()
    p = found.problem
    costs = [p.objective(z, p.timing_for(z).dt) for z in (found.z, guess(p).z)]
    assert costs[0] < costs[1]
    # The grasp moves in favour of the touch.
    assert np.abs(found.z[39, :3] - parts[0].z[39, :3]).max() > 1e-3


def test_each_step_begins_at_the_end_of_the_previous() -> None:
    """The second grasp is already satisfied; the stick does not move while the hand closes."""
    first, second = plan_parts(STEPS[0], *STEPS)
    after = compute_final_scene(sample_start(), first.plan.trajectory, first.task.after)
    assert dict(after.held) == {"stick": "grip"}
    np.testing.assert_allclose(second.scene.start, after.start, atol=1e-12)
    initial, final = (one.objects["stick"].placement for one in (sample_start(), after))
    assert np.linalg.norm(initial.actInv(final).translation) < 1e-4
