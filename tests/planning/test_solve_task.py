"""Which seed a problem begins with, and what is returned when time is up or Ctrl-C pressed: with a solver that does as told."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from helpers.drawers import SHORT, drawer_scene
from helpers.drives import hall
from helpers.small_problems import door_scene, program_of

import vkc_pin as vkc
from vkc_pin.benchmarks.problems.problem_set import problem as drawn_problem
from vkc_pin.planning import solve_task as module
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.request import PlanningRequest
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.planning.solver.solution import Iteration, Solution
from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.planning.statistics import STAGES
from vkc_pin.utils.budget import Budget, record_evaluations
from vkc_pin.utils.cache import Cache
from vkc_pin.world.task.compiler import compile_task

PULL = [vkc.Actuate("drawer", {"slide": 0.3})]
NAMES, MARK = "abcdef", 1e-6
ROUND = Iteration(1, 5, 0.0, 0.1, 0.0, 0.0, 0.1, 0.5, 200.0, True, 0.0)
Answer = tuple[float, str]


class Scripted:
    """Stands for seeds and solver; each seed makes a way of one joint, out and back, whose height says how dear it is.

    Attributes:
        heights: Of the seeds.
        after: Of what one round leads to, and the solver's status.
        finally_: Of what all rounds lead to, and the status.
        aside: The seeds that do not script.
        stuck: The seeds from which the solver gets stuck, when it has no patience.
        events: What happened: "b" a seed was asked for, "b1" it was given one round, "b*" all of
            them, "b*!" at a higher penalty.
        radii: How far planes were to be believed at first, each time; None: as usual.
        patience: Whether the solver was to have any, each time.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        heights: Sequence[float],
        *,
        leads: dict[str, Answer] | None = None,
        amounts: Sequence[float] = (),
    ) -> None:
        self.heights, self.leads, self.amounts = heights, leads or {}, iter(amounts or [1.0] * 20)
        self.events: list[str] = []
        self.stop: Callable[[str], None] = lambda event: None
        monkeypatch.setattr(module, "initialize", self.initialize)
        monkeypatch.setattr(module, "solve", self.solve)
        monkeypatch.setattr(module, "validate", self.validate)
        monkeypatch.setattr(module, "diagnose_goal", lambda *_: None)

    def note(self, event: str) -> None:
        self.events.append(event)
        self.stop(event)
        if not event.endswith("*"):  # as the real search for seeds does
            record_evaluations()

    def z(self, problem: vkc.TrajectoryProblem, name: str, height: float) -> np.ndarray:
        share = np.arange(1, problem.segments + 1) / problem.segments
        z = np.tile(problem.start, (problem.segments, 1))
        z[:, 4] += height * share * (1.0 - share)
        z[:, 8] += MARK * NAMES.index(name)  # by which it is recognised
        return z

    def initialize(
        self, problem: vkc.TrajectoryProblem, *_: Any, **__: Any
    ) -> Iterator[InitialGuess]:
        for name, height in zip(NAMES, self.heights, strict=False):
            self.note(name)
            yield InitialGuess(name, self.z(problem, name, height))

    def solve(
        self,
        problem: vkc.TrajectoryProblem,
        z: np.ndarray,
        *,
        callback: Any,
        radius: np.ndarray | None = None,
    ) -> Solution:
        name = NAMES[round((z[0, 8] - problem.start[8]) / MARK)]
        self.note(f"{name}*")
        height, status = self.leads.get(name, (None, "not converged"))
        if callback is not None:
            callback(ROUND)
        timings = {"coal": 0.5, "casadi": 0.25, "ipopt": 0.125}
        solved = z if height is None else self.z(problem, name, height)
        solution = Solution(solved, problem.timing_for(z).dt, status == "converged", status)
        return dataclasses.replace(
            solution, rounds=1, iterations=5, timings=timings, history=[ROUND]
        )

    def validate(
        self, scene: vkc.Scene, steps: Any, trajectory: vkc.Trajectory, *options: Any
    ) -> vkc.Report:
        amount = next(self.amounts)
        wrong = vkc.Violation(
            "goal", "drawer.slide", waypoint=0, time=0.0, amount=amount, unit="m", detail=""
        )
        return vkc.Report((wrong,) if amount else ())

    def run(
        self, steps: Sequence[Any] = PULL, *, scene: vkc.Scene | None = None, **settings: Any
    ) -> vkc.Plan:
        scene = scene or drawer_scene()
        self.budget, guess = Budget(), settings.pop("guess", None)
        request = PlanningRequest("auto", SHORT, **settings)
        task = compile_task(scene, steps, SHORT)
        with self.budget.activate():
            self.result = module.solve_task(scene, task, request, guess=guess)
        return self.result.plan


@pytest.mark.made_up
@pytest.mark.parametrize(
    ("amounts", "expected"),
    [([], "a a* b b* c c*"), ([1.0, 0.0], "a a* b b*"), ([0.0], "a a*")],
)
def test_seeds_are_tried_in_turn_until_a_motion_is_good(
    amounts: list[float], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = Scripted(monkeypatch, [3.0, 1.0, 2.0], amounts=amounts)
    plan = script.run()
    assert script.events == expected.split()
    assert plan.success == bool(amounts)


@pytest.mark.parametrize(("number", "random_seed"), [(39, 101), (38, 105)])
def test_real_seeds_are_tried_in_turn_until_validation_accepts_a_motion(
    number: int, random_seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is replaced here: what is asked for, solved and checked is written down on the way."""
    given, solved, asked = list[InitialGuess](), list[Solution](), list[str]()
    search, solver = module.initialize, module.solve

    def noted(*arguments: Any, **named: Any) -> Iterator[InitialGuess]:
        for seed in search(*arguments, **named):
            asked.append("seed")
            given.append(seed)
            yield seed

    def answered(problem: vkc.TrajectoryProblem, z: np.ndarray, **named: Any) -> Solution:
        asked.append("solve")
        np.testing.assert_array_equal(z, given[-1].z)
        solved.append(solver(problem, z, **named))
        return solved[-1]

    monkeypatch.setattr(module, "initialize", noted)
    monkeypatch.setattr(module, "solve", answered)
    own = drawn_problem(number)
    plan = vkc.plan(own.scene, own.steps, seed=random_seed)
    assert plan.success, plan.summary()
    assert asked == ["seed", "solve"] * len(solved)
    assert len(solved) > 1, "the first seed sufficed: choose another problem"
    assert plan.initialization == given[-1].name
    assert (
        plan.metrics["rounds"] == sum(solution.rounds for solution in solved) == len(plan.history)
    )
    assert plan.metrics["iterations"] == sum(solution.iterations for solution in solved)
    parts = [value for key, value in plan.metrics.items() if key.startswith("time_")]
    assert all(
        plan.metrics[f"time_{part}"] > 0.0
        for part in ("initialization", "coal", "ipopt", "retiming", "validation")
    )
    assert sum(parts) <= plan.metrics["planning_time"] + plan.metrics["build_time"]
    assert plan.metrics["time_ipopt"] == pytest.approx(
        sum(solution.timings["ipopt"] for solution in solved)
    )
    assert vkc.validate(own.scene, own.steps, plan.trajectory, plan.options).ok
    for solution in solved[:-1]:  # what was given up was no motion
        motion = make_trajectory(vkc.build(own.scene, own.steps), solution.z, solution.dt)
        assert not vkc.validate(own.scene, own.steps, motion, plan.options).ok


@pytest.mark.parametrize(
    ("initialization", "all_astray"), [("stationary", False), ("interpolated", True)]
)
def test_what_clearly_misses_is_checked_only_if_nothing_else_is_left(
    initialization: str, all_astray: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wall from side to side: motions end inside it, or jump through it between two waypoints."""
    solved, checked, solver, check = (
        list[Solution](),
        list[vkc.Trajectory](),
        module.solve,
        module.validate,
    )

    def answered(problem: vkc.TrajectoryProblem, z: np.ndarray, **named: Any) -> Solution:
        solved.append(solver(problem, z, **named))
        return solved[-1]

    def noted(scene: vkc.Scene, steps: Any, trajectory: vkc.Trajectory, *more: Any) -> vkc.Report:
        checked.append(trajectory)
        return check(scene, steps, trajectory, *more)

    monkeypatch.setattr(module, "solve", answered)
    monkeypatch.setattr(module, "validate", noted)
    monkeypatch.setattr(
        module, "find_proofs", lambda _: []
    )  # it would be certain before anything is tried again
    wall = {"name": "wall", "type": "box", "size": [0.6, 9.0, 2.0], "position": [2.0, 0.0, 1.0]}
    plan = vkc.plan(hall(obstacles=[wall]), [vkc.GoTo(4.0, 0.0)], initialization=initialization)
    assert not plan.success
    astray = [solution for solution in solved if solution.shortfall]
    assert astray, "all came near: choose a thicker wall"
    assert (len(astray) == len(solved)) == all_astray
    assert len(checked) == max(1, len(solved) - len(astray))
    problem = vkc.build(plan.scene, plan.steps)
    for solution in solved:
        short = problem.evaluate_contacts(solution.z, reach=0.1).compute_violation()
        assert solution.shortfall == (pytest.approx(short) if short > 0.01 else 0.0)
    for solution in astray:
        motion = make_trajectory(problem, solution.z, solution.dt)
        assert not check(plan.scene, plan.steps, motion, plan.options).ok
    if all_astray:
        nearest = min(astray, key=lambda solution: solution.shortfall)
        np.testing.assert_allclose(plan.trajectory.positions[1:, :2], nearest.z[:, :2], atol=1e-9)
    assert not check(plan.scene, plan.steps, plan.trajectory, plan.options).ok


@pytest.mark.made_up
def test_rounds_of_all_seeds_count(monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[Iteration] = []
    script = Scripted(monkeypatch, [2.0, 1.0], amounts=[1.0, 0.0])
    plan = script.run(callback=rows.append)
    assert script.events == ["a", "a*", "b", "b*"]
    assert (plan.metrics["rounds"], plan.metrics["iterations"]) == (2.0, 10.0)
    assert (plan.metrics["time_coal"], plan.metrics["time_casadi"], plan.metrics["time_ipopt"]) == (
        1.0,
        0.5,
        0.25,
    )
    assert set(STAGES) <= {key.removeprefix("time_") for key in plan.metrics}
    assert list(plan.history) == [dataclasses.asdict(ROUND)] * 2
    assert rows == [ROUND] * 2


def test_the_ends_of_a_seed_are_free_or_not() -> None:
    """What it goes through on the way does not count."""
    post = {"name": "post", "type": "box", "size": [0.3, 0.3, 2.0], "position": [2.0, 0.0, 1.0]}
    drive = vkc.build(hall(obstacles=[post]), [vkc.GoTo(4.0, 0.0)])
    for x, free in ((4.0, True), (2.0, False)):
        z = np.tile(drive.start, (drive.segments, 1))
        z[:, 0] = np.linspace(drive.start[0], x, drive.segments)
        assert module._has_free_ends(drive, InitialGuess("straight", z)) == free


def test_a_seed_of_ones_own_is_the_only_one(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Scripted(monkeypatch, [3.0, 1.0])
    plan = script.run(guess=lambda problem: InitialGuess("mine", script.z(problem, "d", 1.0)))
    assert script.events == ["d*"]
    assert plan.initialization == "mine"


def test_of_failures_the_least_violated_is_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Scripted(
        monkeypatch,
        [3.0, 1.0, 2.0],
        amounts=[0.5, *[0.2] * 4, 0.3],
        leads={"b": (2.0, "converged")},
    )
    plan = script.run()
    assert script.events[-1] == "c*"
    assert (plan.initialization, plan.status) == ("b", "rejected")
    np.testing.assert_array_equal(script.result.z, script.z(script.result.problem, "b", 2.0))


# --- time is up, or Ctrl-C
# -----------------------------------------------------------------------------------------------


def test_no_seed_is_looked_for_when_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was best so far is returned."""
    leads: dict[str, Answer] = {"a": (2.0, "not converged"), "b": (1.0, "time limit")}
    script = Scripted(monkeypatch, [3.0, 1.0, 4.0], leads=leads, amounts=[0.5, 0.7])
    plan = script.run()
    assert script.events == ["a", "a*", "b", "b*"]
    assert (plan.status, plan.initialization, plan.success) == ("time limit", "a", False)
    assert plan.report.violations


def test_the_real_solver_stops() -> None:
    """Also while the program is built, and while seeds are looked for: a robot that stands is what there is then."""
    late, spent = "time limit", "evaluation limit"
    budgets: list[tuple[dict[str, Any], str]] = [
        ({"time_limit": 1e-3}, late),
        ({"max_evaluations": 1}, spent),
        ({"max_evaluations": 3000}, spent),
    ]
    for budget, status in budgets:
        plan = vkc.plan(
            door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], planner=vkc.Planner(), **budget
        )
        assert (plan.status, plan.initialization, plan.metrics["rounds"]) == (status, "none", 0)
        assert plan.report.violations
        assert np.ptp(plan.trajectory.positions, axis=0).max() == 0.0
        assert np.isfinite(plan.metrics["duration"])


def test_a_sufficient_budget_changes_nothing() -> None:
    """It is the same whether all has to be built or is there; with one unit less there is none."""
    scene, steps = door_scene(), [vkc.Actuate("door", {"hinge": 1.2})]
    whole = vkc.plan(scene, steps, planner=vkc.Planner())
    assert whole.success
    used = int(whole.metrics["evaluations"])
    again = vkc.plan(scene, steps, max_evaluations=used)
    assert again.success
    assert again.metrics["evaluations"] == used
    np.testing.assert_array_equal(again.trajectory.positions, whole.trajectory.positions)
    short = [
        vkc.plan(scene, steps, max_evaluations=used // 2, planner=planner)
        for planner in (None, vkc.Planner())
    ]
    assert [plan.status for plan in short] == ["evaluation limit"] * 2
    np.testing.assert_array_equal(short[0].trajectory.positions, short[1].trajectory.positions)


@pytest.mark.parametrize(("amounts", "name"), [([1.0, 0.5], "b"), ([0.5, 1.0], "a")])
def test_ctrl_c_in_the_solver_returns_the_best(
    amounts: list[float], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its own time: how long a motion takes follows from its seed."""
    leads: dict[str, Answer] = {"a": (2.0, "not converged"), "b": (40.0, "interrupted")}
    script = Scripted(monkeypatch, [2.0, 40.0, 40.0], leads=leads, amounts=amounts)
    plan = script.run()
    assert script.events[-1] == "b*", "nothing more is begun"
    assert (plan.status, plan.initialization, plan.success) == ("interrupted", name, False)
    np.testing.assert_array_equal(
        script.result.z, script.z(script.result.problem, name, leads[name][0])
    )
    alone = program_of(drawer_scene(), PULL, options=SHORT)
    own = script.z(alone, name, leads[name][0])
    expected = retime_trajectory(alone.scene, make_trajectory(alone, own, alone.timing_for(own).dt))
    assert plan.metrics["duration"] == pytest.approx(float(expected.times[-1]), rel=1e-6)


@pytest.mark.parametrize(
    ("when", "name"), [("a", "none"), ("a*", "a"), ("b", "a"), ("b*", "a"), ("c*", "a")]
)
def test_ctrl_c_anywhere(when: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """While seeds are looked for, too, or by the time that a solution was found."""
    script = Scripted(monkeypatch, [2.0, 1.0, 3.0])

    def stop(event: str) -> None:
        script.budget.is_interrupted |= event == when

    script.stop = stop
    plan = script.run()
    assert script.events[-1] == when
    assert (plan.status, plan.initialization, plan.success) == ("interrupted", name, False)
    if name == "none":
        assert [phase.name for phase in plan.trajectory.phases] == ["stand"]
    else:
        np.testing.assert_array_equal(script.result.z, script.z(script.result.problem, name, 2.0))


# --- what is weighed
# -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "columns"),
    [
        ("velocity_weight_base", [0, 1, 9]),  # the drawer slides
        ("velocity_weight_heading", [2]),
        ("velocity_weight_arm", [3, 4, 5, 6, 7, 8]),
    ],
)
def test_a_weight_weighs_what_it_says(field: str, columns: list[int]) -> None:
    options = [
        vkc.Options(**{**dataclasses.asdict(SHORT), field: value})
        for value in (getattr(SHORT, field), 7.0)
    ]
    usual, other = (
        program_of(drawer_scene(), PULL, options=each).motion_cost.metric for each in options
    )
    np.testing.assert_array_equal(other[columns], 7.0)
    np.testing.assert_array_equal(np.delete(other, columns), np.delete(usual, columns))


def test_squares_of_turns_cost_what_the_heading_weighs() -> None:
    """Σ w δ² + w_acc δδ²/dt² over a turn on the spot, by hand."""
    options = dataclasses.replace(
        vkc.Options.paper(),
        reach_waypoints=SHORT.reach_waypoints,
        velocity_weight_heading=0.7,
        dt=0.5,
    )
    problem = program_of(hall(), [vkc.GoTo(0.0, 0.0, 1.0)], options=options)
    z = np.tile(problem.start, (problem.segments, 1))
    z[:, 2] = np.linspace(0.0, 1.0, problem.segments + 1)[1:] ** 2
    first = np.diff(np.concatenate([[0.0], z[:, 2]]))
    second = np.diff(np.concatenate([[0.0], first, [0.0]]))
    expected = 0.7 * (np.sum(first**2) + options.acceleration_weight * np.sum(second**2) / 0.5**2)
    assert problem.objective(z, problem.timing_for(z).dt) == pytest.approx(expected, rel=1e-9)


def test_standing_still_costs_nothing() -> None:
    problem = program_of(drawer_scene(), PULL, options=SHORT)
    assert problem.objective(problem.still, problem.timing_for(problem.still).dt) == pytest.approx(
        0.0, abs=1e-9
    )


def test_what_a_problem_leaves_is_trimmed_at_its_end() -> None:
    """Not only when a call ends: a chore has many problems."""
    scene, cache = drawer_scene(), Cache(max_nbytes=1.0)
    request = PlanningRequest("auto", SHORT, cache=cache)
    assert module.solve_task(scene, compile_task(scene, PULL, SHORT), request).plan.success
    assert cache.info().entries == 1
    assert cache.info().misses > 1
