"""The second experiment: push a door open at the end of a corridor, pull a drawer open in a narrow aisle; B1, B2 and VKC."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vkc_pin.benchmarks.charts import criteria_chart
from vkc_pin.benchmarks.comparison import METHODS, Comparison, Solve, Task
from vkc_pin.plan import Plan
from vkc_pin.scene import Scene
from vkc_pin.steps import Actuate

__all__ = ["METHODS", "TASKS", "plan_trial", "run"]

TASKS = {
    "door": Task("corridor_door", (Actuate("door", {"hinge": 1.5}),), "push a door open"),
    "drawer": Task("aisle_drawer", (Actuate("drawer", {"slide": 0.6}),), "pull a drawer open"),
}


def _draw(records: Sequence[Mapping[str, Any]], out: Path, tasks: Mapping[str, str], methods: Sequence[str]) -> list[str]:
    """Draw the criteria of every task as bars, <task>.png."""
    for task, name in tasks.items():
        own = [record for record in records if record["scene"] == task]
        starts = len({record["number"] for record in own})
        title = f"{name.capitalize()}, {starts} random start{'s' * (starts != 1)}"
        criteria_chart(own, out / f"{task}.png", methods, title=title)
    return [f"![Criteria: {name}]({task}.png)" for task, name in tasks.items()]


COMPARISON = Comparison("baselines", "Base and arm together, or one after the other", TASKS, _draw)


def plan_trial(scene: Scene, spec: Mapping[str, Any]) -> Plan:
    """Plan the task of one trial; see `Comparison.plan_trial`."""
    return COMPARISON.plan_trial(scene, spec)


def run(
    *,
    trials: int,
    seed: int,
    out: str | Path,
    jobs: int = 1,
    tasks: Sequence[str] = tuple(TASKS),
    methods: Sequence[str] = METHODS,
    save_failures: bool = False,
    progress: bool = True,
    solve: Solve = plan_trial,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write its results to `out`; see `Comparison.run`.

    The charts are <task>.png: success, efforts and planning time as bars.
    """
    how: dict[str, Any] = {"jobs": jobs, "tasks": tasks, "methods": methods, "save_failures": save_failures}
    return COMPARISON.run(trials=trials, seed=seed, out=out, solve=solve, progress=progress, **how)
