"""Problems drawn at random, each planned once and its plan kept: is what a plan says of itself right?

Whoever judges that judges the saved plans; `tests/oracle` does, which is not part of the package.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS, allowed
from vkc_pin.benchmarks.harness.record import Record, distribution, trial
from vkc_pin.benchmarks.harness.tables import decimal, foot, markdown
from vkc_pin.benchmarks.problems.ablation import every_trial
from vkc_pin.benchmarks.problems.drawn import drawn
from vkc_pin.benchmarks.problems.problem_set import Problem
from vkc_pin.errors import InputError
from vkc_pin.planning.planner import plan
from vkc_pin.procedural.tasks import random_task
from vkc_pin.utils.arguments import check_choice
from vkc_pin.world.task.steps import Actuate, Grasp

__all__ = ["report", "run"]

_ROOMS = 100_000  # of one seed
_LIMITS = {
    **LIMITS,
    "max_evaluations": LIMITS["max_evaluations"] // 10,
}  # many of them cannot be done; those that can take up to 60 000
OF = ("anything", "rooms")


def run(
    *,
    out: str | Path,
    problems: int = 100,
    seed: int = 0,
    of: str = "anything",
    jobs: int = 1,
    scheduler: str | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv, table.md and plans/*.npz to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        problems: How many, at least 1.
        seed: Of the problems and of planning.
        of: "anything" for steps at random, possible or not; "rooms" for `random_task`: something to
            open in a random room.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        InputError: No problems, nothing that they can be of, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if problems < 1:
        raise InputError("out of range", field="problems", expected="at least 1", got=problems)
    check_choice(of, OF, "set of problems", "of")
    settings = {
        "benchmark": "random" if of == OF[0] else of,
        "seed": seed,
        "problems": problems,
        **_LIMITS,
    }
    specs = [
        {"key": f"{number:05d}", "number": number, "seed": seed, "of": of}
        for number in range(problems)
    ]
    function = functools.partial(_record, folder=str(Path(out) / "plans"))
    return runner.run(
        specs,
        function,
        out,
        settings=settings,
        report=report,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
    )


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    statuses = sorted({record["status"] for record in records} - {"success"})
    rows = []
    for kind in (*sorted({record["kind"] for record in records if "kind" in record}), "all"):
        own = [record for record in records if kind in (record.get("kind"), "all")]
        counts = [str(_count(own, status)) for status in statuses]
        times = map(decimal, distribution(own, "planning_time"))
        rows.append([kind, str(len(own)), str(_count(own, "success")), *counts, *times])
    title, possible = "# Random problems", "Not all of them can be done. "
    if about["benchmark"] == "rooms":
        title, possible = "# Random rooms, one task each", ""
    parts = [
        title,
        f"{about['problems']} problems, seed {about['seed']}, {allowed(about)} each. {possible}"
        "Success is the word of the independent validation.",
        markdown(
            ["kind", "problems", "success", *statuses, "time, median [s]", "95th percentile [s]"],
            rows,
        ),
        "## Every trial",
        every_trial(records),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def _in_a_room(seed: int, number: int) -> Problem:
    """Return a task in a random room; with seed 0 the room has the problem's number. It is of the kind of what is moved."""
    scene, steps = random_task(seed * _ROOMS + number)
    name = steps[0].object if isinstance(steps[0], Actuate | Grasp) else ""
    kind = scene.objects[name].object.name
    return Problem(number, f"{scene.name}: {type(steps[0]).__name__} {name}", kind, scene, steps)


def _count(records: list[Record], status: str) -> int:
    return sum(record["status"] == status for record in records)


def _record(spec: dict[str, Any], *, folder: str) -> dict[str, Any]:
    number, seed = spec["number"], spec["seed"]
    own = drawn(seed, number) if spec["of"] == OF[0] else _in_a_room(seed, number)
    found = plan(own.scene, own.steps, seed=seed, **_LIMITS)
    if found.status != "interrupted":
        Path(folder).mkdir(parents=True, exist_ok=True)
        found.save(Path(folder) / f"{spec['key']}.npz")
    return trial(found, method="VKC", seed=seed, number=number, problem=own.name, kind=own.kind)
