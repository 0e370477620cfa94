"""Sixty problems that nothing was tuned on, with the planner as it is and with one setting changed at a time."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS, allowed
from vkc_pin.benchmarks.harness.record import Record, distribution, values
from vkc_pin.benchmarks.harness.tables import decimal, failures, foot, markdown, quartiles
from vkc_pin.benchmarks.problems import trials
from vkc_pin.benchmarks.problems.changes import UNCHANGED, Change, parsed
from vkc_pin.benchmarks.problems.problem_set import KINDS, NUMBER, Problem, kind_of, problem

__all__ = ["SUMMARY", "every_trial", "report", "run", "specify", "summary"]

PAIRED = {"planning_time": "time", "cpu_time": "CPU", "base_effort": "base", "arm_effort": "arm", "objective": "objective"}
"""What is compared with the unchanged planner, problem by problem: field → name."""
SUMMARY = (
    *("success", "first seed", "time, median [s]", "mean [s]", "95th percentile [s]"),
    *("CPU, median [s]", "mean [s]", "95th percentile [s]", "rounds", "iterations", "base [m]", "arm [rad]", "failures"),
)
"""Columns that sum up trials; see `summary`."""


def specify(*, problems: Sequence[int], changes: Sequence[Change], seed: int) -> list[dict[str, Any]]:
    """Return the trials: all settings take turns at a problem, so that they meet the same machine."""
    return [
        {"key": f"{number:02d}/{setting:03d}", "number": number, "kind": kind_of(number), "method": str(change), "seed": seed}
        for number in problems
        for setting, change in enumerate(changes)
    ]


def run(
    *,
    out: str | Path,
    seed: int = 0,
    jobs: int = 1,
    scheduler: str | None = None,
    changes: Sequence[str] = (),
    problems: Sequence[int] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        seed: Of planning.
        jobs: Number of processes. Several slow each other down.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see `engine.results`.
        changes: Settings to change, one at a time; see `changes.parsed`.
        problems: Numbers of problems; None: all.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}, each trial with its `kind` and the change as its `method`; see `runner.run`.

    Raises:
        UnknownNameError: There is no such field, module or constant.
        InputError: A change is none, there is no such problem, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    numbers = chosen(problems)
    chosen_changes = list(dict.fromkeys([UNCHANGED, *(parsed(text) for text in changes)]))
    settings = {"benchmark": "ablation", "seed": seed, "problems": numbers, "changes": [str(change) for change in chosen_changes]}
    settings |= LIMITS
    specs = specify(problems=numbers, changes=chosen_changes, seed=seed)
    return runner.run(specs, _record, out, settings=settings, report=report, jobs=jobs, scheduler=scheduler, progress=progress)


def chosen(problems: Sequence[int] | None) -> list[int]:
    """Return numbers of problems without repetition; all for None. Raises `InputError` if there is no such problem."""
    numbers = sorted(set(range(NUMBER) if problems is None else problems))
    for number in numbers:
        kind_of(number)
    return [int(number) for number in runner.chosen("problem", map(str, numbers), map(str, numbers))]


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    base = {record["number"]: record for record in records if record["method"] == str(UNCHANGED)}
    rows, paired = [], []
    for change in about["changes"]:
        own = [record for record in records if record["method"] == change]
        rows.append([change, *summary(own)])
        pairs = [(base[r["number"]], r) for r in own if r["success"] and base.get(r["number"], {}).get("success")]
        paired.append([change, str(len(pairs)), *(_ratio(pairs, field) for field in PAIRED)])
    head = ["setting", *SUMMARY]
    kinds = [["unchanged", kind, *summary([r for r in base.values() if r.get("kind") == kind])] for kind in KINDS]
    parts = [
        "# One setting changed at a time",
        f"{len(about['problems'])} problems, planning seed {about['seed']}, {allowed(about)} each. "
        "Success is the word of the independent validation; the first seed sufficed where the solver ran once. "
        "Times are those of all trials: of planning, and of the process's CPU for all of the call, with building symbolic "
        "programs. Rounds and iterations are means, efforts medians of successes.",
        markdown(head, rows),
        "## Against the unchanged planner",
        "Median (quartiles) of the ratio to the unchanged planner, over the problems at which both succeed.",
        markdown(["setting", "problems", *PAIRED.values()], paired),
        "## By kind of problem",
        markdown(["setting", "kind", *head[1:]], [row for row in kinds if row[2] != "0 of 0"], text=2),
        "## Every trial",
        every_trial(records),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def every_trial(records: Sequence[Record]) -> str:
    """Return a table of all trials: what, how it went, and what it took."""
    fields = ("planning_time", "cpu_time", "base_effort", "arm_effort", "objective")
    rows = []
    for r in records:
        numbers = (float("nan") if r.get(field) is None else float(r[field]) for field in fields)
        cells = [r.get("problem", ""), str(r.get("method", "")), str(r["seed"]), str(r["status"]), str(r.get("solves", ""))]
        rows.append([str(r["number"]), *cells, *map(decimal, numbers), r.get("failed_constraint") or ""])
    head = [
        "number",
        "problem",
        "setting",
        "seed",
        "status",
        "solves",
        "time [s]",
        "CPU [s]",
        "base [m]",
        "arm [rad]",
        "objective",
    ]
    return markdown([*head, "failed"], rows, text=5)


def summary(own: Sequence[Record]) -> list[str]:
    """Return what `SUMMARY` names, of some trials."""
    good = [record for record in own if record["success"]]
    first = sum(bool(record.get("first_seed")) for record in own)
    times = []
    for field in ("planning_time", "cpu_time"):
        median, late = distribution(own, field)
        times += [median, _mean(own, field), late]
    counts = [f"{_mean(own, field):.1f}" for field in ("rounds", "iterations")]
    efforts = [decimal(distribution(good, field)[0]) for field in ("base_effort", "arm_effort")]
    return [f"{len(good)} of {len(own)}", f"{first} of {len(own)}", *map(decimal, times), *counts, *efforts, failures(own)]


def _mean(records: Sequence[Record], field: str) -> float:
    found = values(records, field)
    return float(np.mean(found)) if found else float("nan")


def _ratio(pairs: Sequence[tuple[Record, Record]], field: str) -> str:
    """Return median and quartiles of a field's ratio; pairs that lack the field, or are zero before, are left out."""
    ratios = [float(new[field]) / float(old[field]) for old, new in pairs if old.get(field) and new.get(field) is not None]
    first, median, third = quartiles(ratios)
    return f"{median:.3f} ({first:.3f}–{third:.3f})" if ratios else "–"


_problem = functools.lru_cache(maxsize=2)(problem)  # settings take turns at it


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    own: Problem = _problem(spec["number"])
    change = UNCHANGED if spec["method"] == str(UNCHANGED) else parsed(spec["method"])
    more = {"number": own.number, "problem": own.name, "kind": own.kind}
    return trials.tried(own.scene, own.steps, seed=spec["seed"], change=change, **more)
