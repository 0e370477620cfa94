"""Tests the beam search over keyframes, forwards and backwards."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from helpers.gates import make_wall_problem
from helpers.judging import replace_attachments
from helpers.small_problems import compute_grasp_error, load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.beam_search import BeamSearch, SearchResult
from vkc_pin.planning.initialization.keyframes import SIMILARITY_TOLERANCE, KeyframeSampler

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20)
OPEN = vkc.Actuate("door", {"hinge": 1.2})


@cache
def make_problem(*, drives: bool = False, grasps: bool = False) -> vkc.TrajectoryProblem:
    """Return the problem of opening or grasping the door, optionally between two drives."""
    steps: list[vkc.steps.Step] = [vkc.Grasp("door") if grasps else OPEN]
    if drives:
        steps = [vkc.GoTo(-1.0, 0.0), *steps, vkc.GoTo(-1.0, 0.5)]
    return make_program(load_door_scene(), steps, options=FEW)


def make_search(p: vkc.TrajectoryProblem, routes: BaseRoutes | None = None) -> BeamSearch:
    return BeamSearch(KeyframeSampler(p, np.random.default_rng(0)), routes)


@cache
def run_search(
    *, drives: bool = False, thorough: bool = True, backwards: bool = False
) -> SearchResult:
    return make_search(make_problem(drives=drives)).search(thorough=thorough, backwards=backwards)


def search_both_ways(p: vkc.TrajectoryProblem) -> tuple[SearchResult, SearchResult]:
    """Search forwards and backwards."""
    one, other = (make_search(p).search(thorough=True, backwards=each) for each in (False, True))
    return one, other


@pytest.mark.parametrize(
    ("drives", "thorough", "backwards"),
    [(False, False, False), (False, True, True), (True, True, False), (True, False, True)],
)
def test_keyframes_are_ordered_and_hold_the_handle(
    drives: bool, thorough: bool, backwards: bool
) -> None:
    p = make_problem(drives=drives)
    found = run_search(drives=drives, thorough=thorough, backwards=backwards)
    count, waypoints = len(found.cost), found.waypoints
    assert waypoints[0] == 0
    assert np.all(np.diff(waypoints) > 0)
    assert set(p.ends.tolist()) <= set(waypoints), "every phase ends with a keyframe"
    assert found.paths.shape == (count, len(waypoints), p.chain.size)
    np.testing.assert_array_equal(found.paths[:, 0], np.tile(p.start, (count, 1)))
    rows = np.array(waypoints[1:]) - 1
    assert np.all(found.paths[:, 1:] >= p.lower[rows] - 1e-9)
    assert np.all(found.paths[:, 1:] <= p.upper[rows] + 1e-9)
    columns = hinge, knob = [p.chain.index(f"door.{name}") for name in ("hinge", "knob")]
    motion = make_search(p).sampler.object_motion[rows][:, columns]
    np.testing.assert_allclose(found.paths[:, 1:, columns], np.tile(motion, (count, 1, 1)))
    reach, _, move = (int(end) for end in p.ends[1 if drives else 0 :][:3])
    closed = [k for k, waypoint in enumerate(waypoints) if reach <= waypoint <= move]
    assert len(closed) >= 6
    for row in found.paths[np.argsort(found.cost)[:3]][:, closed].reshape(-1, p.chain.size):
        assert compute_grasp_error(load_door_scene(), row, row[hinge], row[knob]) < 1e-3


@pytest.mark.parametrize("backwards", [False, True], ids=["forwards", "backwards"])
@pytest.mark.parametrize("drives", [False, True])
def test_path_cost_is_length_plus_collisions(backwards: bool, drives: bool) -> None:
    """Lengths are measured in radians of the arm."""
    p, found = make_problem(drives=drives), run_search(drives=drives, backwards=backwards)
    steps = np.abs(np.diff(found.paths, axis=1)) * np.sqrt(p.motion_cost.metric / 0.025)
    lengths = np.linalg.norm(steps[..., :2], axis=2) + steps[..., 2:].sum(axis=2)
    np.testing.assert_allclose(found.cost, lengths.sum(axis=1) + found.collision_cost, rtol=1e-9)
    count, expected = len(found.cost), np.zeros(len(found.cost))
    for k, waypoint in enumerate(found.waypoints[1:], start=1):
        contacts = p.contacts.evaluate(found.paths[:, k], np.full(count, waypoint), reach=0.1)
        short = contacts.compute_shortfall(count)
        expected += np.where(short > 0.0, 10.0 + 300.0 * short, 0.0)
    reached = found.collision_cost < 1e3
    assert reached.any()
    np.testing.assert_allclose(found.collision_cost[reached], expected[reached], atol=1e-6)


def test_path_cost_with_routes_is_the_driving_distance() -> None:
    p = make_wall_problem(1.6)
    routes = BaseRoutes(p)
    found = make_search(p, routes).search(thorough=False)
    path = found.paths[0]
    (distance,) = routes.compute_distances(0, path[:1, :3], path[1:, :3])
    assert distance > np.hypot(*(path[1] - path[0])[:2]) + 1.0
    metric = np.sqrt(p.motion_cost.metric / 0.025)
    turned = np.abs(path[1] - path[0])[2:] @ metric[2:]
    assert found.cost[0] == pytest.approx(metric[0] * distance + turned)


def test_no_two_paths_end_at_similar_configurations() -> None:
    ends = run_search().paths[:, -1]
    assert len(ends) > 5
    for k, end in enumerate(ends):
        distances = np.abs(ends[k + 1 :] - end).max(axis=1)
        assert distances.min(initial=1.0) > SIMILARITY_TOLERANCE


def test_diverse_headings_are_kept_on_request() -> None:
    """At most four of the 24 grasps have headings in the same eighth of the circle."""
    counts = []
    for keep in (False, True):
        found = make_search(make_problem(grasps=True)).search(thorough=True, keep_headings=keep)
        sectors = np.floor(found.paths[:, -1, 2] / (np.pi / 4)).astype(int) % 8
        counts.append(np.bincount(sectors, minlength=8))
    assert counts[0].sum() == counts[1].sum() == 24
    assert counts[0].max() > counts[1].max() == 4


@pytest.mark.parametrize("firm", [False, True])
def test_rigid_grasp_is_chosen_before_the_object_moves(firm: bool) -> None:
    """A rigid grasp is searched forwards, a free one backwards."""
    grip = load_door_scene().objects["door"].object.attachment("handle_free")
    scene = replace_attachments(
        load_door_scene(), {"tilted": dataclasses.replace(grip, name="tilted", firm=firm)}
    )
    p = make_program(scene, [dataclasses.replace(OPEN, attachment="tilted")], options=FEW)
    assert bool(p.choices) == firm
    one, other = search_both_ways(p)
    assert np.array_equal(one.paths, other.paths) == firm
    for column, grasp, last in p.choices:
        closed = [k for k, waypoint in enumerate(one.waypoints) if grasp <= waypoint <= last]
        chosen = one.paths[:, closed, column]
        assert np.ptp(chosen, axis=1).max() < 1e-6
        assert np.ptp(chosen) > 0.01


def test_open_phases_at_the_end_are_searched_forwards() -> None:
    """A drive, and a task that ends with a free grasp."""
    scene = vkc.load_scene("init_1").sample_start(np.random.default_rng(0))
    for p in (make_wall_problem(1.6), make_program(scene, [vkc.Grasp("stick")])):
        one, other = search_both_ways(p)
        np.testing.assert_array_equal(one.paths, other.paths)
        assert one.waypoints == other.waypoints == [0, p.segments]


@pytest.mark.parametrize("has_routes", [False, True])
def test_grazes_are_acceptable_but_collisions_and_base_jumps_are_not(has_routes: bool) -> None:
    """Jumps are checked in closed phases, if base routes are known."""
    p, waypoints = make_problem(), run_search().waypoints
    search = make_search(p, BaseRoutes(p) if has_routes else None)

    def is_acceptable(collision_cost: float, jump: float, waypoint: int) -> bool:
        """Judge two paths, the cheaper of which jumps [m] at a waypoint and else is stationary."""
        paths = np.tile(p.start, (2, len(waypoints), 1))
        paths[0, :, :2] += np.linspace(0.0, 50.0, len(waypoints))[:, None]
        paths[1, waypoints.index(waypoint) :, 1] += jump
        costs, collision_costs = np.array([2.0, 1.0]), np.array([1e3, collision_cost])
        return search.is_acceptable(SearchResult(paths, costs, collision_costs, waypoints))

    reach, turn, move = p.ends.tolist()
    assert is_acceptable(50.0, 3.0, reach)
    assert not is_acceptable(70.0, 0.0, reach)
    for waypoint in (turn, move):
        assert is_acceptable(0.0, 0.3, waypoint)
        for jump in (0.7, -0.7):
            assert is_acceptable(0.0, jump, waypoint) != has_routes


def test_search_for_narrow_passages_finds_free_approaches() -> None:
    """At the narrow door a free grasp may have a blocked approach."""
    scene = vkc.load_scene("household").with_state("door", {"hinge": 1.52})
    steps = [vkc.Grasp("door", "handle_free"), vkc.Actuate("door", {"hinge": 0.0})]
    p = make_program(scene.with_start(base=(1.5, -0.5, 1.57)), steps)
    grasp, routes, fractions = int(p.ends[0]), BaseRoutes(p), []
    before = grasp - p.options.steps(p.options.approach_time)
    for narrow in (False, True):
        sampler = KeyframeSampler(p, np.random.default_rng(0))
        search = BeamSearch(sampler, routes, for_narrow_passages=narrow)
        found = search.search(thorough=True, backwards=True)
        free = found.paths[found.collision_cost == 0.0, found.waypoints.index(grasp)]
        assert len(free)
        near, reached = sampler.sample(free, before, "track")
        contacts = p.contacts.evaluate(near, np.full(len(near), before), reach=0.1)
        fractions.append(np.mean((contacts.compute_shortfall(len(near)) <= 1e-9) & reached))
    assert fractions[0] < fractions[1] == 1.0
