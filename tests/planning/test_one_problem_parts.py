"""What becomes of seeds, one after the other: with answers that are made up, so that every way through is taken."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.drives import hall
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.planning import one_problem as module
from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.initialization.initial_guess import InitialGuess
from vkc_pin.planning.one_problem import OneProblem, _Try
from vkc_pin.planning.settings import Settings
from vkc_pin.utils.cache import Cache
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.task.compiler import compile_task


def attempt(name: str, *amounts: float, status: str = "rejected") -> _Try:
    """Return where a seed led, violated by so much of each of several things."""
    wrong = [
        Violation("goal", f"x{k}", amount=amount, unit="m", detail="")
        for k, amount in enumerate(amounts)
    ]
    z = np.zeros((1, 1))
    return _Try(name, z, SimpleNamespace(), Report(tuple(wrong)), status)  # type: ignore[arg-type]


def test_what_is_better() -> None:
    """A success, or what violates less all in all."""
    good = attempt("good", status="success")
    for other in (attempt("a", 1.0), good):
        assert good.better(other)
        assert not attempt("b", 1.0, 0.5).better(other)
    assert attempt("b", 0.2, 0.3).better(attempt("a", 0.6))
    assert not attempt("b", 0.2, 0.3).better(attempt("a", 0.4))
    assert attempt("b", 0.2, 0.3).amount == pytest.approx(0.5)
    assert attempt("b", 0.2).noted(["one", "two"]).report.notes == ("one", "two")


def goal(text: str, *, deep: bool = False) -> Any:
    return SimpleNamespace(text=text, deep=deep)


class Script:
    """Stands for solver, validation and whoever looks for reasons.

    Attributes:
        events: "a" a seed was asked for, "a*" it was solved, "?" it was asked for proofs, "goals"
            for goals that are blocked.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        answers: dict[str, _Try | float],
        *,
        proven: Sequence[int] = (),
        goals: Sequence[Any] = (),
        free: bool = True,
        blocked: Sequence[str] = (),
        ways: tuple[list[str], bool] = ([], False),
        statuses: dict[str, str] | None = None,
    ) -> None:
        self.answers, self.events = answers, list[str]()
        one = self.one = object.__new__(OneProblem)
        one.settings = SimpleNamespace(random_seed=7)  # type: ignore[assignment]
        one.problem, one.blocked, one._best, one._astray = self.problem, list(blocked), None, None
        self.statuses = statuses or {}
        one._solve, one._judge = self.solved, self.judged  # type: ignore[method-assign]
        one._proofs = lambda problem: self.asked(
            "?", ["proof"] if self.events.count("?") in proven else []
        )  # type: ignore
        one._goals = lambda problem: self.asked("goals", list(goals))  # type: ignore[method-assign, assignment]
        one._stationary = lambda problem: attempt("none", 9.0, status="not converged")  # type: ignore[method-assign]
        monkeypatch.setattr(
            module, "_ends_free", lambda problem, seed: self.asked(f"free {seed.name}", free)
        )
        monkeypatch.setattr(
            module, "diagnose_paths", lambda *what: self.asked(f"ways {what[3]} {what[4]}", ways)
        )

    problem: Any = SimpleNamespace()

    def asked(self, event: str, answer: Any) -> Any:
        self.events.append(event)
        return answer

    def solved(self, problem: Any, seed: Any) -> Any:
        answer, status = self.answers[seed.name], self.statuses.get(seed.name, "not converged")
        return self.asked(
            f"{seed.name}*",
            SimpleNamespace(
                shortfall=0.0 if isinstance(answer, _Try) else answer, status=status, name=seed.name
            ),
        )

    def judged(self, problem: Any, solution: Any, name: str) -> _Try:
        assert solution.name == name
        answer = self.answers[name]
        return answer if isinstance(answer, _Try) else attempt(name, answer, status="not converged")

    def run(self, *, searched: bool = True) -> tuple[str, str, tuple[str, ...]]:
        """Return the best seed's name, the status, and notes."""

        def seeds() -> Iterator[Any]:
            for name in self.answers:
                self.events.append(name)
                yield SimpleNamespace(name=name)

        best, status = self.one._try_seeds(self.problem, seeds(), searched=searched)
        return best.name, status, best.report.notes


GOOD = attempt("b", status="success")


def test_a_motion_that_is_good_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(monkeypatch, {"a": attempt("a", 1.0), "b": GOOD, "c": GOOD})
    assert script.run() == ("b", "success", ())
    assert script.events == ["a", "a*", "?", "free a", "b", "b*"]


def test_the_least_violated_is_what_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = {
        "a": attempt("a", 1.0),
        "b": attempt("b", 0.5),
        "c": attempt("c", 0.7, status="not converged"),
    }
    script = Script(monkeypatch, answers)
    assert script.run() == ("b", "rejected", ())
    assert script.events[-2:] == ["?", "ways [] 7"]


def test_a_seed_of_ones_own_is_not_asked_for_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Script(
        monkeypatch,
        {"a": attempt("a", 1.0)},
        proven=[0, 1, 2, 3],
        goals=[goal("no room")],
        free=False,
    )
    assert script.run(searched=False) == ("a", "rejected", ())
    assert script.events == ["a", "a*"]


@pytest.mark.parametrize("ending", ["time limit", "interrupted", "effort spent"])
def test_a_budget_at_its_end_returns_the_best_so_far(
    ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = {"a": attempt("a", 0.3), "b": attempt("b", 0.5), "c": GOOD}
    assert Script(monkeypatch, answers, statuses={"b": ending}).run() == ("a", ending, ())
    assert Script(monkeypatch, {"a": GOOD}, statuses={"a": ending}).run() == ("b", "success", ())


def test_of_what_is_astray_the_nearest_is_checked_if_there_is_nothing_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    script = Script(monkeypatch, {"a": 0.3, "b": 0.1, "c": 0.2})
    assert script.run() == ("b", "not converged", ())
    assert script.one._best is None
    assert Script(monkeypatch, {"a": 0.1, "b": 0.3}).run()[0] == "a"
    assert Script(monkeypatch, {"a": 0.1, "b": attempt("b", 5.0), "c": 0.05}).run()[0] == "b"


def test_what_is_proven_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a seed has failed, or in the end."""
    answers = {"a": attempt("a", 1.0), "b": attempt("b", 1.0)}
    script = Script(monkeypatch, answers, proven=range(20))
    assert script.run() == ("none", "infeasible", ("proof",))
    assert script.events.count("b") == 0
    late = Script(monkeypatch, answers, proven=[2, 3])
    assert late.run() == ("none", "infeasible", ("proof",))
    assert late.events.count("b*") == 1


def test_goals_at_which_nothing_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are looked for after the first seed, if its ends are not free; a second one may still succeed."""
    answers = {"a": attempt("a", 1.0), "b": attempt("b", 0.5), "c": GOOD}
    script = Script(monkeypatch, answers, goals=[goal("no room"), goal("no way")], free=False)
    assert script.run() == ("b", "infeasible", ("no room", "no way"))
    assert script.events == ["a", "a*", "?", "free a", "goals", "b", "b*", "?", "?"]
    free = Script(monkeypatch, answers, goals=[goal("no room")])
    assert free.run() == ("b", "success", ())
    deep = Script(
        monkeypatch, answers, goals=[goal("no room"), goal("deep", deep=True)], free=False
    )
    assert deep.run() == (
        "a",
        "infeasible",
        ("no room", "deep"),
    )  # so much in something that no seed helps
    none = Script(monkeypatch, answers, free=False)
    assert none.run() == ("b", "success", ())
    assert none.events.count("goals") == 1


def test_without_any_seed_what_blocks_the_base_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Script(monkeypatch, {}, blocked=["a wall"]).run() == ("none", "infeasible", ("a wall",))
    assert Script(monkeypatch, {}).run() == ("none", "not converged", ())
    script = Script(monkeypatch, {"a": attempt("a", 1.0)}, blocked=["a wall"])
    assert script.run() == ("a", "rejected", ())
    assert script.events[-1] == "ways ['a wall'] 7"
    cut = Script(monkeypatch, {"a": attempt("a", 1.0)}, ways=(["no way to it"], True))
    assert cut.run() == ("a", "infeasible", ("no way to it",))
    hint = Script(monkeypatch, {"a": attempt("a", 1.0)}, ways=(["no way to it"], False))
    assert hint.run() == ("a", "rejected", ("no way to it",))


# --- reasons
# ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hindered", "proven", "told"), [(["h"], ["p"], ["h"]), ([], ["p"], ["p"]), ([], [], [])]
)
def test_proofs_are_looked_for_once(
    hindered: list[str], proven: list[str], told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(
        module, "find_swept_collisions", lambda problem: asked.append("swept") or hindered
    )
    monkeypatch.setattr(module, "find_proofs", lambda problem: asked.append("proofs") or proven)
    one = object.__new__(OneProblem)
    one._proven, one.hindered = None, False
    for _ in range(2):
        assert one._proofs(None) == told  # type: ignore[arg-type]
        assert one.hindered == bool(hindered)
    assert asked == (["swept"] if hindered else ["swept", "proofs"])


def test_each_goal_is_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []
    found = {0: None, 1: goal("no room"), 2: goal("no way")}
    monkeypatch.setattr(
        module,
        "diagnose_goal",
        lambda problem, number, seed: asked.append((number, seed)) or found[number],
    )
    one = object.__new__(OneProblem)
    one.settings, one._explained = SimpleNamespace(random_seed=5), {}  # type: ignore[assignment]
    problem: Any = SimpleNamespace(task=SimpleNamespace(phases=[0, 1, 2]))
    assert one._goals(problem, [1]) == [found[1]]
    assert one._goals(problem) == [found[1], found[2]]
    assert one._goals(problem, [0, 2]) == [found[2]]
    assert asked == [(1, 5), (0, 5), (2, 5)]


def made(*steps: Any, **settings: Any) -> OneProblem:
    scene, options = hall(), vkc.Options(reach_waypoints=6)
    return OneProblem(
        scene,
        compile_task(scene, steps, options),
        Settings("auto", options, cache=Cache(), **settings),
    )


def test_what_there_is_before_anything_has_run() -> None:
    one = made(vkc.GoTo(1.0, 0.0))
    assert (one.goals_first, one.rounds, one.iterations, one.checking, one.hindered) == (
        False,
        0,
        0,
        0.0,
        False,
    )
    assert (one.history, one.blocked, one._best, one._astray, one._proven) == (
        [],
        [],
        None,
        None,
        None,
    )
    assert set(one.times.values()) == {0.0}


def test_seeds_end_where_there_are_none_or_something_is_proven(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What a search asks about goals on its way, and what is noted of it."""
    given: dict[str, Any] = {}

    def initialize(problem: Any, *what: Any, **how: Any) -> Iterator[str]:
        given.update(how, what=what)
        yield from "abc"

    monkeypatch.setattr(module, "initialize", initialize)
    one = made(vkc.GoTo(1.0, 0.0), random_seed=3)
    problem: Any = object()
    assert list(one._seeds(problem)) == ["a", "b", "c"]
    assert given["what"] == ("auto", 3)
    assert given["count"] == one.settings.options.max_restarts
    assert given["notes"] is one.blocked
    assert 0.0 < one.times["initialization"] < 10.0
    for proven, deep, hopeless in (
        ([], [], False),
        (["p"], [], True),
        ([], [False, True], True),
        ([], [False, False], False),
    ):
        one._proofs = lambda _, proven=proven: proven  # type: ignore[method-assign, misc]
        one._goals = lambda _, phases, deep=deep: [goal("x", deep=d) for d in deep]  # type: ignore
        assert given["hopeless"]([0]) == hopeless
    seeds = one._seeds(problem)
    assert next(seeds) == "a"
    one._proven = ["p"]
    assert list(seeds) == []


@pytest.mark.parametrize(
    ("ok", "converged", "status"),
    [
        (True, True, "success"),
        (True, False, "success"),
        (False, True, "rejected"),
        (False, False, "not converged"),
    ],
)
def test_what_a_solution_is_worth(
    ok: bool, converged: bool, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was no solution is not made one by another curve."""
    one = made(vkc.GoTo(1.0, 0.0))
    report = Report() if ok else attempt("x", 1.0).report
    asked: dict[str, Any] = {}

    def accepted(scene: Any, waypoints: Any, check: Any, **how: Any) -> Any:
        asked.update(how, waypoints=waypoints)
        return "curve", report

    monkeypatch.setattr(module, "make_trajectory", lambda problem, z, dt: ("motion", z, dt))
    monkeypatch.setattr(module, "accepted", accepted)
    solution: Any = SimpleNamespace(z="z", dt="dt", converged=converged)
    found = one._judge(None, solution, "name")  # type: ignore[arg-type]
    assert (found.name, found.z, found.trajectory, found.report, found.status) == (
        "name",
        "z",
        "curve",
        report,
        status,
    )
    assert asked == {
        "jerk_time": 0.0,
        "waypoints": ("motion", "z", "dt"),
        **({} if converged else {"repairs": 0}),
    }
    assert 0.0 <= one.times["retiming"] < 1.0


@pytest.mark.parametrize(("speed", "paced"), [(False, False), (True, True)])
def test_constraints_on_velocities_keep_the_programs_own_time(
    speed: bool, paced: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    terms = [vkc.Constraint("place", lambda s: s.coordinate("base_x"), upper=9.0)]
    terms += [vkc.Constraint("speed", lambda s: s.rate("base_x"), upper=9.0)] if speed else []
    one = made(vkc.GoTo(1.0, 0.0), terms=terms)
    assert one._paced == paced
    monkeypatch.setattr(module, "make_trajectory", lambda *_: "waypoints")
    monkeypatch.setattr(module, "accepted", lambda *_, **__: ("curve", Report()))
    one._check = lambda motion: Report()  # type: ignore[method-assign]
    solution: Any = SimpleNamespace(z="z", dt="dt", converged=True)
    assert one._judge(None, solution, "name").trajectory == ("waypoints" if paced else "curve")  # type: ignore


@pytest.mark.parametrize(
    ("short", "error", "free"),
    [
        ({}, 0.0, True),
        ({2: -0.01}, 0.009, True),
        ({1: 0.5}, 0.0, True),  # on the way
        ({2: 0.001}, 0.0, False),
        ({5: 0.001}, 0.0, False),
        ({}, 0.011, False),
        ({}, 0.015, False),
    ],
)
def test_the_ends_of_phases_are_free_and_where_they_should_be(
    short: dict[int, float], error: float, free: bool
) -> None:
    rows, missing = np.array(list(short), int), np.array(list(short.values()))
    vectors, pairs = np.zeros((len(rows), 3)), np.zeros((len(rows), 2), int)
    found = Contacts(
        rows, pairs, 0.02 - missing, np.full(len(rows), 0.02), vectors, vectors, vectors
    )
    problem: Any = SimpleNamespace(
        ends=np.array([3, 6]),
        segments=6,
        options=vkc.Options(),
        evaluate_contacts=lambda z, reach: found,
        pose_error=lambda z: error,
    )
    assert module._ends_free(problem, InitialGuess("any", np.zeros((6, 2)))) == free


def test_pieces_are_the_waypoints_of_each_phase() -> None:
    """Both its ends among them."""
    scene, options = hall(), vkc.Options(reach_waypoints=3)
    steps = [vkc.GoTo(1.0, 0.0), vkc.GoTo(1.0, 1.0)]
    one = OneProblem(scene, compile_task(scene, steps, options), Settings("auto", options))
    one.problem = program_of(scene, steps, options=options)
    one.z, one.initialization = one.problem.still + np.arange(6.0)[:, None], "mine"
    path = np.vstack([one.problem.start, one.z])
    piece = one.piece()
    assert (piece.names, piece.initialization) == (one.problem.chain.names, "mine")
    assert [part.tolist() for part in piece.waypoints] == [path[:4].tolist(), path[3:].tolist()]


@pytest.mark.parametrize("listening", [False, True])
def test_each_round_is_told_of(listening: bool) -> None:
    """To the progress, and to whoever wants to know."""
    told: list[Any] = []
    one = object.__new__(OneProblem)
    callback = (lambda row: told.append(("callback", row))) if listening else None
    one.settings = SimpleNamespace(
        progress=lambda row: told.append(("progress", row)), callback=callback
    )  # type: ignore
    one._report("row")  # type: ignore[arg-type]
    assert told == [("progress", "row"), ("callback", "row")][: 1 + listening]


def test_what_is_being_done_is_told_and_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A check, whose time is kept for the last one, and a search for seeds."""
    told: list[str] = []
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(module, "validate", lambda *what: asked.append(what) or "report")
    one = made(vkc.GoTo(1.0, 0.0))
    s = one.settings
    settings: Any = SimpleNamespace(
        progress=SimpleNamespace(doing=told.append),
        options=s.options,
        terms=s.terms,
        budget=SimpleNamespace(checking=0.0),
    )
    one.settings = settings
    spent = 0.0
    for count in (1, 2):
        assert one._check("motion") == "report"  # type: ignore[arg-type]
        assert told == ["checking"] * count
        assert 0.0 < one.checking == settings.budget.checking < 1.0
        spent += one.checking
        assert one.times["validation"] == pytest.approx(spent)
    assert asked == [(one.scene, one.task.steps, "motion", s.options, s.terms)] * 2
    told.clear()
    monkeypatch.setattr(module, "initialize", lambda *_, **__: iter("ab"))
    one.settings = SimpleNamespace(  # type: ignore[assignment]
        progress=settings.progress,
        options=s.options,
        cache=s.cache,
        initialization="auto",
        random_seed=0,
        perturbation=0.0,
    )
    assert list(one._seeds(None)) == ["a", "b"]  # type: ignore[arg-type]
    assert told == ["looking for a seed"] * 3
