"""Chores: what is an action, what is foreseen, how the window slides, and chores planned for real."""

from __future__ import annotations

import dataclasses
import signal
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.initialization import TARGET
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning import window as module
from vkc_pin.planning.solve_task import TaskResult
from vkc_pin.world.trajectory.splicing import extract_phases
from vkc_pin.world.trajectory.world_model import World

A, G, P = vkc.Actuate, vkc.Grasp, vkc.Place
TABLE = (-3.0, 1.3, 1.051)  # on the bar table
OPEN, SHUT = A("refrigerator", {"hinge": 1.57}), A("refrigerator", {"hinge": 0.0})
CUP = (G("cold_cup"), P("cold_cup", TABLE))


@cache
def home() -> vkc.Scene:
    return vkc.load_scene("household")


def plan_actions(
    scene: vkc.Scene, steps: Sequence[vkc.Step], *, window: int = 2, **how: Any
) -> vkc.Plan:
    return vkc.plan(scene, steps, window=window, **how)


@cache
def fridge() -> vkc.Plan:
    """Take the cup out of the refrigerator, and shut it again."""
    return plan_actions(home(), [OPEN, *CUP, SHUT])


# --- what is foreseen
# -------------------------------------------------------------------------------------------------


def test_one_hand_cannot_open_a_door_with_a_cup_in_it() -> None:
    steps = [OPEN, G("cold_cup"), A("door", {"hinge": 1.52}), P("cold_cup", (1.75, 3.5, 0.741))]
    with pytest.raises(
        InputError, match=r"steps\[2\].object: the robot has one hand, and it holds cold_cup.side"
    ) as caught:
        plan_actions(home(), steps)
    assert caught.value.expected == "Place or Release before"


@pytest.mark.parametrize(
    ("wrong", "kind", "field", "says"),
    [
        (A("fridge", {"hinge": 1.0}), UnknownNameError, "steps[3].object", "refrigerator"),
        (A("refrigerator", {"door": 1.0}), UnknownNameError, "steps[3].joints", "hinge"),
        (G("cup", "handle"), UnknownNameError, "steps[3].attachment", "side"),
        (P("door", (0, 0, 0)), InputError, "steps[3].object", "is fixed in the world"),
        (vkc.Release(), InputError, "steps[3]", "the hand is empty"),
        (G("litter", by="broom.bristles"), InputError, "steps[3].by", "does not carry"),
        ("tidy up", InputError, "steps[3]", "not a step"),
    ],
)
def test_what_cannot_be_done_is_said_at_once(
    wrong: vkc.Grasp, kind: type, field: str, says: str
) -> None:
    with pytest.raises(kind) as caught:
        plan_actions(home(), [OPEN, G("cold_cup"), P("cold_cup", TABLE), wrong, SHUT])
    assert caught.value.field == field
    assert says in str(caught.value)


@pytest.mark.parametrize("steps", [[], OPEN, 3])
def test_steps_are_a_list(steps: object) -> None:
    with pytest.raises(InputError) as caught:
        plan_actions(home(), steps)
    assert caught.value.field == "steps"


@pytest.mark.parametrize("window", [0, -1, 1.5, True, "2"])
def test_window_is_a_number_of_actions(window: object) -> None:
    with pytest.raises(InputError, match="window: out of range"):
        plan_actions(home(), [OPEN], window=window)


@pytest.mark.parametrize(
    ("field", "value"),
    [("initialization", "magic"), ("time_limit", 0), ("seed", -1), ("options", {})],
)
def test_other_arguments_are_those_of_plan(field: str, value: object) -> None:
    with pytest.raises(InputError) as caught:
        plan_actions(home(), [OPEN], **{field: value})
    assert caught.value.field == field


def test_only_what_holds_already_is_nothing_to_do() -> None:
    with pytest.raises(InputError, match="nothing to do"):
        plan_actions(home().with_held({"cup": "side"}), [G("cup")])


# --- how the window slides
# --------------------------------------------------------------------------------------------


class Problems:
    """Notes the problems that a chore solves, and lets some of them fail, as if no motion had been found."""

    def __init__(
        self, patch: pytest.MonkeyPatch, fails: Callable[[tuple[vkc.Step, ...]], bool]
    ) -> None:
        self.asked: list[tuple[tuple[vkc.Step, ...], bool]] = []
        solved = module.solve_task

        def solve(*arguments: Any, guess: object = None, **named: Any) -> TaskResult:
            result = solved(*arguments, guess=guess, **named)
            self.asked.append((result.task.steps, guess is not None))
            if not fails(result.task.steps):
                return result
            plan = result.plan
            trajectory = extract_phases(plan.trajectory, plan.trajectory.names, 0, 1)
            failed = dataclasses.replace(plan, status="not converged", trajectory=trajectory)
            return dataclasses.replace(result, plan=failed)

        patch.setattr(module, "solve_task", solve)


def test_each_action_is_planned_once_alone_and_with_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problems = Problems(monkeypatch, lambda steps: False)
    plan = plan_actions(home(), [OPEN, *CUP, SHUT])
    assert plan.success, plan.summary()
    asked = [
        item for k, item in enumerate(problems.asked) if item not in problems.asked[:k]
    ]  # some twice, if the first fails
    assert asked == [
        ((OPEN,), False),
        (CUP, False),
        ((OPEN, *CUP), True),
        ((SHUT,), False),
        ((*CUP, SHUT), True),
    ]


def test_where_the_next_cannot_be_done_both_are_planned_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problems = Problems(monkeypatch, lambda steps: steps == (SHUT,))
    plan = plan_actions(home(), [OPEN, SHUT])
    assert plan.success, plan.summary()
    alone = [(SHUT,)] * vkc.Options().max_restarts
    assert [steps for steps, _ in problems.asked] == [(OPEN,), *alone, (OPEN, SHUT)]
    assert not problems.asked[-1][1]  # from seeds of its own


def test_no_attachment_is_tried_beside_one_that_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The handle, taken as asked, and the face that is pushed move the same hinge: one chain has it once."""
    problems = Problems(monkeypatch, lambda steps: any(isinstance(step, A) for step in steps))
    steps, options = (
        [G("door", "handle_free"), A("door", {"hinge": 0.3})],
        vkc.Options(max_restarts=1),
    )
    plan = plan_actions(vkc.load_scene("door"), steps, options=options)
    assert (plan.success, plan.status) == (False, "not converged")
    assert [asked for asked, _ in problems.asked] == [tuple(steps)] * len(problems.asked)


@pytest.mark.long
def test_a_decision_that_leads_nowhere_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a window of one nothing is foreseen: only a step back helps."""
    problems = Problems(monkeypatch, lambda steps: steps == (SHUT,))
    plan = plan_actions(home(), [OPEN, SHUT], window=1)
    assert plan.success, plan.summary()
    alone = [steps for steps, _ in problems.asked]
    assert alone[0] == (OPEN,)
    assert (OPEN, SHUT) in alone
    assert len(plan.trajectory.phases) == 3  # reach, open, and shut without letting go


@pytest.mark.long
def test_what_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    Problems(monkeypatch, lambda steps: CUP[0] in steps)
    plan = plan_actions(
        home(),
        [vkc.GoTo(0.5, -0.5), OPEN, *CUP],
        window=1,
        options=vkc.Options(max_outer=1, max_restarts=1),
    )
    assert not plan.success
    assert plan.status == "not converged"
    assert plan.report.notes[0].startswith("steps[2], Grasp(object='cold_cup'")
    assert [phase.name for phase in plan.trajectory.phases][:2] == [
        "go to",
        "reach refrigerator.handle",
    ]
    assert len(plan.steps) == 4


def test_time_is_for_all_steps_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the first action had taken all of it: the second gets none, no other is tried, and what was decided is kept."""
    real, solve, asked = time.perf_counter, module.solve_task, list[TaskResult]()

    def delayed(*arguments: Any, **named: Any) -> TaskResult:
        asked.append(solve(*arguments, **named))
        monkeypatch.setattr(time, "perf_counter", lambda: real() + 101.0)
        return asked[-1]

    monkeypatch.setattr(module, "solve_task", delayed)
    plan = plan_actions(home(), [OPEN, *CUP], time_limit=100.0)
    assert [one.task.steps for one in asked] == [(OPEN,)]
    assert (plan.status, plan.success) == ("time limit", False)
    assert plan.trajectory.phases[1].name == "move refrigerator.hinge"


def test_max_evaluations_bounds_all_steps_together() -> None:
    alone = plan_actions(home(), [OPEN])
    plan = plan_actions(
        home(), [OPEN, *CUP], max_evaluations=int(alone.metrics["evaluations"]) + 1000
    )
    assert (plan.status, plan.success) == ("evaluation limit", False)
    assert "steps[1]" in plan.report.notes[0]
    assert plan.trajectory.phases[1].name == "move refrigerator.hinge"


def test_ctrl_c_leaves_what_is_done() -> None:
    seen: list[vkc.Iteration] = []

    def stop(row: vkc.Iteration) -> None:
        seen.append(row)
        if len(seen) > 1 and row.round == 1 and row.objective != seen[0].objective:
            signal.raise_signal(signal.SIGINT)

    plan = plan_actions(home(), [vkc.GoTo(0.5, -0.5), OPEN, *CUP], callback=stop)
    assert (plan.status, plan.success) == ("interrupted", False)
    assert plan.trajectory.phases[0].name == "go to"
    assert plan.trajectory.positions[plan.trajectory.phases[0].last, :2] == pytest.approx(
        [0.5, -0.5], abs=1e-3
    )


def test_the_robot_does_not_stop_between_ways() -> None:
    """It rests where its hand closes or opens; a motion that goes on from one step to the next is not cut there."""
    plan = plan_actions(home(), [vkc.GoTo(1.0, -0.9), vkc.GoTo(0.4, -0.7), vkc.GoTo(0.2, -0.2)])
    assert plan.success, plan.summary()
    speed = np.linalg.norm(plan.trajectory.velocities()[:, :2], axis=1)
    first = plan.trajectory.phases[0].last
    assert speed[first - 1 : first + 1].min() > 0.1 * speed.max()


# --- chores, for real
# -------------------------------------------------------------------------------------------------


def test_a_chore_of_four_steps() -> None:
    plan = fridge()
    assert plan.success, plan.summary()
    assert plan.steps == (OPEN, *CUP, SHUT)
    assert [phase.name.partition(" ")[0] for phase in plan.trajectory.phases] == [
        "reach",
        "move",
        "reach",
        "place",
        "reach",
        "move",
    ]
    world = World(home())
    rows = world.compute_positions(plan.trajectory)
    hinge = rows[:, world.coordinates.index("refrigerator.hinge")]
    ends = [phase.last for phase in plan.trajectory.phases]
    assert hinge[ends] == pytest.approx([0, 1.57, 1.57, 1.57, 1.57, 0], abs=1e-3)
    cup = world.get_placement("cold_cup", rows[-1])
    assert cup.translation == pytest.approx(TABLE, abs=1e-3)
    assert cup.rotation[:, 2] == pytest.approx([0, 0, 1], abs=5e-3)
    assert vkc.validate(home(), plan.steps, plan.trajectory).ok


def test_metrics_are_those_of_the_whole_chore() -> None:
    plan = fridge()
    assert plan.metrics["base_path_length"] == pytest.approx(plan.trajectory.base_path_length())
    parts = sum(
        plan.metrics[f"time_{part}"]
        for part in ("initialization", "coal", "casadi", "ipopt", "validation")
    )
    assert parts <= plan.metrics["planning_time"] + plan.metrics["build_time"]
    assert parts > 0.5 * plan.metrics["planning_time"]
    assert plan.metrics["rounds"] == len(plan.history)


def test_it_can_be_saved_and_shown(tmp_path: Path) -> None:
    plan = fridge()
    plan.save(tmp_path / "chore.npz")
    assert vkc.Plan.load(tmp_path / "chore.npz").success


def price(plan: vkc.Plan) -> float:
    """Return how long the robot's way is by the weights of `Options`: a metre of the base 1, a radian of anything 0.158."""
    steps = np.diff(plan.trajectory.positions[:, :9], axis=0)
    return float(
        np.linalg.norm(steps[:, :2], axis=1).sum() + np.sqrt(0.025) * np.abs(steps[:, 2:]).sum()
    )


@pytest.mark.parametrize("start", [5, 7])
def test_with_the_next_in_mind_less_is_moved(start: int) -> None:
    """Where the stick is taken depends on where its tip has to go."""
    scene = vkc.load_scene("init_1").sample_start(np.random.default_rng(start))
    steps = [G("stick"), vkc.Touch("stick.tip", TARGET)]
    blind, seeing = (plan_actions(scene, steps, window=window) for window in (1, 2))
    assert blind.success, blind.summary()
    assert seeing.success, seeing.summary()
    assert price(seeing) < price(blind)
