"""Writes the table in README.md's section on status anew, from the results on record: `python docs/make_status.py`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

DOCS = Path(__file__).resolve().parent
README = DOCS.parent / "README.md"
# What is done, the file in docs/results, and the fields of its trials that tell it.
ROWS: list[tuple[str, str, dict[str, str]]] = [
    ("reach a pose", "door_seed_0", {"task": "reach"}),
    ("push the door, grasp given", "door_seed_0", {"task": "push"}),
    ("drive up, turn the knob, push: one problem", "door_seed_0", {"task": "whole"}),
    (
        "fetch a stick and touch a cube under a table with it, [three scenes](docs/initialization.md)",
        "initialization",
        {"method": "auto"},
    ),
    (
        "push a door open at the end of a corridor, [against baselines](docs/baselines.md)",
        "baselines",
        {"scene": "door", "method": "VKC"},
    ),
    (
        "pull a drawer open in a narrow aisle, [against baselines](docs/baselines.md)",
        "baselines",
        {"scene": "drawer", "method": "VKC"},
    ),
]


def trials(name: str, wanted: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the trials on record in docs/results/<name>.json whose fields are as `wanted`."""
    found: list[dict[str, Any]] = json.loads((DOCS / "results" / f"{name}.json").read_text(encoding="utf-8"))["trials"]
    return [trial for trial in found if all(trial[key] == value for key, value in wanted.items())]


def row(text: str, found: Sequence[Mapping[str, Any]]) -> str:
    """Return a row of the table: what is done, waypoints, success, median and 95th percentile of the planning time."""
    times = [trial["planning_time"] for trial in found]
    waypoints = {trial["waypoints"] for trial in found}
    count = f"{min(waypoints)}" if len(waypoints) == 1 else f"{min(waypoints)} to {max(waypoints)}"
    good = sum(trial["success"] for trial in found)
    return f"| {text} | {count} | {good} of {len(found)} | {np.median(times):.2f} s | {np.percentile(times, 95):.2f} s |"


def table() -> str:
    """Return the table in Markdown."""
    head = "| task | waypoints | success | planning time, median | 95th percentile |\n| --- | --- | --- | --- | --- |\n"
    return head + "\n".join(row(text, trials(name, wanted)) for text, name, wanted in ROWS) + "\n"


def filled(text: str) -> str:
    """Return the README with the table between its marks."""
    begin, end = "<!-- figures: bench -->", "<!-- /figures: bench -->"
    return re.sub(rf"{begin}.*?{end}", lambda _: f"{begin}\n\n{table()}\n{end}", text, flags=re.DOTALL)


if __name__ == "__main__":
    README.write_text(filled(README.read_text(encoding="utf-8")), encoding="utf-8")
