"""Updates the tables of experiments in README.md and docs from the results on record.

Usage: python docs/make_tables.py

Sections between `<!-- figures: NAME -->` and `<!-- /figures: NAME -->` belong to
docs/results/NAME.json.gz. Each table is replaced by the table with the same columns in the
experiment's results, and each line with a beginning in `LINES` by the line there. Lines with
versions and machine also name the commit of the trials.

Figures between `<!-- figure: NAME WHAT FIELD=VALUE ... -->` and `<!-- / -->` are computed from the
trials of docs/results/NAME.json.gz with these field values, see `FIGURES`. The number of decimals
is kept.

Figures without a record are between `<!-- measured: COMMIT DATE -->` and `<!-- /measured -->`;
docs/evidence.md lists them. Other sentences are written by hand.
"""

from __future__ import annotations

import gzip
import importlib
import json
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from statistics import mean, median
from typing import Any

import yaml

from vkc_pin.experiments.harness.record import distribution
from vkc_pin.experiments.harness.tables import describe_run, format_table

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
LINES = ("Measured on", "Mean ± standard deviation; median. Trials in which all methods succeed")
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
DOOR = ("door_seed_0", "door_seed_1")
TASKS = ("reach", "push", "push blind", "whole")
PARTS = {
    "initialization": "initial guesses",
    "coal": "coal",
    "casadi": "CasADi",
    "ipopt": "Ipopt",
    "validation": "validation",
}
# Task, its record, and the fields of its trials.
STATUS: list[tuple[str, str, dict[str, str]]] = [
    ("reach a pose", "door_seed_0", {"task": "reach"}),
    ("push the door, grasp given", "door_seed_0", {"task": "push"}),
    ("drive up, turn the knob, push: one problem", "door_seed_0", {"task": "whole"}),
    (
        "fetch a stick and touch a cube under a table with it, "
        "[three scenes](docs/initialization.md)",
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


RECORDS: list[dict[str, Any]] = yaml.safe_load((DOCS / "records.yaml").read_text(encoding="utf-8"))


@cache
def result(name: str) -> dict[str, Any]:
    """Load the record docs/results/NAME.json.gz."""
    found: dict[str, Any] = json.loads(
        gzip.decompress((DOCS / "results" / f"{name}.json.gz").read_bytes())
    )
    return found


def select_trials(
    trials: Iterable[Mapping[str, Any]], wanted: Mapping[str, str]
) -> list[Mapping[str, Any]]:
    """Return the trials whose fields are as `wanted`."""
    return [
        trial
        for trial in trials
        if all(str(trial.get(key)) == value for key, value in wanted.items())
    ]


def status() -> str:
    """Return the table of README's section on status."""
    rows = []
    for text, name, wanted in STATUS:
        own = select_trials(result(name)["trials"], wanted)
        waypoints = {trial["waypoints"] for trial in own}
        count = (
            f"{min(waypoints)}" if len(waypoints) == 1 else f"{min(waypoints)} to {max(waypoints)}"
        )
        median, late = distribution(own, "planning_time")
        rows.append([text, count, good(own), f"{median:.2f} s", f"{late:.2f} s"])
    return format_table(
        ["task", "waypoints", "success", "planning time, median", "95th percentile"], rows
    )


def door() -> str:
    """Return the tables of the door: of both seeds, and of the parts of the planning time."""
    rows, parts, results = [], [], [result(name) for name in DOOR]
    for task in TASKS:
        for found in results:
            own = select_trials(found["trials"], {"task": task})
            times = [f"{value:.3f}" for value in distribution(own, "planning_time")]
            efforts = [
                f"{distribution(own, field)[0]:.2f}"
                for field in ("base_path_length", "arm_path_length")
            ]
            built = f"{max(trial['build_time'] for trial in own):.2f}"
            rows.append([task, str(found["meta"]["seed"]), good(own), *times, *efforts, built])
        own = select_trials(results[0]["trials"], {"task": task})
        split = [f"{distribution(own, f'time_{part}')[0]:.3f}" for part in PARTS]
        parts.append([task, *split, f"{distribution(own, 'iterations')[0]:.0f}"])
    head = [
        "task",
        "seed",
        "success",
        "planning time, median [s]",
        "95th percentile [s]",
        "base path length [m]",
        "arm path length [rad]",
    ]
    split = ["task", *(f"{name} [s]" for name in PARTS.values()), "Ipopt iterations"]
    most = max(found["meta"]["peak_memory_mb"] for found in results)
    about = f"{describe_run(results[0]['meta'])} Peak memory {most:.0f} MB."
    return "\n\n".join(
        [format_table([*head, "largest build time [s]"], rows), format_table(split, parts), about]
    )


def summarize_random_problems(name: str) -> str:
    """Return the tables of recorded random problems: outcomes, and agreement with the oracle."""
    found = result(name)
    about, trials = found["meta"], found["trials"]
    statuses = sorted({trial["status"] for trial in trials} - {"success"})
    rows = []
    for kind in sorted({trial["kind"] for trial in trials}):
        own = select_trials(trials, {"kind": kind})
        counts = [str(len(select_trials(own, {"status": status}))) for status in statuses]
        rows.append(
            [
                kind,
                good(own),
                *counts,
                *(f"{value:.2f}" for value in distribution(own, "planning_time")),
            ]
        )
    agreed = []
    for success, said in ((True, "success"), (False, "failure")):
        own = [bool(trial["oracle"]) for trial in trials if trial["success"] == success]
        agreed.append([said, str(own.count(False)), str(own.count(True))])
    return "\n\n".join(
        [
            format_table(
                ["problems in", "success", *statuses, "time, median [s]", "95th percentile [s]"],
                rows,
            ),
            format_table(
                ["planner's result", "no fault found by the oracle", "fault found"], agreed
            ),
            describe_run(about),
        ]
    )


def good(trials: Sequence[Mapping[str, Any]]) -> str:
    """Return how many succeed."""
    return f"{sum(trial['success'] for trial in trials)} of {len(trials)}"


def commits(trials: Iterable[Mapping[str, Any]]) -> str:
    """Return which commits trials are of; "none" for records that do not say."""
    return (
        ", ".join(
            f"`{commit}`"
            for commit in sorted({trial["commit"] for trial in trials if trial.get("commit")})
        )
        or "none"
    )


def evidence() -> str:
    """Return the table of claims, commands and records, and that of figures without a record."""
    rows, rest = [], []
    for entry in RECORDS:
        name, command = entry["record"], entry["command"]
        found = result(name)
        about, trials = found["meta"], found["trials"]
        sessions = about.get("sessions", ())
        jobs = ", ".join(
            f"{number} at a time" for number in sorted({session["jobs"] for session in sessions})
        )
        minutes = sum(session["seconds"] for session in sessions) / 60.0
        timed = sum(session["trials"] for session in sessions)
        if not sessions:  # of the door, whose record has no sessions
            minutes = sum(trial["planning_time"] + trial["build_time"] for trial in trials) / 60.0
            jobs = "planning alone"
        for option in entry.get("options", ()):
            values = about[option] if isinstance(about[option], list) else [str(about[option])]
            command += (
                f" --{option} {shlex.join(value for value in values if value != 'unchanged')}"
            )
        file = (
            f"--json out/{name}.json" if "door" in name or name == "timing" else f"--out out/{name}"
        )
        whole = f"`{command} {file}`"
        rows.append(
            [
                f"[{entry['claim']}]({entry['page']})",
                whole,
                f"[{name}](results/{name}.json.gz)",
                commits(trials),
            ]
        )
        part = (
            f", {timed} of them"
            if 0 < timed < len(trials) and "robots" not in entry.get("options", ())
            else ""
        )
        rows[-1] += [f"{len(trials)}", f"{minutes:.1f} min, {jobs}{part}"]
    for page in PAGES:
        for commit, date in dict.fromkeys(
            re.findall(r"<!-- measured: (\w+) ([\d-]+) -->", page.read_text(encoding="utf-8"))
        ):
            where = "../README.md" if page.name == "README.md" else page.name
            rest.append([f"[{page.name}]({where})", f"`{commit}`", date])
    head = ["claim", "command", "record", "commit", "trials", "wall time"]
    return "\n\n".join(
        [
            format_table(head, rows, text=4),
            format_table(["page", "at or after commit", "date"], rest, text=3),
        ]
    )


FIGURES: dict[str, Callable[[Sequence[Mapping[str, Any]], str], float | str]] = {
    "good": lambda trials, field: good(trials),
    "successes": lambda trials, field: f"{sum(trial['success'] for trial in trials)}",
    "trials": lambda trials, field: f"{len(trials)}",
    "count": lambda trials, field: f"{sum(bool(trial.get(field)) for trial in trials)}",
    "steady": lambda trials, field: _steady(trials),
    "median": lambda trials, field: distribution(trials, field)[0],
    "mean": lambda trials, field: mean(float(trial[field]) for trial in trials),
    "late": lambda trials, field: distribution(trials, field)[1],
    "most": lambda trials, field: max(float(trial[field]) for trial in trials),
    "least": lambda trials, field: min(float(trial[field]) for trial in trials),
    "percent": lambda trials, field: (
        100.0 * sum(bool(trial.get(field)) for trial in trials) / len(trials)
    ),
    "slowdown": lambda trials, field: _slowdown(trials, field),
}
"""Statistics of trials, of the field named after a colon.

`late` is the 95th percentile, `steady` counts starts of which every trial succeeds.
`slowdown:1000` is the median over starts of the ratio of times with 1000 and 30 obstacles.
"""


def _steady(trials: Sequence[Mapping[str, Any]]) -> str:
    starts: dict[tuple[str, int], bool] = {}
    for trial in trials:
        start = trial["scene"], trial["number"]
        starts[start] = starts.get(start, True) and trial["success"]
    return f"{sum(starts.values())} of {len(starts)}"


def _slowdown(trials: Sequence[Mapping[str, Any]], count: str) -> float:
    base = {
        trial["number"]: trial["planning_time"]
        for trial in select_trials(trials, {"obstacles": "30"})
    }
    return median(
        trial["planning_time"] / base[trial["number"]]
        for trial in select_trials(trials, {"obstacles": count})
    )


def figure(asked: str, before: str) -> str:
    """Return the figure that a mark's text requests, with as many decimals as `before`."""
    name, what, *conditions = asked.split()
    what, _, field = what.partition(":")
    trials = select_trials(
        result(name)["trials"],
        dict(condition.replace("~", " ").split("=", 1) for condition in conditions),
    )
    if not trials:
        raise ValueError(f"no trials of {asked}")
    value = FIGURES[what](trials, field)
    return value if isinstance(value, str) else f"{value:.{len(before.partition('.')[2])}f}"


def format_record(name: str) -> str:
    """Return the tables of a record, as its experiment reports them."""
    own: dict[str, Callable[[], str]] = {
        "status": status,
        "door": door,
        "evidence": evidence,
        **{name: partial(summarize_random_problems, name) for name in ("random", "rooms")},
    }
    if name in own:
        return own[name]() + "\n"
    whose = next(entry["module"] for entry in RECORDS if entry["record"] == name)
    if whose.startswith("tests."):
        sys.path.insert(0, str(ROOT))
    module = importlib.import_module(whose)
    text: str = module.format_results(result(name))
    return text


def columns(table: str) -> str:
    """Return the first line of a table."""
    return table.splitlines()[0]


def update_section(name: str, section: str) -> str:
    """Return a section of a page with the tables of a record."""
    text = format_record(name)
    tables: dict[str, list[str]] = {}
    for table in TABLE.findall(text):
        tables.setdefault(columns(table), []).append(table)

    def replace_table(match: re.Match[str]) -> str:
        left = tables.get(columns(match[0]))
        if not left:
            raise ValueError(f"no table of {name} is left with the columns {columns(match[0])}")
        return left.pop(0)

    section = TABLE.sub(replace_table, section)
    for beginning in LINES:
        line = re.compile(rf"^{beginning}.*$", re.MULTILINE)
        own = line.search(text)
        if own is not None:
            said = own[0] + (
                f" Commit {commits(load_trials(name))}." if beginning == "Measured on" else ""
            )
            section = line.sub(said.replace("\\", r"\\"), section)
    return section


def load_trials(name: str) -> list[Mapping[str, Any]]:
    """Return the trials that a section is about."""
    return [
        trial
        for record in (DOOR if name == "door" else (name,))
        for trial in result(record)["trials"]
    ]


def update_page(text: str) -> str:
    """Return a page with the tables and figures between its marks."""
    one = r"(<!-- figure: ([^>]+?) -->)(.*?)(<!-- / -->)"
    text = re.sub(one, lambda m: m[1] + figure(m[2], m[3]) + m[4], text)
    marks = r"(<!-- figures: (\w+) -->)(.*?)(<!-- /figures: \2 -->)"
    return re.sub(marks, lambda m: m[1] + update_section(m[2], m[3]) + m[4], text, flags=re.DOTALL)


def main() -> int:
    """Write the pages whose tables are others; say which."""
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        if (after := update_page(before)) != before:
            page.write_text(after, encoding="utf-8")
            sys.stdout.write(f"wrote {page.relative_to(ROOT)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
