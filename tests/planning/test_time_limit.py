"""Planning returns a plan wherever the time limit interrupts it."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from helpers.drawers import SHORT, load_drawer_scene

import vkc_pin as vkc
from vkc_pin.experiments.baselines import plan_separately
from vkc_pin.experiments.chores import fetch
from vkc_pin.utils.budget import Budget

PULL = [vkc.Actuate("drawer", {"slide": 0.3})]
CALLS: dict[str, Callable[[], vkc.Plan]] = {
    "plan": lambda: vkc.plan(load_drawer_scene(), PULL, options=SHORT, planner=vkc.Planner()),
    "chore": lambda: vkc.plan(
        load_drawer_scene(), [*PULL, vkc.GoTo(0.0, 0.0)], options=SHORT, window=2
    ),
    "baseline": lambda: plan_separately(load_drawer_scene(), PULL, method="B2", retries=1),
}


class FakeClock:
    """A budget whose time limit is reached after a given number of queries."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count, self.last = 0, np.inf
        monkeypatch.setattr(Budget, "stop_status", property(self.get_status))

    def get_status(self, budget: Budget) -> str:
        self.count += 1
        return "time limit" if self.count > self.last else ""


@pytest.mark.parametrize(
    "call",
    [
        pytest.param(call, id=name, marks=[pytest.mark.long] if name == "chore" else [])
        for name, call in CALLS.items()
    ],
)
def test_plan_is_returned_wherever_the_time_limit_interrupts_it(
    call: Callable[[], vkc.Plan], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = FakeClock(monkeypatch)
    whole = call()
    assert whole.success, whole.summary()
    assert clock.count > 50
    rounds = []
    for last in [0, 2, *np.linspace(5, clock.count - 8, 3).astype(int).tolist()]:
        clock.count, clock.last = 0, last
        plan = call()
        assert plan.success or plan.status == "time limit"
        assert plan.success == plan.report.ok
        assert np.isfinite(plan.trajectory.positions).all()
        assert plan.metrics["evaluations"] <= whole.metrics["evaluations"]
        rounds.append(plan.metrics["rounds"])
    assert rounds[0] <= rounds[-1] <= whole.metrics["rounds"]


@pytest.mark.parametrize("limit", [0.05, 1.0])
def test_hard_task_keeps_the_time_limit(limit: float) -> None:
    scene = vkc.load_scene("fetch")
    start = time.perf_counter()
    plan = vkc.plan(scene, fetch(scene), time_limit=limit, planner=vkc.Planner(), window=2)
    assert time.perf_counter() - start < limit + 3.0
    assert plan.status == "time limit"
    assert plan.report.violations
