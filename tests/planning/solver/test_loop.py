"""Tests the witness-plane loop on small problems."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.drives import make_hall
from helpers.judging import replace_attachments
from helpers.small_problems import load_door_scene, make_program
from helpers.straight_drives import make_straight_drive

import vkc_pin as vkc
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.solver.loop import (
    MIN_IMPROVEMENT,
    NEARLY_FEASIBLE,
    PROGRESS_ROUNDS,
    Solution,
    solve,
)
from vkc_pin.planning.solver.segment_planes import find_segment_contacts
from vkc_pin.planning.solver.trust_region import (
    ACTIVE_FRACTION,
    CLEARANCE_TOLERANCE,
    FIRST_RADIUS,
    SETTLE_RADIUS,
)
from vkc_pin.utils.budget import Budget
from vkc_pin.world.scene.contact_rules import find_grasp_distances

FEW = vkc.Options(reach_waypoints=20, max_outer=12)


def make_drive_case(
    x: float, *obstacles: dict[str, Any], options: vkc.Options = FEW
) -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """Return a drive ahead to `x` [m] and the straight path."""
    return make_straight_drive(make_hall(obstacles=obstacles), options, x=x)


def describe_post(x: float, y: float, radius: float) -> dict[str, Any]:
    where = {"position": [x, y, 0.8], "length": 1.6, "radius": radius}
    return {"name": "post", "type": "cylinder", **where}


def describe_wall(
    x: float, thickness: float, *, y: float = 0.0, width: float = 12.0
) -> dict[str, Any]:
    return describe_box(f"wall_{100 * x:.0f}", [thickness, width, 2.0], [x, y, 1.0])


@cache
def make_pillar_case() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    return make_drive_case(3.2, describe_post(1.6, 0.05, 0.15))


@cache
def make_roadside_case() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """The base grazes a post, and the first feasible motion can be shortened."""
    return make_drive_case(3.2, describe_post(1.6, 0.3, 0.15))


@cache
def make_shallow_case() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """The base overlaps a post a little."""
    return make_drive_case(3.2, describe_post(1.6, -0.1, 0.1))


@cache
def make_walls_case() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """Two walls cross the straight path. All waypoints share one radius."""
    walls = [describe_wall(1.5 + 1.2 * k, 0.1, y=(-1.0) ** k, width=3.0) for k in range(2)]
    return make_drive_case(4.2, *walls, options=vkc.Options(reach_waypoints=14))


@cache
def make_reach_case() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """The hand reaches a distant pose from a stationary guess."""
    scene = make_hall()
    tool = scene.tool_placement()
    tool.translation[0] += 5.0
    problem = make_program(scene, [vkc.Reach(tool)], options=vkc.Options(reach_waypoints=12))
    return problem, problem.still


@cache
def make_grasp_case() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """The hand grasps a stick between obstacles."""
    scene = vkc.load_scene("init_2").sample_start(np.random.default_rng(5))
    problem = make_program(scene, [vkc.Grasp("stick")])
    return problem, next(initialize(problem, "astar", 0)).z


@cache
def make_blocked_case() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """A wall spans the hall."""
    return make_drive_case(4.0, describe_wall(2.0, 1.0))


Case = Callable[[], tuple[vkc.TrajectoryProblem, np.ndarray]]
SOLVED: list[Case] = [make_pillar_case, make_grasp_case, make_reach_case]


@cache
def solve_case(case: Case) -> Solution:
    return solve(*case())


def check_feasible(problem: vkc.TrajectoryProblem, solution: Solution) -> None:
    """Check all constraints at the waypoints, and collisions between them."""
    z = solution.z
    assert np.all((z >= problem.lower - 1e-6) & (z <= problem.upper + 1e-6))
    assert problem.evaluate_contacts(z, reach=0.1).compute_violation() < 1e-3
    assert problem.pose_error(z) < 1e-3
    timing = dataclasses.replace(problem.timing_for(problem.still), dt=solution.dt)
    assert timing.compute_violation(*problem.rates(z, solution.dt)) < 1e-3
    assert problem.drift(z) < 1.0
    path = problem.waypoints(z)
    fractions = np.linspace(0.0, 1.0, 12)[1:-1]
    states = np.concatenate([(1 - s) * path[:-1] + s * path[1:] for s in fractions])
    ends = np.tile(np.arange(1, len(path)), len(fractions))
    assert not len(problem.contacts.evaluate(states, ends, reach=0.0).waypoint)


@pytest.mark.parametrize("case", SOLVED)
def test_solution_is_feasible(case: Case) -> None:
    problem, guess = case()
    solution = solve_case(case)
    assert np.abs(problem.clip(guess) - solution.z).max() > 0.1
    assert (solution.converged, solution.status) == (True, "converged")
    assert solution.shortfall == 0.0
    check_feasible(problem, solution)


@pytest.mark.parametrize("case", [*SOLVED, make_walls_case, make_blocked_case, make_shallow_case])
def test_history_describes_every_round(case: Case) -> None:
    """Rejected rounds shrink the trust region, and nearly feasible motions take small steps."""
    solution = solve_case(case)
    history, rejected, nearly = solution.history, 0, 0
    assert [row.round for row in history] == list(range(1, solution.rounds + 1))
    assert solution.iterations == history[-1].iterations
    assert all(0.0 < time < 100.0 for time in solution.timings.values())
    assert set(solution.timings) == {"coal", "casadi", "ipopt"}
    assert sum(solution.timings.values()) <= history[-1].time < 100.0
    assert history[0].radius == FIRST_RADIUS
    for row in history:
        assert row.step <= row.radius * (1 + 1e-6)
        assert row.shortfall >= 0.0
    for row, after in itertools.pairwise(history):
        assert row.iterations < after.iterations
        assert 0.0 < row.time < after.time
        assert after.penalty >= row.penalty
        assert after.radius <= max(1.5 * row.radius, FIRST_RADIUS) * (1 + 1e-6)
        if not row.accepted and case is make_walls_case:  # with one block
            rejected += 1
            assert after.radius < row.radius or after.penalty > row.penalty
        is_near = CLEARANCE_TOLERANCE <= row.shortfall < NEARLY_FEASIBLE
        if row.accepted and is_near and row.pose_error < TOLERANCE:
            # the planes are accurate for small steps
            nearly += 1
            assert after.radius <= SETTLE_RADIUS or after.penalty > row.penalty
    assert rejected or case is not make_walls_case, "choose a harder problem"
    assert nearly or case is not make_shallow_case, "choose another problem"


@pytest.mark.parametrize("case", SOLVED)
def test_feasible_motions_are_improved_while_worthwhile(case: Case) -> None:
    """The last round improves little, or the trust region did not limit its step."""
    *earlier, last = solve_case(case).history
    accepted = [row.objective for row in earlier if row.accepted]
    assert last.accepted
    improved = last.objective < (1.0 - MIN_IMPROVEMENT) * accepted[-1]
    assert not improved or last.step < ACTIVE_FRACTION * last.radius
    assert solve_case(case).rounds < case()[0].options.max_outer


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_blocked_motions_end_early(seed: int) -> None:
    """The goal is deep in a block across the hall; noise imitates rounding errors."""
    problem, guess = make_drive_case(4.0, describe_wall(4.0, 2.5))
    guess = guess + np.random.default_rng(seed).normal(0.0, 1e-9, guess.shape)
    solution = solve(problem, guess, rounds=vkc.Options().max_outer)
    assert (solution.status, solution.converged) == ("not converged", False)
    assert PROGRESS_ROUNDS <= solution.rounds <= 4 * PROGRESS_ROUNDS
    assert solution.radius is not None
    # It ends for lack of progress, before its trust region has shrunk.
    assert solution.radius.max() >= FIRST_RADIUS
    shortfall = problem.evaluate_contacts(solution.z, reach=0.1).compute_violation()
    assert solution.shortfall == pytest.approx(shortfall)
    assert shortfall > NEARLY_FEASIBLE
    assert solve(problem, guess, rounds=2).rounds == 2


def test_switching_sides_of_a_closed_wall_is_no_progress() -> None:
    """The path goes through a thin wall, whose nearest side differs between waypoints.

    How long that goes on depends on rounding; without a limit, it always lasts to the last round.
    """
    few = vkc.Options(reach_waypoints=5)
    problem, guess = make_drive_case(4.0, describe_wall(2.0, 0.1), options=few)
    most, rng = vkc.Options().max_outer, np.random.default_rng(0)

    def ends_early() -> bool:
        solution = solve(problem, guess + 1e-9 * rng.normal(size=guess.shape), rounds=most)
        assert not solution.converged
        return solution.rounds < most

    assert any(ends_early() for _ in range(8))


def test_solution_continues_with_given_radii() -> None:
    problem, guess = make_blocked_case()
    first = solve(problem, guess, rounds=3)
    assert first.radius is not None
    assert len(np.unique(first.radius)) > 1, "one radius for all: choose a harder problem"
    for radius in (first.radius, np.linspace(0.02, 0.1, problem.segments)):
        original = radius.copy()
        second = solve(problem, first.z, rounds=1, radius=radius)
        assert second.history[0].radius == radius.max()
        assert np.all(np.abs(second.z - first.z).max(axis=1) <= radius * (1 + 1e-6))
        np.testing.assert_array_equal(radius, original)


@pytest.mark.parametrize("penalty", [1.0, 200.0])
def test_waypoints_do_not_jump_through_obstacles(penalty: float) -> None:
    """A guess around a thin post stays on its side, even if overlap costs less than the detour."""
    options = dataclasses.replace(FEW, penalty=penalty)
    problem, guess = make_drive_case(3.2, describe_post(1.6, -0.42, 0.02), options=options)
    guess[:, 1] -= 1.3 * np.sin(np.linspace(0.0, np.pi, len(guess) + 1)[1:])
    assert find_segment_contacts(problem, guess).is_free
    solution = solve(problem, guess)
    assert solution.converged
    assert solution.z[:, 1].min() < -0.42
    check_feasible(problem, solution)


@pytest.mark.parametrize(("overlap", "is_near"), [(0.005, True), (0.025, False)])
def test_penalty_weights_are_raised_if_stalled_near_feasibility(
    overlap: float, is_near: bool
) -> None:
    """The base overlaps a wall at its goal; only a large overlap is reported."""
    wall = describe_wall(1.565 - overlap, 0.1, width=2.0)
    problem, guess = make_drive_case(1.0, wall, options=vkc.Options(reach_waypoints=8))
    solution = solve(problem, guess)
    assert not solution.converged
    penalties = [row.penalty for row in solution.history]
    assert len(set(penalties)) > 2 if is_near else set(penalties) == {problem.options.penalty}
    assert solution.shortfall == pytest.approx(0.0 if is_near else overlap, abs=1e-4)


def test_motion_to_the_start_is_stationary() -> None:
    problem, still = make_drive_case(0.0)
    solution = solve(problem, still)
    assert solution.converged
    np.testing.assert_allclose(solution.z, still, atol=0.05)
    assert problem.objective(solution.z, solution.dt) <= 1e-3


def test_steps_of_a_stationary_guess_are_lengthened() -> None:
    """Infeasible waypoints are a poor estimate of the duration."""
    problem, guess = make_reach_case()
    assert solve_case(make_reach_case).dt.min() > 1.5 * problem.timing_for(guess).dt.max()


def test_rate_limits_hold_if_the_guess_jumps() -> None:
    """Steps are lengthened by half at most, after which rate limits become constraints."""
    options = vkc.Options(reach_waypoints=12, dt=0.25)
    problem, guess = make_drive_case(2.4, options=options)
    guess[:6] = problem.start
    guess[6:] = guess[-1]
    least = problem.timing_for(guess)
    assert least.compute_violation(*problem.rates(guess, least.dt)) > 5.0
    solution = solve(problem, guess)
    assert solution.converged
    assert (solution.dt <= 1.5 * least.dt * (1 + 1e-9)).all()
    check_feasible(problem, solution)


# --- budget
# ------------------------------------------------------------------------------------------------


def test_exhausted_time_returns_the_guess_within_bounds() -> None:
    problem, guess = make_pillar_case()
    with Budget(seconds=0.0).activate():
        solution = solve(problem, guess + 20.0)
    assert (solution.status, solution.converged, solution.rounds) == ("time limit", False, 0)
    np.testing.assert_array_equal(solution.z, problem.clip(guess + 20.0))
    assert solution.shortfall == 0.0  # it was not evaluated


def test_feasible_motion_is_kept_if_the_budget_ends() -> None:
    used: list[int] = []
    with Budget().activate() as budget:
        whole = solve(*make_roadside_case(), callback=lambda _: used.append(budget.evaluations))
    assert any(row.accepted and row.shortfall == 0.0 for row in whole.history[:-1])
    with Budget(max_evaluations=used[-1] - 1).activate():
        solution = solve(*make_roadside_case())
    assert solution.rounds < whole.rounds
    assert (solution.converged, solution.status) == (True, "converged")
    check_feasible(make_roadside_case()[0], solution)


@pytest.mark.parametrize("lacking", [-1e-4, 2e-4, 6e-4, 9e-4])
def test_motions_converge_with_grasps_that_validation_accepts(lacking: float) -> None:
    """No motion changes how far the hand is from what it grasps."""
    scene = load_door_scene()
    least = min(find_grasp_distances(scene, vkc.Hold("door", "handle")).values())
    handle = scene.objects["door"].object.attachments["handle"]
    strict = dataclasses.replace(handle, clearance=least + lacking)
    scene = replace_attachments(scene, {"handle": strict})
    steps = [vkc.Actuate("door", {"hinge": 0.4}, "handle")]
    options = vkc.Options(dist_safe=0.03, reach_waypoints=20)
    problem = make_program(scene, steps, options=options)
    assert solve(problem, next(initialize(problem, "interpolated", 0)).z).converged
