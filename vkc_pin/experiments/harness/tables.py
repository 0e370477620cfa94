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
# smallest difference, in any unit, of a lower value
_LEAST = 1e-6


def to_csv(records: Sequence[Record]) -> str:
    """Return records as CSV with a column for every field; values other than text are JSON."""
    stream = io.StringIO()
    columns: dict[str, None] = {}  # a set in the order of insertion
    for record in records:
        columns.update(dict.fromkeys(record))
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    for record in records:
        writer.writerow({field: _to_text(value) for field, value in record.items()})
    return stream.getvalue()


def _to_text(value: Any) -> str:
    """Return a cell of the CSV file."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False)


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]], *, text: int = 1) -> str:
    """Return a Markdown table whose first `text` columns are aligned left."""
    rule = ["---" if column < text else "---:" for column in range(len(head))]
    lines: list[str] = []
    for row in (head, rule, *rows):
        cells = [str(cell).replace("|", "\\|") for cell in row]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def compute_wilson_interval(good: int, number: int) -> tuple[float, float]:
    """Return Wilson's 95 % confidence interval of a success rate; (0, 1) without trials."""
    if number == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest

    interval = binomtest(good, number).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def compute_quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return first quartile, median and third quartile; NaN without values."""
    if not len(values):
        return float("nan"), float("nan"), float("nan")
    first, median, third = np.percentile(values, (25, 50, 75)).tolist()
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
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")
    return mean, deviation


def count_failures(records: Iterable[Record]) -> str:
    """Return the kinds of failures and their counts, most frequent first."""
    kinds = Counter[str]()
    for record in records:
        if record["success"]:
            continue
        status = str(record["status"])
        constraint = str(record.get("failed_constraint") or "")
        if constraint in ("", status):
            kinds[status] += 1
        else:
            kinds[f"{status} ({constraint.split()[0]})"] += 1
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
    rows: list[list[str]] = []
    for name, group in _group_by_scene(records, scenes):
        for method in methods:
            own = select(group, method=method)
            if not own:
                continue
            median, late = distribution(own, "planning_time")
            times = [format_decimal(median), format_decimal(late)]
            successes = select(own, success=True)
            lengths = format_medians(successes, "base_path_length", "arm_path_length")
            rows.append([name, method, count(own), *times, *lengths, *count_timeouts(own)])
    head = ["scene", "method", "success", "time, median [s]", "95th percentile [s]"]
    head += ["base [m]", "arm [rad]", "timed out", "failures"]
    return format_table(head, rows, text=2)


def find_common_successes(
    records: Iterable[Record], methods: Sequence[str]
) -> list[tuple[Record, ...]]:
    """Return the records of methods at the same scene, start and repeat where all succeed."""
    found: dict[str, dict[tuple[Any, ...], Record]] = {method: {} for method in methods}
    for record in records:
        if record["success"] and record["method"] in found:
            trial = (record["scene"], record["number"], record.get("repeat", 0))
            found[record["method"]][trial] = record
    common: list[tuple[Record, ...]] = []
    for trial in found[methods[0]]:
        if all(trial in own for own in found.values()):
            common.append(tuple(found[method][trial] for method in methods))
    return common


def count_lower(pairs: Sequence[tuple[Record, ...]], field: str) -> int:
    """Count pairs whose first value is lower than the second, beyond rounding."""
    lower = [pair for pair in pairs if float(pair[0][field]) < float(pair[1][field]) - _LEAST]
    return len(lower)


def comparison_table(
    records: Sequence[Record],
    scenes: Mapping[str, str],
    methods: tuple[str, str],
    names: tuple[str, str],
) -> str:
    """Compare path lengths of two methods, with displayed names, where both succeed."""
    rows: list[list[str]] = []
    for name, group in _group_by_scene(records, scenes):
        both = find_common_successes(group, methods)
        for field, shown in EFFORTS.items():
            first = _format_quartiles([float(pair[0][field]) for pair in both])
            second = _format_quartiles([float(pair[1][field]) for pair in both])
            lower = f"{count_lower(both, field)} of {len(both)}"
            rows.append([name, shown, first, second, lower])
    head = ["scene", "path length", *(f"{name}: median (quartiles)" for name in names)]
    return format_table([*head, f"lower with {names[0]}"], rows, text=2)


def describe_run(about: Mapping[str, Any]) -> str:
    """Return machine, versions and duration of a run in sentences."""
    machine = about["machine"]
    versions = dict(about["versions"])
    sources = versions.pop("sources", None)
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    if sources:
        listed += f" (sources {sources})"
    processor = machine["processor"] or machine["machine"]
    text = f"Measured on {machine['cores']} cores of {processor}, {machine['system']}, "
    text += f"Python {machine['python']}, {listed}."
    sessions = about.get("sessions")
    if sessions:
        jobs = sorted({session["jobs"] for session in sessions})
        at_a_time = " or ".join(str(number) for number in jobs)
        trials = sum(session["trials"] for session in sessions)
        minutes = sum(session["seconds"] for session in sessions) / 60.0
        text += f" {trials} trials, {at_a_time} at a time, took {minutes:.1f} min and up to "
        text += f"{about['peak_memory_mb']:.0f} MB a process."
    return text


def _group_by_scene(
    records: Sequence[Record], scenes: Mapping[str, str]
) -> list[tuple[str, list[Record]]]:
    """Return name and records of each scene, and of all if there are several."""
    groups = [(name, select(records, scene=scene)) for scene, name in scenes.items()]
    if len(groups) > 1:
        groups.append(("all", list(records)))
    return groups


def _format_quartiles(values: Sequence[float]) -> str:
    """Format the median of values, with their quartiles; a dash without values."""
    if not values:
        return "–"
    first, median, third = compute_quartiles(values)
    return f"{median:.2f} ({first:.2f}–{third:.2f})"
