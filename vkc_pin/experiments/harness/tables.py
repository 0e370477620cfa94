"""Tabulates results as CSV and Markdown."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vkc_pin.experiments.harness.record import Record, distribution

EFFORTS = {
    "base_path_length": "base [m]",
    "base_path_length_l1": "base |dx|+|dy| [m]",
    "arm_path_length": "arm [rad]",
}
"""Compared path lengths: field → name."""
TIMES = {
    "time_initialization": "initial guesses",
    "time_coal": "coal",
    "time_casadi": "CasADi",
    "time_ipopt": "Ipopt",
    "time_validation": "validation",
}
"""Parts of planning time: field → name. The rest is problem setup and retiming."""
JUDGED = "Success is the result of the independent validation."
_LEAST = 1e-6  # smallest difference, in any unit, of a lower value


def to_csv(records: Sequence[Record]) -> str:
    """Return records as CSV with a column for every field; values other than text are JSON."""
    stream = io.StringIO()
    columns = list(dict.fromkeys(field for record in records for field in record))
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    for record in records:
        writer.writerow({field: _to_text(value) for field, value in record.items()})
    return stream.getvalue()


def _to_text(value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return json.dumps(value, ensure_ascii=False)


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]], *, text: int = 1) -> str:
    """Return a Markdown table whose first `text` columns are aligned left."""
    rule = ["---" if column < text else "---:" for column in range(len(head))]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |"
        for row in (head, rule, *rows)
    )


def compute_wilson_interval(good: int, number: int) -> tuple[float, float]:
    """Return Wilson's 95 % confidence interval of a success rate; (0, 1) without trials."""
    if number == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest

    interval = binomtest(good, number).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def compute_quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return first quartile, median and third quartile; NaN without values."""
    found = np.percentile(values, (25, 50, 75)) if len(values) else np.full(3, np.nan)
    first, median, third = found.tolist()
    return first, median, third


def select(records: Iterable[Record], **fields: Any) -> list[Record]:
    """Return the records with these values of fields."""
    wanted = fields.items()
    return [record for record in records if all(record.get(k) == value for k, value in wanted)]


def count(records: Sequence[Record], field: str = "success") -> str:
    """Count the records in which a field is true, as "2 of 3"."""
    return f"{sum(bool(record.get(field)) for record in records)} of {len(records)}"


def format_medians(records: Sequence[Record], *fields: str) -> list[str]:
    """Format the medians of fields."""
    return [format_decimal(distribution(records, field)[0]) for field in fields]


def join_sections(about: Mapping[str, Any], *parts: str) -> str:
    """Join sections, followed by machine and versions."""
    return "\n\n".join([*parts, describe_run(about)]) + "\n"


def format_decimal(value: float) -> str:
    """Format a number with two decimals, or a dash for NaN and infinity."""
    return f"{value:.2f}" if np.isfinite(value) else "–"


def compute_mean_and_deviation(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and sample standard deviation (n − 1); NaN for too few values."""
    mean = float(np.mean(values)) if len(values) else float("nan")
    return mean, float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def count_failures(records: Iterable[Record]) -> str:
    """Return the kinds of failures and their counts, most frequent first."""
    kinds = Counter[str]()
    for record in records:
        if not record["success"]:
            status, blame = str(record["status"]), str(record.get("failed_constraint") or "")
            kinds[status if blame in ("", status) else f"{status} ({blame.split()[0]})"] += 1
    order = sorted(kinds.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{kind} {number}" for kind, number in order) or "none"


def count_timeouts(records: Sequence[Record]) -> list[str]:
    """Return the number of trials that ended with the time limit, and the other failures."""
    others = [record for record in records if record["status"] != "time limit"]
    return [str(len(records) - len(others)), count_failures(others)]


def methods_table(
    records: Sequence[Record], scenes: Mapping[str, str], methods: Sequence[str]
) -> str:
    """Tabulate success, planning time, path length and failures by scene and method.

    Planning times are those of all trials, path lengths those of successes.
    """
    rows = []
    for name, group in _groups(records, scenes):
        for method in methods:
            if own := select(group, method=method):
                times = map(format_decimal, distribution(own, "planning_time"))
                lengths = format_medians(
                    select(own, success=True), "base_path_length", "arm_path_length"
                )
                rows.append([name, method, count(own), *times, *lengths, *count_timeouts(own)])
    head = ["scene", "method", "success", "time, median [s]", "95th percentile [s]"]
    return format_table([*head, "base [m]", "arm [rad]", "timed out", "failures"], rows, text=2)


def find_common_successes(
    records: Iterable[Record], methods: Sequence[str]
) -> list[tuple[Record, ...]]:
    """Return the records of methods at the same scene, start and repeat where all succeed."""
    found: dict[str, dict[tuple[Any, ...], Record]] = {method: {} for method in methods}
    for record in records:
        if record["success"] and record["method"] in found:
            place = record["scene"], record["number"], record.get("repeat", 0)
            found[record["method"]][place] = record
    places = [place for place in found[methods[0]] if all(place in own for own in found.values())]
    return [tuple(found[method][place] for method in methods) for place in places]


def count_lower(pairs: Sequence[tuple[Record, ...]], field: str) -> int:
    """Count pairs whose first value is lower than the second, beyond rounding."""
    return sum(float(one[field]) < float(other[field]) - _LEAST for one, other in pairs)


def comparison_table(
    records: Sequence[Record],
    scenes: Mapping[str, str],
    methods: tuple[str, str],
    names: tuple[str, str],
) -> str:
    """Compare path lengths of two methods, with displayed names, where both succeed."""
    rows = []
    for name, group in _groups(records, scenes):
        both = find_common_successes(group, methods)
        for field, shown in EFFORTS.items():
            spreads = [_spread([float(pair[k][field]) for pair in both]) for k in (0, 1)]
            rows.append([name, shown, *spreads, f"{count_lower(both, field)} of {len(both)}"])
    head = ["scene", "path length", *(f"{name}: median (quartiles)" for name in names)]
    return format_table([*head, f"lower with {names[0]}"], rows, text=2)


def describe_run(about: Mapping[str, Any]) -> str:
    """Return machine, versions and duration of a run in sentences."""
    machine, versions = about["machine"], {**about["versions"]}
    sources = versions.pop("sources", None)
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    processor = machine["processor"] or machine["machine"]
    text = f"Measured on {machine['cores']} cores of {processor}, {machine['system']}, "
    text += f"Python {machine['python']}, {listed}{f' (sources {sources})' if sources else ''}."
    if sessions := about.get("sessions"):
        jobs = " or ".join(str(jobs) for jobs in sorted({session["jobs"] for session in sessions}))
        minutes = sum(session["seconds"] for session in sessions) / 60.0
        text += f" {sum(session['trials'] for session in sessions)} trials, {jobs} at a time, "
        text += f"took {minutes:.1f} min and up to {about['peak_memory_mb']:.0f} MB a process."
    return text


def _groups(records: Sequence[Record], scenes: Mapping[str, str]) -> list[tuple[str, list[Record]]]:
    """Return name and records of each scene, and of all if there are several."""
    groups = [(name, select(records, scene=scene)) for scene, name in scenes.items()]
    return [*groups, ("all", list(records))] if len(groups) > 1 else groups


def _spread(values: Sequence[float]) -> str:
    first, median, third = compute_quartiles(values)
    return f"{median:.2f} ({first:.2f}–{third:.2f})" if values else "–"
