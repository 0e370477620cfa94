"""Tests of the subproblem: the minimum of the merit model in the trust region."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.drives import hall, moved, through
from helpers.small_problems import door_scene, program_of

import vkc_pin as vkc
from vkc_pin.planning.solver.loop import _Loop

SHORT = vkc.Options(reach_waypoints=8, turn_waypoints=4, move_waypoints=6)


def begun(problem: vkc.TrajectoryProblem, seed: np.ndarray, weight: float) -> _Loop:
    state = _Loop(problem, seed, weight)
    state.begin()
    return state


def loop(kind: str) -> _Loop:
    if kind == "far":
        problem = program_of(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=SHORT)
        return begun(problem, problem.still, 200.0)
    scene = hall()
    problem = program_of(scene, [vkc.GoTo(1.0, 0.0)], options=SHORT)
    return begun(
        problem,
        through(scene, scene.start, moved(scene.start, x=1.0), steps=8).positions[1:],
        200.0,
    )


@pytest.mark.parametrize("kind", ["far", "there"])
@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("size", [0.05, 0.5])
def test_predicted_reduction_is_achieved_within_the_region(
    kind: str, rates: bool, size: float
) -> None:
    """Without close obstacles the model is exact up to Ipopt's tolerance."""
    state = loop(kind)
    state.rates = rates
    state.evaluate_iterate()
    radius = np.full(state.problem.segments, size)
    step = state.subproblem.solve(
        state.z, state.at, state.found, state.merit, state.timing, radius, rates=rates
    )
    assert np.all(np.abs(step.z - state.z) <= size * (1 + 1e-6))
    assert np.all((step.z >= state.problem.lower - 1e-6) & (step.z <= state.problem.upper + 1e-6))
    assert np.all((step.relaxation >= 0.0) & (step.relaxation <= 1.0))
    weights, found = (
        state.merit.weights,
        state.compute_infeasibility(step.z, state.find_contacts(step.z)[0]),
    )
    before, after = state.objective, state.problem.objective(step.z, state.timing.dt)
    others = state.merit.compute_penalty(state.found, clearance=False)
    promised = before + state.merit.compute_penalty(state.found, clearance=True).sum() - after
    promised -= (weights["clearance"] * step.slack + others * step.relaxation).sum()
    assert promised >= -1e-3
    left = others @ step.relaxation
    assert state.merit.compute_penalty(found, clearance=False).sum() <= left + 1e-2 * max(1.0, left)
    if kind == "there":
        assert not step.relaxation.any()
        assert step.succeeded
    else:
        assert promised > 1.0
        assert size > 0.1 or (step.relaxation > 0.5).any(), "a small step does not get there"


def test_multipliers_are_those_of_the_last_round() -> None:
    state = loop("there")
    radius = np.full(state.problem.segments, 0.1)
    counts = []
    for forget in (False, False, True):
        if forget:
            state.subproblem.reset_multipliers()
        before = state.solution.iterations
        state.subproblem.solve(
            state.z, state.at, state.found, state.merit, state.timing, radius, rates=False
        )
        counts.append(state.solution.iterations - before)
    assert counts[1] <= counts[0] == counts[2]
    assert set(state.solution.timings) == {"coal", "casadi", "ipopt"}


@pytest.mark.parametrize("missing", [False, True])
def test_only_planes_violated_at_the_iterate_have_slack(missing: bool) -> None:
    """The penalty weight does not matter, next to a box within or beyond the margin."""
    box = {
        "name": "box",
        "type": "box",
        "size": [0.2, 0.2, 1.0],
        "position": [1.6 if missing else 1.85, 0.0, 0.5],
    }
    scene = hall(obstacles=[box])
    problem = program_of(scene, [vkc.GoTo(1.2, 0.0)], options=SHORT)
    still = begun(problem, problem.still, 1e-3)
    if missing:
        driven = through(scene, scene.start, moved(scene.start, x=1.2), steps=8).positions[1:]
        still = begun(problem, driven, 1e-3)
    assert bool(still.found.amounts["clearance"].any()) == missing
    radius = np.full(problem.segments, 2.0)
    step = still.subproblem.solve(
        still.z, still.at, still.found, still.merit, still.timing, radius, rates=False
    )
    assert bool((step.slack > 1e-3).any()) == missing
    if not missing:
        np.testing.assert_array_equal(step.slack, 0.0)
