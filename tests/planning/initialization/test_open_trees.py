"""Tests paths of base and arm by random trees in open phases: a narrow gate, a pole, a shelf."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from helpers.drives import make_hall
from helpers.gates import GOAL, TOO_NARROW, make_gate_problem, make_waypoint
from helpers.small_problems import make_program
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.initialization import open_trees
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.initialization.open_trees import Guide, OpenSearch
from vkc_pin.utils.budget import Budget

METRIC = np.array([2.0, 2.0, *np.ones(7)])  # x, y and yaw of the base, six joints of the arm
MAX_CHECKS = 20_000
STEPS = 60  # waypoints of open phases
# [m] shortfall that is possible between two checks, 0.15 rad apart, and between waypoints
UNCHECKED_SHORTFALL = 0.03


def make_sampler(p: vkc.TrajectoryProblem, seed: int = 0) -> KeyframeSampler:
    return KeyframeSampler(p, np.random.default_rng(seed))


@cache
def make_folding_problem() -> tuple[vkc.TrajectoryProblem, np.ndarray, np.ndarray]:
    """Return a problem that needs a folded arm, a guide path, and postures."""
    problem = make_gate_problem(TOO_NARROW)
    routes = BaseRoutes(problem)
    guide = routes.find_guide_path(0, problem.start[:3], np.array(GOAL), 80)
    assert guide is not None
    return problem, guide, np.array([problem.start[3:], routes.get_folded_arm(0)])


def find_path(
    seed: int,
    ends: np.ndarray | None = None,
    *,
    poses: np.ndarray | None = None,
    max_checks: int = MAX_CHECKS,
) -> np.ndarray | None:
    """Find a path through the gate, with samples near `poses` or the guide path."""
    problem, guide, arms = make_folding_problem()
    ends = make_waypoint(problem, GOAL)[None] if ends is None else ends
    near = {"poses": guide if poses is None else poses, "arms": arms}
    return connect(problem, problem.start, ends, **near, seed=seed, max_checks=max_checks)


def connect(
    problem: vkc.TrajectoryProblem,
    first: np.ndarray,
    ends: np.ndarray,
    *,
    poses: np.ndarray,
    arms: np.ndarray,
    seed: int = 0,
    max_checks: int = MAX_CHECKS,
    allowed: float | None = None,
) -> np.ndarray | None:
    """Find a path in the first phase; return its waypoints with the first one."""
    sampler = make_sampler(problem, seed)
    allowed = problem.options.dist_safe if allowed is None else allowed
    guide = Guide(poses, arms)
    search = OpenSearch(sampler, 0, first, ends, guide, allowed=allowed)
    path = search.find_path(STEPS, max_checks)
    return None if path is None else np.vstack([first, path])


def connect_directly(
    problem: vkc.TrajectoryProblem,
    first: np.ndarray,
    last: np.ndarray,
    *,
    max_checks: int = MAX_CHECKS,
) -> np.ndarray | None:
    """Find a path between two configurations, sampled near both of them."""
    ends = np.array([first, last])
    return connect(
        problem, first, ends[1:], poses=ends[:, :3], arms=ends[:, 3:], max_checks=max_checks
    )


def make_pole_problem() -> tuple[vkc.TrajectoryProblem, np.ndarray]:
    """Return a problem of an arm on a fixed base, and configurations on both sides of a pole."""
    size = {"radius": 0.05, "length": 1.2}
    pole = {"name": "pole", "type": "cylinder", **size, "position": [0.37, 0.25, 1.7]}
    reach = vkc.Reach((0.6, 0.35, 0.9, 0.0, np.pi / 2, 0.0))
    problem = make_program(make_hall(base="fixed", obstacles=[pole]), [reach])
    ends = np.tile(problem.start, (2, 1))
    ends[:, 3:6] = (0.57, -1.2, -1.2), (2.57, -1.2, -1.2)
    return problem, ends


def refine(path: np.ndarray, spacing: float = 0.02) -> np.ndarray:
    """Return configurations along a path, at most `spacing` [rad] apart."""
    rows = [path[:1]]
    for a, b in itertools.pairwise(path):
        count = max(1, int(np.ceil(np.abs((b - a) * METRIC).max() / spacing)))
        rows.append(np.linspace(a, b, count + 1)[1:])
    return np.vstack(rows)


def compute_shortfall(problem: vkc.TrajectoryProblem, rows: np.ndarray) -> np.ndarray:
    z = np.tile(problem.start, (len(rows), 1))
    z[:, : rows.shape[1]] = rows
    return problem.contacts.evaluate(z, np.ones(len(z), int), reach=0.1).compute_shortfall(len(z))


def assert_free(problem: vkc.TrajectoryProblem, path: np.ndarray) -> None:
    short, allowed = compute_shortfall(problem, refine(path)), problem.options.dist_safe
    assert short.max() <= allowed + UNCHECKED_SHORTFALL
    assert np.mean(short > allowed + 1e-6) < 0.1
    limits = np.array([problem.limits(name) for name in problem.chain.names[: path.shape[1]]])
    assert np.all((path >= limits[:, 0]) & (path <= limits[:, 1]))


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_path_leads_through_the_gate_with_the_arm_folded(seed: int) -> None:
    problem, _, arms = make_folding_problem()
    straight = np.array([problem.start, make_waypoint(problem, GOAL)])
    assert compute_shortfall(problem, refine(straight)).max() > 0.1
    path = find_path(seed)
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], straight, rtol=0.0, atol=1e-9)
    assert_free(problem, path)
    rows = refine(path)
    inside = np.abs(rows[:, 0] + 0.3 - 2.0) < 0.1  # the arm at home is 0.2 to 0.45 m ahead
    assert np.abs(rows[inside, 3:] - problem.start[3:]).max(axis=1).min() > 0.1
    # Shortcuts remove most arm motion besides folding and unfolding.
    folding = np.abs(arms[1] - problem.start[3:]).sum()
    assert np.abs(np.diff(path[:, 3:], axis=0)).sum() < 5.0 * folding


def test_path_ends_at_a_reachable_end() -> None:
    problem, _, arms = make_folding_problem()
    ends = np.tile(make_waypoint(problem, (2.0, 1.5, 0.0)), (4, 1))  # in the wall
    ends[1:3, :3], ends[1:3, 3:] = GOAL, arms
    path = find_path(0, ends)
    assert path is not None
    assert np.abs(ends[1:3] - path[-1]).max(axis=1).min() < 1e-9
    assert_free(problem, path)


@pytest.mark.parametrize("pose", [(2.0, 1.5, 0.0), (4.0, 0.5, 0.0)], ids=["in wall", "behind wall"])
def test_walled_in_goal_has_no_path(pose: tuple[float, float, float]) -> None:
    problem = make_gate_problem(0.0)
    assert connect_directly(problem, problem.start, make_waypoint(problem, pose)) is None


def test_least_violating_end_is_tried() -> None:
    """A goal slightly within the margin is reached; one in the wall is not."""
    problem, _, arms = make_folding_problem()
    allowed = problem.options.dist_safe
    towards = np.tile([1.405, 1.5, np.pi / 2, *arms[1]], (241, 1))
    towards[:, 0] += np.linspace(-0.3, 0.3, 241)
    short = compute_shortfall(problem, towards)
    index = int(np.argmax(short > allowed))
    assert allowed < short[index] < allowed + 3e-3
    near = towards[index]
    path = find_path(0, towards[[-1, index]], poses=np.array([problem.start[:3], near[:3]]))
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], [problem.start, near], rtol=0.0, atol=1e-9)
    assert compute_shortfall(problem, refine(path)).max() <= allowed + UNCHECKED_SHORTFALL


def test_free_path_is_straight_and_slow_at_both_ends() -> None:
    problem = make_program(make_hall(), [vkc.GoTo(2.0, 1.0, 0.5)])
    end = make_waypoint(problem, (2.0, 1.0, 0.5))
    end[3:] += 0.3
    path = connect_directly(problem, problem.start, end, max_checks=1)
    assert path is not None
    fraction = np.arange(STEPS + 1)[:, None] / STEPS
    expected = problem.start + (3.0 * fraction**2 - 2.0 * fraction**3) * (end - problem.start)
    np.testing.assert_allclose(path, expected, rtol=0.0, atol=1e-9)
    path = connect_directly(problem, problem.start, problem.start)
    np.testing.assert_array_equal(path, np.tile(problem.start, (STEPS + 1, 1)))


def test_arm_on_a_fixed_base_avoids_a_pole() -> None:
    problem, straight = make_pole_problem()
    assert compute_shortfall(problem, straight).max() == 0.0
    assert compute_shortfall(problem, refine(straight)).max() > 0.05
    path = connect_directly(problem, *straight)
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], straight, rtol=0.0, atol=1e-9)
    assert np.ptp(path[:, :3], axis=0).max() < 1e-12
    assert_free(problem, path)


def measure_search_around_the_pole(seed: int) -> float:
    """Return the length of a path found by uniform samples, relative to the straight line."""
    problem, ends = make_pole_problem()
    search = OpenSearch(make_sampler(problem, seed), 0, ends[0], ends[1:], None, allowed=0.0)
    path = search.find_path(STEPS, MAX_CHECKS)
    assert path is not None
    lengths = np.linalg.norm(np.diff(np.vstack([ends[0], path]), axis=0), axis=1)
    return float(lengths.sum() / np.linalg.norm(ends[1] - ends[0]))


def test_shortcuts_leave_little_detour() -> None:
    """Without them the median is 1.33."""
    assert np.median([measure_search_around_the_pole(seed) for seed in range(5)]) < 1.1


def test_samples_along_the_guide_find_a_path_sooner() -> None:
    _, guide, _ = make_folding_problem()
    used: dict[int, list[int]] = {}
    for poses in (guide, guide[[0, -1]]):
        for seed in range(3):
            with Budget().activate() as budget:
                find_path(seed, poses=poses, max_checks=4 * MAX_CHECKS)
            used.setdefault(len(poses), []).append(budget.evaluations)
    with_guide, without = (np.median(counts) for counts in used.values())
    assert with_guide < 0.5 * without


def test_obstruction_is_named() -> None:
    """It is the wall between the nearest nodes, whatever was cut off from the trees."""
    problem = make_gate_problem(0.0)
    ends = np.array([problem.start, make_waypoint(problem, (4.0, 0.5, 0.0))])
    guide = Guide(ends[:, :3], ends[:, 3:])
    search = OpenSearch(make_sampler(problem), 0, ends[0], ends[1:], guide, allowed=0.0)
    assert search.find_path(STEPS, 2000) is None
    for tree in search.trees:
        tree.remove_branch(len(tree) - 1)
    pair = search.find_obstruction()
    assert pair is not None
    assert {"left", "right"} & {*pair}
    inside = make_waypoint(problem, (2.0, 1.5, 0.0))[None]
    blocked = OpenSearch(make_sampler(problem), 0, ends[0], inside, guide, allowed=0.0)
    assert blocked.find_obstruction() is None


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 400))
def test_lines_are_checked_everywhere_and_far_apart_first(count: int) -> None:
    fractions = open_trees._order_fractions(count)
    np.testing.assert_allclose(np.sort(fractions), np.arange(1, count + 1) / count)
    gaps = np.diff(np.sort([0.0, *fractions[: count // 2 + 1]]))
    assert gaps.max() <= 3.0 / max(count // 2, 1)


def test_full_clearance_is_kept_everywhere() -> None:
    problem, ends = make_pole_problem()
    near = {"poses": ends[:, :3], "arms": ends[:, 3:]}
    path = connect(problem, ends[0], ends[1:], **near, allowed=0.0)
    assert path is not None
    # Corners are waypoints, so that straight lines between waypoints are the path itself.
    assert compute_shortfall(problem, refine(path, 0.002)).max() < 2e-3
