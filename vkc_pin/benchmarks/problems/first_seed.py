"""How often the first seed trajectory suffices, at the tasks of all experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS
from vkc_pin.benchmarks.harness.record import distribution
from vkc_pin.benchmarks.harness.tables import decimal, failures, foot, markdown, wilson
from vkc_pin.benchmarks.problems.ablation import every_trial
from vkc_pin.benchmarks.problems.problem_set import TASKS, problem_of_task
from vkc_pin.benchmarks.problems.trials import tried
from vkc_pin.errors import InputError

__all__ = ["report", "run"]


def run(
    *,
    out: str | Path,
    trials: int = 10,
    seed: int = 0,
    jobs: int = 1,
    scheduler: str | None = None,
    tasks: Sequence[str] = tuple(TASKS),
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        trials: Number of random starts per task, at least 1.
        seed: Of the starts and of planning.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        tasks: Some of `TASKS`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        UnknownNameError: There is no such task.
        InputError: No trials or tasks, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if trials < 1:
        raise InputError("out of range", field="trials", expected="at least 1", got=trials)
    names = runner.chosen("task", tasks, TASKS)
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
        specs,
        _record,
        out,
        settings=settings,
        report=report,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
    )


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records, rows = result["meta"], result["trials"], []
    for task in (*about["tasks"], "all"):
        own = [record for record in records if task in (record.get("task"), "all")]
        good, first = (
            sum(bool(record.get(field)) for record in own) for field in ("success", "first_seed")
        )
        low, high = wilson(first, len(own))
        interval = f"{100.0 * low:.0f}–{100.0 * high:.0f}"
        times = map(decimal, distribution(own, "planning_time"))
        rows.append(
            [
                task,
                f"{good} of {len(own)}",
                f"{first} of {len(own)}",
                interval,
                *times,
                failures(own),
            ]
        )
    head = [
        "task",
        "success",
        "with the first seed",
        "of all [%]",
        "time, median [s]",
        "95th percentile [s]",
        "failures",
    ]
    parts = [
        "# Success with the first seed",
        f"{about['starts']} random starts per task, seed {about['seed']}. Success is the word of the independent validation. The "
        "first seed sufficed where the solver ran once; beside it Wilson's interval of 95 % confidence.",
        markdown(head, rows),
        "## Every trial",
        every_trial(records),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    own = problem_of_task(spec["task"], spec["seed"], spec["number"])
    return tried(
        own.scene, own.steps, seed=spec["seed"], number=own.number, task=own.kind, problem=own.name
    )
