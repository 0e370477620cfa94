"""Tests interpolation between keyframes: straight, along base paths, and with RRT."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from helpers.drives import make_hall
from helpers.gates import GOAL, NARROW, make_gate_problem, make_wall_problem, make_waypoint
from helpers.small_problems import compute_grasp_error, load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.initialization import interpolation
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.beam_search import BeamSearch
from vkc_pin.planning.initialization.interpolation import AStarPaths, Interpolator, Paths, RrtPaths
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, sample_smoothstep
from vkc_pin.planning.initialization.open_trees import OpenSearch

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20)
ROBOT_SIZE = 9  # x, y and yaw of the base, six joints of the arm


@cache
def make_door_problem() -> tuple[vkc.TrajectoryProblem, np.ndarray, list[int]]:
    """Return the door problem, collision-free keyframes, and their waypoints."""
    p = make_program(load_door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=FEW)
    found = BeamSearch(KeyframeSampler(p, np.random.default_rng(0))).search(thorough=True)
    best = int(np.argmin(np.where(found.collision_cost == 0.0, found.cost, np.inf)))
    assert found.collision_cost[best] == 0.0
    return p, found.paths[best], found.waypoints


def make_interpolator(p: vkc.TrajectoryProblem, paths: Paths | None = None) -> Interpolator:
    sampler = KeyframeSampler(p, np.random.default_rng(0))
    return Interpolator(sampler, ApproachPaths(sampler), paths)


def make_rrt_paths(p: vkc.TrajectoryProblem) -> RrtPaths:
    return RrtPaths(KeyframeSampler(p, np.random.default_rng(0)), BaseRoutes(p))


def interpolate(
    p: vkc.TrajectoryProblem,
    *ends: Sequence[float],
    paths: Paths | None = None,
) -> np.ndarray:
    """Interpolate from the start to poses of the base at the ends of the phases."""
    keyframes = np.array([p.start, *(make_waypoint(p, end) for end in ends)])
    z = make_interpolator(p, paths).interpolate(keyframes, [0, *p.ends.tolist()])
    assert z is not None
    return z


def test_straight_paths_start_and_end_at_rest() -> None:
    p = make_program(make_hall(), [vkc.GoTo(2.0, 1.0, 0.5)])
    expected = np.outer(sample_smoothstep(p.segments), [2.0, 1.0, 0.5])
    z = interpolate(p, (2.0, 1.0, 0.5))
    np.testing.assert_allclose(z[:, :3], expected, atol=1e-12)


def test_base_path_ends_where_the_approach_begins() -> None:
    p, keyframes, waypoints = make_door_problem()
    original, routes = keyframes.copy(), BaseRoutes(p)
    z = make_interpolator(p, AStarPaths(routes)).interpolate(keyframes, waypoints)
    assert z is not None
    np.testing.assert_array_equal(keyframes, original)
    steps = int(p.ends[0]) - FEW.steps(FEW.approach_time)
    grasp = keyframes[waypoints.index(int(p.ends[0]))]
    approach = ApproachPaths(KeyframeSampler(p, np.random.default_rng(0)))
    (near,) = approach.find_approach_start(grasp, p.task.phases[0])
    path = routes.find_path(0, p.start[:3], near[:3], steps)
    assert path is not None
    np.testing.assert_allclose(z[:steps, :2], path[:, :2], atol=1e-4)
    error = z[int(p.ends[0]) - 1] - grasp
    np.testing.assert_allclose(np.delete(error, 2), 0.0, atol=1e-3)  # the heading may be wound
    hinge, knob = (p.chain.index(f"door.{name}") for name in ("hinge", "knob"))
    for row in z[int(p.ends[0]) - 1 :]:
        assert compute_grasp_error(load_door_scene(), row, row[hinge], row[knob]) < 1e-3
    assert z[-1, hinge] == pytest.approx(1.2)


@pytest.mark.parametrize("turns", [-1, 2])
def test_later_headings_continue_where_the_base_path_ends(turns: int) -> None:
    """Headings of keyframes may differ by full turns."""
    p, keyframes, waypoints = make_door_problem()
    wound = keyframes.copy()
    wound[1:, 2] += turns * 2 * np.pi
    interpolator = make_interpolator(p, AStarPaths(BaseRoutes(p)))
    plain, other = (interpolator.interpolate(each, waypoints) for each in (keyframes, wound))
    assert other is not None
    np.testing.assert_allclose(other, plain, atol=1e-3)
    assert np.abs(np.diff(other[:, 2])).max() < 1.0


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_base_path_unwinds_if_the_goal_fixes_the_heading(turns: int) -> None:
    p = make_wall_problem(1.6)
    paths, end = AStarPaths(BaseRoutes(p)), make_waypoint(p, (4.0, 1.5, turns * 2 * np.pi))
    free, fixed = (
        paths.find_path(0, p.start, end, 40, turns=each, reaches=True) for each in (True, False)
    )
    assert free is not None
    assert fixed is not None
    np.testing.assert_allclose(free[-1, :3], [4.0, 1.5, 0.0], atol=1e-9)
    added = np.arange(1, 41) / 40 * turns * 2 * np.pi
    np.testing.assert_allclose(fixed[:, :3], free[:, :3] + np.outer(added, [0, 0, 1]), atol=1e-9)


def test_astar_paths_move_the_arm_straight() -> None:
    p = make_wall_problem(1.6)
    routes, end = BaseRoutes(p), make_waypoint(p, (4.0, 1.5, 0.0))
    end[3:] += 0.2
    interpolator = make_interpolator(p, AStarPaths(routes))
    z = interpolator.interpolate(np.array([p.start, end]), [0, p.segments])
    assert z is not None
    expected = routes.find_path(0, p.start[:3], end[:3], p.segments)
    np.testing.assert_allclose(z[:, :3], expected, atol=1e-9)
    lifted = np.outer(sample_smoothstep(p.segments), np.full(6, 0.2))
    np.testing.assert_allclose(z[:, 3:], p.start[3:] + lifted, atol=1e-9)


def test_missing_paths_are_noted_once_per_phase() -> None:
    steps = [vkc.GoTo(1.0, 1.0, 0.5), vkc.GoTo(4.0, 1.0, 0.5)]
    p = make_program(make_wall_problem(0.0).scene, steps)
    interpolator = make_interpolator(p, AStarPaths(BaseRoutes(p)))
    for x in (1.0, 0.9):
        ends = [make_waypoint(p, (x, 1.0, 0.5)), make_waypoint(p, (4.0, 1.0, 0.5))]
        assert interpolator.interpolate(np.array([p.start, *ends]), [0, *p.ends.tolist()]) is None
    note = "go to: found no path for the base from (1.00, 1.00) to (4.00, 1.00)"
    assert interpolator.blocked == [note]


def test_next_phase_begins_where_the_arm_ended() -> None:
    """The arm is folded in the gate and has no goal, so it may stay folded."""
    beyond = (4.5, 0.5, 0.0)
    p = make_program(make_gate_problem(NARROW).scene, [vkc.GoTo(*GOAL), vkc.GoTo(*beyond)])
    z = interpolate(p, GOAL, beyond, paths=make_rrt_paths(p))
    assert np.abs(np.diff(p.waypoints(z), axis=0)).max() < 1.0
    assert p.evaluate_contacts(z, reach=0.1).compute_violation() < p.options.dist_safe + 0.02


def test_rrt_paths_end_at_the_required_arm() -> None:
    p = make_gate_problem(NARROW)
    end, paths = make_waypoint(p, GOAL), make_rrt_paths(p)
    end[2] += 2 * np.pi
    end[4] += 0.1
    for reaches in (True, False):
        path = paths.find_path(0, p.start, end, 30, turns=True, reaches=reaches)
        assert path is not None
        assert path.shape == (30, ROBOT_SIZE)
        np.testing.assert_allclose(path[-1, :3], GOAL, atol=1e-9)
        folded = paths.routes.find_nearest_folded_arm(0, p.start[3:], end[3:])
        arms = [end[3:], p.start[3:], p.chain.robot.home, paths.routes.get_folded_arm(0), folded]
        allowed = arms[: 1 if reaches else None]
        assert min(np.abs(path[-1, 3:] - arm).max() for arm in allowed) < 1e-9


@pytest.mark.parametrize("yaw", [-2 * np.pi, 2 * np.pi, -3.1])
def test_rrt_paths_turn_as_far_as_the_goal_requires(yaw: float) -> None:
    """The base cannot turn inside the gate."""
    p = make_gate_problem(NARROW)
    end = make_waypoint(p, (*GOAL[:2], yaw))
    path = make_rrt_paths(p).find_path(0, p.start, end, 60, turns=False, reaches=True)
    assert path is not None
    np.testing.assert_allclose(path[-1], end, atol=1e-9)
    z = np.tile(p.start, (60, 1))
    z[:, :ROBOT_SIZE] = path
    assert p.evaluate_contacts(z, reach=0.1).compute_violation() < p.options.dist_safe + 0.02
    inside = np.abs(path[:, 0] - 2.0) < 0.1
    assert np.abs(np.sin(path[inside, 2])).max(initial=0.0) < 0.2


def test_searches_get_longer_after_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second one keeps the full clearance; every phase counts its own failures."""
    scene = make_gate_problem(NARROW).scene
    p = make_program(scene, [vkc.GoTo(*GOAL), vkc.GoTo(*GOAL[:2], 1.0)])
    paths, limits = make_rrt_paths(p), list[tuple[int, float]]()

    def fail(search: OpenSearch, steps: int, max_checks: int) -> None:
        limits.append((max_checks, search.allowed))

    monkeypatch.setattr(OpenSearch, "find_path", fail)
    end = make_waypoint(p, GOAL)
    for phase in (0, 0, 0, 0, 1):
        assert paths.find_path(phase, p.start, end, 9, turns=False, reaches=True) is None
    checks, lenient = interpolation.FIRST_CHECKS, p.options.dist_safe
    expected = [(checks, lenient), (checks, 0.0), (2 * checks, lenient), (2 * checks, 0.0)]
    assert limits == [*expected, (checks, lenient)]
