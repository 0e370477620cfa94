"""Plans random problems and keeps the plans, to be judged by `tests/oracle`."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS, describe_limit
from vkc_pin.benchmarks.harness.record import distribution, trial
from vkc_pin.benchmarks.harness.runner import Execution
from vkc_pin.benchmarks.harness.tables import (
    JUDGED,
    format_decimal,
    format_table,
    join_sections,
    select,
)
from vkc_pin.benchmarks.problems.ablation import tabulate_trials
from vkc_pin.benchmarks.problems.drawn import sample_problem
from vkc_pin.benchmarks.problems.problem_set import Problem
from vkc_pin.planning.planner import plan
from vkc_pin.procedural.tasks import random_task
from vkc_pin.utils.arguments import check_choice
from vkc_pin.world.task.steps import Actuate, Grasp

__all__ = ["format_results", "run"]

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
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        problems: Number of problems, at least 1.
        seed: Random seed of problems and planning.
        of: "anything" for random steps, feasible or not; "rooms" for `random_task`.
    """
    runner.check_positive(problems=problems)
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
        specs, function, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about, records, rows = result["meta"], result["trials"], []
    statuses = sorted({record["status"] for record in records} - {"success"})
    for kind in (*sorted({record["kind"] for record in records if "kind" in record}), "all"):
        own = records if kind == "all" else select(records, kind=kind)
        counts = [str(len(select(own, status=status))) for status in ("success", *statuses)]
        times = map(format_decimal, distribution(own, "planning_time"))
        rows.append([kind, str(len(own)), *counts, *times])
    rooms = about["benchmark"] == "rooms"
    head = ["kind", "problems", "success", *statuses, "time, median [s]", "95th percentile [s]"]
    return join_sections(
        about,
        "# Random rooms, one task each" if rooms else "# Random problems",
        f"{about['problems']} problems, seed {about['seed']}, {describe_limit(about)} each. "
        f"{'' if rooms else 'Some of them are infeasible. '}{JUDGED}",
        format_table(head, rows),
        "## Every trial",
        tabulate_trials(records),
    )


def _in_a_room(seed: int, number: int) -> Problem:
    """Return a task in a random room, whose kind is that of the moved object."""
    scene, steps = random_task(seed * _ROOMS + number)
    name = steps[0].object if isinstance(steps[0], Actuate | Grasp) else ""
    kind = scene.objects[name].object.name
    return Problem(number, f"{scene.name}: {type(steps[0]).__name__} {name}", kind, scene, steps)


def _record(spec: dict[str, Any], *, folder: str) -> dict[str, Any]:
    number, seed = spec["number"], spec["seed"]
    own = sample_problem(seed, number) if spec["of"] == OF[0] else _in_a_room(seed, number)
    found = plan(own.scene, own.steps, seed=seed, **_LIMITS)
    if found.status != "interrupted":
        Path(folder).mkdir(parents=True, exist_ok=True)
        found.save(Path(folder) / f"{spec['key']}.npz")
    return trial(found, method="VKC", seed=seed, number=number, problem=own.name, kind=own.kind)
