"""The third experiment: six tasks of a day in a home; B1, B2 and VKC."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.comparison import COMPARED_PLANNERS, Assignment, Comparison
from vkc_pin.benchmarks.harness.charts import means_chart, success_chart
from vkc_pin.benchmarks.harness.record import Record
from vkc_pin.scene.scene import Scene
from vkc_pin.task.steps import Actuate, GoTo, Place

__all__ = ["COMPARED_PLANNERS", "TABLE_TOP", "TASKS", "on_the_coffee_table", "plan_trial", "report", "run"]

TABLE_TOP = ((2.5, 3.0), (-1.9, -0.9))
"""The coffee table's plate in the scene `household`: x and y, lowest and highest [m]."""
_EDGE = 0.05  # [m] from the cup's axis, whose radius is 0.035, to the plate's edges, at least


def on_the_coffee_table(scene: Scene, rng: np.random.Generator) -> dict[str, list[float]]:
    """Return the cup somewhere on the coffee table, as high as it stands in the scene, at any heading."""
    x, y = (float(rng.uniform(low + _EDGE, high - _EDGE)) for low, high in TABLE_TOP)
    height, yaw = float(scene.objects["cup"].placement.translation[2]), float(rng.uniform(-np.pi, np.pi))
    return {"cup": [x, y, height, 0.0, 0.0, yaw]}


TASKS = {
    "cup": Assignment(
        "household", (Place("cup", (-0.6, -1.6, 0.751)),), "carry a cup to the dining table", scatter=on_the_coffee_table
    ),
    "door": Assignment(
        "household",
        (Actuate("door", {"hinge": 1.52}, attachment="handle_free"), GoTo(1.6, 2.5)),
        "push a narrow door open and drive through",
    ),
    "drawer": Assignment("household", (Actuate("drawer", {"slide": 0.22}),), "pull a low drawer open in a corner"),
    "dishwasher": Assignment("household", (Actuate("dishwasher", {"rack": 0.5}),), "pull a dishwasher's rack out"),
    "refrigerator": Assignment("household", (Actuate("refrigerator", {"hinge": 1.57}),), "pull a refrigerator open"),
    "cabinet": Assignment("household", (Actuate("cabinet", {"hinge": 0.4}),), "pull a cabinet open behind a chair"),
}


def _draw(records: Sequence[Record], out: Path, tasks: Mapping[str, str], methods: Sequence[str]) -> list[str]:
    """Draw success.png, base_effort.png, arm_effort.png and planning_time.png, each with all tasks and methods."""
    shown = {task: task for task in tasks}
    success_chart(records, out / "success.png", shown, methods, title="Success")
    pictures = ["![Success, with Wilson's intervals of 95 % confidence](success.png)"]
    for name, unit in (("base effort", "m"), ("arm effort", "rad"), ("planning time", "s")):
        how: Any = {"field": name.replace(" ", "_"), "label": f"{name} [{unit}]", "shared": name.endswith("effort")}
        means_chart(records, out / f"{how['field']}.png", shown, methods, **how)
        pictures.append(f"![{name.capitalize()}: means and standard deviations]({how['field']}.png)")
    return pictures


COMPARISON = Comparison("household", "Six tasks in a home", TASKS, _draw)

plan_trial, report, run = COMPARISON.plan_trial, COMPARISON.report, COMPARISON.run
