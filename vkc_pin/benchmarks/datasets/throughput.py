"""How many validated episodes an hour a machine makes of each task, of which share of attempts, and with how much memory."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness.record import Record, meta
from vkc_pin.benchmarks.harness.tables import decimal, foot, markdown, to_csv
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generate import generate
from vkc_pin.datasets.recipe import TASKS, Recipe, load_recipe
from vkc_pin.errors import InputError
from vkc_pin.files.writing import write_atomically
from vkc_pin.running.journal import Kept

__all__ = ["RECIPE", "record", "report", "run"]

RECIPE = "home"
"""Of the package: which robots, objects and rooms."""
_LEAST = 20  # attempts of a process that a slope is told of


def run(
    *,
    out: str | Path,
    episodes: int = 200,
    jobs: int = 1,
    recipe: str = RECIPE,
    scheduler: str | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Make datasets of one task each and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder. What it has of the same recipe already is not made again, and not timed.
        episodes: How many of each task, at least 1.
        jobs: Number of processes.
        recipe: Name or path of a recipe; its own tasks make no difference.
        scheduler: Address of a Dask scheduler; see `generate`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}: one record a task with `task`, `episodes_per_hour`, `attempts`, `successes`, `workers`,
        `memory_mb`, `memory_slope_mb` (growth of a process in a thousand attempts), `client_ms` (processor time an attempt of
        the process that feeds the others, writes down what comes and fills shards), `episodes_per_core_hour` and the medians of
        what attempts take.

    Raises:
        InputError: No episodes, or the recipe or `out` is wrong.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if episodes < 1:
        raise InputError("out of range", field="episodes", expected="at least 1", got=episodes)
    made, folder, records = load_recipe(recipe), Path(out), []
    for task in TASKS:
        own = load_recipe({**made.document, "tasks": [task]})
        records.append(_task(task, own, folder / task, episodes, jobs, scheduler, progress))
    about = meta(benchmark="throughput", recipe=made.digest, episodes=episodes, jobs=jobs, sessions=[])
    about |= {"peak_memory_mb": max(record["memory_mb"] for record in records)}
    result = {"meta": about, "trials": records}
    write_atomically(folder / "results.csv", to_csv(records).encode())
    write_atomically(folder / "results.json", (json.dumps(result, indent=1, allow_nan=False) + "\n").encode())
    write_atomically(folder / "table.md", report(result).encode())
    return result


def _task(
    task: str, recipe: Recipe, folder: Path, episodes: int, jobs: int, scheduler: str | None, progress: bool
) -> dict[str, Any]:
    """Make episodes of one task; return its record."""
    began = time.perf_counter()
    dataset = generate(recipe, episodes, folder, jobs=jobs, scheduler=scheduler, progress=progress)
    wall = time.perf_counter() - began
    return record(task, dataset, jobs, wall)


def record(task: str, dataset: Dataset, jobs: int, wall: float) -> dict[str, Any]:
    """Return what the journal of a dataset says of how fast it was made.

    Args:
        task: Which.
        dataset: The dataset.
        jobs: Processes of the last session.
        wall: Time of the call [s], with what starting processes and writing takes.
    """
    kept = Kept.read(dataset.folder / "journal.jsonl")
    attempts = [record for (record,) in kept.lines.values()]
    good = sum(bool(one["success"]) for one in attempts)
    worked = sum(float(one.get("cpu_time", 0.0)) for one in attempts)
    timed = {name: _median(attempts, name) for name in ("setup_time", "planning_time", "build_time", "seconds")}
    return {
        "task": task,
        "episodes_per_hour": round(3600.0 * good / kept.seconds, 1) if kept.seconds else 0.0,
        "episodes_per_core_hour": round(3600.0 * good / worked, 1) if worked else 0.0,
        "attempts": len(attempts),
        "successes": good,
        "success": good == len(attempts),
        "workers": jobs,
        "memory_mb": round(kept.memory, 1),
        "memory_slope_mb": _slope(kept.memories.values()),
        "client_ms": round(
            1000.0 * sum(session.get("client_seconds", 0.0) for session in kept.sessions) / max(1, len(attempts)), 2
        ),
        "wall_time": round(wall, 2),
        **{f"{name}_median": value for name, value in timed.items()},
        "robots": len({one["robot"] for one in attempts if "robot" in one}),
        "kinds": len({one["kind"] for one in attempts if "kind" in one}),
        "rooms": len({one["room"] for one in attempts if "room" in one}),
        "bytes_per_episode": _size(dataset),
    }


def _median(attempts: Sequence[Mapping[str, Any]], name: str) -> float:
    found = [float(one[name]) for one in attempts if one.get(name) is not None]
    return round(float(np.median(found)), 4) if found else 0.0


def _slope(memories: Iterable[Sequence[float]]) -> float | None:
    """Return by how much the memory of a process grows in a thousand attempts [MB], by least squares; None for few attempts.

    Args:
        memories: Of each process, after each of its attempts [MB]. The first half, in which caches fill, does not count; of
            several processes the one that grows most is told.
    """
    late = [np.asarray(one[len(one) // 2 :], float) for one in memories]
    slopes = [np.polyfit(np.arange(len(one)), one, 1)[0] for one in late if len(one) >= _LEAST]
    return round(1000.0 * float(max(slopes)), 2) if slopes else None


def _size(dataset: Dataset) -> int:
    """Return how much an episode takes on disk, its share of the scenes with it [bytes]."""
    files = [*dataset.shards, *(dataset.folder / "scenes").glob("*.json")]
    return round(sum(file.stat().st_size for file in files) / max(1, len(dataset.numbers())))


def report(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    head = [
        "task",
        "episodes an hour",
        "an hour of one core",
        "success of attempts",
        "workers",
        "memory [MB]",
        "growth [MB a thousand]",
        "client [ms]",
        "an attempt [s]",
        "setting up [s]",
        "planning [s]",
    ]
    parts = [
        "# Throughput",
        f"{about['episodes']} validated episodes of each task, with {about['jobs']} processes, recipe {about['recipe']}. "
        "The time counts from when the processes are there to the last attempt; an hour of one core is of processor "
        "time, without what else ran on the machine. Growth is that of a process in a thousand attempts, once half of its "
        "attempts have filled its caches; the client feeds the processes and writes down what comes, and takes so much "
        "processor time an attempt. Medians of an attempt, of what sets it up (room, start, grasp) and of planning it.",
        markdown(head, [_row(one) for one in records]),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def _row(one: Record) -> list[str]:
    times = (one["seconds_median"], one["setup_time_median"], one["planning_time_median"])
    rates = (f"{one['episodes_per_hour']:.0f}", f"{one['episodes_per_core_hour']:.0f}")
    share = f"{one['successes']} of {one['attempts']}"
    growth = "–" if one["memory_slope_mb"] is None else f"{one['memory_slope_mb']:.0f}"
    paid = (f"{one['memory_mb']:.0f}", growth, f"{one['client_ms']:.1f}")
    return [one["task"], *rates, share, str(one["workers"]), *paid, *map(decimal, times)]
