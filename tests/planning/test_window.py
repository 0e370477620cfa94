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
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.experiments.initialization import TARGET

TABLE = (-3.0, 1.3, 1.051)  # on the bar table
OPEN = vkc.Actuate("refrigerator", {"hinge": 1.57})
SHUT = vkc.Actuate("refrigerator", {"hinge": 0.0})
CUP = (vkc.Grasp("cold_cup"), vkc.Place("cold_cup", TABLE))


@cache
def load_home() -> vkc.Scene:
    return vkc.load_scene("household")


def plan_actions(
    steps: Sequence[vkc.steps.Step],
    *,
    scene: vkc.Scene | None = None,
    window: int = 2,
    **options: Any,
) -> vkc.Plan:
    return vkc.plan(scene or load_home(), steps, window=window, **options)


@pytest.mark.parametrize(
    ("steps", "error", "field", "text"),
    [
        ([vkc.Actuate("fridge", {"hinge": 1.0})], UnknownNameError, "steps[1].object", "refr"),
        (
            [vkc.Grasp("cold_cup"), vkc.Actuate("door", {"hinge": 1.5})],
            InputError,
            "steps[2].object",
            "one hand, and it holds cold_cup.side (expected Place or Release before",
        ),
    ],
)
def test_impossible_steps_are_refused(
    steps: list[vkc.steps.Step], error: type[InputError], field: str, text: str
) -> None:
    with pytest.raises(error) as caught:
        plan_actions([OPEN, *steps, SHUT])
    assert caught.value.field == field
    assert text in str(caught.value)


@pytest.mark.parametrize("window", [0, 1.5, True, "2"])
def test_invalid_window(window: Any) -> None:
    with pytest.raises(InputError, match="window: out of range"):
        plan_actions([OPEN], window=window)


@pytest.mark.parametrize("window", [None, 1, 2])
def test_object_may_be_released_where_it_is_grasped(
    window: int | None, capfd: pytest.CaptureFixture[str]
) -> None:
    """No phase holds it then, and a phase at rest has more equations than variables."""
    steps = [vkc.Grasp("tray"), vkc.Release(), vkc.GoTo(0.0, 0.0)]
    plan = vkc.plan(vkc.load_scene("tray"), steps, window=window)
    assert plan.success, plan.summary()
    assert capfd.readouterr() == ("", "")


@pytest.mark.long
def test_evaluation_limit_applies_to_all_actions_together() -> None:
    opening = dataclasses.replace(OPEN, attachment="handle")
    limit = int(plan_actions([opening]).metrics["evaluations"]) + 1000
    plan = plan_actions([opening, *CUP], max_evaluations=limit)
    assert (plan.status, plan.success) == ("evaluation limit", False)
    text = "steps[1], Grasp of cold_cup, could not be planned: evaluation limit"
    assert plan.report.notes[0] == text
    assert plan.trajectory.phases[1].name == "move refrigerator.hinge"


def test_ctrl_c_keeps_completed_actions() -> None:
    seen: list[vkc.Iteration] = []

    def stop(row: vkc.Iteration) -> None:
        seen.append(row)
        if len(seen) > 1 and row.round == 1 and row.objective != seen[0].objective:
            signal.raise_signal(signal.SIGINT)

    plan = plan_actions([vkc.GoTo(0.5, -0.5), OPEN, *CUP], callback=stop)
    assert (plan.status, plan.success) == ("interrupted", False)
    phase = plan.trajectory.phases[0]
    assert phase.name == "go to"
    place = plan.trajectory.positions[phase.last, :2]
    assert place == pytest.approx([0.5, -0.5], abs=1e-3)


def test_robot_does_not_stop_between_drives() -> None:
    plan = plan_actions([vkc.GoTo(1.0, -0.9), vkc.GoTo(0.4, -0.7), vkc.GoTo(0.2, -0.2)])
    assert plan.success, plan.summary()
    speed = np.linalg.norm(plan.trajectory.velocities()[:, :2], axis=1)
    first = plan.trajectory.phases[0].last
    assert speed[first - 1 : first + 1].min() > 0.1 * speed.max()


@pytest.mark.long
def test_cup_is_taken_from_the_refrigerator(tmp_path: Path) -> None:
    """The robot takes the cup out of the refrigerator and closes the door."""
    plan = plan_actions([OPEN, *CUP, SHUT])
    assert plan.success, plan.summary()
    assert plan.steps == (OPEN, *CUP, SHUT)
    names = [phase.name.partition(" ")[0] for phase in plan.trajectory.phases]
    assert names == ["reach", "move", "reach", "place", "reach", "move"]
    hinge = plan.trajectory.column("refrigerator.hinge")
    ends = [phase.last for phase in plan.trajectory.phases]
    assert hinge[ends] == pytest.approx([0, 1.57, 1.57, 1.57, 1.57, 0], abs=1e-3)
    cup = plan.end_scene().objects["cold_cup"].placement
    assert cup.translation == pytest.approx(TABLE, abs=1e-3)
    assert cup.rotation[:, 2] == pytest.approx([0, 0, 1], abs=5e-3)
    m, stages = plan.metrics, ("initialization", "coal", "casadi", "ipopt", "validation")
    parts = sum(m[f"time_{stage}"] for stage in stages)
    assert 0.5 * m["planning_time"] < parts <= m["planning_time"] + m["build_time"]
    assert m["rounds"] == len(plan.history)
    assert vkc.Plan.load(plan.save(tmp_path / "chore.npz")).success


@pytest.mark.long
def test_window_shortens_the_path() -> None:
    """The best grasp of the stick depends on the target of its tip."""
    scene = vkc.load_scene("init_1").sample_start(np.random.default_rng(5))
    steps, lengths = [vkc.Grasp("stick"), vkc.Touch("stick.tip", TARGET)], []
    for window in (1, 2):
        plan = plan_actions(steps, scene=scene, window=window)
        assert plan.success, plan.summary()
        # The weights are those of `Options`.
        moves = np.diff(plan.trajectory.positions[:, :9], axis=0)
        driven = np.linalg.norm(moves[:, :2], axis=1).sum()
        lengths.append(driven + np.sqrt(0.025) * np.abs(moves[:, 2:]).sum())
    assert lengths[1] < lengths[0]
