"""Writes the tables of experiments in README.md and docs anew, from the results on record: `python docs/make_tables.py`.

In a page, what stands between `<!-- figures: NAME -->` and `<!-- /figures: NAME -->` is of docs/results/NAME.json: each table is
replaced by the one of the experiment's own report that has the same columns, and lines that begin like one of `LINES` by the
report's. Other sentences are written by hand.
"""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from vkc_pin.benchmarks.harness.record import distribution
from vkc_pin.benchmarks.harness.tables import foot, markdown

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
LINES = ("Measured on", "Mean ± standard deviation; median. Trials in which all methods succeed")
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
REPORTS = {  # name of a record → whose report it is
    **{name: name for name in ("baselines", "household", "initialization", "chores", "scale", "gap")},
    **{"segments": "scale", "sixty": "problems.ablation", "tradeoff": "problems.ablation"},
    **{"spread": "problems.spread", "first_seed": "problems.first_seed", "robots": "anything.robots"},
    **{"anything": "anything.matrix", "cluttered": "chores"},
    **{"robots_rest": "anything.robots", "robots_packages": "anything.robots", "execution": "executing.execution"},
    "friction": "executing.execution",
    "bases": "driving.bases",
}
DOOR = ("door_seed_0", "door_seed_1")
TASKS = ("reach", "push", "push blind", "whole")
PARTS = {"initialization": "seeds", "coal": "coal", "casadi": "CasADi", "ipopt": "Ipopt", "validation": "validation"}
# What is done, its record, and the fields of its trials that tell it.
STATUS: list[tuple[str, str, dict[str, str]]] = [
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


def result(name: str) -> dict[str, Any]:
    """Return what is on record in docs/results/NAME.json."""
    found: dict[str, Any] = json.loads((DOCS / "results" / f"{name}.json").read_text(encoding="utf-8"))
    return found


def of(trials: Iterable[Mapping[str, Any]], wanted: Mapping[str, str]) -> list[Mapping[str, Any]]:
    """Return the trials whose fields are as `wanted`."""
    return [trial for trial in trials if all(trial[key] == value for key, value in wanted.items())]


def status() -> str:
    """Return the table of README's section on status."""
    rows = []
    for text, name, wanted in STATUS:
        own = of(result(name)["trials"], wanted)
        waypoints = {trial["waypoints"] for trial in own}
        count = f"{min(waypoints)}" if len(waypoints) == 1 else f"{min(waypoints)} to {max(waypoints)}"
        median, late = distribution(own, "planning_time")
        rows.append([text, count, good(own), f"{median:.2f} s", f"{late:.2f} s"])
    return markdown(["task", "waypoints", "success", "planning time, median", "95th percentile"], rows)


def door() -> str:
    """Return the tables of the door: of both seeds, and of where the time goes."""
    rows, parts, results = [], [], [result(name) for name in DOOR]
    for task in TASKS:
        for found in results:
            own = of(found["trials"], {"task": task})
            times = [f"{value:.3f}" for value in distribution(own, "planning_time")]
            efforts = [f"{distribution(own, field)[0]:.2f}" for field in ("base_effort", "arm_effort")]
            built = f"{max(trial['build_time'] for trial in own):.2f}"
            rows.append([task, str(found["meta"]["seed"]), good(own), *times, *efforts, built])
        own = of(results[0]["trials"], {"task": task})
        split = [f"{distribution(own, f'time_{part}')[0]:.3f}" for part in PARTS]
        parts.append([task, *split, f"{distribution(own, 'iterations')[0]:.0f}"])
    head = ["task", "seed", "success", "planning time, median [s]", "95th percentile [s]", "base effort [m]", "arm effort [rad]"]
    split = ["task", *(f"{name} [s]" for name in PARTS.values()), "Ipopt iterations"]
    most = max(found["meta"]["peak_memory_mb"] for found in results)
    about = f"{foot(results[0]['meta'])} Peak memory {most:.0f} MB."
    return "\n\n".join([markdown([*head, "build, at most [s]"], rows), markdown(split, parts), about])


def drawn(name: str) -> str:
    """Return the tables of random problems on record: what came of them, and whether the oracle agrees."""
    found = result(name)
    about, trials = found["meta"], found["trials"]
    statuses = sorted({trial["status"] for trial in trials} - {"success"})
    rows = []
    for kind in sorted({trial["kind"] for trial in trials}):
        own = of(trials, {"kind": kind})
        counts = [str(len(of(own, {"status": status}))) for status in statuses]
        rows.append([kind, good(own), *counts, *(f"{value:.2f}" for value in distribution(own, "planning_time"))])
    agreed = []
    for success, said in ((True, "success"), (False, "failure")):
        own = [bool(trial["oracle"]) for trial in trials if trial["success"] == success]
        agreed.append([said, str(own.count(False)), str(own.count(True))])
    return "\n\n".join(
        [
            markdown(["problems in", "success", *statuses, "time, median [s]", "95th percentile [s]"], rows),
            markdown(["by its own word", "the oracle finds nothing", "it finds something"], agreed),
            foot(about),
        ]
    )


def good(trials: Sequence[Mapping[str, Any]]) -> str:
    """Return how many succeed."""
    return f"{sum(trial['success'] for trial in trials)} of {len(trials)}"


def reported(name: str) -> str:
    """Return the tables of a record, as its experiment reports them."""
    own: dict[str, Callable[[], str]] = {
        "status": status,
        "door": door,
        **{name: partial(drawn, name) for name in ("random", "rooms")},
    }
    if name in own:
        return own[name]() + "\n"
    module = importlib.import_module(f"vkc_pin.benchmarks.{REPORTS[name]}")
    text: str = module.report(result(name))
    return text


def columns(table: str) -> str:
    """Return the first line of a table."""
    return table.splitlines()[0]


def renewed(name: str, section: str) -> str:
    """Return a section of a page with the tables of a record."""
    report = reported(name)
    tables: dict[str, list[str]] = {}
    for table in TABLE.findall(report):
        tables.setdefault(columns(table), []).append(table)

    def table_of(match: re.Match[str]) -> str:
        left = tables.get(columns(match[0]))
        if not left:
            raise ValueError(f"no table of {name} is left with the columns {columns(match[0])}")
        return left.pop(0)

    section = TABLE.sub(table_of, section)
    for beginning in LINES:
        line = re.compile(rf"^{beginning}.*$", re.MULTILINE)
        own = line.search(report)
        if own is not None:
            section = line.sub(own[0].replace("\\", r"\\"), section)
    return section


def filled(text: str) -> str:
    """Return a page with the tables between its marks."""
    marks = r"(<!-- figures: (\w+) -->)(.*?)(<!-- /figures: \2 -->)"
    return re.sub(marks, lambda m: m[1] + renewed(m[2], m[3]) + m[4], text, flags=re.DOTALL)


def main() -> int:
    """Write the pages whose tables are others; say which."""
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        if (after := filled(before)) != before:
            page.write_text(after, encoding="utf-8")
            sys.stdout.write(f"wrote {page.relative_to(ROOT)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
