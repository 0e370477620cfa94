"""How much a motion depends on the random seed: the same problems, planned with several seeds."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS
from vkc_pin.benchmarks.harness.record import Record, values
from vkc_pin.benchmarks.harness.tables import foot, markdown, quartiles
from vkc_pin.benchmarks.problems import trials
from vkc_pin.benchmarks.problems.ablation import chosen, every_trial
from vkc_pin.benchmarks.problems.problem_set import problem
from vkc_pin.errors import InputError

__all__ = ["report", "run", "spread_of"]

FIELDS = {
    "objective": "objective",
    "base_path_length": "base path length",
    "arm_path_length": "arm path length",
}
"""What is compared: field → name."""
WITHIN = 0.1  # of the least: what counts as the same


def run(
    *,
    out: str | Path,
    seed: int = 0,
    jobs: int = 1,
    scheduler: str | None = None,
    seeds: int = 5,
    problems: Sequence[int] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        seed: The first seed of planning; the others follow it.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        seeds: How many seeds, at least 2.
        problems: Numbers of problems; None: all.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        InputError: Too few seeds, there is no such problem, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 2:
        raise InputError(
            "out of range", field="seeds", expected="a whole number of at least 2", got=repr(seeds)
        )
    numbers = chosen(problems)
    settings = {"benchmark": "spread", "seed": seed, "seeds": seeds, "problems": numbers, **LIMITS}
    specs = [
        {"key": f"{number:02d}/{own:04d}", "number": number, "seed": own}
        for number in numbers
        for own in range(seed, seed + seeds)
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


def spread_of(records: Sequence[Record], field: str) -> float | None:
    """Return the largest value of a field over the least, minus 1, of the successes; None for fewer than two, or a least of 0."""
    found = values([record for record in records if record["success"]], field)
    return max(found) / min(found) - 1.0 if len(found) > 1 and min(found) > 0.0 else None


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    groups = {number: [r for r in records if r["number"] == number] for number in about["problems"]}
    whole = {number: own for number, own in groups.items() if all(r["success"] for r in own)}
    summary = []
    for field, name in FIELDS.items():
        found = [spread for own in whole.values() if (spread := spread_of(own, field)) is not None]
        first, median, third = quartiles(found)
        late = float(np.percentile(found, 95)) if found else float("nan")
        same = sum(spread <= WITHIN for spread in found)
        texts = [
            f"{100.0 * value:.1f}"
            for value in (first, median, third, late, max(found, default=float("nan")))
        ]
        summary.append([name, f"{same} of {len(found)}", *texts])
    rows = []
    for number, own in groups.items():
        spreads = [spread_of(own, field) for field in FIELDS]
        good = f"{sum(bool(r['success']) for r in own)} of {len(own)}"
        names = next((r["problem"] for r in own if "problem" in r), "")
        seeds = "; ".join(
            dict.fromkeys(r["initialization"] for r in own if r.get("initialization"))
        )
        rows.append(
            [
                str(number),
                names,
                good,
                *("–" if s is None else f"{100.0 * s:.1f}" for s in spreads),
                seeds,
            ]
        )
    percent = [f"{name} [%]" for name in FIELDS.values()]
    parts = [
        "# Spread over random seeds",
        f"{len(groups)} problems, each planned with {about['seeds']} seeds from {about['seed']} on. Spread is the largest value "
        f"over the least, minus 1, of successes. The summary is over the {len(whole)} problems that succeed with every seed.",
        markdown(
            [
                "of",
                f"within {100 * WITHIN:.0f} %",
                "1st quartile [%]",
                "median",
                "3rd quartile",
                "95th",
                "most",
            ],
            summary,
        ),
        "## Every problem",
        markdown(["number", "problem", "success", *percent, "seed trajectories"], rows, text=2),
        "## Every trial",
        every_trial(records),
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


_problem = functools.lru_cache(maxsize=2)(problem)  # once for all seeds


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    own = _problem(spec["number"])
    more: dict[str, Any] = {"number": own.number, "problem": own.name, "kind": own.kind}
    return trials.tried(own.scene, own.steps, seed=spec["seed"], **more)
