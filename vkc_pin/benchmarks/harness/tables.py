"""Results of experiments as CSV and as tables in Markdown."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness.record import Record, distribution

__all__ = [
    "EFFORTS",
    "TIMES",
    "common",
    "comparison_table",
    "decimal",
    "failures",
    "foot",
    "lower",
    "markdown",
    "mean_and_deviation",
    "methods_table",
    "quartiles",
    "timed_out",
    "to_csv",
    "wilson",
]

EFFORTS = {
    "base_path_length": "base [m]",
    "base_path_length_l1": "base |dx|+|dy| [m]",
    "arm_path_length": "arm [rad]",
}
"""What motions are compared by: field → name."""
TIMES = {
    "time_initialization": "seeds",
    "time_coal": "coal",
    "time_casadi": "CasADi",
    "time_ipopt": "Ipopt",
    "time_validation": "validation",
}
"""What planning time is spent on: field → name. The rest is setting up the problem, and retiming."""
_LEAST = 1e-6  # in any unit, by which a value must be less to be called lower


def to_csv(records: Sequence[Record]) -> str:
    """Return records as CSV, one a row, with a column for every field of any of them; what is no text is written as in JSON."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    columns = list(dict.fromkeys(field for record in records for field in record))
    writer.writerow(columns)
    for values in ([record.get(column) for column in columns] for record in records):
        texts = [
            json.dumps(value, ensure_ascii=False) if value is not None else "" for value in values
        ]
        writer.writerow(
            [
                value if isinstance(value, str) else text
                for value, text in zip(values, texts, strict=True)
            ]
        )
    return stream.getvalue()


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]], *, text: int = 1) -> str:
    """Return a table in Markdown; the first `text` columns are aligned left, the others right."""
    rule = ["---" if column < text else "---:" for column in range(len(head))]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |"
        for row in (head, rule, *rows)
    )


def wilson(good: int, number: int) -> tuple[float, float]:
    """Return Wilson's interval of a success rate, with 95 % confidence; (0, 1) for no trials."""
    if number == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest

    interval = binomtest(good, number).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return first quartile, median and third quartile; NaN for no values."""
    first, median, third = (
        np.percentile(values, (25, 50, 75)) if len(values) else (np.nan, np.nan, np.nan)
    )
    return float(first), float(median), float(third)


def decimal(value: float) -> str:
    """Return a number with two decimals, and a dash for what is none."""
    return f"{value:.2f}" if np.isfinite(value) else "–"


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean and the standard deviation of a sample (n − 1); NaN where there are too few values."""
    mean = float(np.mean(values)) if len(values) else float("nan")
    return mean, float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def failures(records: Iterable[Record]) -> str:
    """Return the kinds of failures with their numbers, most frequent first: status, and the kind of constraint violated first."""
    kinds: Counter[str] = Counter()
    for record in records:
        if not record["success"]:
            status, blame = str(record["status"]), str(record.get("failed_constraint") or "")
            kinds[status if blame in ("", status) else f"{status} ({blame.split()[0]})"] += 1
    return (
        ", ".join(
            f"{kind} {count}"
            for kind, count in sorted(kinds.items(), key=lambda item: (-item[1], item[0]))
        )
        or "none"
    )


def timed_out(records: Iterable[Record]) -> list[str]:
    """Return how many trials the clock ended, of which nobody knows whether the method fails, and the failures of all others."""
    records = list(records)
    others = [record for record in records if record["status"] != "time limit"]
    return [str(len(records) - len(others)), failures(others)]


def methods_table(
    records: Sequence[Record], scenes: Mapping[str, str], methods: Sequence[str]
) -> str:
    """Return successes, planning times, efforts and failures per scene and method, and over all scenes if there are several.

    Planning times are those of all trials, but for errors, which have none; efforts are those of
    successes.

    Args:
        records: Records as `record.trial` makes them.
        scenes: Scene → name to show.
        methods: The methods in the order of the rows; those without trials in a scene are left out
            there.
    """
    rows = []
    for name, chosen in _groups(records, scenes):
        for method in methods:
            own = [record for record in chosen if record["method"] == method]
            if not own:
                continue
            good = [record for record in own if record["success"]]
            time, late = distribution(own, "planning_time")
            efforts = (
                decimal(distribution(good, field)[0])
                for field in ("base_path_length", "arm_path_length")
            )
            times = (decimal(time), decimal(late))
            rows.append(
                [name, method, f"{len(good)} of {len(own)}", *times, *efforts, *timed_out(own)]
            )
    head = [
        "scene",
        "method",
        "success",
        "time, median [s]",
        "95th percentile [s]",
        "base [m]",
        "arm [rad]",
        "timed out",
        "failures",
    ]
    return markdown(head, rows, text=2)


def common(records: Iterable[Record], methods: Sequence[str]) -> list[tuple[Record, ...]]:
    """Return the records of several methods at the same scene, start and repeat, where all of them have a success."""
    found: dict[str, dict[tuple[Any, ...], Record]] = {method: {} for method in methods}
    for record in records:
        if record["success"] and record["method"] in found:
            found[record["method"]][
                (record["scene"], record["number"], record.get("repeat", 0))
            ] = record
    places = [
        place for place in found[methods[0]] if all(place in found[method] for method in methods)
    ]
    return [tuple(found[method][place] for method in methods) for place in places]


def lower(pairs: Sequence[tuple[Record, ...]], field: str) -> int:
    """Return in how many of the pairs the first record's value is lower than the second's, by more than rounding."""
    return sum(float(one[field]) < float(other[field]) - _LEAST for one, other in pairs)


def comparison_table(
    records: Sequence[Record],
    scenes: Mapping[str, str],
    methods: tuple[str, str],
    names: tuple[str, str],
) -> str:
    """Return the efforts of two methods where both succeed, per scene, and over all scenes if there are several.

    Args:
        records: Records as `record.trial` makes them, with `number` (of the start) and `repeat`.
        scenes: Scene → name to show.
        methods: The two methods.
        names: Their names to show.
    """
    rows = []
    for name, chosen in _groups(records, scenes):
        both = common(chosen, methods)
        for field, shown in EFFORTS.items():
            one, other = ([float(pair[k][field]) for pair in both] for k in (0, 1))
            rows.append(
                [name, shown, _spread(one), _spread(other), f"{lower(both, field)} of {len(both)}"]
            )
    head = [
        "scene",
        "evaluations",
        *(f"{name}: median (quartiles)" for name in names),
        f"lower with {names[0]}",
    ]
    return markdown(head, rows, text=2)


def foot(about: Mapping[str, Any]) -> str:
    """Return in sentences on what machine and with which versions the results with the "meta" `about` were measured."""
    machine, versions = about["machine"], {**about["versions"]}
    sources = versions.pop("sources", None)
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    text = f"{machine['cores']} cores of {machine['processor'] or machine['machine']}, {machine['system']}, "
    text = f"Measured on {text}Python {machine['python']}, {listed}{f' (sources {sources})' if sources else ''}."
    if sessions := about.get("sessions"):
        jobs = " or ".join(
            str(number) for number in sorted({session["jobs"] for session in sessions})
        )
        minutes = sum(session["seconds"] for session in sessions) / 60.0
        number = sum(session["trials"] for session in sessions)
        memory = f"{about['peak_memory_mb']:.0f} MB"
        text += f" {number} trials, {jobs} at a time, took {minutes:.1f} min and up to {memory} a process."
    return text


def _groups(records: Sequence[Record], scenes: Mapping[str, str]) -> list[tuple[str, list[Record]]]:
    """Return name and records of every scene, and of all of them if there are several."""
    groups = [
        (name, [record for record in records if record["scene"] == scene])
        for scene, name in scenes.items()
    ]
    return [*groups, ("all", list(records))] if len(groups) > 1 else groups


def _spread(values: Sequence[float]) -> str:
    first, median, third = quartiles(values)
    return f"{median:.2f} ({first:.2f}–{third:.2f})" if values else "–"
