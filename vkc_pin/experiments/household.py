"""Third experiment: six tasks in a home."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.experiments.comparison import Assignment, Comparison
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.charts import means_chart, success_chart
from vkc_pin.experiments.harness.record import Record
from vkc_pin.world.files.documents import read_yaml
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Place

TABLE_TOP = ((2.5, 3.0), (-1.9, -0.9))
"""The coffee table's plate in the scene `household`: x and y, lowest and highest [m]."""
# [m] from the cup's axis, whose radius is 0.035, to the plate's edges, at least
_EDGE = 0.05


def sample_cup_pose(scene: Scene, rng: np.random.Generator) -> dict[str, list[float]]:
    """Sample the pose of the cup on the coffee table, at any heading."""
    (x_min, x_max), (y_min, y_max) = TABLE_TOP
    x = float(rng.uniform(x_min + _EDGE, x_max - _EDGE))
    y = float(rng.uniform(y_min + _EDGE, y_max - _EDGE))
    height = float(scene.objects["cup"].placement.translation[2])
    yaw = float(rng.uniform(-np.pi, np.pi))
    return {"cup": [x, y, height, 0.0, 0.0, yaw]}


TASKS = {
    "cup": Assignment(
        "household",
        (Place("cup", (-0.6, -1.6, 0.751)),),
        "carry a cup to the dining table",
        scatter=sample_cup_pose,
    ),
    "door": Assignment(
        "household",
        (Actuate("door", {"hinge": 1.52}, attachment="handle_free"), GoTo(1.6, 2.5)),
        "push a narrow door open and drive through",
    ),
    "drawer": Assignment(
        "household", (Actuate("drawer", {"slide": 0.22}),), "pull a low drawer open in a corner"
    ),
    "dishwasher": Assignment(
        "household", (Actuate("dishwasher", {"rack": 0.5}),), "pull a dishwasher's rack out"
    ),
    "refrigerator": Assignment(
        "household", (Actuate("refrigerator", {"hinge": 1.57}),), "pull a refrigerator open"
    ),
    "cabinet": Assignment(
        "household", (Actuate("cabinet", {"hinge": 0.4}),), "pull a cabinet open behind a chair"
    ),
}


def _draw(
    records: Sequence[Record], out: Path, tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Draw success, path lengths and planning times of all tasks and methods."""
    shown = {task: task for task in tasks}
    success_chart(records, out / "success.png", shown, methods, title="Success")
    pictures = ["![Success, with Wilson's intervals of 95 % confidence](success.png)"]
    units = {"base path length": "m", "arm path length": "rad", "planning time": "s"}
    for name, unit in units.items():
        field = name.replace(" ", "_")
        means_chart(
            records,
            out / f"{field}.png",
            shown,
            methods,
            field=field,
            label=f"{name} [{unit}]",
            shared=name.endswith("length"),
        )
        pictures.append(f"![{name.capitalize()}: means and standard deviations]({field}.png)")
    return pictures


COMPARISON = Comparison("household", "Six tasks in a home", TASKS, _draw)

# --- with the numbers of the paper's code
# -------------------------------------------------------------------------------

_PAPER_HOME = "household, the paper's numbers"
# [m] the dining table's upper face, 1 mm below the cup
_TOP = 1.109
# [m] thickness of its plate
_PLATE = 0.03
# [m] by which the rack comes out. It is 0.4 deep, and begins 0.15 behind the face: at the end it
# hangs free
_RAIL = 0.8


def make_paper_home() -> Scene:
    """Return the scene `household` with the table height and the rack travel of the paper's code.

    A table of 1.11 m is a bar table, so it has the size of the kitchen's, 1.2 x 0.6 m. On one as
    deep as the dining table, 0.8 m, the forearm of a level hand would pass through the plate.
    """
    home = load_scene("household")
    document = home.document
    document["name"] = _PAPER_HOME
    (table,) = (item for item in document["obstacles"] if item["name"] == "dining_table")
    others = [item for item in document["obstacles"] if item is not table]
    x, y, _ = table["position"]
    document["obstacles"] = [*others, *_make_bar_table(x, y)]
    (dishwasher,) = (item for item in document["objects"] if item["name"] == "dishwasher")
    description = read_yaml(home.folder / "objects" / "dishwasher.yaml").data
    urdf = (home.folder / "objects" / description["urdf"]).read_text(encoding="utf-8")
    longer = urdf.replace('upper="0.55"', f'upper="{_RAIL}"')
    dishwasher["type"] = {**description, "urdf": longer}
    return Scene.from_document(document, home.folder)


def _make_bar_table(x: float, y: float) -> list[dict[str, Any]]:
    """Return a table of a plate and two columns with feet as obstacles, centred at x and y [m]."""
    plate = {"type": "box", "size": [1.2, 0.6, _PLATE], "position": [x, y, _TOP - _PLATE / 2.0]}
    shapes: list[dict[str, Any]] = [plate]
    height = _TOP - _PLATE
    for column_x in (x - 0.35, x + 0.35):
        column = {
            "type": "cylinder",
            "radius": 0.035,
            "length": height,
            "position": [column_x, y, height / 2.0],
        }
        foot = {"type": "box", "size": [0.2, 0.44, 0.02], "position": [column_x, y, 0.01]}
        shapes += [column, foot]
    return [
        {"name": f"dining_table_{number}", **shape, "colour": "oak"}
        for number, shape in enumerate(shapes)
    ]


def _load(name: str) -> Scene:
    return make_paper_home() if name == _PAPER_HOME else load_scene(name)


_PAPER_TASKS = {
    "cup": replace(TASKS["cup"], scene=_PAPER_HOME, steps=(Place("cup", (-0.6, -1.6, 1.11)),)),
    "dishwasher": replace(
        TASKS["dishwasher"],
        scene=_PAPER_HOME,
        steps=(Actuate("dishwasher", {"rack": _RAIL}, attachment="other_side"),),
        name="pull a dishwasher's rack out by 0.8, held at the side",
    ),
}
PAPER = Comparison(
    "household",
    "Two tasks in a home, with the numbers of the paper's code",
    {**TASKS, **_PAPER_TASKS},  # in the same places, so that the starts are the same
    _draw,
    _load,
)

plan_trial = COMPARISON.plan_trial


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result of either variant in Markdown."""
    is_paper = _PAPER_HOME in result["meta"]["scenes"].values()
    comparison = PAPER if is_paper else COMPARISON
    return comparison.format_results(result)


def run(*, variant: str | None = None, **how: Any) -> dict[str, Any]:
    """Run the experiment.

    Args:
        variant: "paper" for the tasks that differ in the paper's code, with its numbers.
        **how: See `Comparison.run`.

    Raises:
        UnknownNameError: There is no such variant.
    """
    if variant is None:
        return COMPARISON.run(**how)
    runner.select_names("variant", [variant], ["paper"])
    how.setdefault("tasks", list(_PAPER_TASKS))
    return PAPER.run(**how)
