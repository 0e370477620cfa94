"""Tests planning of long lists of steps in a sliding window of actions."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.initialization import TARGET
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.world.trajectory.world_model import World

TABLE = (-3.0, 1.3, 1.051)  # on the bar table
OPEN, SHUT = (
    vkc.Actuate("refrigerator", {"hinge": 1.57}),
    vkc.Actuate("refrigerator", {"hinge": 0.0}),
)
CUP = (vkc.Grasp("cold_cup"), vkc.Place("cold_cup", TABLE))


@cache
def load_home() -> vkc.Scene:
    return vkc.load_scene("household")


def plan_actions(
    scene: vkc.Scene, steps: Sequence[vkc.Step], *, window: int = 2, **options: Any
) -> vkc.Plan:
    return vkc.plan(scene, steps, window=window, **options)


@cache
def plan_fridge() -> vkc.Plan:
    """Plan to take the cup out of the refrigerator and to close the door."""
    return plan_actions(load_home(), [OPEN, *CUP, SHUT])


def test_hand_that_holds_a_cup_cannot_open_a_door() -> None:
    steps = [
        OPEN,
        vkc.Grasp("cold_cup"),
        vkc.Actuate("door", {"hinge": 1.52}),
        vkc.Place("cold_cup", (1.75, 3.5, 0.741)),
    ]
    with pytest.raises(
        InputError, match=r"steps\[2\].object: the robot has one hand, and it holds cold_cup.side"
    ) as caught:
        plan_actions(load_home(), steps)
    assert caught.value.expected == "Place or Release before"


@pytest.mark.parametrize(
    ("step", "error", "field", "text"),
    [
        (
            vkc.Actuate("fridge", {"hinge": 1.0}),
            UnknownNameError,
            "steps[3].object",
            "refrigerator",
        ),
        (vkc.Actuate("refrigerator", {"door": 1.0}), UnknownNameError, "steps[3].joints", "hinge"),
        (vkc.Grasp("cup", "handle"), UnknownNameError, "steps[3].attachment", "side"),
        (vkc.Place("door", (0, 0, 0)), InputError, "steps[3].object", "is fixed in the world"),
        (vkc.Release(), InputError, "steps[3]", "the hand is empty"),
        (vkc.Grasp("litter", by="broom.bristles"), InputError, "steps[3].by", "does not carry"),
        ("tidy up", InputError, "steps[3]", "not a step"),
    ],
)
def test_impossible_steps_are_refused(step: vkc.Grasp, error: type, field: str, text: str) -> None:
    with pytest.raises(error) as caught:
        plan_actions(
            load_home(), [OPEN, vkc.Grasp("cold_cup"), vkc.Place("cold_cup", TABLE), step, SHUT]
        )
    assert caught.value.field == field
    assert text in str(caught.value)


@pytest.mark.parametrize("window", [0, -1, 1.5, True, "2"])
def test_invalid_window(window: object) -> None:
    with pytest.raises(InputError, match="window: out of range"):
        plan_actions(load_home(), [OPEN], window=window)


def test_steps_without_effect_are_refused() -> None:
    with pytest.raises(InputError, match="nothing to do"):
        plan_actions(load_home().with_held({"cup": "side"}), [vkc.Grasp("cup")])


@pytest.mark.long
def test_evaluation_limit_applies_to_all_actions_together() -> None:
    opening = dataclasses.replace(OPEN, attachment="handle")
    alone = plan_actions(load_home(), [opening])
    plan = plan_actions(
        load_home(), [opening, *CUP], max_evaluations=int(alone.metrics["evaluations"]) + 1000
    )
    assert (plan.status, plan.success) == ("evaluation limit", False)
    assert "steps[1]" in plan.report.notes[0]
    assert plan.trajectory.phases[1].name == "move refrigerator.hinge"


def test_ctrl_c_keeps_completed_actions() -> None:
    seen: list[vkc.Iteration] = []

    def stop(row: vkc.Iteration) -> None:
        seen.append(row)
        if len(seen) > 1 and row.round == 1 and row.objective != seen[0].objective:
            signal.raise_signal(signal.SIGINT)

    plan = plan_actions(load_home(), [vkc.GoTo(0.5, -0.5), OPEN, *CUP], callback=stop)
    assert (plan.status, plan.success) == ("interrupted", False)
    assert plan.trajectory.phases[0].name == "go to"
    assert plan.trajectory.positions[plan.trajectory.phases[0].last, :2] == pytest.approx(
        [0.5, -0.5], abs=1e-3
    )


def test_robot_does_not_stop_between_drives() -> None:
    plan = plan_actions(
        load_home(), [vkc.GoTo(1.0, -0.9), vkc.GoTo(0.4, -0.7), vkc.GoTo(0.2, -0.2)]
    )
    assert plan.success, plan.summary()
    speed = np.linalg.norm(plan.trajectory.velocities()[:, :2], axis=1)
    first = plan.trajectory.phases[0].last
    assert speed[first - 1 : first + 1].min() > 0.1 * speed.max()


@pytest.mark.long
def test_cup_is_taken_from_the_refrigerator(tmp_path: Path) -> None:
    plan = plan_fridge()
    assert plan.success, plan.summary()
    assert plan.steps == (OPEN, *CUP, SHUT)
    names = [phase.name.partition(" ")[0] for phase in plan.trajectory.phases]
    assert names == ["reach", "move", "reach", "place", "reach", "move"]
    world = World(load_home())
    rows = world.compute_positions(plan.trajectory)
    hinge = rows[:, world.coordinates.index("refrigerator.hinge")]
    ends = [phase.last for phase in plan.trajectory.phases]
    assert hinge[ends] == pytest.approx([0, 1.57, 1.57, 1.57, 1.57, 0], abs=1e-3)
    cup = world.get_placement("cold_cup", rows[-1])
    assert cup.translation == pytest.approx(TABLE, abs=1e-3)
    assert cup.rotation[:, 2] == pytest.approx([0, 0, 1], abs=5e-3)
    m, stages = plan.metrics, ("initialization", "coal", "casadi", "ipopt", "validation")
    parts = sum(m[f"time_{stage}"] for stage in stages)
    assert 0.5 * m["planning_time"] < parts <= m["planning_time"] + m["build_time"]
    assert m["rounds"] == len(plan.history)
    assert vkc.Plan.load(plan.save(tmp_path / "chore.npz")).success


def compute_weighted_length(plan: vkc.Plan) -> float:
    """Return the path length with the weights of `Options`."""
    steps = np.diff(plan.trajectory.positions[:, :9], axis=0)
    return float(
        np.linalg.norm(steps[:, :2], axis=1).sum() + np.sqrt(0.025) * np.abs(steps[:, 2:]).sum()
    )


@pytest.mark.parametrize("start", [5])
@pytest.mark.long
def test_window_shortens_the_path(start: int) -> None:
    """The best grasp of the stick depends on the target of its tip."""
    scene = vkc.load_scene("init_1").sample_start(np.random.default_rng(start))
    steps = [vkc.Grasp("stick"), vkc.Touch("stick.tip", TARGET)]
    separate, together = (plan_actions(scene, steps, window=window) for window in (1, 2))
    assert separate.success, separate.summary()
    assert together.success, together.summary()
    assert compute_weighted_length(together) < compute_weighted_length(separate)
