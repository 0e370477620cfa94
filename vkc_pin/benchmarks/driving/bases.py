"""The door and the drawer with every kind of base that drives, from the same random starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.record import Record, distribution, trial
from vkc_pin.benchmarks.harness.tables import foot, markdown
from vkc_pin.errors import InputError
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate

__all__ = ["BASES", "TASKS", "TURNING_RADIUS", "report", "run", "started"]

TASKS = {"door": {"hinge": 1.2}, "drawer": {"slide": 0.35}}
"""Scene → what is opened how far: its object of the same name."""
TURNING_RADIUS = 0.8
"""[m] of bases that are steered. The Husky is not: the figure is ours, a little less than its length of 0.99 m."""
BASES: dict[str, dict[str, Any]] = {
    "omni": {},
    "differential": {},
    "ackermann": {"turning_radius": TURNING_RADIUS},
}
"""Kind of base → what else the scene says of the robot."""


def started(task: str, base: str, seed: int, number: int) -> Scene:
    """Return a scene with the base at a random place, the same for every kind of base.

    Args:
        task: One of `TASKS`.
        base: One of `BASES`.
        seed: Of the random numbers.
        number: Which start; it does not depend on how many there are.
    """
    scene = load_scene(task).sample_start(np.random.default_rng([seed, number]))
    robot = {**scene.document["robot"], "base": base, **BASES[base]}
    return Scene.from_document({**scene.document, "robot": robot}, scene.folder)


def run(
    *,
    out: str | Path,
    trials: int = 50,
    seed: int = 0,
    tasks: Sequence[str] | None = None,
    bases: Sequence[str] | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        trials: Number of random starts for each task and base, at least 1.
        seed: Of the starts and of planning.
        tasks: Some of `TASKS`; None: all.
        bases: Some of `BASES`; None: all.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        UnknownNameError: There is no such task or base.
        InputError: No trials, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if trials < 1:
        raise InputError("out of range", field="trials", expected="at least 1", got=trials)
    tasks = list(runner.chosen("task", TASKS if tasks is None else tasks, TASKS))
    bases = list(runner.chosen("base", BASES if bases is None else bases, BASES))
    settings = {
        "benchmark": "bases",
        "seed": seed,
        "starts": trials,
        "tasks": tasks,
        "bases": bases,
        "radius": TURNING_RADIUS,
    }
    specs = [
        {
            "key": f"{task}-{base}-{number:04d}",
            "task": task,
            "base": base,
            "number": number,
            "seed": seed,
        }
        for task in tasks
        for base in bases
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
    """Return the table of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    rows = [_row(task, base, records) for task in about["tasks"] for base in about["bases"]]
    failures = [
        f"- {r['task']}, {r['base']}, start {r['number']}: {r['status']}; {'; '.join(r['violations']) or 'no violation'}"
        for r in records
        if not r["success"]
    ]
    heads = [
        "task",
        "base",
        "success",
        "time, median [s]",
        "95th percentile [s]",
        "evaluations",
        "Ipopt iterations",
    ]
    parts = [
        "# Bases that drive",
        f"{about['starts']} random starts, seed {about['seed']}; bases that are steered turn on {about['radius']:g} m or more. "
        "Success is the word of the independent validation. Times are those of all trials, without building symbolic programs; "
        "efforts and lengths are medians, too.",
        markdown([*heads, "base [m]", "arm [rad]", "motion [s]"], rows),
        *(["\n".join(["Failures:", "", *failures])] if failures else []),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def _row(task: str, base: str, records: Sequence[Record]) -> list[str]:
    rows = [record for record in records if (record["task"], record["base"]) == (task, base)]
    good = [row for row in rows if row["success"]]
    time, late = distribution(rows, "planning_time")
    counts = [f"{distribution(rows, field)[0]:.0f}" for field in ("evaluations", "iterations")]
    lengths = [
        f"{distribution(good, field)[0]:.2f}"
        for field in ("base_path_length", "arm_path_length", "duration")
    ]
    return [
        task,
        base,
        f"{len(good)} of {len(rows)}",
        f"{time:.3f}",
        f"{late:.3f}",
        *counts,
        *lengths,
    ]


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    task, base, seed, number = (spec[field] for field in ("task", "base", "seed", "number"))
    found: Plan = plan(started(task, base, seed, number), [Actuate(task, TASKS[task])], seed=seed)
    if found.status == "interrupted":
        raise KeyboardInterrupt
    about = {"task": task, "base": base, "number": number, "duration": found.metrics["duration"]}
    return trial(found, method="VKC", seed=seed, **about)
