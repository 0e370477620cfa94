"""Tests of the parts of a round of the solver loop."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.drives import hall
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.planning.chain.contacts import Contacts, make_empty_contacts
from vkc_pin.planning.nlp.merit import TOLERANCE, Infeasibility, Merit
from vkc_pin.planning.solver import loop as module
from vkc_pin.planning.solver.loop import _Loop, solve
from vkc_pin.planning.solver.segment_planes import SegmentContacts
from vkc_pin.planning.solver.solution import Solution
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.planning.solver.tunnelling import Crossing
from vkc_pin.utils.budget import BudgetExhaustedError

N = 8


def contact(distance: float, margin: float = 0.02, waypoint: int = 0) -> Contacts:
    row, vector = np.array([distance]), np.array([[1.0, 0.0, 0.0]])
    return Contacts(
        np.array([waypoint]), np.array([[0, 1]]), row, np.array([margin]), vector, vector, vector
    )


def make_infeasibility(**amounts: float) -> Infeasibility:
    rows = {kind: np.zeros(N) for kind in Merit(1.0).weights}
    for kind, amount in amounts.items():
        rows[kind][3] = amount
    return Infeasibility(rows, np.zeros((N, 0, 7)), np.zeros(0), np.zeros(0))


def parts(**fields: Any) -> Any:
    """Return a loop with the given attributes only."""
    loop = object.__new__(_Loop)
    for name, value in fields.items():
        setattr(loop, name, value)
    return loop


# --- what is close
# ------------------------------------------------------------


@pytest.mark.parametrize(
    ("short", "free", "clear"),
    [
        (0.0, True, True),
        (0.9, True, True),
        (1.1, True, False),
        (0.0, False, False),
        (1.1, False, False),
    ],
)
def test_contacts_are_clear_at_waypoints_and_within_segments(
    short: float, free: bool, clear: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    at, between, crossed = (
        contact(0.02 - short * CLEARANCE_TOLERANCE),
        contact(0.5, 0.4),
        [Crossing((1, 2), 3, 4)],
    )
    asked: list[tuple[float, int]] = []

    def evaluate(z: np.ndarray, *, reach: float, nearest: int) -> Contacts:
        asked.append((reach, nearest))
        return at

    options = SimpleNamespace(contact_reach=0.25, contact_slots=4)
    loop = parts(
        problem=SimpleNamespace(evaluate_contacts=evaluate),
        options=options,
        solution=SimpleNamespace(timings={"coal": 1.0}),
    )
    monkeypatch.setattr(
        module, "find_segment_contacts", lambda problem, z: SegmentContacts(between, free, crossed)
    )
    found, told, passages = loop.find_contacts(np.zeros((N, 2)))
    assert (told, passages, asked) == (clear, crossed, [(0.25, 4)])
    assert sorted(found.distance.tolist()) == sorted([*at.distance.tolist(), 0.5])
    assert 1.0 < loop.solution.timings["coal"] < 1.5  # what it took, once more


# --- what it costs
# ------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "last", "dear"),
    [(3, 4, [2, 3, 4]), (0, 0, [0]), (1, 1, [0, 1]), (0, 2, [0, 1, 2]), (7, 7, [6, 7])],
)
def test_crossing_makes_penalties_around_its_segments_infinite(
    first: int, last: int, dear: list[int]
) -> None:
    """Segment k ends at row k of z_1..z_N and begins at the one before."""
    loop = parts(
        merit=Merit(10.0),
        found=make_infeasibility(poses=0.009, clearance=0.5),
        crossings=[Crossing((1, 2), 0, 7)],
    )
    trial: Any = SimpleNamespace(
        infeasibility=make_infeasibility(rolling=0.2),
        crossings=[Crossing((1, 2), 5, 5), Crossing((1, 3), first, last)],
    )
    before, after = loop.compute_penalties(trial)
    assert np.flatnonzero(np.isinf(after)).tolist() == dear
    assert before.tolist() == pytest.approx([0.0] * 3 + [5.09] + [0.0] * 4)
    assert after[~np.isinf(after)].sum() == pytest.approx(0.0 if 3 in dear else 2.0)


@pytest.mark.parametrize(("poses", "counts"), [(0.009, True), (0.011, False), (1.0, False)])
def test_crossings_are_ignored_while_poses_are_infeasible(poses: float, counts: bool) -> None:
    loop = parts(merit=Merit(1.0), found=make_infeasibility(poses=poses), crossings=[])
    trial: Any = SimpleNamespace(
        infeasibility=make_infeasibility(), crossings=[Crossing((1, 2), 2, 2)]
    )
    assert np.isinf(loop.compute_penalties(trial)[1]).any() == counts


def test_predicted_and_actual_reduction(monkeypatch: pytest.MonkeyPatch) -> None:
    """The arguments are predicted and actual reduction, and the merit before."""
    given: list[tuple[float, ...]] = []
    monkeypatch.setattr(
        module, "is_step_acceptable", lambda *numbers: given.append(numbers) or True
    )
    trial: Any = SimpleNamespace(objective=7.0, predicted_penalty=np.array([0.25, 0.5]))
    assert parts(objective=10.0).is_acceptable(trial, np.array([1.0, 2.0]), np.array([0.5, 0.75]))
    assert given == [(3.0 + 3.0 - 0.75, 3.0 + 3.0 - 1.25, 13.0)]


# --- going on
# ------------------------------------------------------------


class Clock:
    """Fake `Timing` with given rate violations before and after stretching."""

    def __init__(self, name: str, *, over: float = 0.0, left: float = 0.0) -> None:
        self.dt, self.over, self.left = name, over, left

    def compute_violation(self, *pace: str) -> float:
        assert pace == ("fast", "faster")
        return self.over

    def stretch(self, *pace: str) -> Clock:
        assert pace == ("fast", "faster")
        return Clock("stretched", over=self.left)


def gone_on(
    *,
    others: float = 0.0,
    rates: bool = False,
    short: float = 0.5,
    rate: float = 0.0,
    left: float = 0.0,
) -> tuple[Any, list[str]]:
    """Return a loop that has accepted a trial, and its recorded actions."""
    done: list[str] = []
    problem = SimpleNamespace(
        timing_for=lambda z: Clock(f"of {z}"), pace=lambda z: ("fast", "faster")
    )
    loop = parts(
        problem=problem,
        found=make_infeasibility(poses=others),
        rates=rates,
        timing=Clock("old", left=left),
        solution=SimpleNamespace(z="old", dt="old"),
        subproblem=SimpleNamespace(reset_multipliers=lambda: done.append("forget")),
        evaluate_iterate=lambda: done.append("look"),
    )
    trial: Any = SimpleNamespace(
        z="new",
        contacts=contact(0.02 - short),
        infeasibility=make_infeasibility(),
        crossings=["p"],
        objective=3.0,
        pose_error=0.25,
        rate_excess=rate,
    )
    loop.accept(trial)
    assert (loop.z, loop.at, loop.found, loop.crossings) == (
        trial.z,
        trial.contacts,
        trial.infeasibility,
        trial.crossings,
    )
    assert (loop.objective, loop.pose_error, loop.solution.z) == (3.0, 0.25, "new")
    assert loop.solution.dt == loop.timing.dt
    return loop, done


def test_feasible_motion_keeps_its_timing() -> None:
    for how in (
        {},
        {"others": 0.9 * TOLERANCE},
        {"others": 0.01, "rates": True},
        {"short": 0.5, "rate": 1.0},
    ):
        loop, done = gone_on(**how)  # type: ignore[arg-type]
        assert (loop.timing.dt, done, loop.rates) == ("old", [], how.get("rates", False))


def test_infeasible_motion_gets_new_timing() -> None:
    for others in (0.01, 1.5 * TOLERANCE):
        loop, done = gone_on(others=others)
        assert (loop.timing.dt, done, loop.rates) == ("of new", ["look"], False)


@pytest.mark.parametrize(
    ("short", "rate", "slower"), [(0.009, 1.5e-4, True), (0.011, 1.0, False), (0.0, 0.9e-4, False)]
)
def test_nearly_clear_motion_that_is_too_fast_is_slowed_down(
    short: float, rate: float, slower: bool
) -> None:
    loop, done = gone_on(short=short, rate=rate)
    assert (loop.timing.dt, done) == (("stretched", ["look"]) if slower else ("old", []))
    assert not loop.rates


def test_rate_limits_become_constraints_if_slowing_down_fails() -> None:
    loop, done = gone_on(short=0.0, rate=1.0, left=1.5 * TOLERANCE)
    assert (loop.rates, done) == (True, ["forget", "look"])
    loop, done = gone_on(short=0.0, rate=1.0, left=0.9 * TOLERANCE)
    assert (loop.rates, done) == (False, ["look"])
    loop, done = gone_on(short=0.0, rate=1.0, left=1.0, rates=True)
    assert (loop.rates, done) == (True, ["look"])


@pytest.mark.parametrize(
    ("change", "done"),
    [
        ({}, True),
        ({"succeeded": False}, False),
        ({"clear": False}, False),
        ({"pose_error": 0.9 * TOLERANCE, "over": 0.9 * TOLERANCE}, True),
        ({"pose_error": 1.5 * TOLERANCE}, False),
        ({"over": 1.5 * TOLERANCE}, False),
    ],
)
def test_loop_converges_if_all_constraints_hold(change: dict[str, Any], done: bool) -> None:
    told = {"succeeded": True, "clear": True, "pose_error": 0.0, "over": 0.0, **change}
    problem = SimpleNamespace(pace=lambda z: ("fast", "faster"))
    loop = parts(
        problem=problem, pose_error=told["pose_error"], timing=Clock("now", over=told["over"])
    )
    trial: Any = SimpleNamespace(
        z=np.zeros((N, 2)), succeeded=told["succeeded"], is_clear=told["clear"]
    )
    assert loop.has_converged(trial) == done


@pytest.mark.parametrize(
    ("short", "grows"), [(0.9 * CLEARANCE_TOLERANCE, False), (1.1 * CLEARANCE_TOLERANCE, True)]
)
def test_only_violated_constraints_get_higher_weights(short: float, grows: bool) -> None:
    done: list[str] = []
    subproblem = SimpleNamespace(reset_multipliers=lambda: done.append("forget"))
    loop = parts(subproblem=subproblem, merit=Merit(2.0), found=make_infeasibility(clearance=short))
    assert loop.raise_penalties() == grows
    assert loop.merit.weights["clearance"] == (8.0 if grows else 2.0)
    assert done == ["forget"]


# --- when it is given up
# ------------------------------------------------------------


@pytest.mark.parametrize(
    ("short", "accepted", "rounds"),
    [(0.009, False, 12), (0.011, False, 5), (0.009, True, 5), (0.011, True, 5), (0.0, False, 12)],
)
def test_rejected_rounds_do_not_count_as_stalled_near_feasibility(
    short: float, accepted: bool, rounds: int
) -> None:
    found = make_infeasibility(clearance=short, poses=0.1)
    row = {
        "objective": 1.0,
        "pose_error": 0.1,
        "contacts": contact(0.02 - short),
        "step": np.zeros(N),
    }
    loop: Any = SimpleNamespace(
        solution=Solution(np.zeros((N, 2)), np.ones(N)),
        found=found,
        objective=1.0,
        merit=Merit(2.0),
        try_step=lambda radius: SimpleNamespace(**row),
        compute_penalties=lambda trial: (np.zeros(N), np.zeros(N)),
        is_acceptable=lambda *_: accepted,
        accept=lambda trial: None,
        has_converged=lambda trial: False,
    )
    region: Any = SimpleNamespace(
        radius=np.ones(N), adapt=lambda *_: None, has_stalled=lambda *_: False
    )
    module._iterate(loop, region, None, 12)
    assert loop.solution.rounds == rounds


# --- what is returned
# ------------------------------------------------------------


def drive() -> vkc.TrajectoryProblem:
    return program_of(
        hall(), [vkc.GoTo(1.0, 0.0)], options=vkc.Options(reach_waypoints=N, max_outer=7)
    )


@pytest.mark.parametrize(("short", "astray"), [(0.009, 0.0), (0.011, 0.011), (0.0, 0.0)])
def test_large_shortfall_is_reported(
    short: float, astray: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, asked = drive(), list[Any]()
    monkeypatch.setattr(
        module, "_iterate", lambda loop, region, callback, rounds: asked.append((callback, rounds))
    )
    monkeypatch.setattr(_Loop, "find_contacts", lambda loop, z: (make_empty_contacts(), True, []))
    monkeypatch.setattr(
        vkc.TrajectoryProblem, "evaluate_contacts", lambda self, z, **how: contact(0.02 - short)
    )
    solution = solve(problem, problem.still)
    assert (solution.status, solution.converged) == ("not converged", False)
    assert solution.shortfall == pytest.approx(astray)
    assert asked == [(None, 7)]
    solve(problem, problem.still, rounds=3)
    assert asked[-1] == (None, 3)


@pytest.mark.parametrize("good", [False, True])
def test_exhausted_budget_is_the_status_unless_feasible(
    good: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unfinished solution reports no shortfall; a feasible one is returned."""
    problem = drive()
    kept = problem.still + 0.1, np.full(N, 0.5)

    def ended(loop: _Loop, *_: Any) -> None:
        if good:
            loop.solution.converged, loop.feasible = True, kept
        raise BudgetExhaustedError("time limit")

    monkeypatch.setattr(module, "_iterate", ended)
    monkeypatch.setattr(_Loop, "find_contacts", lambda loop, z: (make_empty_contacts(), True, []))
    monkeypatch.setattr(
        vkc.TrajectoryProblem, "evaluate_contacts", lambda self, z, **how: contact(-1.0)
    )
    solution = solve(problem, problem.still)
    assert (solution.status, solution.converged) == (
        ("converged", True) if good else ("time limit", False)
    )
    assert solution.shortfall == 0.0
    np.testing.assert_array_equal(solution.z, kept[0] if good else problem.clip(problem.still))
    assert (solution.dt is kept[1]) == good


def test_time_counts_from_the_start_of_the_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fake clock started long ago and advances at every query."""
    clock = itertools.count(1_000_000)
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: float(next(clock))))
    problem = drive()
    rows = solve(problem, problem.still, rounds=3).history
    assert rows
    assert 0.0 < rows[0].time < 20.0
    assert all(
        before.time < after.time < before.time + 20.0 for before, after in itertools.pairwise(rows)
    )
