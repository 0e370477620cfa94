"""Counts how often the first initial guess suffices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import distribution
from vkc_pin.experiments.harness.runner import LIMITS, Execution
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    compute_wilson_interval,
    count,
    count_failures,
    format_decimal,
    format_table,
    join_sections,
    select,
)
from vkc_pin.experiments.tasks import TASKS

from .ablation import tabulate_trials
from .problem_set import make_task_problem
from .trials import run_trial


def run(
    *,
    out: str | Path,
    trials: int = 10,
    seed: int = 0,
    tasks: Sequence[str] = tuple(TASKS),
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        trials: Number of random starts per task, at least 1.
        seed: Random seed of starts and planning.
        tasks: Some of `TASKS`.
    """
    runner.check_positive(trials=trials)
    names = runner.select_names("task", tasks, TASKS)
    settings = {"benchmark": "first-seed", "seed": seed, "starts": trials, "tasks": names, **LIMITS}
    specs = [
        {
            "key": f"{list(TASKS).index(name):02d}/{number:04d}",
            "task": name,
            "number": number,
            "seed": seed,
        }
        for name in names
        for number in range(trials)
    ]
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    rows = []
    for task in (*about["tasks"], "all"):
        own = records if task == "all" else select(records, task=task)
        first = sum(bool(record.get("first_seed")) for record in own)
        low, high = compute_wilson_interval(first, len(own))
        interval = f"{100.0 * low:.0f}–{100.0 * high:.0f}"
        times = map(format_decimal, distribution(own, "planning_time"))
        rows.append(
            [task, count(own), count(own, "first_seed"), interval, *times, count_failures(own)]
        )
    head = ["task", "success", "first guess only", "of all [%]", "time, median [s]"]
    return join_sections(
        about,
        "# Success with the first initial guess",
        f"{about['starts']} random starts per task, seed {about['seed']}. {JUDGED} The first "
        "guess sufficed if no program needed another; its interval is Wilson's of 95 % confidence.",
        format_table([*head, "95th percentile [s]", "failures"], rows),
        "## Every trial",
        tabulate_trials(records),
    )


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    own = make_task_problem(spec["task"], spec["seed"], spec["number"])
    return run_trial(
        own.scene, own.steps, seed=spec["seed"], number=own.number, task=own.kind, problem=own.name
    )
