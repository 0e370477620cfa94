"""Tests RRT paths of base and arm: a narrow gate, a pole, a ball beside a moving door."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from helpers.drawers import replace_scene_fields
from helpers.drives import make_hall
from helpers.gates import GOAL, TOO_NARROW, make_gate_problem, make_waypoint
from helpers.small_problems import compute_grasp_error, load_door_scene, make_program
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.initialization import keyframes
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.beam_search import BeamSearch
from vkc_pin.planning.initialization.interpolation import Interpolator, RrtPaths
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.initialization.rrt import (
    MAX_EXTENSIONS,
    find_closed_path,
    find_open_path,
    needs_trees,
)
from vkc_pin.utils.budget import Budget, BudgetExhaustedError

METRIC = np.array([2.0, 2.0, *np.ones(7)])  # x, y and yaw of the base, six joints of the arm
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
    max_extensions: int = MAX_EXTENSIONS,
) -> np.ndarray | None:
    """Find a path through the gate, with samples near `poses` or the guide path."""
    problem, guide, arms = make_folding_problem()
    ends = make_waypoint(problem, GOAL)[None] if ends is None else ends
    near = {"poses": guide if poses is None else poses, "arms": arms}
    return connect(problem, problem.start, ends, **near, seed=seed, max_extensions=max_extensions)


def connect(
    problem: vkc.TrajectoryProblem,
    first: np.ndarray,
    ends: np.ndarray,
    *,
    poses: np.ndarray,
    arms: np.ndarray,
    seed: int = 0,
    max_extensions: int = MAX_EXTENSIONS,
) -> np.ndarray | None:
    """Find a path in the first phase; return its waypoints with the first one."""
    sampler = make_sampler(problem, seed)
    path = find_open_path(sampler, 0, first, ends, STEPS, max_extensions, poses=poses, arms=arms)
    return None if path is None else np.vstack([first, path])


def connect_directly(
    problem: vkc.TrajectoryProblem,
    first: np.ndarray,
    last: np.ndarray,
    *,
    max_extensions: int = 400,
) -> np.ndarray | None:
    """Find a path between two configurations, sampled near both of them."""
    ends = np.array([first, last])
    return connect(
        problem, first, ends[1:], poses=ends[:, :3], arms=ends[:, 3:], max_extensions=max_extensions
    )


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
    path = connect_directly(problem, problem.start, end, max_extensions=1)
    assert path is not None
    fraction = np.arange(STEPS + 1)[:, None] / STEPS
    expected = problem.start + (3.0 * fraction**2 - 2.0 * fraction**3) * (end - problem.start)
    np.testing.assert_allclose(path, expected, rtol=0.0, atol=1e-9)
    path = connect_directly(problem, problem.start, problem.start)
    np.testing.assert_array_equal(path, np.tile(problem.start, (STEPS + 1, 1)))


def test_arm_on_a_fixed_base_avoids_a_pole() -> None:
    size = {"radius": 0.05, "length": 1.2}
    pole = {"name": "pole", "type": "cylinder", **size, "position": [0.37, 0.25, 1.7]}
    reach = vkc.Reach((0.6, 0.35, 0.9, 0.0, np.pi / 2, 0.0))
    problem = make_program(make_hall(base="fixed", obstacles=[pole]), [reach])
    straight = np.tile(problem.start, (2, 1))
    straight[:, 3:6] = (0.57, -1.2, -1.2), (2.57, -1.2, -1.2)
    assert compute_shortfall(problem, straight).max() == 0.0
    assert compute_shortfall(problem, refine(straight)).max() > 0.05
    path = connect_directly(problem, *straight, max_extensions=MAX_EXTENSIONS)
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], straight, rtol=0.0, atol=1e-9)
    assert np.ptp(path[:, :3], axis=0).max() < 1e-12
    assert_free(problem, path)


def test_samples_along_the_guide_find_a_path_sooner() -> None:
    _, guide, _ = make_folding_problem()
    assert all(find_path(seed, max_extensions=400) is not None for seed in range(3))
    assert find_path(0, poses=guide[[0, -1]], max_extensions=400) is None


# --- closed chains

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=24)
OPEN_AND_LEAVE = [vkc.Actuate("door", {"hinge": 1.2}), vkc.GoTo(-1.0, 0.5)]
MOVE = 2  # the phase in which the door swings


@cache
def make_free_door() -> tuple[vkc.TrajectoryProblem, np.ndarray, list[int], np.ndarray]:
    """Return the door problem, keyframes with their waypoints, and straight waypoints."""
    p = make_program(load_door_scene(), OPEN_AND_LEAVE, options=FEW)
    sampler = make_sampler(p, 2)
    found = BeamSearch(sampler).search(thorough=True)
    path = found.paths[int(np.argmin(np.where(found.collision_cost == 0.0, found.cost, np.inf)))]
    z = Interpolator(sampler, ApproachPaths(sampler), None).interpolate(path, found.waypoints)
    assert z is not None
    return p, path, found.waypoints, z


def get_move_phase() -> tuple[np.ndarray, np.ndarray]:
    """Return the keyframes and the straight waypoints of phase MOVE."""
    p, path, waypoints, z = make_free_door()
    begin, end = int(p.ends[MOVE - 1]), int(p.ends[MOVE])
    is_within = [begin <= at <= end for at in waypoints]
    return path[is_within], z[begin:end]


@cache
def make_blocked_door() -> vkc.TrajectoryProblem:
    """Return the same problem with a ball in the elbow's path."""
    p, straight = make_free_door()[0], get_move_phase()[1]
    _, places = p.chain.joint_placements(straight[len(straight) // 2][None])
    scene = load_door_scene()
    elbow = p.chain.model.getJointId(str(scene.robot.model.names[4]))
    position = places[0, elbow].round(4).tolist()
    ball = {"name": "ball", "type": "sphere", "radius": 0.06, "position": position}
    obstacles = [*scene.document["obstacles"], ball]
    blocked = replace_scene_fields(scene, obstacles=obstacles)
    return make_program(blocked, OPEN_AND_LEAVE, options=FEW)


def find_path_with_door(seed: int, *, max_extensions: int = MAX_EXTENSIONS) -> np.ndarray | None:
    through, straight = get_move_phase()
    sampler = make_sampler(make_blocked_door(), seed)
    return find_closed_path(sampler, MOVE, through, len(straight), max_extensions)


def compute_penetration(p: vkc.TrajectoryProblem, rows: np.ndarray) -> float:
    short = keyframes.compute_shortfall(p, rows, p.contacts.find_waypoint(MOVE), reach=0.0)
    return float(short.max() - p.options.dist_safe)


def assert_holds_the_handle(p: vkc.TrajectoryProblem, rows: np.ndarray) -> None:
    hinge, knob = (p.chain.index(f"door.{name}") for name in ("hinge", "knob"))
    for row in rows:
        assert compute_grasp_error(load_door_scene(), row, row[hinge], row[knob]) < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_path_avoids_an_obstacle_and_holds_the_handle(seed: int) -> None:
    p, (through, straight) = make_free_door()[0], get_move_phase()
    assert compute_penetration(make_blocked_door(), straight) > 0.02
    rows = find_path_with_door(seed)
    assert rows is not None
    assert rows.shape == straight.shape
    assert compute_penetration(make_blocked_door(), rows) <= 5e-3  # waypoints are between nodes
    assert_holds_the_handle(p, rows)
    hinge = rows[:, p.chain.index("door.hinge")]
    assert hinge[-1] == pytest.approx(1.2)
    assert np.all((hinge >= -1e-9) & (hinge <= 1.2 + 1e-9))
    lower, upper = p.lower[p.ends[MOVE] - 1], p.upper[p.ends[MOVE] - 1]
    assert np.all(((rows >= lower - 1e-9) & (rows <= upper + 1e-9))[:, :9])
    steps = np.abs(np.diff(np.vstack([through[0], rows]), axis=0)).max(axis=1)
    assert steps[0] < 0.1
    assert steps.max() < 0.6
    if seed == 1:
        np.testing.assert_array_equal(find_path_with_door(seed), rows)


def test_next_phase_begins_where_the_closed_path_ends() -> None:
    p, (_, path, waypoints, _) = make_blocked_door(), make_free_door()
    sampler = make_sampler(p)
    approach = ApproachPaths(sampler, keeps_base_fixed=True)
    paths = RrtPaths(sampler, BaseRoutes(p))
    z = Interpolator(sampler, approach, paths).interpolate(path, waypoints)
    assert z is not None
    begin, end = int(p.ends[MOVE - 1]), int(p.ends[MOVE])
    assert compute_penetration(p, z[begin:end]) <= 5e-3
    assert_holds_the_handle(p, z[int(p.ends[0]) - 1 : end])
    assert z[-1, p.chain.index("door.hinge")] == pytest.approx(1.2)
    assert np.abs(np.diff(z, axis=0))[:, 3:9].max() < 1.0


def test_closed_path_stays_within_the_limits_of_the_object() -> None:
    """Nodes between two waypoints may exceed those of both."""
    p = make_blocked_door()
    inside, hinge = slice(int(p.ends[MOVE - 1]), int(p.ends[MOVE]) - 1), p.chain.index("door.hinge")
    upper = p.upper.copy()
    upper[inside, hinge] = 1.0
    sampler = make_sampler(p.with_bounds(p.lower, upper))
    approach = ApproachPaths(sampler, keeps_base_fixed=True)
    paths = RrtPaths(sampler, BaseRoutes(sampler.problem))
    z = Interpolator(sampler, approach, paths).interpolate(*make_free_door()[1:3])
    assert z is not None
    assert z[inside, hinge].max() == 1.0
    assert_holds_the_handle(p, z[inside])


def test_free_phases_and_colliding_starts_need_no_trees() -> None:
    p, (through, straight) = make_free_door()[0], get_move_phase()
    assert compute_penetration(p, straight) <= 0.0
    assert not needs_trees(make_sampler(p), MOVE, through, straight)
    assert needs_trees(make_sampler(make_blocked_door()), MOVE, through, straight)
    colliding = through.copy()
    colliding[0] = straight[len(straight) // 2]
    assert not needs_trees(make_sampler(make_blocked_door()), MOVE, colliding, straight)


def test_extensions_and_budget_end_the_search() -> None:
    assert find_path_with_door(0, max_extensions=0) is None
    with Budget(max_evaluations=50).activate(), pytest.raises(BudgetExhaustedError):
        find_path_with_door(0)
