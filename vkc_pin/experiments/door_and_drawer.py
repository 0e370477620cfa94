"""Second experiment: a door at the end of a corridor and a drawer in a narrow aisle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from vkc_pin.experiments.comparison import (
    Assignment,
    Comparison,
    select_compared_methods,
)
from vkc_pin.experiments.harness.charts import criteria_chart
from vkc_pin.experiments.harness.record import Record
from vkc_pin.world.task.steps import Actuate

TASKS = {
    "door": Assignment("corridor_door", (Actuate("door", {"hinge": 1.5}),), "push a door open"),
    "drawer": Assignment(
        "aisle_drawer", (Actuate("drawer", {"slide": 0.6}),), "pull a drawer open"
    ),
}


def _draw(
    records: Sequence[Record], out: Path, tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Draw the criteria of each task as bars, <task>.png."""
    compared = select_compared_methods(methods)
    for task, name in tasks.items():
        own = [record for record in records if record["scene"] == task]
        starts = len({record["number"] for record in own})
        noun = "random start" if starts == 1 else "random starts"
        title = f"{name.capitalize()}, {starts} {noun}"
        criteria_chart(own, out / f"{task}.png", compared, title=title)
    return [f"![Criteria: {name}]({task}.png)" for task, name in tasks.items()]


COMPARISON = Comparison("baselines", "Base and arm together, or one after the other", TASKS, _draw)

plan_trial = COMPARISON.plan_trial
format_results = COMPARISON.format_results
run = COMPARISON.run
