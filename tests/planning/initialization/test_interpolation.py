"""Tests of interpolation between keyframes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.drives import hall
from helpers.gates import GOAL, NARROW, at, gated, walled
from helpers.small_problems import door_scene, hand_off_the_handle, program_of

import vkc_pin as vkc
from vkc_pin.planning.initialization import interpolation as joining
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.beam_search import BeamSearch
from vkc_pin.planning.initialization.interpolation import AStarPaths, Interpolator, Paths, RrtPaths
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, sample_smoothstep
from vkc_pin.planning.initialization.rrt import MAX_EXTENSIONS

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20)
OPEN = vkc.Actuate("door", {"hinge": 1.2})
ROBOT = 9  # x, y and yaw of the base, six joints of the arm


@cache
def door() -> tuple[vkc.TrajectoryProblem, np.ndarray, tuple[int, ...]]:
    """Return the door problem, its keyframes and their waypoints."""
    p = program_of(door_scene(), [OPEN], options=FEW)
    found = BeamSearch(KeyframeSampler(p, np.random.default_rng(0))).search(thorough=True)
    best = int(np.argmin(np.where(found.collision_cost == 0.0, found.cost, np.inf)))
    assert found.collision_cost[best] == 0.0
    return p, found.paths[best], tuple(found.waypoints)


def interpolator(p: vkc.TrajectoryProblem, paths: Paths | None = None) -> Interpolator:
    sampler = KeyframeSampler(p, np.random.default_rng(0))
    return Interpolator(sampler, ApproachPaths(sampler), paths)


def trees(p: vkc.TrajectoryProblem, seed: int = 0) -> RrtPaths:
    return RrtPaths(KeyframeSampler(p, np.random.default_rng(seed)), BaseRoutes(p))


class Say:
    """Fake paths given by a function; records its arguments."""

    def __init__(
        self,
        way: Callable[[np.ndarray, np.ndarray, int], np.ndarray | None],
        *,
        checks_approach: bool = False,
    ) -> None:
        self.checks_approach, self.made = checks_approach, way
        self.asked: list[tuple[int, np.ndarray, np.ndarray, int, bool]] = []
        self.turns: list[bool] = []  # whether headings may end whole turns further

    def find_path(
        self,
        phase: int,
        first: np.ndarray,
        last: np.ndarray,
        steps: int,
        *,
        turns: bool,
        reaches: bool,
    ) -> np.ndarray | None:
        self.asked.append((phase, first.copy(), last.copy(), steps, reaches))
        self.turns.append(turns)
        return self.made(first, last, steps)


def turning(by: float, columns: int = 3) -> Callable[[np.ndarray, np.ndarray, int], np.ndarray]:
    """Return a function that makes straight paths with an additional turn."""

    def way(first: np.ndarray, last: np.ndarray, steps: int) -> np.ndarray:
        end = last.copy()
        end[2] += by
        return np.asarray(
            (first + np.outer(np.arange(1, steps + 1) / steps, end - first))[:, :columns]
        )

    return way


def holds_the_handle(z: np.ndarray) -> None:
    p, _, _ = door()
    hinge, knob = (p.chain.index(f"door.{name}") for name in ("hinge", "knob"))
    for row in z[int(p.ends[0]) - 1 :]:
        assert hand_off_the_handle(door_scene(), row, row[hinge], row[knob]) < 1e-3
    assert z[-1, hinge] == pytest.approx(1.2)


# --- straight
# ------------------------------------------------------------


def test_guess_passes_keyframes_and_closes_the_chain() -> None:
    p, knots, at_ = door()
    given = knots.copy()
    z = interpolator(p).interpolate(knots, list(at_))
    assert z is not None
    np.testing.assert_array_equal(knots, given)  # those of others, too
    assert z.shape == (p.segments, p.chain.size)
    assert np.all((z >= p.lower) & (z <= p.upper))
    reach = int(p.ends[0])
    np.testing.assert_allclose(z[reach - 1], knots[at_.index(reach)], atol=1e-3)
    before = reach - FEW.steps(FEW.approach_time)
    first, last = p.start, z[before - 1]
    share = np.linalg.norm(z[:before] - first, axis=1) / np.linalg.norm(last - first)
    assert np.all(np.diff(share) > 0.0)
    np.testing.assert_allclose(z[:before], first + np.outer(share, last - first), atol=1e-9)
    holds_the_handle(z)


def test_free_phases_follow_the_smooth_profile() -> None:
    p = program_of(hall(), [vkc.GoTo(2.0, 1.0, 0.5)])
    z = interpolator(p).interpolate(np.array([p.start, at(p, (2.0, 1.0, 0.5))]), [0, p.segments])
    assert z is not None
    np.testing.assert_allclose(
        z[:, :3], np.outer(sample_smoothstep(p.segments), [2.0, 1.0, 0.5]), atol=1e-12
    )


# --- along what somebody says
# ------------------------------------------------------------


def test_paths_are_searched_between_retreat_and_approach() -> None:
    p, knots, at_ = door()
    ways = Say(turning(0.0))
    z = interpolator(p, ways).interpolate(knots, list(at_))
    assert z is not None
    ((phase, first, last, steps, reaches),) = ways.asked
    assert (phase, reaches, ways.turns) == (0, True, [True])
    np.testing.assert_array_equal(first, p.start)
    assert steps == int(p.ends[0]) - FEW.steps(FEW.approach_time)
    np.testing.assert_allclose(z[:steps, :3], turning(0.0)(first, last, steps), atol=1e-9)
    hand, ahead = (
        dataclasses.replace(door_scene(), start=row[:ROBOT]).tool_placement()
        for row in (last, knots[at_.index(int(p.ends[0]))])
    )
    np.testing.assert_allclose(hand.actInv(ahead.translation), [0.0, 0.0, FEW.approach], atol=1e-3)
    holds_the_handle(z)


@pytest.mark.parametrize("turns", [-1, 1, 2])
def test_later_headings_continue_after_full_turns(turns: int) -> None:
    p, knots, at_ = door()
    plain = interpolator(p, Say(turning(0.0))).interpolate(knots, list(at_))
    wound = interpolator(p, Say(turning(turns * 2 * np.pi))).interpolate(knots, list(at_))
    assert plain is not None
    assert wound is not None
    reach = int(p.ends[0])
    np.testing.assert_allclose(
        wound[reach - 1 :, 2] - plain[reach - 1 :, 2], turns * 2 * np.pi, atol=1e-3
    )
    others = [k for k in range(p.chain.size) if k != 2]
    np.testing.assert_allclose(wound[:, others], plain[:, others], atol=1e-3)
    assert np.abs(np.diff(wound[reach - 1 :, 2])).max() < 0.5
    holds_the_handle(wound)


@pytest.mark.parametrize(("yaw", "turns"), [(0.5, False), (None, True)])
def test_full_turns_are_allowed_unless_the_goal_fixes_the_heading(
    yaw: float | None, turns: bool
) -> None:
    """The turns of a path are accepted: its search knows where the base can turn."""
    p = program_of(hall(), [vkc.GoTo(2.0, 1.0, yaw)])
    ways = Say(turning(0.0))
    z = interpolator(p, ways).interpolate(
        np.array([p.start, at(p, (2.0, 1.0, 0.5))]), [0, p.segments]
    )
    assert ways.turns == [turns]
    assert z is not None
    np.testing.assert_allclose(
        z[:, :3], np.outer(np.arange(1, p.segments + 1) / p.segments, [2.0, 1.0, 0.5]), atol=1e-9
    )


def test_next_phase_begins_where_the_arm_ended() -> None:
    """Without a goal of the arm it may stay folded."""
    p = program_of(hall(), [vkc.GoTo(2.0, 1.0, 0.5), vkc.GoTo(0.0, 1.0, 0.5)])

    def lifting(first: np.ndarray, last: np.ndarray, steps: int) -> np.ndarray:
        way = turning(0.0, ROBOT)(first, last, steps)
        way[:, 5] = first[5] + 0.4 * np.arange(1, steps + 1) / steps
        return way

    ways, knots = Say(lifting), np.array([p.start, at(p, (2.0, 1.0, 0.5)), at(p, (0.0, 1.0, 0.5))])
    z = interpolator(p, ways).interpolate(knots, [0, *p.ends.tolist()])
    assert z is not None
    assert [(phase, reaches) for phase, *_, reaches in ways.asked] == [(0, False), (1, False)]
    middle = int(p.ends[0])
    assert ways.asked[1][1][5] == pytest.approx(p.start[5] + 0.4)
    assert z[middle - 1, 5] == pytest.approx(p.start[5] + 0.4)
    assert z[-1, 5] == pytest.approx(p.start[5] + 0.8)
    assert np.abs(np.diff(z, axis=0)).max() < 0.2


def test_missing_paths_are_noted_once_per_phase() -> None:
    p = program_of(hall(), [vkc.GoTo(2.0, 1.0, 0.5), vkc.GoTo(0.0, 1.0, 0.5)])
    allowed: list[Any] = [None]
    ways = Say(
        lambda first, last, steps: turning(0.0)(first, last, steps) if allowed.pop(0) else None
    )
    join = interpolator(p, ways)

    def through(x: float) -> np.ndarray | None:
        return join.interpolate(
            np.array([p.start, at(p, (x, 1.0, 0.5)), at(p, (0.0, 1.0, 0.5))]), [0, *p.ends.tolist()]
        )

    assert through(2.0) is None
    assert join.blocked == ["go to: found no path for the base from (0.00, 0.00) to (2.00, 1.00)"]
    allowed += [None]
    assert through(1.9) is None, "another place, the same phase"
    assert len(join.blocked) == 1
    allowed += [True, None]
    assert through(2.0) is None
    assert len(ways.asked) == 4


def test_phases_of_different_names_have_a_line_each() -> None:
    both = program_of(door_scene(), [vkc.GoTo(0.0, 0.0), OPEN], options=FEW)
    found = BeamSearch(KeyframeSampler(both, np.random.default_rng(0))).search(thorough=False)
    allowed: list[Any] = [None, True, None]
    join = interpolator(
        both,
        Say(
            lambda first, last, steps: turning(0.0)(first, last, steps) if allowed.pop(0) else None
        ),
    )
    for _ in range(2):
        assert join.interpolate(found.paths[0], found.waypoints) is None
    assert [line.split(":")[0] for line in join.blocked] == ["go to", "reach door.handle"]


# --- what is hit on the way in
# ------------------------------------------------------------


@pytest.mark.parametrize(
    ("careful", "depth", "kept"),
    [(False, 0.015, True), (True, 0.015, False), (True, 0.005, True)],
)
def test_colliding_approach_is_omitted_if_checked(
    careful: bool, depth: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shortfall above half of the margin omits the approach."""
    p, knots, at_ = door()
    ways = Say(turning(0.0, ROBOT), checks_approach=careful)
    join = interpolator(p, ways)
    monkeypatch.setattr(join.sampler, "compute_shortfall", lambda z, _: np.full(len(z), depth))
    z = join.interpolate(knots, list(at_))
    assert z is not None
    ((_, _, last, steps, _),) = ways.asked
    reach = int(p.ends[0])
    grasp = knots[at_.index(reach)]
    if kept:
        assert steps == reach - FEW.steps(FEW.approach_time)
        assert np.abs(last - grasp)[:ROBOT].max() > 0.01
    else:
        assert steps == reach
        np.testing.assert_array_equal(last, grasp)
    made = ways.made(p.start, last, steps)
    assert made is not None
    np.testing.assert_allclose(z[: steps - 1, :ROBOT], made[:-1, :ROBOT], atol=1e-9)
    np.testing.assert_allclose(
        z[steps - 1, :ROBOT], made[-1, :ROBOT], atol=1e-4
    )  # a knot is rough, what it is closed to exact


def test_only_rrt_paths_check_approaches() -> None:
    p, _, _ = door()
    assert trees(p).checks_approach
    assert not AStarPaths(BaseRoutes(p)).checks_approach


# --- around, and with base and arm
# ------------------------------------------------------------


def test_astar_paths_move_the_arm_straight() -> None:
    p = walled(1.6)
    routes, end = BaseRoutes(p), at(p, (4.0, 1.5, 0.0))
    end[3:] += 0.2
    z = interpolator(p, AStarPaths(routes)).interpolate(np.array([p.start, end]), [0, p.segments])
    assert z is not None
    expected = routes.find_path(0, p.start[:3], end[:3], p.segments)
    assert expected is not None
    assert abs(expected[-1, 2]) < 1e-9, "no whole turns here"
    np.testing.assert_allclose(z[:, :3], expected, atol=1e-9)
    np.testing.assert_allclose(
        z[:, 3:], p.start[3:] + np.outer(sample_smoothstep(p.segments), np.full(6, 0.2)), atol=1e-9
    )


class Winding:
    """Routes with additional full turns of the base."""

    def __init__(self, turns: int) -> None:
        self.turns = turns

    def find_path(self, phase: int, start: np.ndarray, goal: np.ndarray, steps: int) -> np.ndarray:
        end = goal + np.array([0.0, 0.0, self.turns * 2 * np.pi])
        return np.asarray(start + np.outer(np.arange(1, steps + 1) / steps, end - start))


@pytest.mark.parametrize("wound", [-1, 0, 1, 2])
def test_astar_paths_unwind_if_the_goal_fixes_the_heading(wound: int) -> None:
    ways = AStarPaths(Winding(wound))  # type: ignore[arg-type]
    first, last, share = np.zeros(ROBOT), np.zeros(ROBOT), np.arange(1, 21) / 20
    last[:3] = 2.0, 1.0, 0.5
    for turns, yaw in ((True, 0.5 + wound * 2 * np.pi), (False, 0.5)):
        way = ways.find_path(0, first, last, 20, turns=turns, reaches=True)
        assert way is not None
        np.testing.assert_allclose(way, np.outer(share, [2.0, 1.0, yaw]), atol=1e-9)


def test_rrt_paths_lead_through_a_narrow_gate() -> None:
    p = gated(NARROW)
    ends = np.array([p.start, at(p, GOAL)])
    assert interpolator(p, AStarPaths(BaseRoutes(p))).interpolate(ends, [0, p.segments]) is None
    straight = interpolator(p).interpolate(ends, [0, p.segments])
    z = interpolator(p, trees(p)).interpolate(ends, [0, p.segments])
    assert straight is not None
    assert z is not None
    hit, grazed = (
        p.evaluate_contacts(each, reach=0.1).compute_violation() for each in (straight, z)
    )
    assert hit > 0.2
    assert grazed < p.options.dist_safe + 0.02
    np.testing.assert_allclose(z[-1, :3], GOAL, atol=1e-9)
    assert np.abs(np.diff(p.waypoints(z), axis=0)).max() < 1.0


def test_rrt_paths_end_at_the_required_arm() -> None:
    p = gated(NARROW)
    end = at(p, GOAL)
    end[2] += 2 * np.pi  # as inverse kinematics may well have it
    end[4] += 0.1
    grown = trees(p)
    for reaches in (True, False):
        way = grown.find_path(0, p.start, end, 30, turns=True, reaches=reaches)
        assert way is not None
        assert way.shape == (30, ROBOT)
        np.testing.assert_allclose(way[-1, :3], GOAL, atol=1e-9)  # there is no reason to turn round
        near = grown.routes.find_nearest_folded_arm(0, p.start[3:], end[3:])
        allowed = [end[3:], p.start[3:], p.chain.robot.home, grown.routes.get_folded_arm(0), near][
            : 1 if reaches else None
        ]
        assert min(np.abs(way[-1, 3:] - arm).max() for arm in allowed) < 1e-9


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("wound", [-1, 1])
def test_rrt_paths_turn_as_far_as_the_goal_requires(wound: int, seed: int) -> None:
    """The base must turn fully, which is impossible inside the gate."""
    p = gated(NARROW)
    end = at(p, GOAL)
    end[2] += wound * 2 * np.pi
    way = trees(p, seed).find_path(0, p.start, end, 60, turns=False, reaches=True)
    assert way is not None
    np.testing.assert_allclose(way[-1], end, atol=1e-9)
    z = np.tile(p.start, (60, 1))
    z[:, :ROBOT] = way
    assert p.evaluate_contacts(z, reach=0.1).compute_violation() < p.options.dist_safe + 0.02
    inside = np.abs(way[:, 0] - 2.0) < 0.1
    assert np.abs(np.sin(way[inside, 2])).max(initial=0.0) < 0.2


def test_rrt_paths_return_none_if_there_is_no_path() -> None:
    p = gated(0.0)
    join = interpolator(p, trees(p))
    assert join.interpolate(np.array([p.start, at(p, GOAL)]), [0, p.segments]) is None
    assert len(join.blocked) == 1


def test_extension_limit_is_halved_after_failures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Phases are counted separately."""
    p = gated(NARROW)
    ways, tries, found = (
        trees(p),
        list[int](),
        iter([False, False, False, False, False, True, False, False]),
    )

    def connect(
        *_: Any, poses: np.ndarray, tries: int, asked: list[int] = tries, **__: Any
    ) -> np.ndarray | None:
        asked.append(tries)
        return np.tile(p.start[:ROBOT], (2, 1)) if next(found) else None

    monkeypatch.setattr(joining, "connect", connect)
    for number, phase in enumerate([0, 0, 1, 0, 0, 0, 0, 0]):
        monkeypatch.setattr(ways.routes, "find_guide_path", lambda *_: np.zeros((2, 3)))
        for name in ("get_folded_arm", "find_nearest_folded_arm"):
            monkeypatch.setattr(ways.routes, name, lambda *_: p.start[3:ROBOT])
        way = ways.find_path(phase, p.start, at(p, GOAL), 5, turns=True, reaches=True)
        assert (way is not None) == (number == 5)
    assert tries == [
        MAX_EXTENSIONS,
        MAX_EXTENSIONS // 2,
        MAX_EXTENSIONS,
        MAX_EXTENSIONS // 4,
        MAX_EXTENSIONS // 8,
        MAX_EXTENSIONS // 16,
        MAX_EXTENSIONS,
        MAX_EXTENSIONS // 2,
    ]


def test_extension_limit_counts_constrained_searches_that_ran(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    p, through, _ = door()
    ways, tries, found = trees(p), list[int](), iter([False, False, True, False])
    blocked = iter([False, True, False, True, False, False, True, True])

    def held(*given: Any) -> np.ndarray | None:
        tries.append(given[-1])
        return through if next(found) else None

    monkeypatch.setattr(joining, "is_obstructed", lambda *_: next(blocked))
    monkeypatch.setattr(joining, "find_constrained_path", held)
    led = [ways.find_constrained_path(2, through, through) is not None for _ in range(8)]
    assert led == [False] * 6 + [True, False]
    assert tries == [MAX_EXTENSIONS, MAX_EXTENSIONS // 2, MAX_EXTENSIONS // 4, MAX_EXTENSIONS]


def test_constrained_path_determines_door_motion_and_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The door opens in the second half of the phase, and the robot ends elsewhere."""
    p = program_of(door_scene(), [OPEN, vkc.GoTo(-1.0, 0.5)], options=FEW)
    own = KeyframeSampler(p, np.random.default_rng(0))
    found = BeamSearch(own).search(thorough=True)
    knots, move = found.paths[int(np.argmin(found.cost))], int(p.ends[2])
    begin, hinge, at_ = int(p.ends[1]), p.chain.index("door.hinge"), found.waypoints.index(move)
    others = found.paths[found.collision_cost < 1e3, at_]
    other = others[int(np.abs(others - knots[at_])[:, :ROBOT].max(axis=1).argmax())]
    assert np.abs(other - knots[at_])[:3].max() > 0.05, "they all end in the same place"
    asked, firsts = list[tuple[int, int]](), list[np.ndarray]()

    def held(
        _: RrtPaths, phase: int, through: np.ndarray, straight: np.ndarray
    ) -> np.ndarray | None:
        asked.append((phase, len(straight)))
        if phase < 2:
            return None
        late = straight.copy()
        late[:, hinge] = np.interp(
            np.arange(1, len(late) + 1), [len(late) / 2, len(late)], [0.0, 1.2]
        )
        late[-1] = other
        return late

    def way(
        self: RrtPaths, phase: int, first: np.ndarray, last: np.ndarray, steps: int, **_: Any
    ) -> np.ndarray:
        firsts.append(first.copy())
        return np.asarray(first + np.outer(np.arange(1, steps + 1) / steps, last - first))[
            :, :ROBOT
        ]

    monkeypatch.setattr(RrtPaths, "find_constrained_path", held)
    monkeypatch.setattr(RrtPaths, "find_path", way)
    z = interpolator(p, trees(p)).interpolate(knots, list(found.waypoints))
    assert z is not None
    assert asked == [(1, begin - int(p.ends[0])), (2, move - begin)]
    np.testing.assert_allclose(z[begin + (move - begin) // 2 - 1, hinge], 0.0, atol=1e-9)
    for row in z[int(p.ends[0]) - 1 : move]:
        assert (
            hand_off_the_handle(door_scene(), row, row[hinge], row[p.chain.index("door.knob")])
            < 1e-3
        )
    assert z[move - 1, hinge] == pytest.approx(1.2)
    np.testing.assert_allclose(z[move - 1], other, atol=1e-3)
    there = ApproachPaths(own).find_retreat_end(other, p.task.phases[3], p.task.phases[2])
    np.testing.assert_allclose(
        firsts[-1],
        there[0]
        if len(there) and own.compute_shortfall(there, p.contacts.find_waypoint(3))[0] < 0.01
        else other,
    )


def test_rrt_paths_of_a_fixed_base_move_the_arm_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("a base that cannot drive needs no way")

    monkeypatch.setattr(BaseRoutes, "find_guide_path", never)
    beam = {
        "name": "beam",
        "type": "cylinder",
        "radius": 0.05,
        "length": 1.2,
        "position": [0.37, 0.25, 1.7],
    }
    p = program_of(
        hall(base="fixed", obstacles=[beam]), [vkc.Reach((0.6, 0.35, 0.9, 0.0, np.pi / 2, 0.0))]
    )
    first, last = p.start.copy(), p.start.copy()
    first[3:6], last[3:6] = (0.57, -1.2, -1.2), (2.57, -1.2, -1.2)
    way = trees(p).find_path(0, first, last, 60, turns=False, reaches=True)
    assert way is not None
    np.testing.assert_array_equal(way[:, :3], np.tile(first[:3], (60, 1)))
    np.testing.assert_allclose(way[-1], last, atol=1e-12)
    straight = first + np.outer(sample_smoothstep(60), last - first)
    hit, grazed = (
        p.contacts.evaluate(z, np.ones(60, int), reach=0.1).compute_violation()
        for z in (straight, way)
    )
    assert hit > 0.05
    assert grazed < p.options.dist_safe + 0.02


def test_rrt_paths_stay_free_if_the_goal_fixes_the_heading() -> None:
    """The guide drives backwards through the gate, one full turn off."""
    p = program_of(gated(NARROW).scene, [vkc.GoTo(*GOAL[:2], -3.1)])
    z = interpolator(p, trees(p)).interpolate(
        np.array([p.start, at(p, (*GOAL[:2], -3.1))]), [0, p.segments]
    )
    assert z is not None
    np.testing.assert_allclose(z[-1, 2], -3.1, atol=1e-9)
    assert p.evaluate_contacts(z, reach=0.1).compute_violation() < p.options.dist_safe + 0.02
