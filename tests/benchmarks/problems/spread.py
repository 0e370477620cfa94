"""Measures how much motions depend on the random seed."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, values
from vkc_pin.experiments.harness.runner import LIMITS, Execution
from vkc_pin.experiments.harness.tables import (
    compute_quartiles,
    count,
    format_table,
    join_sections,
    select,
)

from . import trials
from .ablation import select_problems, tabulate_trials
from .problem_set import problem

FIELDS = {
    "objective": "objective",
    "base_path_length": "base path length",
    "arm_path_length": "arm path length",
}
"""Compared fields → names."""
WITHIN = 0.1  # of the least: what counts as the same


def run(
    *,
    out: str | Path,
    seed: int = 0,
    seeds: int = 5,
    problems: Sequence[int] | None = None,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        seed: First random seed of planning.
        seeds: Number of consecutive seeds, at least 2.
        problems: Numbers of problems. Default: all.
    """
    if isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 2:
        raise InputError(
            "out of range", field="seeds", expected="a whole number of at least 2", got=repr(seeds)
        )
    numbers = select_problems(problems)
    settings = {"benchmark": "spread", "seed": seed, "seeds": seeds, "problems": numbers, **LIMITS}
    specs = [
        {"key": f"{number:02d}/{own:04d}", "number": number, "seed": own}
        for number in numbers
        for own in range(seed, seed + seeds)
    ]
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def compute_spread(records: Sequence[Record], field: str) -> float | None:
    """Return the ratio of largest to least value of successes, minus 1, if it is defined."""
    found = values([record for record in records if record["success"]], field)
    return max(found) / min(found) - 1.0 if len(found) > 1 and min(found) > 0.0 else None


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    groups = {number: select(records, number=number) for number in about["problems"]}
    whole = [own for own in groups.values() if all(r["success"] for r in own)]
    summary = []
    rows = []
    for field, name in FIELDS.items():
        found = [spread for own in whole if (spread := compute_spread(own, field)) is not None]
        late = float(np.percentile(found, 95)) if found else float("nan")
        figures = (*compute_quartiles(found), late, max(found, default=float("nan")))
        same = sum(spread <= WITHIN for spread in found)
        cells = [f"{100.0 * value:.1f}" for value in figures]
        summary.append([name, f"{same} of {len(found)}", *cells])
    for number, own in groups.items():
        spreads = [compute_spread(own, field) for field in FIELDS]
        cells = ["–" if spread is None else f"{100.0 * spread:.1f}" for spread in spreads]
        name = next((r["problem"] for r in own if "problem" in r), "")
        guesses = dict.fromkeys(r["initialization"] for r in own if r.get("initialization"))
        rows.append([str(number), name, count(own), *cells, "; ".join(guesses)])
    within = f"within {100 * WITHIN:.0f} %"
    columns = [
        "of",
        within,
        "1st quartile [%]",
        "median",
        "3rd quartile",
        "95th percentile",
        "largest",
    ]
    percent = [f"{name} [%]" for name in FIELDS.values()]
    return join_sections(
        about,
        "# Spread over random seeds",
        f"{len(groups)} problems, each planned with {about['seeds']} seeds from {about['seed']} "
        "on. Spread is the largest value over the least, minus 1, of successes. The summary is "
        f"over the {len(whole)} problems that succeed with every seed.",
        format_table(columns, summary),
        "## Every problem",
        format_table(["number", "problem", "success", *percent, "initial guesses"], rows, text=2),
        "## Every trial",
        tabulate_trials(records),
    )


_problem = functools.lru_cache(maxsize=2)(problem)  # once for all seeds


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    own = _problem(spec["number"])
    more: dict[str, Any] = {"number": own.number, "problem": own.name, "kind": own.kind}
    return trials.run_trial(own.scene, own.steps, seed=spec["seed"], **more)
