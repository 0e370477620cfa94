from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import hall
from helpers.gates import GOAL, NARROW, TIGHT, gated
from helpers.small_problems import SHORT, door_scene, hand_off_the_handle, program_of
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.initialization import interpolation as joining
from vkc_pin.planning.initialization import methods as initialization
from vkc_pin.planning.initialization.beam_search import BeamSearch, SearchResult
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.initialization.keyframes import sample_goal_configurations
from vkc_pin.planning.initialization.methods import (
    _MAX_GOOD_PENETRATION,
    INITIALIZATIONS,
    _interleave,
    initialize,
)
from vkc_pin.world.models.coordinates import wrap_angle

OPENED = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20)


@cache
def problem() -> vkc.TrajectoryProblem:
    return program_of(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=OPENED)


def seeds(method: str = "interpolated", *, seed: int = 0, count: int = 1) -> list[np.ndarray]:
    return [found.z for found in initialize(problem(), method, seed, count=count)]


@pytest.mark.parametrize("method", INITIALIZATIONS)
def test_guesses_are_within_bounds(method: str) -> None:
    for z in seeds(method, count=3):
        assert z.shape == (problem().segments, problem().chain.size)
        assert np.all(z >= problem().lower)
        assert np.all(z <= problem().upper)


@pytest.mark.parametrize("seed", range(3))
def test_interpolated_guesses_hold_the_handle(seed: int) -> None:
    chain, scene = problem().chain, door_scene()
    hinge, knob = chain.index("door.hinge"), chain.index("door.knob")
    for z in seeds(seed=seed, count=3):
        held = z[problem().ends[0] - 1 :]  # the grasp and all that follows
        for row in held:
            assert hand_off_the_handle(scene, row, row[hinge], row[knob]) < 1e-3
        assert problem().pose_error(z) < 1e-3


@pytest.mark.parametrize("method", ["interpolated", "astar"])
@pytest.mark.parametrize(
    "robot",
    [{"base": "differential"}, {"base": "ackermann", "turning_radius": 0.8}],
    ids=["tank", "car"],
)
@pytest.mark.parametrize(("name", "goal"), [("door", {"hinge": 1.2}), ("drawer", {"slide": 0.35})])
def test_guesses_of_wheeled_bases_can_be_driven(
    name: str, goal: dict[str, float], robot: dict[str, Any], method: str
) -> None:
    """Bases roll with their turning radius, and the chain is closed."""
    scene = vkc.load_scene(name)
    document, rng = (
        {**scene.document, "robot": {"name": "husky_ur5e", **robot}},
        np.random.default_rng(5),
    )
    scene = vkc.Scene.from_document(document, scene.folder)
    for _ in range(2):
        p = program_of(scene.sample_start(rng), [vkc.Actuate(name, goal)], options=vkc.Options())
        seed = next(initialize(p, method, 0))
        along, aside, turn = p.rolling.compute_steps(p.waypoints(seed.z))
        end = int(p.ends[0])
        allowed = np.full(len(aside), 1e-4)
        allowed[end - p.options.steps(p.options.approach_time) : end] = 0.01
        assert (np.abs(aside) <= allowed).all()
        assert (np.abs(along) >= robot.get("turning_radius", 0.0) * np.abs(turn) - allowed).all()
        assert np.abs(along).sum() > 0.5
        assert p.pose_error(seed.z) < 1e-2


def test_guess_opens_the_door() -> None:
    (z,) = seeds()
    hinge, knob = (z[:, problem().chain.index(name)] for name in ("door.hinge", "door.knob"))
    reach, turn, _ = problem().ends
    assert np.all(hinge[:turn] == 0.0)
    assert np.all(knob[:reach] == 0.0)
    assert hinge[-1] == pytest.approx(1.2)
    assert np.all(np.diff(hinge) >= 0.0)
    assert np.all(knob[turn - 1 :] >= 0.5)


def test_guesses_start_without_a_jump() -> None:
    for z in seeds(count=2):
        path = problem().waypoints(z)
        reach = int(problem().ends[0])
        np.testing.assert_array_equal(path[0], problem().start)
        # A straight way to where the hand is before the handle: every waypoint lies between its
        # ends; and straight on.
        before = reach - OPENED.steps(OPENED.approach_time)
        low, high = np.minimum(path[0], path[before]), np.maximum(path[0], path[before])
        assert np.all((path[: before + 1] >= low - 1e-9) & (path[: before + 1] <= high + 1e-9))
        first, last = (
            dataclasses.replace(door_scene(), start=path[k, :9]).tool_placement()
            for k in (before, reach)
        )
        way = first.inverse() * last
        np.testing.assert_allclose(
            way.translation, [0.0, 0.0, OPENED.approach], rtol=0.0, atol=1e-3
        )
        np.testing.assert_allclose(way.rotation, np.eye(3), rtol=0.0, atol=1e-3)
        assert np.abs(np.diff(path, axis=0)).max() < 0.8


def test_same_random_seed_gives_same_guesses() -> None:
    first, second = seeds(seed=4, count=4), seeds(seed=4, count=4)
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(seeds(seed=5)[0], first[0])


def test_several_guesses_differ() -> None:
    found = seeds(count=3)
    assert 1 <= len(found) <= 3
    for k, z in enumerate(found):
        for other in found[:k]:
            assert np.abs(z - other)[:, :3].max() > problem().options.dist_safe
    assert len(seeds(count=1)) == 1


def test_stationary_guess_keeps_the_robot_in_place() -> None:
    for seed in (0, 1):
        z, *others = seeds("stationary", seed=seed, count=4)
        robot = problem().chain.robot.coordinates.size
        assert len(others) == 6
        for number, other in enumerate(
            others
        ):  # in which the base goes straight from place to place
            np.testing.assert_array_equal(other[:, 3:], z[:, 3:])
            assert all(np.abs(other - one)[:, :3].max() > 0.1 for one in [z, *others[:number]])
            bases = problem().waypoints(other)[:, :3]
            for begin, end in itertools.pairwise([0, *problem().ends]):
                np.testing.assert_allclose(
                    np.diff(bases[begin : end + 1], 2, axis=0), 0.0, atol=1e-12
                )
            assert np.all((other >= problem().lower) & (other <= problem().upper))
        np.testing.assert_array_equal(z[:, :robot], np.tile(problem().start[:robot], (len(z), 1)))
        hinge = z[:, problem().chain.index("door.hinge")]
        assert hinge[-1] == pytest.approx(1.2)
        assert hinge[problem().ends[1] - 1] == 0.0


def test_random_place_of_least_merit_is_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive = program_of(hall(), [vkc.Reach((2.0, 1.5, 1.0, 0.0, np.pi / 2, 0.0))], options=SHORT)

    def merits(places: int) -> list[float]:
        monkeypatch.setattr(initialization, "_PLACE_SAMPLES", places)
        _, *others = initialize(drive, "stationary", 0, count=4)
        return [initialization._compute_merit(drive, seed.z, drive.segments) for seed in others]

    assert max(merits(128)) < min(merits(1))


def test_base_turns_the_shorter_direction() -> None:
    scene = hall().with_start(base=[0.0, 0.0, 3.0])
    turn = program_of(scene, [vkc.GoTo(1.0, 0.5, -3.0)], options=SHORT)
    (z,) = (found.z for found in initialize(turn, "interpolated", 0))
    np.testing.assert_allclose(z[-1, :3], [1.0, 0.5, 2 * np.pi - 3.0])
    np.testing.assert_allclose(z[:, 3:], np.tile(scene.start[3:], (len(z), 1)))


def test_unreachable_target_still_has_a_guess() -> None:
    lost = program_of(hall(), [vkc.Reach((1.0, 0.0, 4.0, 0.0, 0.0, 0.0))], options=SHORT)
    for z in (found.z for found in initialize(lost, "interpolated", 0, count=2)):
        assert np.isfinite(z).all()
        assert np.all((z >= lost.lower) & (z <= lost.upper))


def test_fixed_base_stays_in_every_guess() -> None:
    fixed = program_of(
        hall(base="fixed"), [vkc.Reach((0.5, 0.4, 1.0, 0.0, np.pi / 2, 0.0))], options=SHORT
    )
    for z in (found.z for found in initialize(fixed, "interpolated", 0, count=3)):
        assert np.ptp(fixed.waypoints(z)[:, :3], axis=0).max() == 0.0
    still, *others = (found.z for found in initialize(fixed, "stationary", 0, count=3))
    for z in others:  # the arm goes elsewhere instead
        assert np.ptp(fixed.waypoints(z)[:, :3], axis=0).max() == 0.0
        assert np.abs(z - still)[-1, 3:].max() > 0.1


def test_goal_configurations_have_the_stated_residuals() -> None:
    target = pin.SE3(pin.rpy.rpyToMatrix(0.0, np.pi / 2, 0.0), np.array([1.5, 0.5, 0.9]))
    reach = program_of(hall(), [vkc.Reach(target)], options=SHORT)
    found = sample_goal_configurations(reach, reach.segments, np.random.default_rng(0))
    assert found is not None
    z, residual = found
    assert np.count_nonzero(residual < 1e-4) > len(z) / 2
    assert np.all((z >= reach.lower[-1]) & (z <= reach.upper[-1]))
    for row, error in list(zip(z, residual, strict=True))[:20]:
        tool = dataclasses.replace(reach.scene, start=row).tool_placement()
        off = np.concatenate(
            [tool.translation - target.translation, pin.log3(tool.rotation.T @ target.rotation)]
        )
        assert (
            np.abs(off).max() == pytest.approx(error, abs=5e-2, rel=0.5)
            if error > 1e-3
            else np.abs(off).max() < 2e-3
        )


def test_no_goal_configurations_without_a_goal() -> None:
    free = program_of(
        door_scene(), [vkc.Actuate("door", {"hinge": 1.2}), vkc.GoTo(0.0, 0.0)], options=SHORT
    )
    last = sample_goal_configurations(free, free.segments, np.random.default_rng(0))
    assert last is not None
    z, residual = last
    np.testing.assert_allclose(z[:, :2], 0.0)
    assert np.all(residual == 0.0)
    middle = int(free.ends[-1]) - 1  # on the way, nothing is asked for
    assert sample_goal_configurations(free, middle, np.random.default_rng(0)) is None


Overlaps = list[float | None]
FINE, POOR, LOST = (
    0.9 * _MAX_GOOD_PENETRATION,
    1.1 * _MAX_GOOD_PENETRATION,
    4.4 * _MAX_GOOD_PENETRATION,
)


class Looked:
    """Fake searches that record requests (s0) and yields (S0); None: no guess."""

    def __init__(self, straight: Overlaps, around: Overlaps, trees: Overlaps) -> None:
        self.said: list[str] = []
        kinds = {"s": straight, "a": around, "t": trees}
        for seed in _interleave(*(self._seeds(kind, overlaps) for kind, overlaps in kinds.items())):
            self.said.append(seed.name.upper())

    def _seeds(self, kind: str, overlaps: Overlaps) -> Iterator[InitialGuess | None]:
        for number, penetration in enumerate(overlaps):
            self.said.append(f"{kind}{number}")
            yield (
                None
                if penetration is None
                else InitialGuess(f"{kind}{number}", np.zeros((1, 1)), penetration)
            )


@pytest.mark.parametrize(
    ("straight", "around", "trees", "expected"),
    [
        # What goes straight is good: the others are looked for (s) when what was before them has
        # been taken (S).
        ([0.0, 0.0], [0.0, 0.0], [], "s0 S0 a0 A0 s1 S1 a1 A1"),
        ([0.0, 0.0, 0.0], [0.0], [], "s0 S0 a0 A0 s1 S1 s2 S2"),
        ([0.0], [0.0, 0.0, 0.0], [], "s0 S0 a0 A0 a1 A1 a2 A2"),
        ([], [0.0, 0.0], [], "a0 A0 a1 A1"),
        ([], [], [], ""),
        ([0.0, 0.0], [0.0, 0.0], [0.0], "s0 S0 a0 A0 t0 T0 s1 S1 a1 A1"),
        ([], [0.0, 0.0], [0.0, 0.0], "a0 A0 t0 T0 a1 A1 t1 T1"),
        ([FINE], [LOST], [0.0], "s0 S0 a0 t0 T0 A0"),
        # What goes straight hits things, what goes around does not: it waits until nothing better
        # is left, and is asked last.
        ([LOST, 0.0], [0.0, 0.0], [], "s0 a0 A0 a1 A1 s1 S1 S0"),
        ([POOR, 0.0], [FINE, 0.0], [0.0], "s0 a0 A0 t0 T0 a1 A1 s1 S1 S0"),
        # Both do, or there is no way around: what trees find comes first.
        ([POOR], [LOST], [0.0, 0.0], "s0 a0 t0 T0 t1 T1 S0 A0"),
        ([LOST], [], [0.0], "s0 t0 T0 S0"),
        ([POOR], [POOR], [LOST], "s0 a0 t0 S0 A0 T0"),  # of equals, what goes straight
        ([LOST, LOST], [POOR, 0.0], [0.0, 0.0], "s0 a0 t0 T0 t1 T1 s1 a1 A1 A0 S0 S1"),
        ([LOST, LOST], [LOST, LOST], [], "s0 a0 S0 s1 a1 A0 S1 A1"),
        ([POOR, POOR], [], [], "s0 S0 s1 S1"),
        # A search that finds nothing.
        ([None, 0.0], [0.0], [], "s0 a0 A0 s1 S1"),
        ([LOST], [None], [None, 0.0], "s0 a0 t0 S0 t1 T1"),
        ([None], [None], [None], "s0 a0 t0"),
    ],
)
def test_methods_take_turns(
    straight: Overlaps, around: Overlaps, trees: Overlaps, expected: str
) -> None:
    assert Looked(straight, around, trees).said == expected.split()


@given(*(st.lists(st.sampled_from([0.0, FINE, POOR, LOST, None]), max_size=5) for _ in range(3)))
def test_guesses_are_generated_on_demand_and_once(
    straight: Overlaps, around: Overlaps, trees: Overlaps
) -> None:
    said = Looked(straight, around, trees).said
    kinds = (("s", straight), ("a", around), ("t", trees))
    looked = [f"{kind}{k}" for kind, found in kinds for k in range(len(found))]
    seeds = [
        f"{kind}{k}"
        for kind, found in kinds
        for k, penetration in enumerate(found)
        if penetration is not None
    ]
    assert sorted(said) == sorted([*looked, *map(str.upper, seeds)])
    assert all(said.index(name) < said.index(name.upper()) for name in seeds)
    penetration = {
        f"{kind}{k}".upper(): found[k] for kind, found in kinds for k in range(len(found))
    }
    for at, name in enumerate(said):
        if name in penetration:
            known = [
                other.upper()
                for other in said[:at]
                if other.islower() and penetration[other.upper()] is not None
            ]
            left = [penetration[other] for other in known if other not in said[:at]]
            assert penetration[name] == min(left), "the best of those that wait comes first"


def test_base_turns_gradually() -> None:
    scene, rng = vkc.load_scene("aisle_drawer"), np.random.default_rng(7)
    for _ in range(16):  # on some of these ways headings wind by a whole turn
        problem = program_of(
            scene.sample_start(rng), [vkc.GoTo(2.9, 2.0, float(rng.uniform(-3.0, 3.0)))]
        )
        (seed,) = initialize(problem, "astar", 0)
        turns = np.diff(problem.waypoints(seed.z)[:, 2])
        assert abs(turns[-1]) < 0.2
        assert np.abs(turns).max() < 1.0
        assert abs(seed.z[-1, 2] - problem.start[2]) <= np.pi + 1e-9


def test_task_without_motion_has_a_guess() -> None:
    scene = vkc.load_scene("drawer")
    problem = program_of(scene, [vkc.GoTo(*scene.start[:3].tolist())])
    with np.errstate(all="raise"):
        (seed,) = initialize(problem, "interpolated", 0)
    assert np.abs(seed.z - problem.start).max() < 1e-9


# --- through narrow places
# ------------------------------------------------------------


@pytest.mark.parametrize("width", [NARROW, TIGHT])
def test_rrt_guess_leads_through_a_narrow_gate(width: float) -> None:
    """The base with its arm at home has no path; the rest is a graze."""
    gate = gated(width)
    assert list(initialize(gate, "astar", 0)) == []
    notes: list[str] = []
    (seed,) = initialize(gate, "rrt", 0, notes=notes)
    assert notes == []
    assert seed.name == "rrt"
    short = gate.evaluate_contacts(seed.z, reach=0.1).compute_shortfall(gate.segments)
    assert seed.penetration == pytest.approx(
        max(short.max() - gate.options.dist_safe, 0.0), abs=1e-9
    )
    assert seed.penetration < _MAX_GOOD_PENETRATION
    assert short.max() < gate.options.dist_safe + 0.01
    np.testing.assert_allclose(seed.z[-1, :3], GOAL, atol=1e-9)
    if width == TIGHT:  # in the other gate the arm at home just fits, if it may graze
        assert np.ptp(seed.z[:, 3:9], axis=0).max() > 0.5, "the arm moves on the way"
    (same,) = initialize(gate, "rrt", 0)
    np.testing.assert_array_equal(seed.z, same.z)


def test_auto_prefers_rrt_if_other_guesses_collide() -> None:
    found = list(initialize(gated(NARROW), "auto", 0, count=2))
    assert [seed.name for seed in found[:2]] == ["rrt", "interpolated"]
    assert found[0].penetration < _MAX_GOOD_PENETRATION < found[1].penetration


@pytest.mark.parametrize("is_blocked", [True, False])
def test_no_trees_grow_if_a_goal_is_blocked(
    is_blocked: bool,
) -> None:
    asked: list[Sequence[int]] = []

    def answer(phases: Sequence[int]) -> bool:
        asked.append(phases)
        return is_blocked

    names = {seed.name for seed in initialize(gated(NARROW), "auto", 0, is_infeasible=answer)}
    assert ("rrt" in names) == (not is_blocked)
    assert asked == [[]], "the searches before have come to the goal, where the robot is free"


def test_no_trees_grow_if_other_guesses_are_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trees are slow, so they come last."""
    grown: list[int] = []
    connect = joining.connect

    def watch(*given: Any, **named: Any) -> np.ndarray | None:
        grown.append(1)
        return connect(*given, **named)

    monkeypatch.setattr(joining, "connect", watch)
    found = initialize(gated(3.0), "auto", 0)
    assert [next(found).name, next(found).name, len(grown)] == ["interpolated", "astar", 0]
    assert next(found).name == "rrt"
    assert grown


def test_rrt_has_no_guess_if_there_is_no_path() -> None:
    notes: list[str] = []
    assert list(initialize(gated(0.0), "rrt", 0, count=2, notes=notes)) == []
    assert len(notes) == 1
    plan = vkc.plan(gated(0.0).scene, [vkc.GoTo(*GOAL)], initialization="rrt")
    assert plan.status == "infeasible"
    assert "no path for the base, proven" in plan.report()


def test_motion_through_the_narrow_gate() -> None:
    plan = vkc.plan(gated(NARROW).scene, [vkc.GoTo(*GOAL)])
    assert plan.success, plan.report()
    assert plan.initialization == "rrt"


@pytest.mark.parametrize(("method", "stands"), [("astar", False), ("rrt", True)])
def test_rrt_keeps_the_base_fixed_during_approach(method: str, stands: bool) -> None:
    (z,) = seeds(method)
    reach = int(problem().ends[0])
    last = z[reach - OPENED.steps(OPENED.approach_time) - 1 : reach, :3]
    assert (np.ptp(last, axis=0).max() < 1e-4) == stands  # as exact as inverse kinematics


@pytest.mark.parametrize("method", ["interpolated", "astar", "rrt"])
def test_search_modes_of_successive_attempts(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """No result is acceptable; only RRT rejects those of thorough searches."""
    asked: list[tuple[bool, bool, bool]] = []
    search = BeamSearch.search

    def watch(beam: BeamSearch, *, thorough: bool, backwards: bool = False) -> SearchResult:
        asked.append((thorough, backwards, beam.for_narrow_passages))
        return search(beam, thorough=thorough, backwards=backwards)

    monkeypatch.setattr(BeamSearch, "search", watch)
    monkeypatch.setattr(BeamSearch, "is_acceptable", lambda *_: False)
    found = seeds(method, count=2)
    if method == "rrt":
        assert asked == [(False, False, True), (True, True, True), (True, False, True)]
        assert found == []
    else:
        assert asked[:2] == [(False, False, False), (True, False, False)]
        assert found


@pytest.mark.parametrize(
    ("ways", "expected"),
    [
        ("forwards backwards", "fbfbf"),  # in turn
        ("backwards", "fbbbb"),
        ("forwards", "fbfff"),
        ("", "fbfbf"),
    ],
)
def test_rrt_avoids_a_direction_that_failed(
    ways: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, found = list[str](), SearchResult(np.zeros((0, 1, 9)), np.zeros(0), np.zeros(0), [0])

    def search(_: BeamSearch, *, thorough: bool, backwards: bool = False) -> SearchResult:
        asked.append("b" if backwards else "f")
        return found

    def is_acceptable(*_: object) -> bool:
        return ("backwards" if asked[-1] == "b" else "forwards") in ways

    monkeypatch.setattr(BeamSearch, "search", search)
    monkeypatch.setattr(BeamSearch, "is_acceptable", is_acceptable)
    monkeypatch.setattr(initialization._RrtSearch, "_select_best", lambda *_: None)
    assert seeds("rrt", count=4) == []
    assert "".join(asked) == expected


class Watched:
    """Records the results of beam searches by method."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.found: list[tuple[str, SearchResult]] = []
        search = BeamSearch.search

        def watch(beam: BeamSearch, *, thorough: bool, backwards: bool = False) -> SearchResult:
            found = search(beam, thorough=thorough, backwards=backwards)
            kind = (
                "rrt"
                if beam.for_narrow_passages
                else "interpolated"
                if beam.routes is None
                else "astar"
            )
            self.found.append((kind, found))
            return found

        monkeypatch.setattr(BeamSearch, "search", watch)

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.found]


def grasps(found: SearchResult) -> np.ndarray:
    """Return robot configurations that grasp, shape (B, 9)."""
    return found.paths[:, found.waypoints.index(int(problem().ends[0])), :9]


def test_rrt_uses_its_own_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """RRT searches for narrow passages; other results may be blocked."""
    watched = Watched(monkeypatch)
    assert [seed.name for seed in initialize(problem(), "rrt", 0)] == ["rrt"]
    assert watched.kinds == ["rrt"]
    watched.found.clear()
    *others, first = initialize(problem(), "auto", 0)
    assert [seed.name for seed in [*others, first]] == ["interpolated", "astar", "rrt"]
    assert watched.kinds == ["interpolated", "astar", "rrt"]
    apart = grasps(watched.found[-1][1]) - first.z[int(problem().ends[0]) - 1, :9]
    apart[:, 2] = wrap_angle(apart[:, 2])  # on the way there the base may turn the other way round
    assert np.abs(apart).max(axis=1).min() < 1e-3


def test_detours_are_compared_with_other_grasps_by_merit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All compared guesses are made if each has a detour, otherwise the first only."""
    joined, join = list[np.ndarray](), joining.Interpolator.interpolate

    def joins(self: joining.Interpolator, through: np.ndarray, at: list[int]) -> np.ndarray | None:
        z = join(self, through, at)
        joined.extend([] if z is None else [z])
        return z

    monkeypatch.setattr(joining.Interpolator, "interpolate", joins)
    (first,) = initialize(problem(), "rrt", 0)
    assert len(joined) == 1
    joined.clear()
    monkeypatch.setattr(initialization, "has_arm_detour", lambda *_: True)
    (best,) = initialize(problem(), "rrt", 0)
    assert 1 < len(joined) <= initialization._COMPARED_PATHS
    np.testing.assert_array_equal(joined[0], first.z)

    def merit(z: np.ndarray) -> float:
        contacts = problem().evaluate_contacts(z, reach=problem().options.largest_margin, nearest=1)
        return (
            problem().objective(z, problem().timing_for(z).dt)
            + problem().options.penalty * contacts.compute_shortfall(len(z)).sum()
        )

    assert merit(best.z) == min(map(merit, joined))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_count_applies_to_every_method(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, int] = {}

    def seeds(one: Any, most: int) -> Iterator[InitialGuess]:
        asked[one.method] = most
        return iter([])

    monkeypatch.setattr(initialization._GuessSearch, "generate", seeds)
    assert list(initialize(problem(), "auto", 0, count=count)) == []
    assert asked == {"interpolated": count, "astar": count, "rrt": count}


def test_rrt_guess_holds_the_handle() -> None:
    chain = problem().chain
    hinge, knob = chain.index("door.hinge"), chain.index("door.knob")
    found = seeds("rrt", count=2)
    assert found
    for z in found:
        for row in z[problem().ends[0] - 1 :]:
            assert hand_off_the_handle(door_scene(), row, row[hinge], row[knob]) < 1e-3


def test_narrow_door_is_closed_from_outside() -> None:
    """The door is open into the bedroom, and its lever is in the doorway."""
    scene = (
        vkc.load_scene("household")
        .with_state("door", {"hinge": 1.52})
        .with_start(base=(1.5, -0.5, 1.57))
    )
    plan = vkc.plan(
        scene, [vkc.Grasp("door", "handle_free"), vkc.Actuate("door", {"hinge": 0.0})], seed=0
    )
    assert plan.success, plan.report()
    assert plan.trajectory.column("door.hinge")[-1] == pytest.approx(0.0, abs=1e-3)
    assert plan.trajectory.positions[-1, 1] < 1.0  # the wall is at 1.25: it has come out
