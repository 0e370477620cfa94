"""Which seed a problem begins with, and what is returned when time is up or Ctrl-C pressed: with a solver that does as told."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.drawers import SHORT, drawer_scene, holding
from helpers.drives import hall
from helpers.small_problems import door_scene, program_of

import vkc_pin as vkc
from vkc_pin.interrupt import Interrupt
from vkc_pin.planning import one_problem as module
from vkc_pin.planning.one_problem import OneProblem
from vkc_pin.planning.outcome import TIMES
from vkc_pin.planning.settings import Settings
from vkc_pin.seeds.seed import Seed
from vkc_pin.solver.solution import Iteration, Resume, Solution
from vkc_pin.task.compiler import compile_task

PULL = [vkc.Actuate("drawer", {"slide": 0.3})]
NAMES, MARK = "abcdef", 1e-6
ROUND = Iteration(1, 5, 0.0, 0.1, 0.0, 0.0, 0.1, 0.5, 200.0, True, 0.0)
Answer = tuple[float, str]


class Race:
    """Stands for seeds and solver; each seed makes a way of one joint, out and back, whose height says how dear it is.

    Attributes:
        heights: Of the seeds.
        after: Of what one round leads to, and the solver's status.
        finally_: Of what all rounds lead to, and the status.
        aside: The seeds that do not race.
        stuck: The seeds from which the solver gets stuck, when it has no patience.
        events: What happened: "b" a seed was asked for, "b1" it was given one round, "b*" all of them, "b*!" at a higher penalty.
        radii: How far planes were to be believed at first, each time; None: as usual.
        patience: Whether the solver was to have any, each time.
        care: Whether it was to be thorough, each time.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        heights: Sequence[float],
        *,
        after: dict[str, Answer] | None = None,
        finally_: dict[str, Answer] | None = None,
        aside: str = "",
        amounts: Sequence[float] = (),
        stuck: str = "",
    ) -> None:
        self.heights, self.after, self.finally_ = heights, after or {}, finally_ or {}
        self.stuck = stuck
        self.aside, self.amounts = aside, iter(amounts or [1.0] * 20)
        self.events: list[str] = []
        self.given: list[np.ndarray] = []
        self.radii: list[np.ndarray | None] = []
        self.patience: list[bool] = []
        self.care: list[bool] = []
        self.stop: Callable[[str], None] = lambda event: None
        monkeypatch.setattr(module, "initialize", self.initialize)
        monkeypatch.setattr(module, "solve", self.solve)
        monkeypatch.setattr(module, "validate", self.validate)
        monkeypatch.setattr(module, "explain", lambda *_: [])

    def note(self, event: str) -> None:
        self.events.append(event)
        self.stop(event)

    def z(self, problem: vkc.TrajectoryProblem, name: str, height: float) -> np.ndarray:
        share = np.arange(1, problem.segments + 1) / problem.segments
        z = np.tile(problem.start, (problem.segments, 1))
        z[:, 4] += height * share * (1.0 - share)
        z[:, 8] += MARK * NAMES.index(name)  # by which it is recognised
        return z

    def initialize(self, problem: vkc.TrajectoryProblem, *_: Any, **__: Any) -> Iterator[Seed]:
        for name, height in zip(NAMES, self.heights, strict=False):
            self.note(name)
            yield Seed(name, self.z(problem, name, height), races=name not in self.aside)

    def radius(self, problem: vkc.TrajectoryProblem, name: str) -> np.ndarray:
        """Return how far planes are believed after a round, as the solver says; another for every seed."""
        return np.linspace(0.1, 0.2, problem.segments) + 0.1 * NAMES.index(name)

    def solve(
        self,
        problem: vkc.TrajectoryProblem,
        z: np.ndarray,
        *,
        callback: Any,
        deadline: float,
        rounds: int | None = None,
        radius: np.ndarray | None = None,
        penalty: float | None = None,
        patient: bool = True,
        thorough: bool = True,
        interrupt: Interrupt,
    ) -> Solution:
        name = NAMES[round((z[0, 8] - problem.start[8]) / MARK)]
        self.given.append(z)
        self.radii.append(radius)
        self.note(f"{name}{rounds or '*'}{'!' if penalty else ''}")
        self.patience.append(patient)
        self.care.append(thorough)
        height, status = (self.after if rounds else self.finally_).get(name, (None, "not converged"))
        if callback is not None:
            callback(ROUND)
        timings = {"coal": 0.5, "casadi": 0.25, "ipopt": 0.125}
        solved = z if height is None else self.z(problem, name, height)
        solution = Solution(solved, problem.timing_for(z).dt, status == "converged", status, self.radius(problem, name))
        if name in self.stuck and not rounds and not patient:
            solution.resume = Resume(self.radius(problem, name), 800.0)
        interrupt.pressed |= status == "interrupted"
        return dataclasses.replace(solution, rounds=1, iterations=5, timings=timings, history=[ROUND])

    def validate(self, scene: vkc.Scene, steps: Any, trajectory: vkc.Trajectory, *options: Any) -> vkc.Report:
        amount = next(self.amounts)
        wrong = vkc.Violation("goal", "drawer.slide", waypoint=0, time=0.0, amount=amount, unit="m", detail="")
        return vkc.Report((wrong,) if amount else ())

    def run(self, steps: Sequence[Any] = PULL, *, scene: vkc.Scene | None = None, **settings: Any) -> vkc.Plan:
        scene = scene or drawer_scene()
        self.one = OneProblem(scene, compile_task(scene, steps, SHORT), Settings("auto", SHORT, **settings))
        return self.one.run()


@cache
def flat() -> float:
    """Return the objective of standing still."""
    problem = program_of(drawer_scene(), PULL, options=SHORT)
    return problem.objective(problem.still, problem.timing_for(problem.still).dt)


@pytest.mark.parametrize(
    ("heights", "after", "expected"),
    [
        ([3.0, 1.0, 2.0, 0.5], {}, "a a1 b b1 c c1 b* c* a* d d*"),  # only three race
        ([1.0, 2.0, 3.0], {}, "a a1 b b1 c c1 a* b* c*"),
        ([2.0, 1.0], {}, "a a1 b b1 b* a*"),
        ([1.0], {}, "a a1 a*"),
        # What counts is where the round leads to.
        ([1.0, 2.0, 3.0], {"a": 0.9, "b": 0.8, "c": 0.1}, "a a1 b b1 c c1 c* b* a*"),
        ([1.0, 2.0, 3.0], {"a": 4.0}, "a a1 b b1 c c1 b* c* a*"),
        ([2.0, 2.0, 1.0], {}, "a a1 b b1 c c1 c* a* b*"),  # of equals, the one that initialization thinks better
        ([], {}, ""),
    ],
)
def test_the_seed_that_looks_best_after_a_round_goes_first(
    heights: list[float], after: dict[str, float], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    race = Race(monkeypatch, heights, after={name: (height, "not converged") for name, height in after.items()})
    plan = race.run()
    assert race.events == expected.split()
    assert plan.status == "not converged"


@pytest.mark.parametrize(
    ("heights", "aside", "expected"),
    [
        ([1.0, 3.0, 2.0, 4.0], "a", "a b b1 c c1 c* b* a* d d*"),
        ([1.0, 2.0, 3.0], "ab", "a b c c1 c* a* b*"),
        ([3.0, 2.0, 1.0, 0.5], "abc", "a b c a* b* c* d d*"),
        ([2.0, 1.0], "b", "a a1 b a* b*"),
    ],
)
def test_seeds_that_do_not_race_go_last(heights: list[float], aside: str, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    race = Race(monkeypatch, heights, aside=aside)
    race.run()
    assert race.events == expected.split()


def test_the_first_success_ends_it_and_goes_on_from_the_race(monkeypatch: pytest.MonkeyPatch) -> None:
    race = Race(monkeypatch, [3.0, 2.0, 1.0], after={"b": (0.5, "not converged")}, amounts=[0.0])
    plan = race.run()
    assert race.events == ["a", "a1", "b", "b1", "c", "c1", "b*"]
    assert plan.success
    assert plan.initialization == "b"
    np.testing.assert_array_equal(race.given[-1], race.z(race.one.problem, "b", 0.5))


def test_raced_seeds_go_on_with_the_trust_region_that_they_had(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with its own; those that did not race, and those of the race itself, begin as usual."""
    race = Race(monkeypatch, [3.0, 2.0, 4.0, 1.0], aside="c")
    race.run()
    assert race.events == ["a", "a1", "b", "b1", "c", "b*", "a*", "c*", "d", "d*"]
    radii = dict(zip([event for event in race.events if len(event) == 2], race.radii, strict=True))
    assert [name for name, radius in radii.items() if radius is None] == ["a1", "b1", "c*", "d*"]
    for name in ("b*", "a*"):
        np.testing.assert_array_equal(radii[name], race.radius(race.one.problem, name[0]))


@pytest.mark.parametrize(
    ("amounts", "stuck", "expected"),
    [
        ([3.0, 2.0, 1.0, 1.0], "abc", "a a* b b* c c* c*!"),  # what violates least
        ([3.0, 2.0, 4.0, 1.0], "ac", "a a* b b* c c* a*!"),
        ([3.0, 0.0], "a", "a a* b b*"),
        ([3.0, 2.0, 4.0], "", "a a* b b* c c*"),
    ],
)
def test_of_what_got_stuck_the_best_is_tried_again_once_there_are_no_other_seeds(
    amounts: list[float], stuck: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    race = Race(monkeypatch, [3.0, 1.0, 2.0], amounts=[*amounts, 1.0, 1.0, 1.0], stuck=stuck)
    race.run([vkc.GoTo(0.0, 0.0)])
    assert race.events == expected.split()
    solved = [event for event in race.events if "*" in event]
    assert race.patience == ["!" in event for event in solved]
    for event, radius in zip(solved, race.radii, strict=True):
        if "!" in event:
            np.testing.assert_array_equal(radius, race.radius(race.one.problem, event[0]))


@pytest.mark.parametrize("rough", [False, True])
def test_rough_motions_need_neither_a_race_nor_much_care(rough: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    race = Race(monkeypatch, [2.0, 1.0])
    race.run(rough=rough)
    assert race.events == (["a", "a*", "b", "b*"] if rough else ["a", "a1", "b", "b1", "b*", "a*"])
    assert set(race.care) == {not rough}


def test_rounds_of_the_race_count(monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[Iteration] = []
    race = Race(monkeypatch, [2.0, 1.0], amounts=[1.0, 0.0])
    plan = race.run(callback=rows.append)
    assert race.events == ["a", "a1", "b", "b1", "b*", "a*"]
    assert (plan.metrics["rounds"], plan.metrics["iterations"]) == (4.0, 20.0)
    assert (plan.metrics["time_coal"], plan.metrics["time_casadi"], plan.metrics["time_ipopt"]) == (2.0, 1.0, 0.5)
    assert set(TIMES) <= {key.removeprefix("time_") for key in plan.metrics}
    assert list(plan.history) == [dataclasses.asdict(ROUND)] * 4
    assert rows == [ROUND] * 4


@pytest.mark.parametrize(
    ("steps", "held"),
    [
        ([vkc.GoTo(0.0, 0.0)], False),
        ([vkc.Grasp("drawer")], False),  # the grasp is the end: nothing that follows hangs on it
        (PULL, True),  # it is held already
    ],
    ids=["no grasp", "grasp at the end", "held from the start"],
)
def test_without_a_grasp_inside_there_is_no_race(steps: list[Any], held: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    race = Race(monkeypatch, [3.0, 1.0, 2.0])
    race.run(steps, scene=holding() if held else None)
    assert race.events == ["a", "a*", "b", "b*", "c", "c*"]


def test_a_seed_of_ones_own_does_not_race(monkeypatch: pytest.MonkeyPatch) -> None:
    race = Race(monkeypatch, [3.0, 1.0], stuck="d")
    race.run()
    race.events.clear()
    plan = race.one.run(lambda problem: Seed("mine", race.z(problem, "d", 1.0)))
    assert (race.events, race.patience[-1]) == (["d*"], False)  # whoever has one has a motion already
    assert plan.initialization == "mine"


def test_of_failures_the_least_violated_is_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    race = Race(monkeypatch, [3.0, 1.0, 2.0], amounts=[0.5, 0.2, 0.3], finally_={"c": (2.0, "converged")})
    plan = race.run()
    assert race.events[-3:] == ["b*", "c*", "a*"]
    assert (plan.initialization, plan.status) == ("c", "rejected")
    np.testing.assert_array_equal(race.one.z, race.z(race.one.problem, "c", 2.0))


# --- time is up, or Ctrl-C, during the race ------------------------------------------------------------------------------


def test_time_is_up_during_the_race(monkeypatch: pytest.MonkeyPatch) -> None:
    """The solver returns at once from then on; what looked best before is returned."""
    late: dict[str, Answer] = {"b": (1.0, "time limit"), "c": (3.0, "time limit")}
    race = Race(monkeypatch, [2.0, 3.0, 4.0], after=late, finally_=dict.fromkeys("abc", (1.0, "time limit")))
    plan = race.run(time_limit=10.0)
    assert plan.status == "time limit"
    assert not plan.success
    assert plan.initialization == "a"
    assert race.events[-1] == "a*", "no other seed is begun"
    assert plan.validation.violations


def test_the_real_solver_stops_during_the_race() -> None:
    """No round is begun any more, and Ipopt stops at its first iteration."""
    plan = vkc.plan(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], time_limit=0.01)
    assert plan.status == "time limit"
    assert plan.metrics["rounds"] <= 1
    assert plan.metrics["iterations"] <= 1
    assert plan.validation.violations
    assert plan.initialization != "none"
    assert np.isfinite(plan.trajectory.positions).all()


@pytest.mark.parametrize(
    ("after", "name"),
    [
        ({"a": (1.0, "interrupted")}, "a"),
        ({"a": (1.0, "not converged"), "b": (2.0, "interrupted")}, "a"),
        ({"a": (2.0, "not converged"), "b": (1.0, "interrupted")}, "b"),
        ({"a": (2.0, "not converged"), "b": (1.0, "not converged"), "c": (3.0, "interrupted")}, "b"),
    ],
)
def test_ctrl_c_during_the_race_returns_the_leader(after: dict[str, Answer], name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    race = Race(monkeypatch, [5.0, 5.0, 5.0], after=after)
    plan = race.run()
    assert race.events[-1] == f"{max(after)}1", "nothing more is begun"
    assert (plan.status, plan.initialization, plan.success) == ("interrupted", name, False)
    np.testing.assert_array_equal(race.one.z, race.z(race.one.problem, name, after[name][0]))


@pytest.mark.parametrize(("when", "name"), [("a", "none"), ("a1", "a"), ("b", "a"), ("b1", "b"), ("c1", "b"), ("b*", "b")])
def test_ctrl_c_anywhere(when: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """While seeds are looked for, too, or by the time that a solution was found."""
    race = Race(monkeypatch, [2.0, 1.0, 3.0])

    def stop(event: str) -> None:
        race.one.settings.interrupt.pressed |= event == when

    race.stop = stop
    plan = race.run()
    assert race.events[-1] == when
    assert (plan.status, plan.initialization, plan.success) == ("interrupted", name, False)
    z = race.one.z
    if name == "none":
        np.testing.assert_array_equal(z, np.tile(race.one.problem.start, (len(z), 1)))
    else:
        np.testing.assert_array_equal(z, race.z(race.one.problem, name, {"a": 2.0, "b": 1.0}[name]))


# --- what is weighed -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "columns"),
    [
        ("velocity_weight_base", [0, 1]),
        ("velocity_weight_heading", [2]),
        ("velocity_weight_arm", [3, 4, 5, 6, 7, 8]),
        ("velocity_weight_object", [9]),
    ],
)
def test_a_weight_weighs_what_it_says(field: str, columns: list[int]) -> None:
    options = [vkc.Options(**{**dataclasses.asdict(SHORT), field: value}) for value in (getattr(SHORT, field), 7.0)]
    usual, other = (program_of(drawer_scene(), PULL, options=each).transcription.structure for each in options)
    for name in ("weights_velocity", "weights_acceleration"):
        weights, changed = getattr(usual, name), getattr(other, name)
        factors = np.ones(weights.shape[-1])
        factors[columns] = 7.0 / getattr(SHORT, field)
        np.testing.assert_allclose(changed, weights * factors, rtol=1e-12)
    np.testing.assert_array_equal(other.weights_velocity[0, columns], 7.0)


def test_turning_costs_what_the_heading_weighs() -> None:
    """Σ w δ² + w_acc δδ²/dt² over a turn on the spot, by hand."""
    options = dataclasses.replace(SHORT, velocity_weight_heading=0.7, dt=0.5)
    problem = program_of(hall(), [vkc.GoTo(0.0, 0.0, 1.0)], options=options)
    z = np.tile(problem.start, (problem.segments, 1))
    z[:, 2] = np.linspace(0.0, 1.0, problem.segments + 1)[1:] ** 2
    first = np.diff(np.concatenate([[0.0], z[:, 2]]))
    second = np.diff(np.concatenate([[0.0], first, [0.0]]))
    expected = 0.7 * (np.sum(first**2) + options.acceleration_weight * np.sum(second**2) / 0.5**2)
    assert problem.objective(z, problem.timing_for(z).dt) == pytest.approx(expected, rel=1e-9)


def test_standing_still_costs_nothing() -> None:
    assert flat() == pytest.approx(0.0, abs=1e-9)


def test_no_seed_is_looked_for_when_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """And what the solver has not touched does not lead."""
    after = {"a": (2.0, "not converged"), "b": (1.0, "time limit")}
    race = Race(monkeypatch, [3.0, 1.0, 4.0], after=after, finally_=dict.fromkeys("abc", (2.0, "time limit")))
    plan = race.run(time_limit=10.0)
    assert "c" not in race.events
    assert (plan.status, plan.initialization) == ("time limit", "a")


def test_the_leader_keeps_its_own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """How long a motion takes follows from its seed; the last seed's is not the leader's."""
    race = Race(monkeypatch, [2.0, 40.0, 40.0], after={"a": (2.0, "not converged"), "b": (40.0, "interrupted")})
    plan = race.run()
    assert plan.initialization == "a"
    alone = program_of(drawer_scene(), PULL, options=SHORT)
    dt = alone.timing_for(race.z(alone, "a", 2.0)).dt
    assert plan.metrics["duration"] == pytest.approx(float(dt.sum()) + SHORT.grasp_time, rel=1e-6)
