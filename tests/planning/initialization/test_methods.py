"""Tests initial guesses: bounds, closed chains, order, determinism, narrow passages."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.drawers import compute_tool_pose, replace_scene_fields
from helpers.drives import make_hall
from helpers.gates import GOAL, NARROW, TOO_NARROW, make_gate_problem
from helpers.small_problems import SHORT, compute_grasp_error, load_door_scene, make_program
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.initialization.initial_guess import (
    InitialGuess,
    PhaseWaypoints,
    extract_phase_waypoints,
    make_initial_guess,
)
from vkc_pin.planning.initialization.methods import (
    INITIALIZATIONS,
    MAX_GOOD_PENETRATION,
    initialize,
    interleave_guesses,
)

FEW = vkc.Options(reach_waypoints=20, turn_waypoints=6, move_waypoints=20)


@cache
def make_problem() -> vkc.TrajectoryProblem:
    return make_program(load_door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=FEW)


@cache
def make_guesses(method: str, seed: int = 0, count: int = 3) -> list[InitialGuess]:
    return list(initialize(make_problem(), method, seed, count=count))


@pytest.mark.parametrize("method", INITIALIZATIONS)
def test_guesses_are_within_bounds_and_numbered(method: str) -> None:
    found = make_guesses(method)
    assert found
    for guess in found:
        assert guess.z.shape == (make_problem().segments, make_problem().chain.size)
        assert np.all((guess.z >= make_problem().lower) & (guess.z <= make_problem().upper))
    if method != "auto":
        names = [method, *(f"{method} {number}" for number in range(2, len(found) + 1))]
        assert [guess.name for guess in found] == names
        assert len(found) <= (5 if method == "stationary" else 3)
    else:
        assert {guess.name.split()[0] for guess in found} == {"interpolated", "astar", "rrt"}


@pytest.mark.parametrize(("method", "seed"), [("interpolated", 0), ("interpolated", 1), ("rrt", 0)])
def test_guesses_hold_the_handle(method: str, seed: int) -> None:
    p = make_problem()
    hinge, knob = (p.chain.index(f"door.{name}") for name in ("hinge", "knob"))
    for guess in make_guesses(method, seed):
        for row in guess.z[p.ends[0] - 1 :]:
            assert compute_grasp_error(load_door_scene(), row, row[hinge], row[knob]) < 1e-3
        assert p.pose_error(guess.z) < 1e-3


@pytest.mark.parametrize(
    ("name", "goal", "method", "robot"),
    [
        ("door", {"hinge": 1.2}, "interpolated", {"base": "differential"}),
        ("drawer", {"slide": 0.35}, "astar", {"base": "ackermann", "turning_radius": 0.8}),
    ],
)
def test_wheeled_bases_can_drive_their_guesses(
    name: str, goal: dict[str, float], method: str, robot: dict[str, Any]
) -> None:
    """Bases roll with their turning radius, and the chain is closed."""
    scene = replace_scene_fields(vkc.load_scene(name), robot={"name": "husky_ur5e", **robot})
    start = scene.sample_start(np.random.default_rng(5))
    p = make_program(start, [vkc.Actuate(name, goal)], options=vkc.Options())
    guess = next(initialize(p, method, 0))
    along, aside, turn = p.rolling.compute_steps(p.waypoints(guess.z))
    end = int(p.ends[0])
    allowed = np.full(len(aside), 1e-4)
    allowed[end - p.options.steps(p.options.approach_time) : end] = 0.01
    assert (np.abs(aside) <= allowed).all()
    assert (np.abs(along) >= robot.get("turning_radius", 0.0) * np.abs(turn) - allowed).all()
    assert np.abs(along).sum() > 0.5
    assert p.pose_error(guess.z) < 1e-2


def test_guess_opens_the_door_after_a_straight_approach() -> None:
    p, z = make_problem(), make_guesses("interpolated")[0].z
    hinge, knob = (z[:, p.chain.index(name)] for name in ("door.hinge", "door.knob"))
    reach, turn, _ = p.ends
    assert np.all(hinge[:turn] == 0.0)
    assert np.all(knob[:reach] == 0.0)
    assert hinge[-1] == pytest.approx(1.2)
    assert np.all(np.diff(hinge) >= 0.0)
    assert np.all(knob[turn - 1 :] >= 0.5)
    path, before = p.waypoints(z), int(reach) - FEW.steps(FEW.approach_time)
    np.testing.assert_array_equal(path[0], p.start)
    shift = path[before] - path[0]
    fraction = np.linalg.norm(path[: before + 1] - path[0], axis=1) / np.linalg.norm(shift)
    assert np.all(np.diff(fraction) > 0.0)
    np.testing.assert_allclose(path[: before + 1], path[0] + np.outer(fraction, shift), atol=1e-9)
    first, last = (compute_tool_pose(load_door_scene(), path[k]) for k in (before, reach))
    approach = first.inverse() * last
    np.testing.assert_allclose(approach.translation, [0.0, 0.0, FEW.approach], atol=1e-3)
    np.testing.assert_allclose(approach.rotation, np.eye(3), atol=1e-3)
    assert np.abs(np.diff(path, axis=0)).max() < 0.8


def test_equal_seeds_give_equal_guesses_and_successive_guesses_differ() -> None:
    found = make_guesses("interpolated")
    again = list(initialize(make_problem(), "interpolated", 0, count=3))
    assert 2 <= len(found) == len(again)
    for guess, same in zip(found, again, strict=True):
        np.testing.assert_array_equal(guess.z, same.z)
    for guess, other in itertools.combinations(found, 2):
        assert np.abs(guess.z - other.z)[:, :3].max() > FEW.dist_safe
    assert not np.array_equal(make_guesses("interpolated", 1)[0].z, found[0].z)


def test_stationary_guesses_move_the_base_straight_or_not_at_all() -> None:
    p = make_problem()
    still, *others = (guess.z for guess in make_guesses("stationary"))
    assert len(others) == 4
    for number, other in enumerate(others):
        np.testing.assert_array_equal(other[:, 3:], still[:, 3:])
        assert all(np.abs(other - one)[:, :3].max() > 0.1 for one in [still, *others[:number]])
        bases = p.waypoints(other)[:, :3]
        for begin, end in itertools.pairwise([0, *p.ends]):
            np.testing.assert_allclose(np.diff(bases[begin : end + 1], 2, axis=0), 0.0, atol=1e-12)
    np.testing.assert_array_equal(still[:, :9], np.tile(p.start[:9], (len(still), 1)))
    hinge = still[:, p.chain.index("door.hinge")]
    assert hinge[-1] == pytest.approx(1.2)
    assert hinge[p.ends[1] - 1] == 0.0


def test_base_turns_in_the_shorter_direction() -> None:
    scene = make_hall().with_start(base=[0.0, 0.0, 3.0])
    turn = make_program(scene, [vkc.GoTo(1.0, 0.5, -3.0)], options=SHORT)
    z = next(initialize(turn, "interpolated", 0)).z
    np.testing.assert_allclose(z[-1, :3], [1.0, 0.5, 2 * np.pi - 3.0])
    np.testing.assert_allclose(z[:, 3:], np.tile(scene.start[3:], (len(z), 1)))


def test_unreachable_target_still_has_a_guess() -> None:
    reach = vkc.Reach((1.0, 0.0, 4.0, 0.0, 0.0, 0.0))
    p = make_program(make_hall(), [reach], options=SHORT)
    guess = next(initialize(p, "interpolated", 0))
    assert np.all((guess.z >= p.lower) & (guess.z <= p.upper))


def test_fixed_base_stays_in_every_guess() -> None:
    target = vkc.Reach((0.5, 0.4, 1.0, 0.0, np.pi / 2, 0.0))
    fixed = make_program(make_hall(base="fixed"), [target], options=SHORT)
    for method in ("interpolated", "stationary"):
        found = [guess.z for guess in initialize(fixed, method, 0, count=2)]
        for z in found:
            assert np.ptp(fixed.waypoints(z)[:, :3], axis=0).max() == 0.0
    for z in found[1:]:  # stationary guesses move the arm instead
        assert np.abs(z - found[0])[-1, 3:].max() > 0.1


def test_base_turns_gradually() -> None:
    scene, rng = vkc.load_scene("aisle_drawer"), np.random.default_rng(7)
    for _ in range(6):  # headings wind by a full turn on some of these paths
        goal = vkc.GoTo(2.9, 2.0, float(rng.uniform(-3.0, 3.0)))
        p = make_program(scene.sample_start(rng), [goal])
        (guess,) = initialize(p, "astar", 0)
        turns = np.diff(p.waypoints(guess.z)[:, 2])
        assert abs(turns[-1]) < 0.2
        assert np.abs(turns).max() < 1.0
        assert abs(guess.z[-1, 2] - p.start[2]) <= np.pi + 1e-9


def test_task_without_motion_has_a_guess() -> None:
    scene = vkc.load_scene("drawer")
    p = make_program(scene, [vkc.GoTo(*scene.start[:3].tolist())])
    with np.errstate(all="raise"):
        (guess,) = initialize(p, "interpolated", 0)
    assert np.abs(guess.z - p.start).max() < 1e-9


def test_phase_that_only_waits_is_no_part_of_a_guess_for_the_whole_task() -> None:
    z = make_guesses("interpolated")[0].z
    whole = extract_phase_waypoints(make_problem(), z, "interpolated")
    standing = np.tile(make_problem().start, (4, 1))
    part = PhaseWaypoints(
        (("stand", ()), *whole.phases), whole.names, (standing, *whole.waypoints), "interpolated"
    )
    np.testing.assert_array_equal(make_initial_guess(make_problem(), [part]).z, z)


# --- order of the methods

Penetrations = list[float | None]
FINE, POOR, SHALLOW, DEEP = (ratio * MAX_GOOD_PENETRATION for ratio in (0.9, 1.1, 2.2, 4.4))


def interleave(*kinds: Penetrations) -> list[str]:
    """Return the requests (a0) and yields (A0) of several methods; None: no guess."""
    events: list[str] = []

    def generate(kind: str, penetrations: Penetrations) -> Iterator[InitialGuess | None]:
        for number, penetration in enumerate(penetrations):
            events.append(name := f"{kind}{number}")
            guess = InitialGuess(name, np.zeros((1, 1)), penetration or 0.0)
            yield None if penetration is None else guess

    for guess in interleave_guesses(*map(generate, "abc", kinds)):
        events.append(guess.name.upper())
    return events


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        (([0.0, 0.0], [0.0, 0.0], [0.0]), "a0 A0 b0 B0 c0 C0 a1 A1 b1 B1"),
        (([POOR, 0.0], [FINE, 0.0], [0.0]), "a0 b0 B0 c0 C0 b1 B1 a1 A1 A0"),
        (([DEEP, DEEP], [DEEP, DEEP], []), "a0 b0 a1 b1 A0 B0 A1 B1"),
        (([POOR, POOR], [DEEP], []), "a0 b0 A0 a1 A1 B0"),
        (([None, 0.0], [0.0], [None]), "a0 b0 B0 c0 a1 A1"),
    ],
)
def test_methods_take_turns(kinds: Sequence[Penetrations], expected: str) -> None:
    assert interleave(*kinds) == expected.split()


@given(st.lists(st.lists(st.sampled_from([0.0, FINE, POOR, DEEP, None]), max_size=5), max_size=3))
def test_guesses_are_requested_once_and_good_ones_come_first(kinds: list[Penetrations]) -> None:
    events, waiting, yielded = interleave(*kinds), set[str](), Counter[str]()
    penetrations = {
        f"{kind}{k}": value
        for kind, found in zip("abc", kinds, strict=False)
        for k, value in enumerate(found)
    }
    assert sorted(filter(str.islower, events)) == sorted(penetrations)

    def rank(name: str) -> tuple[int, float]:
        penetration = penetrations[name] or 0.0
        return 0 if penetration <= MAX_GOOD_PENETRATION else 1 + yielded[name[0]], penetration

    for number, event in enumerate(events):
        name = event.lower()
        if event.isupper():
            waiting.remove(name)
            is_deep = (penetrations[name] or 0.0) > SHALLOW
            others = [one for one in waiting if is_deep or (penetrations[one] or 0.0) <= SHALLOW]
            assert all(rank(name) <= rank(other) for other in others)
            assert not (is_deep and any(map(str.islower, events[number:])))
            yielded[name[0]] += 1
        elif penetrations[name] is not None:
            waiting.add(name)
    assert not waiting


# --- narrow passages


@pytest.mark.parametrize("width", [NARROW, TOO_NARROW])
def test_rrt_guess_leads_through_a_narrow_gate(width: float) -> None:
    """The base with its arm at home has no path."""
    gate, notes = make_gate_problem(width), list[str]()
    assert list(initialize(gate, "astar", 0)) == []
    (guess,) = initialize(gate, "rrt", 0, notes=notes)
    assert (guess.name, notes) == ("rrt", [])
    short = gate.evaluate_contacts(guess.z, reach=0.1).compute_shortfall(gate.segments)
    deepest = short.max() - gate.options.dist_safe
    assert guess.penetration == pytest.approx(max(deepest, 0.0), abs=1e-9)
    assert deepest < 0.01
    np.testing.assert_allclose(guess.z[-1, :3], GOAL, atol=1e-9)
    if width == TOO_NARROW:  # the arm at home just fits through the other gate
        assert np.ptp(guess.z[:, 3:9], axis=0).max() > 0.4
    (same,) = initialize(gate, "rrt", 0)
    np.testing.assert_array_equal(guess.z, same.z)


@pytest.mark.parametrize("is_infeasible", [True, False])
def test_auto_postpones_guesses_in_collision_and_checks_feasibility_before_rrt(
    is_infeasible: bool,
) -> None:
    checked: list[Sequence[int]] = []

    def answer(phases: Sequence[int]) -> bool:
        checked.append(phases)
        return is_infeasible

    found = list(initialize(make_gate_problem(NARROW), "auto", 0, count=2, is_infeasible=answer))
    names = ["interpolated"] if is_infeasible else ["rrt", "rrt 2", "interpolated"]
    assert [guess.name for guess in found[: len(names)]] == names
    assert found[len(names) - 1].penetration > MAX_GOOD_PENETRATION
    assert all("rrt" not in guess.name for guess in found) == is_infeasible
    assert checked == [[]], "the robot is free at the goal of every phase"


@pytest.mark.parametrize("method", ["astar", "rrt"])
def test_missing_path_is_noted(method: str) -> None:
    notes: list[str] = []
    assert list(initialize(make_gate_problem(0.0), method, 0, count=2, notes=notes)) == []
    assert ["found no path" in note for note in notes] == [True]


@pytest.mark.parametrize(("method", "is_fixed"), [("astar", False), ("rrt", True)])
def test_rrt_keeps_the_base_fixed_during_the_approach(method: str, is_fixed: bool) -> None:
    reach = int(make_problem().ends[0])
    begin = reach - FEW.steps(FEW.approach_time) - 1
    approach = make_guesses(method)[0].z[begin:reach, :3]
    assert (np.ptp(approach, axis=0).max() < 1e-4) == is_fixed


def test_narrow_door_is_closed_from_outside() -> None:
    """The door is open into the bedroom, and its lever is in the doorway."""
    scene = vkc.load_scene("household").with_state("door", {"hinge": 1.52})
    plan = vkc.plan(
        scene.with_start(base=(1.5, -0.5, 1.57)),
        [vkc.Grasp("door", "handle_free"), vkc.Actuate("door", {"hinge": 0.0})],
        seed=0,
    )
    assert plan.success, plan.summary()
    assert plan.trajectory.column("door.hinge")[-1] == pytest.approx(0.0, abs=1e-3)
    assert plan.trajectory.positions[-1, 1] < 1.0  # the wall is at 1.25


@pytest.mark.long
def test_door_that_opens_towards_the_robot_does_not_lock_it_in() -> None:
    """With the least motion, the robot pulls the door open and ends behind it."""
    steps, notes = [vkc.Actuate("door", {"hinge": -1.5}), vkc.GoTo(4.1, -0.3)], list[str]()
    scene = vkc.load_scene("door")
    assert next(initialize(make_program(scene, steps), "astar", 0, notes=notes)).penetration < 0.2
    assert notes[0].startswith("go to: found no path for the base"), "from behind the door"
    plan = vkc.plan(scene, steps, seed=0, max_evaluations=300_000)
    assert plan.success, plan.summary()
    assert plan.trajectory.column("door.hinge")[-1] == pytest.approx(-1.5, abs=1e-3)
    np.testing.assert_allclose(plan.trajectory.positions[-1, :2], [4.1, -0.3], atol=1e-3)
