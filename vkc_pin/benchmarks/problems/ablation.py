"""Problems that nothing was tuned on, or starts of the experiments' tasks, as planned and with one setting changed at a time."""

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
from vkc_pin.benchmarks.problems.problem_set import (
    KINDS,
    NUMBER,
    TASKS,
    Problem,
    kind_of,
    problem,
    problem_of_task,
)
from vkc_pin.errors import InputError

__all__ = ["SUMMARY", "every_trial", "report", "run", "specify", "summary"]

PAIRED = {
    "planning_time": "time",
    "cpu_time": "CPU",
    "base_path_length": "base",
    "arm_path_length": "arm",
    "objective": "objective",
}
"""What is compared with the unchanged planner, problem by problem: field → name."""
SUMMARY = (
    *("success", "first seed", "time, median [s]", "mean [s]", "95th percentile [s]"),
    *(
        "CPU, median [s]",
        "mean [s]",
        "95th percentile [s]",
        "rounds",
        "iterations",
        "base [m]",
        "arm [rad]",
        "failures",
    ),
)
"""Columns that sum up trials; see `summary`."""


def specify(
    *,
    problems: Sequence[int],
    changes: Sequence[Change],
    seed: int,
    tasks: Sequence[str] = (),
    starts: int = 10,
) -> list[dict[str, Any]]:
    """Return the trials: all settings take turns at a problem, so that they meet the same machine.

    With tasks, the problems are so many random starts of each, by the seed; otherwise those with
    these numbers.
    """
    if tasks:
        own = [
            (
                f"{list(TASKS).index(task):02d}/{number:04d}",
                {"task": task, "number": number, "kind": task},
            )
            for task in tasks
            for number in range(starts)
        ]
    else:
        own = [
            (f"{number:02d}", {"number": number, "kind": kind_of(number)}) for number in problems
        ]
    return [
        {"key": f"{key}/{setting:03d}", **what, "method": str(change), "seed": seed}
        for key, what in own
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
    tasks: Sequence[str] = (),
    starts: int = 10,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        seed: Of planning, and of the starts of tasks.
        jobs: Number of processes. Several slow each other down.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        changes: Settings to change, one at a time; see `changes.parsed`.
        problems: Numbers of problems; None: all.
        tasks: Some of `TASKS`, from random starts, instead of the sixty problems.
        starts: Random starts per task, at least 1.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}, each trial with its `kind` and the change as its `method`;
        see `runner.run`.

    Raises:
        UnknownNameError: There is no such field, module, constant or task.
        InputError: A change is none, there is no such problem, both problems and tasks are given,
            there are no starts, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if tasks and problems is not None:
        raise InputError(
            "only one of them counts",
            field="tasks",
            expected="no numbers of problems beside",
            got=problems,
        )
    if starts < 1:
        raise InputError("out of range", field="starts", expected="at least 1", got=starts)
    names = runner.chosen("task", tasks, TASKS) if tasks else ()
    numbers = [] if tasks else chosen(problems)
    chosen_changes = list(dict.fromkeys([UNCHANGED, *(parsed(text) for text in changes)]))
    what: dict[str, Any] = {"tasks": names, "starts": starts} if tasks else {"problems": numbers}
    settings = {
        "benchmark": "ablation",
        "seed": seed,
        **what,
        "changes": [str(change) for change in chosen_changes],
        **LIMITS,
    }
    specs = specify(problems=numbers, changes=chosen_changes, seed=seed, tasks=names, starts=starts)
    return runner.run(
        specs,
        _record,
        out,
        settings=settings,
        report=report,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
    )


def chosen(problems: Sequence[int] | None) -> list[int]:
    """Return numbers of problems without repetition; all for None. Raises `InputError` if there is no such problem."""
    numbers = sorted(set(range(NUMBER) if problems is None else problems))
    for number in numbers:
        kind_of(number)
    return [
        int(number) for number in runner.chosen("problem", map(str, numbers), map(str, numbers))
    ]


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    base = {_which(record): record for record in records if record["method"] == str(UNCHANGED)}
    rows, paired = [], []
    for change in about["changes"]:
        own = [record for record in records if record["method"] == change]
        rows.append([change, *summary(own)])
        pairs = [
            (base[_which(r)], r)
            for r in own
            if r["success"] and base.get(_which(r), {}).get("success")
        ]
        paired.append([change, str(len(pairs)), *(_ratio(pairs, field) for field in PAIRED)])
    head = ["setting", *SUMMARY]
    kinds = [
        [
            change,
            kind,
            *summary([r for r in records if (r["method"], r.get("kind")) == (change, kind)]),
        ]
        for kind in about.get("tasks", KINDS)
        for change in (about["changes"] if "tasks" in about else [str(UNCHANGED)])
    ]
    what = (
        f"{about['starts']} random starts a task"
        if "tasks" in about
        else f"{len(about['problems'])} problems"
    )
    parts = [
        "# One setting changed at a time",
        f"{what}, planning seed {about['seed']}, {allowed(about)} each. "
        "Success is the word of the independent validation; the first seed sufficed where the solver ran once. "
        "Times are those of all trials: of planning, and of the process's CPU for all of the call, with building symbolic "
        "programs. Rounds and iterations are means, efforts medians of successes.",
        markdown(head, rows),
        "## Against the unchanged planner",
        "Median (quartiles) of the ratio to the unchanged planner, over the problems at which both succeed.",
        markdown(["setting", "problems", *PAIRED.values()], paired),
        "## By kind of problem",
        markdown(
            ["setting", "kind", *head[1:]], [row for row in kinds if row[2] != "0 of 0"], text=2
        ),
        "## Every trial",
        every_trial(records),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def every_trial(records: Sequence[Record]) -> str:
    """Return a table of all trials: what, how it went, and what it took."""
    fields = ("planning_time", "cpu_time", "base_path_length", "arm_path_length", "objective")
    rows = []
    for r in records:
        numbers = (float("nan") if r.get(field) is None else float(r[field]) for field in fields)
        cells = [
            r.get("problem", ""),
            str(r.get("method", "")),
            str(r["seed"]),
            str(r["status"]),
            str(r.get("solves", "")),
        ]
        rows.append(
            [str(r["number"]), *cells, *map(decimal, numbers), r.get("failed_constraint") or ""]
        )
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
    efforts = [
        decimal(distribution(good, field)[0]) for field in ("base_path_length", "arm_path_length")
    ]
    return [
        f"{len(good)} of {len(own)}",
        f"{first} of {len(own)}",
        *map(decimal, times),
        *counts,
        *efforts,
        failures(own),
    ]


def _which(record: Record) -> tuple[Any, ...]:
    """Return what tells a trial's problem from others."""
    return record.get("task"), record["number"]


def _mean(records: Sequence[Record], field: str) -> float:
    found = values(records, field)
    return float(np.mean(found)) if found else float("nan")


def _ratio(pairs: Sequence[tuple[Record, Record]], field: str) -> str:
    """Return median and quartiles of a field's ratio; pairs that lack the field, or are zero before, are left out."""
    ratios = [
        float(new[field]) / float(old[field])
        for old, new in pairs
        if old.get(field) and new.get(field) is not None
    ]
    first, median, third = quartiles(ratios)
    return f"{median:.3f} ({first:.3f}–{third:.3f})" if ratios else "–"


@functools.lru_cache(maxsize=2)  # settings take turns at it
def _problem(task: str | None, seed: int, number: int) -> Problem:
    return problem(number) if task is None else problem_of_task(task, seed, number)


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    own = _problem(spec.get("task"), spec["seed"], spec["number"])
    change = UNCHANGED if spec["method"] == str(UNCHANGED) else parsed(spec["method"])
    more = {"number": own.number, "problem": own.name, "kind": own.kind} | (
        {"task": spec["task"]} if "task" in spec else {}
    )
    return trials.tried(own.scene, own.steps, seed=spec["seed"], change=change, **more)
