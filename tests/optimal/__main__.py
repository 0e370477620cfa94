"""Prints a table of plan durations and of the least durations along the same paths.

Usage: python -m tests.optimal --starts N --json FILE
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import vkc_pin as vkc
from vkc_pin.experiments.execution import TASKS
from vkc_pin.experiments.harness.record import find_commit
from vkc_pin.experiments.harness.tables import describe_run
from vkc_pin.experiments.tasks import TASKS as ALL_TASKS
from vkc_pin.experiments.tasks import make_start
from vkc_pin.utils.system import describe_machine, find_versions, measure_peak_memory

from .bound import compute_bound

TASK_NAMES = tuple(
    dict.fromkeys([*TASKS, *(name for name in ALL_TASKS if name.startswith("household"))])
)
"""Tasks of `bench execution` and of the household."""


def format_table(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table with one line per task."""
    lines = [
        "| task | plans | duration [s] | least along its path [s] | worst ratio | bounded by "
        "torques |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for task in dict.fromkeys(row["task"] for row in rows):
        own = [row for row in rows if row["task"] == task]
        duration, least = (
            sum(row[field] for row in own) / len(own) for field in ("duration", "least")
        )
        worst = max(row["duration"] / row["least"] for row in own)
        torque_bound = sum(row["heavy"] > 0 for row in own)
        lines.append(
            f"| {task} | {len(own)} | {duration:.2f} | {least:.2f} | {worst:.3f} | {torque_bound} |"
        )
    return "\n".join(lines) + "\n"


def format_results(result: Mapping[str, Any]) -> str:
    """Return the Markdown table of a record, with versions and machine below."""
    return format_table(result["trials"]) + "\n" + describe_run(result["meta"]) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Plan and compare; return 1 if a duration exceeds 1.15 times its least value."""
    parser = argparse.ArgumentParser(prog="python -m tests.optimal", description=__doc__)
    parser.add_argument("--starts", type=int, default=5, help="random starts per task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tasks", nargs="+", default=TASK_NAMES, choices=TASK_NAMES)
    parser.add_argument("--json", type=Path, help="file for the results of each plan")
    options = parser.parse_args(arguments)
    rows, start_time, machine = list[dict[str, Any]](), time.perf_counter(), describe_machine()
    for name in options.tasks:
        for number in range(options.starts):
            scene = make_start(name, options.seed, number)
            plan = vkc.plan(
                scene, ALL_TASKS[name].steps, seed=options.seed, max_evaluations=1_000_000
            )
            if plan.success:
                least, torque_bound = compute_bound(plan.scene, plan.trajectory)
                duration = float(plan.trajectory.times[-1])
                row = {
                    "task": name,
                    "number": number,
                    "duration": duration,
                    "least": least,
                    "heavy": torque_bound,
                }
                rows.append({**row, "commit": find_commit()})
    if options.json is not None:
        session = {
            "jobs": 1,
            "trials": len(rows),
            "seconds": round(time.perf_counter() - start_time, 1),
        }
        meta = {
            "versions": find_versions(),
            "machine": machine,
            "seed": options.seed,
            "starts": options.starts,
            "sessions": [session],
        }
        meta["peak_memory_mb"] = round(measure_peak_memory(), 1)
        options.json.write_text(
            json.dumps({"meta": meta, "trials": rows}, indent=1) + "\n", encoding="utf-8"
        )
    sys.stdout.write(format_table(rows))
    return int(any(row["duration"] > 1.15 * row["least"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
