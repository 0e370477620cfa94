"""Tabulates comparisons of planning base and arm together and apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

from vkc_pin.baselines.separate import BASELINES
from vkc_pin.benchmarks.harness.limits import describe_limit
from vkc_pin.benchmarks.harness.record import Record, distribution, values
from vkc_pin.benchmarks.harness.tables import (
    EFFORTS,
    compute_mean_and_deviation,
    compute_wilson_interval,
    count_lower,
    count_timeouts,
    describe_run,
    find_common_successes,
    format_decimal,
    format_table,
)

__all__ = ["BUDGETS", "CRITERIA", "WAYPOINTS", "format_results", "select_compared_methods"]

WAYPOINTS = {f"{method}x{finer}": (method, finer) for finer in (1, 3) for method in BASELINES}
"""Baselines with other numbers of waypoints: name → method, multiple of VKC's number."""

CRITERIA = {
    **EFFORTS,
    "peak_velocity": "peak arm velocity [rad/s]",
    "peak_acceleration": "peak arm acceleration [rad/s²]",
    "duration": "duration [s]",
}
"""What motions are compared by: field → name."""
BUDGETS = {"1/10": 0.1, "1/3": 1 / 3, "2/3": 2 / 3, "whole budget": 1.0}
"""Name → share of the budget."""
_OWN = "VKC"


def select_compared_methods(methods: Sequence[str]) -> Sequence[str]:
    """Return the methods whose motions are compared; other numbers of waypoints only if alone."""
    return [method for method in methods if method not in WAYPOINTS] or methods


def format_results(
    result: Mapping[str, Any],
    tasks: Mapping[str, str],
    *,
    title: str,
    saved: Mapping[str, str] | None = None,
    pictures: Sequence[str] = (),
) -> str:
    """Return the tables of a result in Markdown.

    Args:
        result: Result of `Comparison.run`.
        tasks: Task → description.
        title: Title.
        saved: Key → file, of failures whose plans are saved.
        pictures: Pictures in Markdown.
    """
    about, records = result["meta"], result["trials"]
    methods = about["methods"]
    compared = select_compared_methods(methods)
    *first, last = (f"`{task}`: {name}" for task, name in tasks.items())
    parts = [
        f"# {title}",
        f"{', '.join(first)}{' and ' * bool(first)}{last}. {about['starts']} random "
        f"start{'s' * (about['starts'] != 1)} per task, the same for all methods; seed "
        f"{about['seed']}. Per "
        f"trial {describe_limit(about)}, in which the baselines try up to {about['retries']} "
        "times. "
        "Success is the result of the independent validation. Standard deviations are those of "
        "samples (n − 1).",
        "## Success",
        _success(records, tasks, methods),
        "## Planning time",
        "Without imports and symbolic build. The last column is the ratio of medians to VKC.",
        _times(records, tasks, methods),
        *_calls(records, tasks, methods),
        *_budgets(about, records, tasks, methods),
        "## Path lengths, peaks and durations where all methods succeed",
        "Mean ± standard deviation; median. Trials in which all methods succeed: "
        + _numbers(records, tasks, compared)
        + ".",
        _criteria(records, tasks, compared, shared=True),
        *_pairwise(records, tasks, methods),
        "## Path lengths, peaks and durations over each method's own successes",
        "Mean ± standard deviation; median. The methods succeed in different trials, so that "
        "harder trials count for some methods only.",
        _criteria(records, tasks, methods, shared=False),
        *pictures,
    ]
    if saved:
        parts += [
            "## Failures",
            "`vkc-pin view FILE` shows them, with violated clearances in red.",
            _list_failures(records, saved),
        ]
    return "\n\n".join([*parts, describe_run(about)]) + "\n"


def _success(records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]) -> str:
    rows = []
    for task, method in product([*tasks, "all"] if len(tasks) > 1 else tasks, methods):
        own = [
            record
            for record in records
            if record["method"] == method and task in ("all", record["scene"])
        ]
        good = sum(bool(record["success"]) for record in own)
        low, high = (f"{100.0 * end:.0f}" for end in compute_wilson_interval(good, len(own)))
        rate = f"{100.0 * good / len(own):.0f}" if own else "–"
        rows.append(
            [task, method, f"{good} of {len(own)}", rate, f"{low}–{high}", *count_timeouts(own)]
        )
    head = [
        "task",
        "method",
        "success",
        "[%]",
        "95 % interval (Wilson)",
        "timed out",
        "failures: cause (violated first)",
    ]
    return format_table(head, rows, text=2)


def _times(records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]) -> str:
    rows = []
    for name, good in (("all trials", False), ("successes", True)):
        for task, method in product(tasks, methods):
            own, reference = (
                _select_records(records, task, which, good=good) for which in (method, _OWN)
            )
            (median, late), times = distribution(own, "planning_time"), values(own, "planning_time")
            cells = (
                median,
                late,
                *compute_mean_and_deviation(times),
                median / distribution(reference, "planning_time")[0],
            )
            rows.append([name, task, method, str(len(times)), *map(format_decimal, cells)])
    head = [
        "over",
        "task",
        "method",
        "n",
        "median [s]",
        "95th percentile [s]",
        "mean [s]",
        "deviation [s]",
        f"ratio to {_OWN}",
    ]
    return format_table(head, rows, text=3)


def _calls(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Return a section on the time of whole calls, if it is recorded."""
    rows = []
    for task, method in product(tasks, methods):
        own = _select_records(records, task, method)
        if values(own, "wall_time"):
            first = [
                format_decimal(distribution(own, field)[0]) for field in ("cold_time", "warm_time")
            ]
            wall = [format_decimal(value) for value in distribution(own, "wall_time")]
            rows.append([task, method, str(len(values(own, "cold_time"))), *first, *wall])
    head = [
        "task",
        "method",
        "repeated calls",
        "cold, median [s]",
        "warm, median [s]",
        "all, median [s]",
        "95th percentile [s]",
    ]
    text = (
        "Wall-clock time of whole calls. The first trials of a task are planned twice by a planner "
        "with empty caches: cold, including construction of the symbolic programs and loading or "
        "compiling them, and warm. All: every trial, in order."
    )
    return ["## Wall-clock time of calls", text, format_table(head, rows, text=2)] if rows else []


def _budgets(
    about: Mapping[str, Any],
    records: Sequence[Record],
    tasks: Mapping[str, str],
    methods: Sequence[str],
) -> list[str]:
    """Return a section on successes with smaller budgets, if the budget was limited."""
    if "max_evaluations" not in about or not values(records, "evaluations"):
        return []
    shares = [(name, about["max_evaluations"] * share) for name, share in BUDGETS.items()]
    rows = []
    for task, method in product(tasks, methods):
        own = _select_records(records, task, method)
        good = values([record for record in own if record["success"]], "evaluations")
        within = [sum(count <= limit for count in good) for _, limit in shares]
        gain = 100.0 * (within[-1] - within[-2]) / max(len(own), 1)
        most = f"{max(good) / about['max_evaluations']:.3f}" if good else "–"
        rows.append(
            [task, method, *(f"{number} of {len(own)}" for number in within), f"{gain:.0f}", most]
        )
    head = [
        "task",
        "method",
        *(name for name, _ in shares),
        "gain from 2/3 [points]",
        "largest fraction used",
    ]
    text = (
        "Successes within fractions of the budget. The budget only ends planning, so that these "
        "are the successes with smaller budgets. The gain is that of half as much again, from 2/3 "
        "to the whole budget."
    )
    return ["## Success with smaller budgets", text, format_table(head, rows, text=2)]


def _numbers(records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]) -> str:
    """Return the number of trials of each task in which all methods succeed."""
    numbers = []
    for task in tasks:
        own = [record for record in records if record["scene"] == task]
        numbers.append(
            f"{len(find_common_successes(own, methods))} of "
            f"{len({record['number'] for record in own})} ({task})"
        )
    return ", ".join(numbers)


def _criteria(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str], *, shared: bool
) -> str:
    """Return all criteria over shared trials, or over each method's own successes."""
    rows = []
    for task in tasks:
        own = [record for record in records if record["scene"] == task]
        good = {method: _select_records(own, task, method, good=True) for method in methods}
        if shared:
            both = find_common_successes(own, methods)
            good = {method: [row[k] for row in both] for k, method in enumerate(methods)}
        if not shared:
            rows.append([task, "n", *(str(len(good[method])) for method in methods)])
        for field, name in CRITERIA.items():
            rows.append([task, name, *(_spread(good[method], field) for method in methods)])
    return format_table(["task", "criterion", *methods], rows, text=2)


def _pairwise(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Return a section that compares VKC with every other method."""
    others = [method for method in methods if method != _OWN]
    if _OWN not in methods or not others:
        return []
    rows = []
    for other in others:
        for task in tasks:
            both = find_common_successes(
                [record for record in records if record["scene"] == task], (_OWN, other)
            )
            for field, name in {**CRITERIA, "planning_time": "planning time [s]"}.items():
                medians = (
                    format_decimal(distribution([row[k] for row in both], field)[0]) for k in (0, 1)
                )
                rows.append(
                    [task, name, other, *medians, f"{count_lower(both, field)} of {len(both)}"]
                )
    head = ["task", "criterion", "other", f"{_OWN}, median", "other, median", f"lower with {_OWN}"]
    text = f"Over the trials in which {_OWN} and the other method succeed."
    return [f"## {_OWN} against each baseline", text, format_table(head, rows, text=3)]


def _list_failures(records: Sequence[Record], saved: Mapping[str, str]) -> str:
    rows = []
    for record in records:
        if record["key"] in saved:
            violated = record["violations"][0] if record["violations"] else "–"
            cells = [
                record["scene"],
                record["number"],
                record["method"],
                record["status"],
                violated,
                f"`{saved[record['key']]}`",
            ]
            rows.append([str(cell) for cell in cells])
    return format_table(
        ["task", "trial", "method", "cause", "violated first", "file"], rows, text=6
    )


def _select_records(
    records: Sequence[Record], task: str, method: str, *, good: bool = False
) -> list[Record]:
    """Return the records of a task and method, or its successes."""
    own = (record for record in records if (record["scene"], record["method"]) == (task, method))
    return [record for record in own if record["success"] or not good]


def _spread(records: Sequence[Record], field: str) -> str:
    found = values(records, field)
    mean, deviation = map(format_decimal, compute_mean_and_deviation(found))
    return (
        f"{mean} ± {deviation}; {format_decimal(distribution(records, field)[0])}" if found else "–"
    )
