"""Changes one setting at a time, on sixty problems or random starts of tasks."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, distribution, values
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    compute_quartiles,
    count,
    count_failures,
    format_decimal,
    format_medians,
    format_table,
    join_sections,
    select,
)
from vkc_pin.experiments.tasks import TASKS

from . import trials
from .changes import UNCHANGED, Change, parse_change
from .problem_set import (
    KINDS,
    NUMBER,
    Problem,
    get_kind,
    make_task_problem,
    problem,
)

PAIRED = {
    "planning_time": "time",
    "cpu_time": "CPU",
    "base_path_length": "base",
    "arm_path_length": "arm",
    "objective": "objective",
}
"""Fields compared with the unchanged planner per problem → names."""
SUMMARY = (
    *("success", "first guess", "time, median [s]", "mean [s]", "95th percentile [s]"),
    *("CPU, median [s]", "mean [s]", "95th percentile [s]", "rounds", "iterations"),
    *("base [m]", "arm [rad]", "failures"),
)
"""Columns of `summary`."""
SUMMARIZED = (
    "First guess: trials in which no program needed a second initial guess. Times are those of "
    "all trials, CPU time with building symbolic programs. Rounds and iterations are means, path "
    "lengths medians of successes."
)
"""Description of `summary`."""


def specify(
    *,
    problems: Sequence[int],
    changes: Sequence[Change],
    seed: int,
    tasks: Sequence[str] = (),
    starts: int = 10,
) -> list[dict[str, Any]]:
    """Return the trials: all settings at each problem in turn, so that they meet the same load.

    With tasks, the problems are `starts` random starts of each.
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
            (f"{number:02d}", {"number": number, "kind": get_kind(number)}) for number in problems
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
    changes: Sequence[str] = (),
    problems: Sequence[int] | None = None,
    tasks: Sequence[str] = (),
    starts: int = 10,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        seed: Random seed of planning, and of the starts of tasks.
        changes: Changed settings; see `changes.parse_change`.
        problems: Numbers of problems. Default: all.
        tasks: Some of `TASKS`, from random starts, instead of the sixty problems.
        starts: Random starts per task, at least 1.
        **execution: See `Execution`; several jobs slow each other down.

    Returns:
        See `runner.run`; the `method` of a trial is its change.
    """
    if tasks and problems is not None:
        raise InputError(
            "only one of them counts",
            field="tasks",
            expected="no numbers of problems beside",
            got=problems,
        )
    runner.check_positive(starts=starts)
    names = runner.select_names("task", tasks, TASKS) if tasks else ()
    numbers = [] if tasks else select_problems(problems)
    chosen_changes = list(dict.fromkeys([UNCHANGED, *(parse_change(text) for text in changes)]))
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
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def select_problems(problems: Sequence[int] | None) -> list[int]:
    """Return distinct numbers of problems; all for None."""
    numbers = sorted(set(range(NUMBER) if problems is None else problems))
    for number in numbers:
        get_kind(number)
    return [
        int(number)
        for number in runner.select_names("problem", map(str, numbers), map(str, numbers))
    ]


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    base = {_which(record): record for record in select(records, method=str(UNCHANGED))}
    rows = []
    paired = []
    for change in about["changes"]:
        own = select(records, method=change)
        rows.append([change, *summary(own)])
        pairs = [(base.get(_which(r), {}), r) for r in own if r["success"]]
        pairs = [(old, new) for old, new in pairs if old.get("success")]
        paired.append([change, str(len(pairs)), *(_ratio(pairs, field) for field in PAIRED)])
    kinds = []
    for kind in about.get("tasks", KINDS):
        for change in about["changes"] if "tasks" in about else [str(UNCHANGED)]:
            if own := select(records, method=change, kind=kind):
                kinds.append([change, kind, *summary(own)])
    problems = f"{len(about.get('problems', ()))} problems"
    if "tasks" in about:
        problems = f"{about['starts']} random starts a task"
    return join_sections(
        about,
        "# One setting changed at a time",
        f"{problems}, planning seed {about['seed']}, {describe_limit(about)} each. {JUDGED} "
        f"{SUMMARIZED}",
        format_table(["setting", *SUMMARY], rows),
        "## Against the unchanged planner",
        "Median (quartiles) of the ratio to the unchanged planner, over the problems at which "
        "both succeed.",
        format_table(["setting", "problems", *PAIRED.values()], paired),
        "## By kind of problem",
        format_table(["setting", "kind", *SUMMARY], kinds, text=2),
        "## Every trial",
        tabulate_trials(records),
    )


def tabulate_trials(records: Sequence[Record]) -> str:
    """Tabulate all trials."""
    fields = ("planning_time", "cpu_time", "base_path_length", "arm_path_length", "objective")
    rows = []
    for r in records:
        numbers = (float("nan") if r.get(field) is None else float(r[field]) for field in fields)
        texts = [r["number"], *(r.get(f, "") for f in ("problem", "method", "seed", "status"))]
        cells = [str(text) for text in (*texts, r.get("solves", ""))]
        rows.append([*cells, *map(format_decimal, numbers), r.get("failed_constraint") or ""])
    head = ["number", "problem", "setting", "seed", "status", "solves", "time [s]", "CPU [s]"]
    return format_table([*head, "base [m]", "arm [rad]", "objective", "failed"], rows, text=5)


def summary(own: Sequence[Record]) -> list[str]:
    """Return the columns `SUMMARY` of trials."""
    times = []
    for field in ("planning_time", "cpu_time"):
        median, late = distribution(own, field)
        times += [median, _mean(own, field), late]
    means = [f"{_mean(own, field):.1f}" for field in ("rounds", "iterations")]
    lengths = format_medians(select(own, success=True), "base_path_length", "arm_path_length")
    first = count(own, "first_seed")
    return [count(own), first, *map(format_decimal, times), *means, *lengths, count_failures(own)]


def _which(record: Record) -> tuple[Any, ...]:
    """Return the key of a trial's problem."""
    return record.get("task"), record["number"]


def _mean(records: Sequence[Record], field: str) -> float:
    found = values(records, field)
    return float(np.mean(found)) if found else float("nan")


def _ratio(pairs: Sequence[tuple[Record, Record]], field: str) -> str:
    """Return median and quartiles of the ratio of a field, where it is defined."""
    ratios = [
        float(new[field]) / float(old[field])
        for old, new in pairs
        if old.get(field) and new.get(field) is not None
    ]
    first, median, third = compute_quartiles(ratios)
    return f"{median:.3f} ({first:.3f}–{third:.3f})" if ratios else "–"


@functools.lru_cache(maxsize=2)  # settings take turns at it
def _problem(task: str | None, seed: int, number: int) -> Problem:
    return problem(number) if task is None else make_task_problem(task, seed, number)


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    own = _problem(spec.get("task"), spec["seed"], spec["number"])
    change = UNCHANGED if spec["method"] == str(UNCHANGED) else parse_change(spec["method"])
    more = {"number": own.number, "problem": own.name, "kind": own.kind} | (
        {"task": spec["task"]} if "task" in spec else {}
    )
    return trials.run_trial(own.scene, own.steps, seed=spec["seed"], change=change, **more)
