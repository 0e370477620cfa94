"""Several steps as one problem: which of the plans that were tried is returned, and that all of their time is counted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

import vkc_pin as vkc
from vkc_pin import all_at_once as module
from vkc_pin.one_problem import TIMES, Settings


def fake(status: str, spent: float) -> vkc.Plan:
    metrics = {"planning_time": spent, "build_time": 0.0, "iterations": spent, "rounds": 1.0, "own": spent}
    return vkc.Plan(
        scene=None,  # type: ignore[arg-type]
        steps=(),
        options=vkc.Options(),
        trajectory=None,  # type: ignore[arg-type]
        validation=SimpleNamespace(ok=status == "success"),  # type: ignore[arg-type]
        status=status,
        metrics=metrics | {f"time_{key}": 0.0 for key in TIMES},
    )


@pytest.mark.parametrize(
    ("steps", "runs", "joined", "status", "spent", "own"),
    [
        # Steps, then the whole, works.
        (["success", "success"], ["success"], None, "success", 1 + 2 + 10, 10),
        # The whole fails; the steps one after the other are a motion, whose check takes 0.5.
        (["success", "success"], ["rejected"], "success", "success", 1 + 2 + 0.5 + 10, 3.5),
        # They are none either: searched seeds.
        (["success", "success"], ["rejected", "success"], "rejected", "success", 1 + 2 + 0.5 + 10 + 20, 20),
        (["success", "success"], ["rejected", "not converged"], "rejected", "not converged", 1 + 2 + 0.5 + 10 + 20, 20),
        # A step fails.
        (["success", "rejected"], ["success"], None, "success", 1 + 2 + 10, 10),
        # Ctrl-C in the whole: nothing more is tried, but what there is is taken.
        (["success", "success"], ["interrupted"], "rejected", "interrupted", 1 + 2 + 0.5 + 10, 10),
        (["success", "success"], ["interrupted"], "success", "success", 1 + 2 + 0.5 + 10, 3.5),
        # Ctrl-C in a step.
        (["success", "interrupted"], [], "interrupted", "interrupted", 1 + 2 + 0.5, 3.5),
    ],
)
def test_what_is_returned_and_what_it_took(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[str],
    runs: list[str],
    joined: str | None,
    status: str,
    spent: float,
    own: float,
) -> None:
    plans = [fake(name, k + 1.0) for k, name in enumerate(steps)]
    queue = [fake(name, 10.0 * (k + 1)) for k, name in enumerate(runs)]
    limits: list[float] = []

    class One:
        def __init__(self, scene: Any, steps: Any, settings: Settings) -> None:
            self.task = SimpleNamespace(steps=(1, 2), phases=(1, 2, 3))
            self.settings = settings

        def run(self, seed: Any = None) -> vkc.Plan:
            assert self.settings.time_limit is not None
            limits.append(self.settings.time_limit)
            self.settings.interrupt.pressed = queue[0].status == "interrupted"
            return queue.pop(0)

    part = SimpleNamespace(task=SimpleNamespace(phases=(1,)), piece=lambda: None)
    monkeypatch.setattr(module, "OneProblem", One)
    brief: list[bool] = []

    def stages(*_: Any, **keywords: Any) -> list[tuple[Any, vkc.Plan]]:
        brief.append(keywords.get("brief", False))
        settings.interrupt.pressed = plans[-1].status == "interrupted"
        return [(part, p) for p in plans]

    monkeypatch.setattr(module, "stages", stages)
    monkeypatch.setattr(
        module, "joined", lambda *_: fake(joined or "never", 0.5 + sum(p.metrics["planning_time"] for p in plans))
    )
    settings = Settings("auto", vkc.Options(), None, 100.0, 0, 0.0)
    result = module.all_at_once(None, [], settings)  # type: ignore[arg-type]
    assert result.status == status
    assert brief == [True]  # where steps lead is a seed only: no long time for what may be a dead end
    assert not queue
    assert result.metrics["planning_time"] == pytest.approx(spent)
    assert result.metrics["own"] == own  # what is no time stays that of the plan that is returned
    assert limits == pytest.approx([97.0, 86.5][: len(runs)])


def test_building_before_planning_costs_no_negative_time() -> None:
    scene = vkc.load_scene("drawer")
    steps = [vkc.Actuate("drawer", {"slide": 0.2})]
    options = vkc.Options(reach_waypoints=23, move_waypoints=11)  # a structure of its own
    vkc.build(scene, steps, options=options)
    metrics = vkc.plan(scene, steps, options=options).metrics
    parts = sum(value for key, value in metrics.items() if key.startswith("time_"))
    assert metrics["planning_time"] >= parts > 0.0
