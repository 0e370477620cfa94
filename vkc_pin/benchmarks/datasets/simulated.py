"""Simulates many workers of dataset generation from measured task durations.

A discrete-event simulation of `utils.parallel.engine`: every worker has one task in progress and
one queued; the single client handles results one after the other. The dataset ends with the last
of its first numbers; tasks beyond are wasted.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Any

import numpy as np

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.utils.parallel.journal import JournalContents

__all__ = ["WORKERS", "Costs", "measure_costs", "simulate_workers"]

WORKERS = (1, 2, 10, 100, 1000)
_AHEAD = 2  # tasks in hand or waiting at a worker, as the engine has them
_EACH = 100  # tasks of a worker, on average
_SEED = 0


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
        task, begins = len(spans), max(ready[worker], free)
        drawn = costs.first if task < workers else later
        ready[worker] = begins + drawn[int(rng.integers(len(drawn)))]
        spans.append((begins, ready[worker]))
        heapq.heappush(ended, (ready[worker], task, worker))

    for _ in range(_AHEAD):
        for worker in range(workers):
            send(worker)
    left, results = wanted, 0
    while True:
        moment, task, worker = heapq.heappop(ended)
        free, results, left = max(free, moment) + half, results + 1, left - (task < wanted)
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
