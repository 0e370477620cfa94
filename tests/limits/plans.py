"""Plans the tasks of all experiments and of random rooms, and exports the motions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import vkc_pin as vkc
from tests.benchmarks.problems.problem_set import NUMBER, problem
from vkc_pin.experiments.tasks import TASKS, make_start

__all__ = ["export_plans"]

_ROOMS = NUMBER - 20  # number of problems in random rooms


def export_plans(folder: Path, count: int, *, first: int = 0, seed: int = 0) -> Iterator[Path]:
    """Plan problems, export tables, and yield the .npz of each success; existing files are reused.

    Args:
        folder: Folder of the exported files.
        count: Number of problems.
        first: Number of the first problem. Every fourth problem is in a random room, until the
            rooms run out.
        seed: Random seed of the starts and of planning.
    """
    rooms = range(_ROOMS)
    for number in range(first, first + count):
        file = folder / f"{seed}_{number:04d}.npz"
        if not file.is_file():
            if number % 4 == 3 and number // 4 in rooms:
                chosen = problem(number // 4)
                scene, steps = chosen.scene, chosen.steps
            else:
                name = list(TASKS)[number % len(TASKS)]
                scene, steps = make_start(name, seed, number), TASKS[name].steps
            plan = vkc.plan(scene, steps, seed=seed, max_evaluations=1_000_000)
            if not plan.success:
                continue
            plan.to_csv(file.with_suffix(".csv"))
            plan.save(file)
        yield file
