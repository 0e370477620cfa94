"""Measures validated episodes an hour, and simulates many workers from measured durations.

A discrete-event simulation of `utils.parallel`: every worker has one task in progress and one
queued; the single client handles results one after the other. The dataset ends with the last
of its first numbers; tasks beyond are wasted.
"""

from __future__ import annotations

import heapq
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.recipe import TASKS, load_recipe
from vkc_pin.errors import InputError
from vkc_pin.experiments.harness.record import Record, describe_environment, find_commit
from vkc_pin.experiments.harness.runner import check_folder
from vkc_pin.experiments.harness.tables import describe_run, format_decimal, format_table, to_csv
from vkc_pin.utils.journal import JournalContents
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.world.files.writing import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


WORKERS = (1, 2, 10, 100, 1000)
_AHEAD = 2  # tasks in hand or waiting at a worker, as the engine has them
_EACH = 100  # tasks of a worker, on average
_SEED = 0
RECIPE = "home"
"""Of the package: which robots, objects and rooms."""
_LEAST = 20  # attempts of a process from which a growth is computed


@dataclass(frozen=True)
class Costs:
    """Measured durations of tasks, each of which makes the episodes of a room.

    Attributes:
        first: CPU times of the first task of each process [s].
        later: CPU times of the other tasks [s].
        client: CPU time of the client per task, with Dask's scheduler if there is one [s].
        episodes: Average number of episodes per task.
    """

    first: tuple[float, ...]
    later: tuple[float, ...]
    client: float
    episodes: float

    @property
    def mean(self) -> float:
        """Average duration of a task [s]."""
        return float(np.mean(self.later or self.first))


def measure_costs(dataset: Dataset) -> Costs:
    """Return the costs in a dataset's journal."""
    kept = JournalContents.read(dataset.folder / "journal.jsonl")
    fields = dataset.recipe.fields
    size = fields.rooms.episodes * fields.variants
    tasks: dict[tuple[int, str], list[float]] = {}
    for key, (record,) in kept.lines.items():
        tasks.setdefault((int(key) // size, kept.processes.get(key, "")), []).append(
            float(record.get("cpu_time", 0.0))
        )
    first: list[float] = []
    later: list[float] = []
    known = set[str]()
    for (_, process), times in tasks.items():
        (later if process in known else first).append(sum(times))
        known.add(process)
    good = sum(bool(record["success"]) for (record,) in kept.lines.values())
    client = sum(float(session.get("client_seconds", 0.0)) for session in kept.sessions)
    return Costs(tuple(first), tuple(later), client / len(tasks), good / len(tasks))


def simulate_workers(costs: Costs, workers: int, tasks: int | None = None) -> dict[str, Any]:
    """Simulate a number of workers.

    Args:
        costs: Costs of tasks.
        workers: Number of workers.
        tasks: Number of tasks of the dataset. Default: 100 per worker.

    Returns:
        `workers`, `tasks`, `episodes_per_hour`, `efficiency` (share of the workers' time spent on
        the dataset), `client` (share of time in which it is busy) and `in_vain` (share of the
        workers' time spent on wasted tasks).
    """
    wanted = _EACH * workers if tasks is None else tasks
    rng = np.random.default_rng(_SEED)
    later = costs.later or costs.first
    half = costs.client / 2.0  # to send a task; the other half to take its result
    free = 0.0  # when the client is idle
    ready = [0.0] * workers  # when a worker is idle
    ended: list[tuple[float, int, int]] = []  # results sent to the client: time, task, worker
    spans: list[tuple[float, float]] = []  # of each task

    def send(worker: int) -> None:
        nonlocal free
        free += half
        task = len(spans)
        begins = max(ready[worker], free)
        drawn = costs.first if task < workers else later
        ready[worker] = begins + drawn[int(rng.integers(len(drawn)))]
        spans.append((begins, ready[worker]))
        heapq.heappush(ended, (ready[worker], task, worker))

    for _ in range(_AHEAD):
        for worker in range(workers):
            send(worker)
    left = wanted
    results = 0
    while True:
        moment, task, worker = heapq.heappop(ended)
        free = max(free, moment) + half
        results += 1
        left -= task < wanted
        if not left:
            break
        send(worker)
    all_time = workers * free
    needed, others = (
        sum(max(0.0, min(end, free) - begin) for begin, end in part)
        for part in (spans[:wanted], spans[wanted:])
    )
    return {
        "workers": workers,
        "tasks": wanted,
        "episodes_per_hour": round(3600.0 * wanted * costs.episodes / free, 1),
        "efficiency": round(needed / all_time, 4),
        "client": round(half * (len(spans) + results) / free, 4),
        "in_vain": round(others / all_time, 4),
    }


def run(
    *,
    out: str | Path,
    episodes: int = 200,
    jobs: int = 1,
    recipe: str = RECIPE,
    scheduler: str | None = None,
    curve: bool = True,
    progress: bool = True,
) -> dict[str, Any]:
    """Generate a dataset of each task and write results, table and chart to a folder.

    Args:
        out: Folder. Existing episodes of the same recipe are neither made nor timed again.
        episodes: Number of episodes per task, at least 1.
        jobs: Number of processes.
        recipe: Name or path of a recipe; its tasks are ignored.
        scheduler: Address of a Dask scheduler; see `generate`.
        curve: Whether one worker, and two if `jobs` is larger, make the same episodes as well.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": records by task, "curve": records by task and number of workers,
        "simulated": results of `simulate_workers`, with `saturated_at`: workers that saturate
        the client}.

    Raises:
        InputError: An argument is wrong, or `out` holds other files.
        KeyboardInterrupt: Ctrl-C was pressed; the same call resumes the run.
    """
    if episodes < 1:
        raise InputError("out of range", field="episodes", expected="at least 1", got=episodes)
    made = load_recipe(recipe)
    folder = Path(out)
    check_folder(folder, [f"{task}/journal.jsonl" for task in TASKS])
    counts = sorted(
        {*(count for count in (1, 2) if curve and scheduler is None and count < jobs), jobs}
    )
    records: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    many: list[dict[str, Any]] = []
    for task in TASKS:
        own = load_recipe({**made.document, "tasks": [task]})
        rates = dict[int, float]()
        for count in counts:
            where = folder / task if count == jobs else folder / f"{count}_workers" / task
            began = time.perf_counter()
            dataset = generate(
                own, episodes, where, jobs=count, scheduler=scheduler, progress=progress
            )
            found = record(
                task, dataset, None if scheduler is not None else count, time.perf_counter() - began
            )
            rates[count] = found["episodes_per_hour"]
            if count == jobs:
                records.append(found)
                many += _many(task, measure_costs(dataset))
        if len(rates) > 1:
            curves += [
                {
                    "task": task,
                    "workers": count,
                    "episodes_per_hour": rate,
                    "times": round(rate / rates[1], 3) if rates[1] else 0.0,
                }
                for count, rate in rates.items()
            ]
    session = {
        "jobs": jobs,
        "trials": sum(one["attempts"] for one in records),
        "seconds": sum(one["wall_time"] for one in records),
    }
    about = describe_environment(
        benchmark="throughput", recipe=made.digest, episodes=episodes, jobs=jobs, sessions=[session]
    )
    about |= {
        "peak_memory_mb": max(record["memory_mb"] for record in records),
        "scheduled": jobs > 1 or scheduler is not None,
    }
    result = {"meta": about, "trials": records, "curve": curves, "simulated": many}
    write_atomically(folder / "results.csv", to_csv(records).encode())
    write_atomically(
        folder / "results.json", (json.dumps(result, indent=1, allow_nan=False) + "\n").encode()
    )
    workers_chart(result, folder / "workers.png")
    write_atomically(folder / "table.md", format_results(result).encode())
    return result


def _many(task: str, costs: Costs) -> list[dict[str, Any]]:
    """Simulate a task with several numbers of workers."""
    full = round(costs.mean / costs.client, 1) if costs.client else None
    return [
        {"task": task, **simulate_workers(costs, count), "saturated_at": full} for count in WORKERS
    ]


def record(task: str, dataset: Dataset, jobs: int | None, wall: float) -> dict[str, Any]:
    """Return the generation statistics of a dataset.

    Args:
        task: Name of the task.
        dataset: Dataset.
        jobs: Number of processes; None for as many as the journal has.
        wall: Wall time of the call [s].
    """
    kept = JournalContents.read(dataset.folder / "journal.jsonl")
    attempts = [record for (record,) in kept.lines.values()]
    good = sum(bool(one["success"]) for one in attempts)
    worked = sum(float(one.get("cpu_time", 0.0)) for one in attempts)
    timed = {
        name: _median(attempts, name)
        for name in ("setup_time", "planning_time", "build_time", "seconds")
    }
    return {
        "task": task,
        "commit": find_commit(),
        "episodes_per_hour": round(3600.0 * good / kept.seconds, 1) if kept.seconds else 0.0,
        "episodes_per_core_hour": round(3600.0 * good / worked, 1) if worked else 0.0,
        "attempts": len(attempts),
        "successes": good,
        "success": good == len(attempts),
        "workers": len(kept.memories) if jobs is None else jobs,
        "memory_mb": round(kept.memory, 1),
        "memory_slope_mb": _slope(kept.memories.values()),
        "client_ms": round(
            1000.0
            * sum(session.get("client_seconds", 0.0) for session in kept.sessions)
            / max(1, len(attempts)),
            2,
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
    """Return the memory growth per 1000 attempts [MB], by least squares; None for few attempts.

    The first half, which fills caches, is ignored; the largest growth of any process counts.
    """
    late = [np.asarray(one[len(one) // 2 :], float) for one in memories]
    slopes = [np.polyfit(np.arange(len(one)), one, 1)[0] for one in late if len(one) >= _LEAST]
    return round(1000.0 * float(max(slopes)), 2) if slopes else None


def _size(dataset: Dataset) -> int:
    """Return the size of an episode on disk with its share of scenes [bytes]."""
    files = [*dataset.shards, *(dataset.folder / "scenes").glob("*.json")]
    return round(sum(file.stat().st_size for file in files) / max(1, len(dataset.numbers())))


def format_results(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    head = [
        "task",
        "episodes per hour",
        "per core and hour",
        "success of attempts",
        "workers",
        "memory [MB]",
        "growth [MB per 1000 attempts]",
        "client [ms]",
        "attempt [s]",
        "setup [s]",
        "planning [s]",
    ]
    parts = [
        "# Throughput",
        f"{about['episodes']} validated episodes per task, {about['jobs']} processes, recipe "
        f"{about['recipe']}. Episodes per hour count from the start of the processes to the last "
        "attempt; those per core and hour are of CPU time, without other processes. Growth is that "
        "of a process in the second half of its attempts. The client distributes tasks and writes "
        "results: its CPU time is per attempt. Medians of an attempt, its setup (room, start, "
        "grasp) and planning.",
        format_table(head, [_row(one) for one in records]),
        *_curve(result["curve"]),
        *_simulation(result["simulated"], bool(about["scheduled"])),
    ]
    return "\n\n".join([*parts, describe_run(about)]) + "\n"


def _row(one: Record) -> list[str]:
    times = (one["seconds_median"], one["setup_time_median"], one["planning_time_median"])
    rates = (f"{one['episodes_per_hour']:.0f}", f"{one['episodes_per_core_hour']:.0f}")
    share = f"{one['successes']} of {one['attempts']}"
    growth = "–" if one["memory_slope_mb"] is None else f"{one['memory_slope_mb']:.0f}"
    paid = (f"{one['memory_mb']:.0f}", growth, f"{one['client_ms']:.1f}")
    return [one["task"], *rates, share, str(one["workers"]), *paid, *map(format_decimal, times)]


def _curve(curve: Sequence[Record]) -> list[str]:
    """Return the table of measured numbers of workers."""
    if not curve:
        return []
    rows = [
        [
            one["task"],
            str(one["workers"]),
            f"{one['episodes_per_hour']:.0f}",
            format_decimal(one["times"]),
        ]
        for one in curve
    ]
    text = "The same episodes with fewer workers, in this run. "
    text += "A single worker is the client's own process, without Dask."
    return [text, format_table(["task", "workers", "episodes per hour", "speedup"], rows)]


def _simulation(many: Sequence[Record], scheduled: bool) -> list[str]:
    """Return the table of simulated numbers of workers."""
    head = [
        "task",
        "workers",
        "episodes per hour, simulated",
        "efficiency",
        "client busy",
        "discarded work",
        "client saturated at",
    ]
    rows = [
        [
            *(one["task"], str(one["workers"]), f"{one['episodes_per_hour']:.0f}"),
            *(f"{100.0 * one[name]:.0f} %" for name in ("efficiency", "client", "in_vain")),
            "–" if one["saturated_at"] is None else f"{one['saturated_at']:.0f} workers",
        ]
        for one in many
    ]
    text = (
        "Many workers, simulated from the durations of these tasks, with a hundred tasks per "
        "worker. Every result waits for the single client, whose CPU time "
        f"{'includes' if scheduled else 'excludes'} that of Dask's scheduler. Efficiency is the "
        "share of the workers' time spent on the dataset; discarded work was begun beyond its last "
        "number. Network and disks are not simulated."
    )
    return [text, format_table(head, rows), "![Efficiency of many workers, simulated](workers.png)"]


def workers_chart(result: Mapping[str, Any], path: str | Path | None) -> Figure:
    """Draw the simulated and measured efficiency against the number of workers."""
    with use_style():
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        for task, colour in zip(TASKS, COLOURS, strict=False):
            own = [one for one in result["simulated"] if one["task"] == task]
            axes.plot(
                [one["workers"] for one in own],
                [one["efficiency"] for one in own],
                "o-",
                color=colour,
                label=task,
            )
            seen = [one for one in result["curve"] if one["task"] == task]
            shares = [one["times"] / one["workers"] for one in seen]
            axes.plot([one["workers"] for one in seen], shares, "x", color=colour, markersize=9.0)
        axes.set_xscale("log")
        axes.set_xticks(WORKERS, [str(count) for count in WORKERS])
        axes.minorticks_off()
        axes.set_ylim(0.0, 1.1)
        axes.set_xlabel("workers")
        axes.set_ylabel("efficiency (crosses: measured)")
        axes.legend()
        return save_figure(figure, path)
