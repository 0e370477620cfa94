"""Tests of the beam search over keyframes, forwards and backwards."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from helpers.gates import walled
from helpers.small_problems import (
    door_scene,
    hand_off_the_handle,
    program_of,
    with_attachment,
    with_objects,
)

import vkc_pin as vkc
from vkc_pin.planning.initialization import beam_search as module
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.beam_search import BeamSearch, SearchResult
from vkc_pin.planning.initialization.keyframes import KeyframeSampler

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20)
OPEN = vkc.Actuate("door", {"hinge": 1.2})
DIRECTIONS = pytest.mark.parametrize("backwards", [False, True], ids=["forwards", "backwards"])


@cache
def problem(*, around: bool = False) -> vkc.TrajectoryProblem:
    """Return the problem of opening the door; around: and of driving somewhere before and after."""
    steps = [vkc.GoTo(-1.0, 0.0), OPEN, vkc.GoTo(-1.0, 0.5)] if around else [OPEN]
    return program_of(door_scene(), steps, options=FEW)


def beam(seed: int = 0, *, around: bool = False, routes: bool = False) -> BeamSearch:
    p = problem(around=around)
    return BeamSearch(
        KeyframeSampler(p, np.random.default_rng(seed)), BaseRoutes(p) if routes else None
    )


@DIRECTIONS
@pytest.mark.parametrize("thorough", [False, True], ids=["quick", "thorough"])
@pytest.mark.parametrize("around", [False, True], ids=["alone", "driving before and after"])
def test_keyframes_are_ordered_and_satisfy_the_closure(
    thorough: bool, backwards: bool, around: bool
) -> None:
    p, search = problem(around=around), beam(around=around)
    found = search.search(thorough=thorough, backwards=backwards)
    assert found.waypoints[0] == 0
    assert np.all(np.diff(found.waypoints) > 0)
    assert set(p.ends.tolist()) <= set(found.waypoints), "a knot at the end of every phase"
    assert found.waypoints == beam(around=around).search(thorough=thorough).waypoints
    assert found.paths.shape == (len(found.cost), len(found.waypoints), p.chain.size)
    assert found.cost.shape == found.collision_cost.shape
    np.testing.assert_array_equal(found.paths[:, 0], np.tile(p.start, (len(found.cost), 1)))
    rows = np.array(found.waypoints[1:]) - 1
    assert np.all(found.paths[:, 1:] >= p.lower[rows] - 1e-9)
    assert np.all(found.paths[:, 1:] <= p.upper[rows] + 1e-9)
    hinge, knob = (p.chain.index(f"door.{name}") for name in ("hinge", "knob"))
    np.testing.assert_allclose(
        found.paths[:, 1:, [hinge, knob]],
        np.tile(search.sampler.object_motion[rows][:, [hinge, knob]], (len(found.cost), 1, 1)),
    )
    reach, _, move = (int(end) for end in p.ends[1 if around else 0 :][:3])
    held = [k for k, waypoint in enumerate(found.waypoints) if reach <= waypoint <= move]
    assert len(held) >= 6
    good = np.argsort(found.cost)[:3]
    for path in found.paths[good]:
        for row in path[held]:
            assert hand_off_the_handle(door_scene(), row, row[hinge], row[knob]) < 1e-3


@DIRECTIONS
@pytest.mark.parametrize("around", [False, True], ids=["alone", "driving before and after"])
def test_path_cost_is_length_plus_collisions(backwards: bool, around: bool) -> None:
    """Paths run from start to end, whatever the search direction."""
    search = beam(1, around=around)
    found = search.search(thorough=True, backwards=backwards)
    steps = np.abs(np.diff(found.paths, axis=1)) * np.sqrt(
        problem(around=around).effort.metric / 0.025
    )
    way = np.linalg.norm(steps[..., :2], axis=2).sum(axis=1) + steps[..., 2:].sum(axis=(1, 2))
    np.testing.assert_allclose(found.cost, way + found.collision_cost, rtol=1e-9)
    trouble = np.zeros(len(found.cost))
    for k, waypoint in enumerate(found.waypoints[1:], start=1):
        at = np.full(len(trouble), waypoint)
        short = (
            problem(around=around)
            .contacts.evaluate(found.paths[:, k], at, reach=0.1)
            .compute_shortfall(len(trouble))
        )
        trouble += np.where(short > 0.0, 10.0 + 300.0 * short, 0.0)
    reached = found.collision_cost < 1e3
    assert reached.any()
    np.testing.assert_allclose(found.collision_cost[reached], trouble[reached], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    "steps", [[vkc.Grasp("door")], [vkc.GoTo(-1.0, 0.0), OPEN]], ids=["grasp", "drive and open"]
)
def test_shortened_paths_cost_no_more_and_still_grasp(steps: list[vkc.Step]) -> None:
    p = program_of(door_scene(), steps, options=FEW)
    search = BeamSearch(KeyframeSampler(p, np.random.default_rng(1)))
    found = search.search(thorough=False)
    short = search.shorten(found)
    assert (short.cost <= found.cost).all()
    # What is held already binds the base to where it is grasped; there all together would have to
    # move.
    assert (short.cost / found.cost).min() < (0.97 if len(steps) == 1 else 1.0)
    ways = np.abs(np.diff(short.paths, axis=1)) * np.sqrt(p.effort.metric / 0.025)
    way = np.linalg.norm(ways[..., :2], axis=2).sum(axis=1) + ways[..., 2:].sum(axis=(1, 2))
    np.testing.assert_allclose(short.cost, way + short.collision_cost, rtol=1e-9)
    (moved,) = np.flatnonzero((short.paths != found.paths).any(axis=(0, 2)))
    assert found.waypoints[moved] == p.ends[len(steps) - 1]  # where the base is sent it stays
    hinge, knob = (p.chain.index(name) for name in ("door.hinge", "door.knob"))
    for row, trouble in zip(short.paths[:, moved], short.collision_cost, strict=True):
        assert (
            trouble >= 1e3 or hand_off_the_handle(door_scene(), row, row[hinge], row[knob]) < 1e-3
        )
        assert (row >= p.chain.lower - 1e-9).all()
        assert (row <= p.chain.upper + 1e-9).all()


def test_shortened_paths_update_collision_costs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search = BeamSearch(
        KeyframeSampler(
            program_of(door_scene(), [vkc.Grasp("door")], options=FEW), np.random.default_rng(1)
        ),
        for_narrow_passages=True,
    )
    found = search.search(thorough=False)
    monkeypatch.setattr(search, "_compute_penalty", lambda z, *_: np.abs(z[:, 0]))
    short = search.shorten(found)
    assert np.count_nonzero(short.collision_cost != found.collision_cost) > len(found.cost) / 2
    np.testing.assert_allclose(
        short.collision_cost - found.collision_cost,
        np.abs(short.paths[:, -1, 0]) - np.abs(found.paths[:, -1, 0]),
    )


def test_cheapest_of_similar_ends_is_kept() -> None:
    z = np.array([[0.0, 0.0], [0.05, 0.05], [0.3, 0.0], [0.3, 0.05], [0.3, 0.25], [2.0, 0.0]])
    total = np.array([3.0, 2.0, 4.0, 5.0, 6.0, 1.0])
    assert BeamSearch._select_beam(total, z, 6, 10).tolist() == [5, 1, 2, 4]
    assert BeamSearch._select_beam(total, z, 6, 3).tolist() == [5, 1, 2]
    assert BeamSearch._select_beam(total, z, 5, 10).tolist() == [5, 1, 2, 4]
    assert BeamSearch._select_beam(total, z, 2, 4).tolist() == [
        5,
        1,
        2,
    ]  # two of four are shortened: no more of them


def test_diverse_headings_are_kept_on_request() -> None:
    """With sectors, expensive paths of other headings precede the fifth of one sector."""
    z = np.zeros((12, 4))
    z[:, 0], z[10:, 2] = np.arange(12.0), (2.0, -2.0)
    total = np.arange(12.0)
    assert BeamSearch._select_beam(total, z, 12, 6, 1).tolist() == [0, 1, 2, 3, 4, 5]
    assert BeamSearch._select_beam(total, z, 12, 6, 8).tolist() == [0, 1, 2, 3, 10, 11]
    assert BeamSearch._select_beam(total, z, 12, 8, 8).tolist() == [0, 1, 2, 3, 10, 11, 4, 5]


def test_no_two_paths_end_at_similar_configurations() -> None:
    found = beam(1).search(thorough=True)
    ends = found.paths[:, -1]
    assert all(
        np.abs(ends[k + 1 :] - end).max(axis=1, initial=0.0).min(initial=1.0) > 0.1
        for k, end in enumerate(ends)
    )


def test_paths_to_grasps_are_shortened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Shortening the result of a search again hardly reduces its cost."""
    search = BeamSearch(
        KeyframeSampler(
            program_of(door_scene(), [vkc.Grasp("door")], options=FEW), np.random.default_rng(1)
        )
    )
    found = search.search(thorough=False)
    assert found.cost.min() < 1.02 * search.shorten(found).cost.min()
    with monkeypatch.context() as patch:
        patch.setattr(module, "_SHORTENING_ROUNDS", 0)
        drawn = BeamSearch(KeyframeSampler(search.problem, np.random.default_rng(1))).search(
            thorough=False
        )
    assert found.cost.min() < drawn.cost.min()
    careful = BeamSearch(
        KeyframeSampler(search.problem, np.random.default_rng(1)), for_narrow_passages=True
    ).search(thorough=False)
    assert careful.cost.min() > found.cost.min(), "what is short may be what trees do not lead to"


@DIRECTIONS
def test_search_is_deterministic(backwards: bool) -> None:
    one, same = (beam(2).search(thorough=True, backwards=backwards) for _ in range(2))
    np.testing.assert_array_equal(one.paths, same.paths)
    np.testing.assert_array_equal(one.cost, same.cost)


def test_without_a_grasp_backwards_is_forwards() -> None:
    gone = walled(1.6)
    one, other = (
        BeamSearch(KeyframeSampler(gone, np.random.default_rng(0))).search(
            thorough=True, backwards=back
        )
        for back in (False, True)
    )
    np.testing.assert_array_equal(one.paths, other.paths)
    assert one.waypoints == other.waypoints == [0, gone.segments]


def test_rigid_grasp_keeps_its_choice_backwards() -> None:
    clamped(backwards=True)


def test_rigid_grasp_keeps_its_choice_forwards() -> None:
    clamped(backwards=False)


def gripping(*, firm: bool) -> vkc.TrajectoryProblem:
    """Return a door problem with a free or a rigid grasp."""
    scene = door_scene()
    tilting = dataclasses.replace(
        scene.objects["door"].object.attachment("handle_free"), name="tilted", firm=firm
    )
    scene = with_objects(scene, {"door": with_attachment(scene.objects["door"], tilting)})
    return program_of(scene, [dataclasses.replace(OPEN, attachment="tilted")], options=FEW)


@pytest.mark.parametrize("firm", [False, True])
def test_rigid_grasp_is_chosen_before_the_object_moves(
    firm: bool,
) -> None:
    """A rigid grasp is searched forwards, a free one backwards."""
    p = gripping(firm=firm)
    assert bool(p.choices) == firm
    one, other = (
        BeamSearch(KeyframeSampler(p, np.random.default_rng(0))).search(
            thorough=True, backwards=back
        )
        for back in (False, True)
    )
    assert np.array_equal(one.paths, other.paths) == firm


def clamped(*, backwards: bool) -> None:
    p = gripping(firm=True)
    ((column, grasp, last),) = p.choices
    found = BeamSearch(KeyframeSampler(p, np.random.default_rng(1))).search(
        thorough=True, backwards=backwards
    )
    held = [k for k, waypoint in enumerate(found.waypoints) if grasp <= waypoint <= last]
    chosen = found.paths[:, held, column]
    assert np.ptp(chosen, axis=1).max() < 1e-6, "the freedom changes while the hand clamps"
    assert np.ptp(chosen) > 0.01, "it is the same in all paths"


# --- what is tolerable
# ------------------------------------------------------------


def going(jump: float, when: int, *, trouble: float = 0.0) -> SearchResult:
    """Return two paths, the cheaper one with a jump of the base [m]."""
    p, at = problem(), beam().search(thorough=False).waypoints
    paths = np.tile(p.start, (2, len(at), 1))
    paths[1, at.index(when) :, 1] += jump
    paths[0, :, :2] += np.linspace(0.0, 50.0, len(at))[:, None]
    return SearchResult(paths, np.array([2.0, 1.0]), np.array([1e3, trouble]), at)


@pytest.mark.parametrize("routes", [False, True])
def test_grazes_are_acceptable_and_collisions_are_not(routes: bool) -> None:
    search, end = beam(routes=routes), int(problem().ends[0])
    assert search.is_acceptable(going(0.0, end))
    assert search.is_acceptable(going(0.0, end, trouble=59.0))
    assert not search.is_acceptable(going(0.0, end, trouble=61.0))


def test_base_jumps_are_rejected_in_closed_phases() -> None:
    reach, turn, move = problem().ends.tolist()
    for when in (turn, move):
        assert beam(routes=True).is_acceptable(going(0.4, when))
        assert not beam(routes=True).is_acceptable(going(0.6, when))
        assert not beam(routes=True).is_acceptable(going(-0.6, when))
        assert beam().is_acceptable(going(0.6, when)), "without ways of the base nobody asks"
    assert beam(routes=True).is_acceptable(going(3.0, reach)), (
        "on the way to the handle it may be anywhere"
    )


# --- careful
# ------------------------------------------------------------


def test_approach_precedes_the_grasp_by_its_waypoints() -> None:
    """The approach starts after the first waypoint of its phase at the latest."""
    grasp, options = int(problem().ends[0]), problem().options
    assert beam().approaches == {grasp: grasp - options.steps(options.approach_time)}
    assert beam().sampler.find_pose(grasp - options.steps(options.approach_time)) is not None
    _, grasp, *_ = problem(around=True).ends.tolist()
    assert beam(around=True).approaches == {grasp: grasp - options.steps(options.approach_time)}
    brief = program_of(door_scene(), [OPEN], options=dataclasses.replace(FEW, reach_waypoints=3))
    assert BeamSearch(KeyframeSampler(brief, np.random.default_rng(0))).approaches == {3: 1}


@pytest.mark.parametrize("careful", [False, True])
def test_search_for_narrow_passages_counts_approach_collisions(
    careful: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One grasp is blocked, one has a blocked approach, and one has none."""
    search, grasp = (
        BeamSearch(
            KeyframeSampler(problem(), np.random.default_rng(0)), for_narrow_passages=careful
        ),
        int(problem().ends[0]),
    )
    before = search.approaches[grasp]
    depths = {grasp: np.array([0.01, 0.0, 0.0, 0.0]), before: np.array([0.02, 0.0, 0.0])}
    z, found = np.tile(problem().start, (4, 1)), np.ones(4, bool)
    z[:, 4] += np.arange(4)

    def knot(near: np.ndarray, waypoint: int, how: str) -> tuple[np.ndarray, np.ndarray]:
        assert (waypoint, how) == (before, "track")
        np.testing.assert_array_equal(near, z[1:])  # those that are free where they grasp
        return near, np.array([True, False, True])

    monkeypatch.setattr(search.sampler, "compute_shortfall", lambda _, waypoint: depths[waypoint])
    monkeypatch.setattr(search.sampler, "sample", knot)
    bad = search._compute_penalty(z, found, grasp)
    collision = [module._COLLISION_COST + module._DEPTH_COST * depth for depth in (0.01, 0.02)]
    np.testing.assert_allclose(
        bad,
        [collision[0], collision[1], module._UNREACHABLE_COST, 0.0]
        if careful
        else [collision[0], 0, 0, 0],
    )
    depths[int(problem().ends[1])] = np.zeros(4)
    np.testing.assert_array_equal(
        search._compute_penalty(z, found, int(problem().ends[1])), np.zeros(4)
    )


def test_search_for_narrow_passages_finds_free_approaches() -> None:
    """At the narrow door a free grasp may have a blocked approach."""
    scene = (
        vkc.load_scene("household")
        .with_state("door", {"hinge": 1.52})
        .with_start(base=(1.5, -0.5, 1.57))
    )
    p = program_of(scene, [vkc.Grasp("door", "handle_free"), vkc.Actuate("door", {"hinge": 0.0})])
    grasp, routes, shares = int(p.ends[0]), BaseRoutes(p), []
    for careful in (False, True):
        search = BeamSearch(
            KeyframeSampler(p, np.random.default_rng(0)), routes, for_narrow_passages=careful
        )
        found = search.search(thorough=True, backwards=True)
        before, held = (
            search.approaches[grasp],
            found.paths[found.collision_cost == 0.0, found.waypoints.index(grasp)],
        )
        assert len(held), "every path is blocked"
        near, reached = search.sampler.sample(held, before, "track")
        hit = p.contacts.evaluate(near, np.full(len(near), before), reach=0.1).compute_shortfall(
            len(near)
        )
        shares.append(float(np.mean((hit <= 1e-9) & reached)))
    assert shares[0] < shares[1] == 1.0


def test_task_that_ends_with_a_free_grasp() -> None:
    """No phase follows, so the search runs forwards."""
    scene = vkc.load_scene("init_1").sample_start(np.random.default_rng(0))
    problem = program_of(scene, [vkc.Grasp("stick")])
    assert {grasp for _, grasp, _ in problem.choices} == {problem.segments}
    one, other = (
        BeamSearch(KeyframeSampler(problem, np.random.default_rng(0))).search(
            thorough=True, backwards=back
        )
        for back in (False, True)
    )
    assert one is not None
    assert other is not None
    assert one.waypoints == other.waypoints == [0, problem.segments]
    np.testing.assert_array_equal(one.paths, other.paths)
